"""The double pendulum on a cart: its equations against sympy's, its energy, LQR, and gymnasium's interface.

sympy and pygame are no dependencies of millrace: without them the tests that need them are skipped.
"""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
import pytest
from gymnasium.error import DependencyNotInstalled, ResetNeeded
from gymnasium.utils.env_checker import check_env

import millrace.extras.envs
from millrace.extras.envs.double_pendulum import (
    DT_S,
    SPEED_LIMIT,
    SUBSTEPS,
    CartDoublePendulum,
    PendulumState,
    Physics,
    accelerations,
    advance,
    energy,
    linear_accelerations,
    linear_model,
)
from millrace.protocol.arrays import Doubles
from tests.support.envs.lqr import LQR, discrete_model, lqr_gain

ROOT = Path(__file__).parents[3]
ID = "millrace/CartDoublePendulum-v0"
FREE = Physics(friction_Ns_m=0)
ODD = Physics(cart_kg=0.7, link_kg=0.3, link_m=0.8, inertia_kgm2=0.05, gravity_m_s2=3.7, friction_Ns_m=0.4)
ANYWHERE = np.array([3, np.pi, np.pi, 4, 8, 8])
NEAR = np.full(6, 0.05)


def state_within(spread: Doubles, seed: int) -> PendulumState:
    x, theta, phi, *speeds = np.random.default_rng(seed).uniform(-spread, spread).tolist()
    return (x, theta, phi, *speeds)


def make(**keywords: Any) -> CartDoublePendulum:
    env = CartDoublePendulum(**keywords)
    env.reset(seed=1)
    return env


def push(part: float = 0.0) -> npt.NDArray[np.float32]:
    return np.array([part], np.float32)


# The equations of motion --------------------------------------------------------------------------------------------------


class Derived:
    """What sympy makes of the Lagrangian: functions of the six constants, the force and the six numbers of a state."""

    def __init__(self) -> None:
        sympy = pytest.importorskip("sympy")
        t = sympy.Symbol("t")
        constants = sympy.symbols("m M l I g friction F")
        m, mass, length, inertia, g, friction, force = constants
        q = [sympy.Function(name)(t) for name in ("x", "theta", "phi")]
        x, theta, phi = q
        low = sympy.Matrix([x + length * sympy.sin(theta), length * sympy.cos(theta)])
        high = low + length * sympy.Matrix([sympy.sin(phi), sympy.cos(phi)])
        masses = sum(speed.dot(speed) for speed in (low.diff(t), high.diff(t)))
        kinetic = (m * x.diff(t) ** 2 + mass * masses + inertia * (theta.diff(t) ** 2 + phi.diff(t) ** 2)) / 2
        potential = mass * g * (low[1] + high[1])
        lagrangian = kinetic - potential
        applied = (force - friction * x.diff(t), 0, 0)
        equations = [
            sympy.expand(lagrangian.diff(c.diff(t)).diff(t) - lagrangian.diff(c) - applied_to)
            for c, applied_to in zip(q, applied, strict=True)
        ]
        second, first, zeroth = (sympy.symbols(f"{name}_x {name}_theta {name}_phi") for name in ("acc", "vel", "pos"))
        plain = [(c.diff(t, 2), s) for c, s in zip(q, second, strict=True)]
        plain += [(c.diff(t), s) for c, s in zip(q, first, strict=True)] + list(zip(q, zeroth, strict=True))
        arguments = [*constants, *zeroth, *first]
        residual = sympy.Matrix(equations).subs(plain)
        self.mass = sympy.lambdify(arguments, residual.jacobian(second))
        self.rest = sympy.lambdify(arguments, residual.subs(dict.fromkeys(second, 0)))
        self.energy = sympy.lambdify(arguments, (kinetic + potential).subs(plain))
        # The linearisation at the top, by the rules of the notebook: sin α = α, cos α = 1, squares of speeds are 0.
        flat = sympy.Matrix([sympy.simplify(row) for row in residual])
        difference = zeroth[1] - zeroth[2]
        for sine, cosine, angle in [(sympy.sin(a), sympy.cos(a), a) for a in (difference, *zeroth[1:])]:
            flat = flat.subs([(sine, angle), (cosine, 1)])
        flat = flat.subs([(vel**2, 0) for vel in first[1:]])
        assert not flat.atoms(sympy.sin, sympy.cos)
        self.linear_mass = sympy.lambdify(arguments, flat.jacobian(second))
        self.linear_rest = sympy.lambdify(arguments, flat.subs(dict.fromkeys(second, 0)))

    @staticmethod
    def solved(
        mass: Callable[..., Any], rest: Callable[..., Any], physics: Physics, state: PendulumState, force: float
    ) -> Doubles:
        p = physics
        constants = (p.cart_kg, p.link_kg, p.link_m, p.inertia_kgm2, p.gravity_m_s2, p.friction_Ns_m, force)
        return np.linalg.solve(np.array(mass(*constants, *state), float), -np.ravel(rest(*constants, *state)))


