"""The linear-quadratic regulator of the double pendulum, as a reference for learned policies. Pure; numpy only."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from millrace.extras.envs.double_pendulum import DT_S, SUBSTEPS, CartDoublePendulum, Physics, linear_model
from millrace.protocol.arrays import Doubles, Floats


def discrete_model(physics: Physics, dt_s: float = DT_S, substeps: int = SUBSTEPS) -> tuple[Doubles, Doubles]:
    """A [6, 6] and B [6] of state' = A state + B F: exactly one step of the linearized environment."""
    a, b = linear_model(physics)
    h = dt_s / substeps
    rate = np.zeros((7, 7))  # d/dt of the state and, in the last row, of the constant force
    rate[:6, :6], rate[:6, 6] = h * a, h * b
    term = step = np.eye(7)
    for n in range(1, 5):  # Runge–Kutta of fourth order is the exponential series up to its fourth power
        term = term @ rate / n
        step = step + term
    step = np.linalg.matrix_power(step, substeps)
    return step[:6, :6], step[:6, 6]


def lqr_gain(
    physics: Physics,
    dt_s: float = DT_S,
    substeps: int = SUBSTEPS,
    *,
    state_cost: Sequence[float] = (1, 10, 10, 0.1, 0.1, 0.1),
    force_cost: float = 0.01,
) -> Doubles:
    """K [6] of the force F = −K state that minimizes the sum of stateᵀ diag(state_cost) state + force_cost F².

    Iterates the discrete Riccati equation P = Q + Aᵀ P (A − B K), K = Bᵀ P A / (force_cost + Bᵀ P B) until P
    converges. Raises `ValueError` if it does not.
    """
    a, b = discrete_model(physics, dt_s, substeps)
    q = np.diag(np.asarray(state_cost, np.float64))
    p = q
    for _ in range(100_000):
        gain = b @ p @ a / (force_cost + b @ p @ b)
        last, p = p, q + a.T @ p @ (a - np.outer(b, gain))
        p = (p + p.T) / 2
        if np.abs(p - last).max() <= 1e-10 * np.abs(p).max():
            return np.asarray(gain)
        if not np.isfinite(p).all():
            break
    raise ValueError("the Riccati equation did not converge; check the costs and the physical constants")


class LQR:
    """The policy of `lqr_gain` for an environment: observation [6] to action [1]."""

    def __init__(self, env: CartDoublePendulum) -> None:
        self._gain = lqr_gain(env.physics, env.dt_s, env.substeps) / env.force_limit_N

    def __call__(self, observation: Floats) -> Floats:
        """The action, clipped to its space."""
        return np.clip([-self._gain @ observation], -1, 1).astype(np.float32)
