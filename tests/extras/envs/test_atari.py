"""Atari games: a single copy, ALE's vectorized form and envpool give the same screens, rewards and ends of episodes."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any, ClassVar

import numpy as np
import pytest
from gymnasium.vector import VectorEnv

from millrace.extras.envs import atari
from millrace.extras.envs.envpool import envpool_spec
from millrace.extras.envs.envpool_copies import EnvpoolCopies
from millrace.extras.envs.vector_copies import VectorCopies
from millrace.extras.envs.vectorized import make_native
from millrace.learner.config.config import Config
from millrace.learner.config.hyperparameters import PPOConfig
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.errors import UsageError
from millrace.protocol.specs import RunSpec
from millrace.workers.copies.env_copies import EnvCopies, LoopedCopies, copy_seed
from tests.support.in_process.collectors import bits, collect, no_pulse, random_collector
from tests.support.in_process.described import run_spec

envpool = pytest.mark.skipif(find_spec("envpool") is None, reason="envpool is not here: pip install envpool")
pytestmark = pytest.mark.skipif(
    find_spec("ale_py") is None or find_spec("cv2") is None, reason="no emulator: pip install ale-py opencv-python-headless"
)

KINDS = ["loop", "native", pytest.param("envpool", marks=envpool)]
OPEN: dict[str, Callable[[EnvSpec, int], EnvCopies]] = {
    "loop": lambda env, N: LoopedCopies([env.make] * N, no_pulse),
    "native": lambda env, N: VectorCopies(make_native(env, N)),
    "envpool": lambda env, N: EnvpoolCopies(envpool_spec(env), N),
}
BREAKOUT = EnvSpec("millrace/Atari-v0", {"game": "Breakout"})


@pytest.mark.parametrize(("game", "max_frames", "flag"), [("Pong", 600, "truncated"), ("Breakout", 108_000, "terminated")])
def test_the_vectorized_form_shows_rewards_and_ends_as_the_loop_does(
    game: str, max_frames: int, flag: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Screens, flags and reset rows, of episodes that begin alike; Breakout's end by themselves, Pong's by the clock."""
    monkeypatch.setattr(atari, "MAX_FRAMES", max_frames)
    N, env = 2, EnvSpec("millrace/Atari-v0", {"game": game, "noop_max": 0})
    one, other = OPEN["native"](env, N), OPEN["loop"](env, N)
    np.testing.assert_array_equal(one.reset([3, 4], no_pulse)[0], other.reset([3, 4], no_pulse)[0])
    generator, ended = np.random.default_rng(0), {"terminated": 0, "truncated": 0}
    for _ in range(350):
        actions = generator.integers(4, size=N)
        row, looped = one.step(actions, no_pulse), other.step(actions, no_pulse)
        np.testing.assert_array_equal(row.leaves[0], looped.leaves[0])
        assert row.reward.tolist() == looped.reward
        assert (row.terminated.tolist(), row.truncated.tolist()) == (looped.terminated, looped.truncated)
        for name in ended:
            ended[name] += int(np.count_nonzero(getattr(row, name)))
    assert [name for name, times in ended.items() if times > 1] == [flag]
    for copies in (one, other):
        copies.close()


SETTINGS = [
    *("fire_on_reset", "clip_rewards", "terminal_on_life_loss", "fire_after_life_loss"),
    *("fire_on_reset clip_rewards terminal_on_life_loss", "fire_on_reset fire_after_life_loss terminal_on_life_loss"),
]
IN_MAKE_TEST = {("SpaceInvaders", SETTINGS[-2]), ("Breakout", SETTINGS[-1])}  # each setting, in the game where it matters