@pytest.fixture(scope="session")
def derived() -> Derived:
    return Derived()


@pytest.mark.parametrize("physics", [Physics(), ODD])
def test_the_closed_form_is_what_the_lagrangian_says(derived: Derived, physics: Physics) -> None:
    solve = accelerations(physics)
    for seed in range(200):
        state, force = state_within(ANYWHERE, seed), float(np.random.default_rng([seed]).uniform(-20, 20))
        expected = derived.solved(derived.mass, derived.rest, physics, state, force)
        np.testing.assert_allclose(solve(*state[1:], force), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("physics", [Physics(), ODD])
def test_the_energy_is_that_of_the_lagrangian(derived: Derived, physics: Physics) -> None:
    p = physics
    for seed in range(50):
        state = state_within(ANYWHERE, seed)
        expected = derived.energy(p.cart_kg, p.link_kg, p.link_m, p.inertia_kgm2, p.gravity_m_s2, 0, 0, *state)
        assert energy(physics, state) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("physics", [Physics(), ODD])
def test_the_linear_model_is_the_one_of_the_notebook(derived: Derived, physics: Physics) -> None:
    a, b = linear_model(physics)
    solve = linear_accelerations(physics)
    for seed in range(50):
        state, force = state_within(NEAR, seed), float(np.random.default_rng([seed]).uniform(-20, 20))
        expected = derived.solved(derived.linear_mass, derived.linear_rest, physics, state, force)
        np.testing.assert_allclose(a @ state + b * force, [*state[3:], *expected], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(solve(*state[1:], force), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("physics", [Physics(), ODD])
def test_the_linear_model_is_the_jacobian_at_the_top(physics: Physics) -> None:
    a, b = linear_model(physics)
    solve, h = accelerations(physics), 1e-5
    columns = [np.subtract(solve(*row), solve(*-row)) / (2 * h) for row in h * np.eye(6)]  # by θ, φ, ẋ, θ̇, φ̇, F
    np.testing.assert_allclose(np.column_stack([a[3:, 1:], b[3:]]), np.transpose(columns), rtol=1e-7, atol=1e-7)
    assert not a[:, 0].any()  # nothing depends on where the cart is
    np.testing.assert_array_equal(a[:3], np.eye(3, 6, 3))


# Time steps ---------------------------------------------------------------------------------------------------------------


def after(seconds: float, h: float, state: PendulumState, physics: Physics = FREE, force: float = 0.0) -> PendulumState:
    solve = accelerations(physics)
    for _ in range(round(seconds / h)):
        state = advance(solve, state, force, h)
    return state


def drift(h: float, seed: int, seconds: float = 10.0) -> float:
    """The largest change of energy, in joules, while the links fall and whirl."""
    solve, state = accelerations(FREE), state_within(NEAR, seed)
    first, worst = energy(FREE, state), 0.0
    for _ in range(round(seconds / h)):
        state = advance(solve, state, 0.0, h)
        worst = max(worst, abs(energy(FREE, state) - first))
    assert first > 1.4
    return worst


def test_energy_is_conserved_without_force_and_friction() -> None:
    assert max(drift(DT_S / SUBSTEPS, seed) for seed in range(10)) < 3e-3  # of 1.47 J above the middle, 2.94 J of fall


def test_shorter_steps_conserve_energy_better() -> None:
    coarse, fine = (max(drift(h, seed) for seed in range(3)) for h in (0.01, 0.005))
    assert fine < coarse / 12


def test_the_method_is_of_fourth_order() -> None:
    state = (0.0, 0.3, -0.2, 0.1, 0.4, -0.5)
    best = np.array(after(1.0, 1 / 3200, state, ODD, 2.0))
    errors = [np.abs(after(1.0, 1 / n, state, ODD, 2.0) - best).max() for n in (50, 100, 200)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.3)
    assert np.log2(errors[1] / errors[2]) == pytest.approx(4, abs=0.3)


def test_friction_takes_energy_away() -> None:
    state: PendulumState = (0.0, 0.05, 0.05, 1.0, 0.0, 0.0)
    energies = [energy(Physics(), after(n / 10, 0.01, state, Physics())) for n in range(0, 50, 10)]
    assert all(later < earlier for earlier, later in pairwise(energies))


def test_the_force_does_the_work_that_it_gives() -> None:
    state: PendulumState = (0.0, 0.05, -0.05, 0.0, 0.0, 0.0)
    moved = after(0.5, 0.001, state, FREE, 3.0)
    assert energy(FREE, moved) - energy(FREE, state) == pytest.approx(3.0 * moved[0], rel=1e-6)


def test_a_linearised_step_is_the_discrete_model() -> None:
    a, b = discrete_model(Physics())
    env = make(linearised=True)
    for seed in range(5):
        env.state = state_within(NEAR, seed)
        expected = a @ env.state + b * env.force_limit_N * 0.25
        env.step(push(0.25))
        assert env.state is not None
        np.testing.assert_allclose(env.state, expected, rtol=1e-12, atol=1e-14)


def test_near_the_top_the_linearised_environment_is_the_other_one_but_for_third_powers() -> None:
    def apart(size: float) -> float:
        ends = []
        for linearised in (False, True):
            env = make(linearised=linearised)
            env.state = (0.0, size, -size, 0.0, size, 0.0)
            env.step(push())
            ends.append(np.array(env.state))
        return float(np.abs(ends[0] - ends[1]).max())

    assert apart(0.1) > 1e-6
    assert apart(0.1) / apart(0.01) == pytest.approx(1000, rel=0.1)


# LQR ----------------------------------------------------------------------------------------------------------------------


def test_lqr_keeps_it_up_for_the_whole_episode() -> None:
    env = gymnasium.make(ID)
    assert isinstance(env.unwrapped, CartDoublePendulum)
    policy, returns = LQR(env.unwrapped), []
    for seed in range(100):
        observation, _ = env.reset(seed=seed)
        ended, total, steps = False, 0.0, 0
        while not ended:
            observation, reward, terminated, truncated, _ = env.step(policy(observation))
            total, steps, ended = total + float(reward), steps + 1, terminated or truncated
        assert (terminated, truncated, steps) == (False, True, 500), f"seed {seed}"
        returns.append(total)
    assert min(returns) > 499


def test_without_a_policy_it_falls() -> None:
    env = gymnasium.make(ID)
    for seed in range(20):
        env.reset(seed=seed)
        steps = [env.step(push()) for _ in range(200)]
        assert any(terminated for _, _, terminated, _, _ in steps), f"seed {seed}"


def test_the_gain_solves_the_riccati_equation_and_is_stable() -> None:
    physics, costs, force_cost = ODD, (1.0, 10.0, 10.0, 0.1, 0.1, 0.1), 0.01
    a, b = discrete_model(physics)
    gain = lqr_gain(physics, state_cost=costs, force_cost=force_cost)
    closed = a - np.outer(b, gain)
    assert np.abs(np.linalg.eigvals(a)).max() > 1 > np.abs(np.linalg.eigvals(closed)).max()
    # The cost to go under this gain, summed up (P = Q + K'RK + C'PC by doubling), and the gain that is best for it.
    p, power = np.diag(costs) + force_cost * np.outer(gain, gain), closed
    for _ in range(30):
        p, power = p + power.T @ p @ power, power @ power
    np.testing.assert_allclose(b @ p @ a / (force_cost + b @ p @ b), gain, rtol=1e-6)


def test_what_cannot_be_regulated_is_refused() -> None:
    with pytest.raises(ValueError, match="Riccati"), np.errstate(all="ignore"):
        lqr_gain(Physics(), state_cost=(np.nan,) * 6)


# The environment ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def no_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


@pytest.mark.usefixtures("no_screen")
@pytest.mark.parametrize("linearised", [False, True])
def test_gymnasium_finds_nothing_to_warn_about(linearised: bool) -> None:
    check_env(gymnasium.make(ID, linearised=linearised).unwrapped)


def test_the_whole_way_by_gymnasiums_name() -> None:
    env = gymnasium.make(f"millrace.extras.envs:{ID}", link_m=0.4, linearised=True)
    assert isinstance(env.unwrapped, CartDoublePendulum)
    assert env.unwrapped.physics == dataclasses.replace(Physics(), link_m=0.4)
    assert env.spec is not None
    assert env.spec.max_episode_steps == 500


def test_the_same_seed_is_the_same_episode() -> None:
    def episode(seed: int) -> list[list[float]]:
        env = make()
        observation, _ = env.reset(seed=seed)
        return [observation.tolist(), *(env.step(push(0.1 * n))[0].tolist() for n in range(5))]

    assert episode(3) == episode(3) != episode(4)


def test_starts_differ_and_are_near_upright() -> None:
    env = make(start_spread=0.1)
    starts = np.array([env.reset()[0] for _ in range(200)])
    assert np.unique(starts[:, 1]).size == 200
    assert 0.09 < np.abs(starts).max(0).min() <= np.abs(starts).max() <= 0.1


@pytest.mark.parametrize(
    ("index", "limit"), [(0, 2.4), (1, 0.5), (2, 0.5), (3, SPEED_LIMIT), (4, SPEED_LIMIT), (5, SPEED_LIMIT)]
)
@pytest.mark.parametrize("side", [-1, 1])
def test_beyond_a_limit_it_is_over(index: int, limit: float, side: int) -> None:
    env = make(dt_s=1e-9)  # hardly moves
    for part, over in ((0.999, False), (1.001, True), (1e6, True)):
        state = [0.0] * 6
        state[index] = side * limit * part
        env.state = tuple(state)  # type: ignore[assignment]
        observation, reward, terminated, truncated, _ = env.step(push())
        assert (terminated, truncated, reward == 0) == (over, False, over)
        assert observation in env.observation_space
        if part < 2 and index < 3:  # as it is, not as far as it may go
            np.testing.assert_array_equal(observation, np.array(env.state, np.float32))


def test_the_clock_truncates_and_does_not_terminate() -> None:
    env = gymnasium.make(ID, gravity_m_s2=0.0, start_spread=0.0)
    env.reset(seed=1)
    rows = [env.step(push()) for _ in range(500)]
    assert [truncated for *_, truncated, _ in rows] == [False] * 499 + [True]
    assert not any(terminated for _, _, terminated, _, _ in rows)
    assert {reward for _, reward, *_ in rows} == {1.0}


def test_the_reward_is_the_documented_one() -> None:
    env = make()
    env.state = (1.2, 0.2, -0.3, 0.5, 0.1, 0.2)
    _, reward, *_ = env.step(push(-0.5))
    x, theta, phi = env.state[:3]
    assert reward == pytest.approx(1 - 0.3 * (x / 2.4) ** 2 - 0.3 * (theta**2 + phi**2) / (2 * 0.5**2) - 0.05 * 0.5**2)


def test_the_worst_of_being_up_is_better_than_being_down() -> None:
    env = make(dt_s=1e-9)
    env.state = (2.3999, 0.4999, -0.4999, 0.0, 0.0, 0.0)
    assert 0.35 <= float(env.step(push(1.0))[1]) < 0.351


def test_a_push_beyond_the_limit_is_the_limit() -> None:
    ends = []
    for part in (1.0, 2.0, 1e30):
        env = make()
        env.step(push(-part))
        ends.append((env.state, env.push))
    assert ends[0] == ends[1] == ends[2]
    assert ends[0][1] == -1


@pytest.mark.parametrize("part", [np.nan, np.inf, -np.inf])
def test_a_push_that_is_no_number_is_refused(part: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        make().step(push(part))


def test_step_and_render_want_a_reset_first() -> None:
    for call in (partial(CartDoublePendulum().step, push()), CartDoublePendulum("rgb_array").render):
        with pytest.raises(ResetNeeded, match=r"call reset\(\) first"):
            call()


@pytest.mark.parametrize(
    "keywords",
    [{"cart_kg": 0}, {"friction_Ns_m": -1}, {"link_m": np.inf}, {"gravity_m_s2": np.nan}, {"dt_s": 0}, {"substeps": 0},
     {"force_limit_N": np.inf}, {"track_m": -1}, {"angle_limit_rad": np.nan}, {"start_spread": -1}, {"start_spread": 0.5}],
)  # fmt: skip
def test_constants_that_make_no_sense_are_refused(keywords: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(keywords))}: expected"):
        CartDoublePendulum(**keywords)


def test_unknown_keywords_are_refused() -> None:
    with pytest.raises(TypeError, match="colour"):
        CartDoublePendulum(colour=1)


def test_every_keyword_moves_what_it_names() -> None:
    def end(**keywords: Any) -> npt.NDArray[np.float32]:
        env = make(**keywords)
        env.state = (0.1, 0.2, -0.2, 0.3, 0.1, 0.4)
        return env.step(push(0.5))[0]

    different: list[dict[str, Any]] = [
        {"linearised": True}, {"dt_s": 0.01}, {"force_limit_N": 5.0}, {"cart_kg": 2.0}, {"link_kg": 0.2}, {"link_m": 0.6},
        {"inertia_kgm2": 0.01}, {"gravity_m_s2": 1.6}, {"friction_Ns_m": 0.0},
    ]  # fmt: skip
    ends = [tuple(end(**keywords).tolist()) for keywords in ({}, *different)]
    assert len(set(ends)) == len(ends)
    np.testing.assert_allclose(end(substeps=8), end(), rtol=1e-5)


# Pictures -----------------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("no_screen")
def test_a_picture() -> None:
    env = make(render_mode="rgb_array")
    first = env.render()
    assert (first.shape, first.dtype) == ((400, 600, 3), np.uint8)
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 10
    env.state = (-1.0, 0.3, 0.2, 0.0, 0.0, 0.0)
    env.step(push(1.0))
    second, (x, theta, phi, *_), metre = env.render(), env.state, 600 / 5.6  # the track, and 0.4 m on either side
    assert (first != second).any(2).sum() > 1000
    drawn = (second != second[0, 0]).any(2)
    top = int(np.flatnonzero(drawn.any(1))[0])
    tip = x + 0.5 * (np.sin(theta) + np.sin(phi))
    assert np.flatnonzero(drawn[top]).mean() == pytest.approx(300 + metre * tip, abs=2)
    joint, mass = 255, 10  # pixels: where the links begin, the radius of their ends
    assert top == pytest.approx(joint - metre * 0.5 * (np.cos(theta) + np.cos(phi)) - mass, abs=2)
    env.reset()
    assert env.push == 0
    env.close()
    env.close()
    assert env.render() is not None  # drawn on a new screen


@pytest.mark.usefixtures("no_screen")
def test_a_window() -> None:
    env = CartDoublePendulum("human", dt_s=0.001)
    env.reset(seed=1)
    env.step(push(0.1))
    assert env.render() is None
    env.close()


def test_without_a_render_mode_there_is_a_warning() -> None:
    with pytest.warns(UserWarning, match="render_mode"):
        assert make().render() is None


def test_without_pygame_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(DependencyNotInstalled, match=r"gymnasium\[classic-control\]"):
        make(render_mode="rgb_array").render()


def test_importing_it_is_cheap() -> None:
    asks = (
        f"import sys, {millrace.extras.envs.__name__}; assert 'millrace.extras.envs.double_pendulum' not in sys.modules;"
        f"import gymnasium; env = gymnasium.make('{ID}'); env.reset(seed=1); env.step(env.action_space.sample());"
        "assert not sys.modules.keys() & {'pygame', 'torch', 'scipy', 'sympy', 'tests.support.envs.lqr'}"
    )
    done = subprocess.run([sys.executable, "-c", asks], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
