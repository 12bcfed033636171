"""A cart that balances two links, one on top of the other: the equations of motion and the environment.

Rule: q = (x, θ, φ). Both angles are absolute; 0 is upright, and positive is towards +x. At the end of each massless link
is a mass M with inertia I. The Lagrangian

    L = ½ m ẋ² + ½ M (v₁² + v₂²) + ½ I (θ̇² + φ̇²) − M g l (2 cos θ + cos φ),   v₁, v₂ the speeds of the two masses,

gives M(q) q̈ + c(q, q̇) = (F − friction · ẋ, 0, 0). A step applies one force for `dt_s` seconds, in `substeps` equal steps
of the classical Runge–Kutta method of fourth order. The code uses Python floats, because for three unknowns they are faster
than arrays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded

from millrace.extras.envs.double_pendulum_screen import Screen
from millrace.protocol.arrays import Doubles, Floats

PendulumState = tuple[
    float, float, float, float, float, float
]  # x_m, theta_rad, phi_rad, and their derivatives, each per second
Accelerations = Callable[[float, float, float, float, float, float], tuple[float, float, float]]

DT_S = 0.02
SUBSTEPS = 2
SPEED_LIMIT = 50.0  # m/s and rad/s; far above the speeds that the force can reach on the track


@dataclass(frozen=True)
class Physics:
    """The constants of the Lagrangian. The friction force is `friction_Ns_m` times the cart's speed."""

    cart_kg: float = 1.0
    link_kg: float = 0.1
    link_m: float = 0.5
    inertia_kgm2: float = 0.002
    gravity_m_s2: float = 9.81
    friction_Ns_m: float = 1.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            positive = name in {"cart_kg", "link_kg", "link_m"}
            if not (value > 0 if positive else value >= 0) or not math.isfinite(value):
                raise ValueError(f"{name}: expected a finite number {'above' if positive else 'of at least'} 0, got {value}")


def accelerations(physics: Physics) -> Accelerations:
    """The function (θ, φ, ẋ, θ̇, φ̇, F) -> (ẍ, θ̈, φ̈), which solves M(q) q̈ = (F − friction · ẋ, 0, 0) − c(q, q̇)."""
    sin = math.sin
    cos = math.cos
    friction = physics.friction_Ns_m
    ml = physics.link_kg * physics.link_m
    ml2 = ml * physics.link_m
    mgl = ml * physics.gravity_m_s2
    m11 = physics.cart_kg + 2 * physics.link_kg
    m22 = 2 * ml2 + physics.inertia_kgm2
    m33 = ml2 + physics.inertia_kgm2
    m22_m33 = m22 * m33

    def solve(
        theta: float, phi: float, x_dot: float, theta_dot: float, phi_dot: float, force: float
    ) -> tuple[float, float, float]:
        sin_theta = sin(theta)
        cos_theta = cos(theta)
        sin_phi = sin(phi)
        cos_phi = cos(phi)
        m12 = 2 * ml * cos_theta
        m13 = ml * cos_phi
        m23 = ml2 * (cos_theta * cos_phi + sin_theta * sin_phi)
        turning = ml2 * (sin_theta * cos_phi - cos_theta * sin_phi)
        theta_dot2 = theta_dot * theta_dot
        phi_dot2 = phi_dot * phi_dot
        f1 = force - friction * x_dot + ml * (2 * sin_theta * theta_dot2 + sin_phi * phi_dot2)
        f2 = 2 * mgl * sin_theta - turning * phi_dot2
        f3 = mgl * sin_phi + turning * theta_dot2
        # The cofactors of M, which is symmetric.
        a11 = m22_m33 - m23 * m23
        a12 = m13 * m23 - m12 * m33
        a13 = m12 * m23 - m13 * m22
        a22 = m11 * m33 - m13 * m13
        a23 = m12 * m13 - m11 * m23
        a33 = m11 * m22 - m12 * m12
        scale = 1 / (m11 * a11 + m12 * a12 + m13 * a13)
        return (
            (a11 * f1 + a12 * f2 + a13 * f3) * scale,
            (a12 * f1 + a22 * f2 + a23 * f3) * scale,
            (a13 * f1 + a23 * f2 + a33 * f3) * scale,
        )

    return solve


def mass_matrix(physics: Physics, theta_rad: float = 0.0, phi_rad: float = 0.0) -> Doubles:
    """The mass matrix M(q) [3, 3], which multiplies (ẍ, θ̈, φ̈)."""
    ml = physics.link_kg * physics.link_m
    ml2 = ml * physics.link_m
    inertia = physics.inertia_kgm2
    m12 = 2 * ml * math.cos(theta_rad)
    m13 = ml * math.cos(phi_rad)
    m23 = ml2 * math.cos(theta_rad - phi_rad)
    cart = physics.cart_kg + 2 * physics.link_kg
    return np.array([[cart, m12, m13], [m12, 2 * ml2 + inertia, m23], [m13, m23, ml2 + inertia]])