@pytest.mark.parametrize(
    ("game", "names"),
    [
        pytest.param(*each, marks=() if each in IN_MAKE_TEST else pytest.mark.soak)
        for each in itertools.product(["Breakout", "SpaceInvaders"], SETTINGS)
    ],
)
def test_settings_mean_the_same_in_the_vectorized_form_as_in_the_loop(game: str, names: str) -> None:
    """With no-op actions in the steps that only reset: there, the loop takes them by itself."""
    N, env = 2, EnvSpec("millrace/Atari-v0", {"game": game, "noop_max": 0, **dict.fromkeys(names.split(), True)})
    one, other = OPEN["native"](env, N), OPEN["loop"](env, N)
    np.testing.assert_array_equal(one.reset([3, 4], no_pulse)[0], other.reset([3, 4], no_pulse)[0])
    generator, ended, ends, rewards = np.random.default_rng(0), np.zeros(N, bool), 0, set()
    for _ in range(900):
        actions = np.where(ended, atari.NOOP, generator.integers(4, size=N))
        row, looped = one.step(actions, no_pulse), other.step(actions, no_pulse)
        np.testing.assert_array_equal(row.leaves[0], looped.leaves[0])
        assert row.reward.tolist() == looped.reward
        assert (row.terminated.tolist(), row.truncated.tolist()) == (looped.terminated, looped.truncated)
        assert not (ended & (row.terminated | row.truncated)).any(), "an end in a step that only resets"
        assert not row.reward[ended].any(), "a reward in a step that only resets"
        ended = row.terminated | row.truncated
        ends += int(ended.sum())
        rewards |= set(row.reward.tolist())
    assert ends > 1
    assert (max(rewards) == 1) == ("clip_rewards" in names or game == "Breakout"), rewards
    for copies in (one, other):
        copies.close()


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"mode": 0}, "cannot make it: got an unexpected keyword argument 'mode'; use"),
        ({"noop_max": 0}, "envpool: noop_max: expected at least 1, got 0"),
        ({"fire_on_reset": True, "terminal_on_life_loss": True}, "expected fire_after_life_loss True, got False"),
        ({"fire_on_reset": True, "fire_after_life_loss": True}, "expected fire_after_life_loss False, got True"),
    ],
)
@envpool
def test_settings_that_mean_something_else_in_envpool_are_refused(settings: dict[str, Any], says: str) -> None:
    with pytest.raises(UsageError, match=says):
        envpool_spec(EnvSpec(BREAKOUT.id, {"game": "Breakout", **settings}))


@pytest.mark.parametrize("kind", ["loop", "native"])
@pytest.mark.parametrize("terminal_on_life_loss", [False, True])
@pytest.mark.parametrize("fires", [False, True])
def test_a_policy_that_never_presses_fire_plays_on_only_with_fire_after_life_loss(
    kind: str, terminal_on_life_loss: bool, fires: bool
) -> None:
    settings = {"fire_on_reset": True, "terminal_on_life_loss": terminal_on_life_loss, "fire_after_life_loss": fires}
    copies = OPEN[kind](EnvSpec(BREAKOUT.id, {**BREAKOUT.kwargs, "noop_max": 0, **settings}), 1)
    copies.reset([3], no_pulse)
    ends = sum(int(copies.step(np.zeros(1, int), no_pulse).terminated[0]) for _ in range(250))
    copies.close()
    if terminal_on_life_loss:
        assert ends >= 5 if fires else ends == 1
    else:
        assert ends >= 1 if fires else ends == 0


@pytest.mark.parametrize("noop_max", [0, 30])
def test_a_game_with_continuous_actions_is_started_in_both_forms(noop_max: int) -> None:
    """Also by a policy that never presses FIRE. With random joysticks, both forms show the same."""
    settings = {"fire_on_reset": True, "fire_after_life_loss": True, "terminal_on_life_loss": True, "noop_max": noop_max}
    N, env = 2, EnvSpec(BREAKOUT.id, {**BREAKOUT.kwargs, **settings, "continuous": True})
    one, other = OPEN["native"](env, N), OPEN["loop"](env, N)
    one.reset([3, 4], no_pulse)
    other.reset([3, 4], no_pulse)
    generator, ended, lives = np.random.default_rng(0), np.zeros((N, 1), bool), np.zeros((2, N), int)
    low, high = [0, -np.pi, 0], [1, np.pi, 0.4]  # FIRE is pressed above 0.5
    for _ in range(400):
        actions = np.where(ended, np.float32(0), generator.uniform(low, high, (N, 3)).astype(np.float32))
        row, looped = one.step(actions, no_pulse), other.step(actions, no_pulse)
        if not noop_max:  # otherwise the two draw other numbers of no-op actions
            np.testing.assert_array_equal(row.leaves[0], looped.leaves[0])
            assert (row.reward.tolist(), row.terminated.tolist()) == (looped.reward, looped.terminated)
        ended[:, 0] = row.terminated
        lives += [row.terminated, looped.terminated]
    assert (lives >= 4).all()
    for copies in (one, other):
        copies.close()


def test_fire_is_pressed_only_in_games_that_have_it() -> None:
    """Freeway's first action after the no-op action is UP."""
    for game, presses in (("Freeway", False), ("Breakout", True)):
        settings = {"game": game, "fire_after_life_loss": True}
        one, several = atari.make_game(**settings), atari.make_games(1, **settings)
        assert isinstance(one, atari._FiresAfterLives) == isinstance(several, atari._VectorFiresAfterLives) == presses
        one.close()
        several.close()