def energy(physics: Physics, state: Sequence[float]) -> float:
    """Energy in joules: ½ q̇ᵀ M(q) q̇ + M g l (2 cos θ + cos φ). Constant without force and friction."""
    _, theta_rad, phi_rad, *speeds = state
    speed = np.array(speeds)
    mgl = physics.link_kg * physics.gravity_m_s2 * physics.link_m
    potential = mgl * (2 * math.cos(theta_rad) + math.cos(phi_rad))
    return float(speed @ mass_matrix(physics, theta_rad, phi_rad) @ speed) / 2 + potential


def linear_model(physics: Physics) -> tuple[Doubles, Doubles]:
    """A [6, 6] and B [6] of d state/dt = A state + B F, linearized at the upright position.

    There, sin α = α, cos α = 1, and squared speeds are 0.
    """
    mgl = physics.link_kg * physics.gravity_m_s2 * physics.link_m
    forces = [[0, 0, 0, -physics.friction_Ns_m, 0, 0, 1], [0, 2 * mgl, 0, 0, 0, 0, 0], [0, 0, mgl, 0, 0, 0, 0]]
    solved = np.linalg.solve(mass_matrix(physics), np.array(forces))  # [3, 7]: columns for the state, then for F
    return np.vstack([np.eye(3, 6, 3), solved[:, :6]]), np.append(np.zeros(3), solved[:, 6])


def linear_accelerations(physics: Physics) -> Accelerations:
    """A function like the one that `accelerations` returns, but for the linear model."""
    a, b = linear_model(physics)
    (x1, x2, x3, x4), (t1, t2, t3, t4), (p1, p2, p3, p4) = np.column_stack([a[3:, 1:4], b[3:]]).tolist()

    def solve(
        theta: float, phi: float, x_dot: float, theta_dot: float, phi_dot: float, force: float
    ) -> tuple[float, float, float]:
        return (
            x1 * theta + x2 * phi + x3 * x_dot + x4 * force,
            t1 * theta + t2 * phi + t3 * x_dot + t4 * force,
            p1 * theta + p2 * phi + p3 * x_dot + p4 * force,
        )

    return solve


def advance(solve: Accelerations, state: PendulumState, force: float, h: float) -> PendulumState:
    """One Runge–Kutta step of fourth order, `h` seconds long: k₁ to k₄ are (speeds, accelerations) at its four points."""
    x, t, p, u1, v1, w1 = state
    half = h / 2
    a1, b1, c1 = solve(t, p, u1, v1, w1, force)
    u2 = u1 + half * a1
    v2 = v1 + half * b1
    w2 = w1 + half * c1
    a2, b2, c2 = solve(t + half * v1, p + half * w1, u2, v2, w2, force)
    u3 = u1 + half * a2
    v3 = v1 + half * b2
    w3 = w1 + half * c2
    a3, b3, c3 = solve(t + half * v2, p + half * w2, u3, v3, w3, force)
    u4 = u1 + h * a3
    v4 = v1 + h * b3
    w4 = w1 + h * c3
    a4, b4, c4 = solve(t + h * v3, p + h * w3, u4, v4, w4, force)
    sixth = h / 6
    return (
        x + sixth * (u1 + 2 * (u2 + u3) + u4),
        t + sixth * (v1 + 2 * (v2 + v3) + v4),
        p + sixth * (w1 + 2 * (w2 + w3) + w4),
        u1 + sixth * (a1 + 2 * (a2 + a3) + a4),
        v1 + sixth * (b1 + 2 * (b2 + b3) + b4),
        w1 + sixth * (c1 + 2 * (c2 + c3) + c4),
    )