def test_after_a_lost_life_the_same_game_goes_on_until_it_has_ended_or_a_seed_is_given() -> None:
    env = atari.make_game(game="Breakout", noop_max=0, fire_on_reset=True, terminal_on_life_loss=True)
    env.reset(seed=1)
    lives, generator = [], np.random.default_rng(0)

    def play() -> None:
        """Until an episode ends."""
        while not env.step(generator.integers(4))[2]:
            pass
        lives.append(env.unwrapped.ale.lives())  # type: ignore[attr-defined]

    for _ in range(6):
        play()
        env.reset()
    assert lives == [4, 3, 2, 1, 0, 4]
    play()
    env.reset(seed=2)
    assert env.unwrapped.ale.lives() == 5  # type: ignore[attr-defined]
    env.step(0)
    env.reset()
    assert env.unwrapped.ale.getEpisodeFrameNumber() < 4, "a reset in the middle of an episode starts a game"  # type: ignore[attr-defined]
    env.close()


def test_a_game_that_ends_in_the_step_after_a_lost_life_ends_an_episode_in_the_next_step() -> None:
    class Emulator(VectorEnv[Any, Any, Any]):
        """Copy 0 loses a life in step 1 and its game in step 2. Copy 1 loses a life in step 2."""

        num_envs = 2
        terminated: ClassVar = iter([[1, 0], [0, 1], [0, 0], [0, 0], [0, 0]])
        truncated: ClassVar = iter([[0, 0], [1, 0], [0, 0], [0, 0], [0, 0]])

        def step(self, actions: Any) -> Any:
            ends = (np.array(next(flags), bool) for flags in (self.terminated, self.truncated))
            return np.zeros((2, 1)), np.ones(2), *ends, {}

    games = atari._StepAfterLives(Emulator())
    rows = [games.step([0, 0]) for _ in range(5)]
    assert [[*reward, *terminated, *truncated] for _, reward, terminated, truncated, _ in rows] == [
        [1, 1, True, False, False, False],
        [0, 1, False, True, False, False],
        [1, 0, True, False, False, False],
        [0, 1, False, False, False, False],
        [1, 1, False, False, False, False],
    ]


def described(vector: Any) -> RunSpec:
    config = Config(env=BREAKOUT.id, vector=vector, envs=4, lanes=4, algorithm=PPOConfig(rollout_steps=24))
    return run_spec(config, BREAKOUT)


@pytest.mark.parametrize("kind", KINDS)
def test_lanes_are_the_same_again_and_others_than_their_neighbours(kind: str) -> None:
    run = described(kind)
    assert run.policy.observation[0].shape == (4, 84, 84)
    once = collect(random_collector(run), run, lanes=(0, 1))
    again = collect(random_collector(run), run, lanes=(0, 1))
    assert [bits(rollout) for rollout in once] == [bits(rollout) for rollout in again]
    assert once[0].obs[0].tobytes() != once[1].obs[0].tobytes()


@pytest.mark.parametrize("kind", KINDS)
def test_the_step_after_an_end_only_resets(kind: str) -> None:
    N = 3
    copies = OPEN[kind](BREAKOUT, N)
    copies.reset([copy_seed(1, 0, 0, n) for n in range(N)], no_pulse)
    generator, ended, ends = np.random.default_rng(1), np.zeros(N, bool), 0
    for _ in range(400):
        row = copies.step(generator.integers(4, size=N), no_pulse)
        for n in np.flatnonzero(ended):
            assert (row.reward[n], row.terminated[n], row.truncated[n]) == (0, False, False)
            screens = np.asarray(row.leaves[0][n])
            assert screens[3].any()
            assert (screens[:3] == (screens[3] if kind == "envpool" else 0)).all()
        ended = np.logical_or(row.terminated, row.truncated)
        ends += int(ended.sum())
    assert ends > 2
    copies.close()


def test_an_id_of_the_emulators_own_is_refused_where_one_copy_shows_something_else() -> None:
    env = EnvSpec("ALE/Pong-v5")
    with pytest.raises(
        UsageError,
        match=r"vector native: its copies have other spaces .*; take millrace/Atari-v0 --env-kwargs game Pong, or use",
    ) as caught:
        run_spec(Config(env=env.id, vector="native"), env)
    assert "\n" not in str(caught.value)