class CartDoublePendulum(gymnasium.Env[Floats, Floats]):
    """Keep both links upright by pushing the cart.

    Action: Box [1] float32, the force divided by `force_limit_N`. It is clipped to -1 to 1.

    Observation: Box [6] float32, (x_m, theta_rad, phi_rad, x_dot_m_s, theta_dot_rad_s, phi_dot_rad_s). θ is the angle of the
    lower link, φ that of the upper one.

    Start: each of these six numbers is sampled uniformly from ±`start_spread`.

    Reward: 1 − 0.3 (x / track)² − 0.3 (θ² + φ²) / 2 angle_limit² − 0.05 action², which is between 0.35 and 1. The step that
    terminates the episode has reward 0.

    Terminated: if |x| is above `track_m`, |θ| or |φ| above `angle_limit_rad`, or a speed above `SPEED_LIMIT`. Truncated:
    never, but `gymnasium.make` adds a time limit of 500 steps (10 s).

    `linearised`: simulate the linear model. Other keyword arguments are the fields of `Physics`.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": round(1 / DT_S)}

    def __init__(
        self,
        render_mode: str | None = None,
        *,
        linearised: bool = False,
        force_limit_N: float = 20.0,
        dt_s: float = DT_S,
        substeps: int = SUBSTEPS,
        track_m: float = 2.4,
        angle_limit_rad: float = 0.5,
        start_spread: float = 0.05,
        **physics: float,
    ) -> None:
        self.physics = Physics(**physics)
        for name, value in {
            "force_limit_N": force_limit_N, "dt_s": dt_s, "substeps": substeps, "track_m": track_m,
            "angle_limit_rad": angle_limit_rad,
        }.items():  # fmt: skip
            if not 0 < value < math.inf:
                raise ValueError(f"{name}: expected a finite number above 0, got {value}")
        if not 0 <= start_spread < min(track_m, angle_limit_rad):
            raise ValueError(f"start_spread: expected from 0 to below track_m and angle_limit_rad, got {start_spread}")
        self.render_mode = render_mode
        self.metadata = self.metadata | {"render_fps": round(1 / dt_s)}
        self.force_limit_N = force_limit_N
        self.dt_s = dt_s
        self.substeps = substeps
        self.track_m = track_m
        self.angle_limit_rad = angle_limit_rad
        self.start_spread = start_spread
        # Twice the limits of x and the angles, so that even an episode's last observation is inside the space.
        self._high = np.array([2 * track_m, *[2 * angle_limit_rad] * 2, *[SPEED_LIMIT] * 3], np.float32)
        self.observation_space = spaces.Box(-self._high, self._high, dtype=np.float32)
        self.action_space = spaces.Box(-1, 1, (1,), np.float32)
        self.state: PendulumState | None = None
        self.push = 0.0  # last action, clipped
        self._solve = (linear_accelerations if linearised else accelerations)(self.physics)
        self._x_cost = 0.3 / track_m**2
        self._angle_cost = 0.15 / angle_limit_rad**2
        self._screen: Screen | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        """Start an episode nearly upright."""
        super().reset(seed=seed)
        x, theta, phi, *speeds = self.np_random.uniform(-self.start_spread, self.start_spread, 6).tolist()
        self.state = (x, theta, phi, *speeds)
        self.push = 0.0
        if self.render_mode == "human":
            self.render()
        return np.array(self.state, np.float32), {}

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Push the cart for `dt_s` seconds."""
        state = self.state
        if state is None:
            raise ResetNeeded("CartDoublePendulum: step() before reset(); call reset() first")
        push = float(action[0])
        if not -1 <= push <= 1:
            if not math.isfinite(push):
                raise ValueError(f"CartDoublePendulum: action: expected a finite number from -1 to 1, got {push}")
            push = math.copysign(1.0, push)
        force = self.force_limit_N * push
        h = self.dt_s / self.substeps
        for _ in range(self.substeps):
            state = advance(self._solve, state, force, h)
        self.state = state
        self.push = push
        x, theta, phi, x_dot, theta_dot, phi_dot = state
        up = (
            abs(x) <= self.track_m
            and abs(theta) <= self.angle_limit_rad
            and abs(phi) <= self.angle_limit_rad
            and abs(x_dot) <= SPEED_LIMIT
            and abs(theta_dot) <= SPEED_LIMIT
            and abs(phi_dot) <= SPEED_LIMIT
        )
        observation = np.array(state, np.float32)
        reward = 0.0
        if up:
            reward = 1 - self._x_cost * x * x - self._angle_cost * (theta * theta + phi * phi) - 0.05 * push * push
        else:
            observation = observation.clip(-self._high, self._high)
        if self.render_mode == "human":
            self.render()
        return observation, reward, not up, False, {}

    def render(self) -> Any:
        """With "rgb_array", return a picture [400, 600, 3] uint8. With "human", show it in a window and return None."""
        if self.render_mode is None:
            gymnasium.logger.warn(
                'CartDoublePendulum: render() needs a render_mode, "rgb_array" or "human", given to make()'
            )
            return None
        if self.state is None:
            raise ResetNeeded("CartDoublePendulum: render() before reset(); call reset() first")
        if self._screen is None:
            self._screen = Screen(self.render_mode == "human", self.track_m, self.physics.link_m)
        return self._screen.show(self.state, self.push, self.metadata["render_fps"])

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._screen is not None:
            self._screen.close()
            self._screen = None
