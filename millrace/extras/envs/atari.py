"""Atari games with the preprocessing of Mnih et al. (2015): frame skip 4, grayscale, 84 × 84, the last four screens stacked.

Rule: an observation is a stack of screens [4, 84, 84], whichever program steps the game. The single game, the emulator's
vectorized form and envpool differ only in their random numbers, and in the frames before an episode's first screen. These
are zeros, but in envpool they are copies of the first screen.

The environment's keyword arguments are the fields of `GameSettings` and further arguments for the emulator. Scores with
different settings can't be compared. Ending episodes at lost lives and clipping rewards are meant for training; turn them
off for evaluations with `eval_env_kwargs`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.wrappers import AtariPreprocessing, ClipReward, FrameStackObservation

from millrace.protocol.errors import UsageError

FRAMES = 4
SKIP = 4
SIDE = 84
MAX_FRAMES = 108_000  # time limit of a game, in emulator frames: half an hour of play
NOOP = 0  # the action that does nothing
FIRE = 1  # the action that presses the button, in games that have it
JOYSTICK_FIRE = np.array([0, 0, 1], np.float32)  # FIRE in a game with continuous actions: radius, angle, fire


@dataclass(frozen=True)
class GameSettings:
    """The settings of an Atari game."""

    game: str = "Pong"
    """Name of the game, as in `ALE/Pong-v5`."""
    repeat_action_probability: float = 0.0
    """Probability of sticky actions: 0.25 in Machado et al. (2018), 0 in Mnih et al. (2015) and most published tables.
    Sticky actions make games harder.
    """
    noop_max: int = 30
    """A game starts with a random number of no-op actions, at most this many. 0: it always starts in the same state."""
    fire_on_reset: bool = False
    """Start a game with the action FIRE, if the game has it."""
    fire_after_life_loss: bool = False
    """In the step after each lost life, take the action FIRE, if the game has it, in place of the policy's action. Without
    this, the policy itself must press FIRE in games that wait for it, such as Breakout.
    """
    terminal_on_life_loss: bool = False
    """End an episode at each lost life; the next episode continues the same game. Returns are then those of single lives, so
    evaluate without this setting. envpool takes no-op actions after each lost life.
    """
    clip_rewards: bool = False
    """Clip rewards to ±1. Returns are then not scores, so evaluate without this setting."""

    @staticmethod
    def split(kwargs: dict[str, Any]) -> tuple[GameSettings, dict[str, Any]]:
        """The settings among these keyword arguments, and the other arguments."""
        names = {field.name for field in fields(GameSettings)}
        options = {name: value for name, value in kwargs.items() if name not in names}
        return GameSettings(**{name: value for name, value in kwargs.items() if name in names}), options


def make_game(**kwargs: Any) -> gymnasium.Env[Any, Any]:
    """Make one env copy. `kwargs`: the fields of `GameSettings`, and further arguments for `gymnasium.make`.

    Needs ale-py and OpenCV.
    """
    _silence_emulator()
    settings, options = GameSettings.split(kwargs)
    options |= {
        "repeat_action_probability": settings.repeat_action_probability,
        "max_num_frames_per_episode": MAX_FRAMES,
    }
    env = gymnasium.make(f"ale_py:ALE/{settings.game}-v5", frameskip=1, disable_env_checker=True, **options)
    if isinstance(env.action_space, Box):
        env = _Joystick(env)
    if settings.fire_on_reset:
        env = _StartsGames(env)
    has_fire = _has_fire(env)
    env = FrameStackObservation(AtariPreprocessing(env, settings.noop_max, SKIP, SIDE), FRAMES, padding_type="zero")
    if settings.clip_rewards:
        env = ClipReward(env, -1.0, 1.0)
    if settings.fire_after_life_loss and has_fire:
        env = _FiresAfterLives(env)
    return _EndsWithLives(env) if settings.terminal_on_life_loss else env


def make_games(num_envs: int, **kwargs: Any) -> VectorEnv[Any, Any, Any]:
    """Make `num_envs` copies that the emulator steps together, in a single thread, as each core already has a worker."""
    _silence_emulator()
    settings, options = GameSettings.split(kwargs)
    made = gymnasium.make_vec(
        f"ale_py:ALE/{settings.game}-v5",
        num_envs,
        "vector_entry_point",
        frameskip=SKIP,
        repeat_action_probability=settings.repeat_action_probability,
        max_num_frames_per_episode=MAX_FRAMES,
        noop_max=settings.noop_max,
        use_fire_reset=settings.fire_on_reset,
        life_loss_info=settings.terminal_on_life_loss,  # `episodic_life` would start a new game after each life
        reward_clipping=settings.clip_rewards,
        num_threads=1,
        **options,
    )
    if settings.fire_after_life_loss and made.unwrapped.ale.get_action_set()[FIRE].value == FIRE:  # type: ignore[attr-defined]
        made = _VectorFiresAfterLives(made)
    return _StepAfterLives(made) if settings.terminal_on_life_loss else made


class _Joystick(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Accepts the actions NOOP and FIRE even in a game with continuous actions (`continuous=True`)."""

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        return self.env.step(JOYSTICK_FIRE * action if isinstance(action, int) else action)


class _StartsGames(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Presses FIRE for one frame after a reset, in games with this action."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self._has_fire = _has_fire(env)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        first = self.env.reset(seed=seed, options=options)
        if not self._has_fire:
            return first
        observation, _, _, _, info = self.env.step(FIRE)
        return observation, info


class _FiresAfterLives(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Plays FIRE in the step after a lost life, in place of the given action."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self._lives = 0
        self._fires = False  # whether to fire in the next step

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        first = self.env.reset(seed=seed, options=options)
        self._lives = _lives_left(self.env)
        self._fires = False
        return first

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        result = self.env.step(FIRE if self._fires else action)
        before = self._lives
        self._lives = _lives_left(self.env)
        self._fires = self._lives < before
        return result


class _VectorFiresAfterLives(VectorWrapper):
    """Like `_FiresAfterLives`, for the emulator's vectorized form, which ignores the action in a step that resets a game."""

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        self._lives = np.zeros(env.num_envs, int)
        self._fires = np.zeros(env.num_envs, bool)  # whether to fire in the next step
        self._fire = JOYSTICK_FIRE if isinstance(env.single_action_space, Box) else FIRE

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        self._lives[:] = info["lives"]
        self._fires[:] = False
        return observation, info

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        actions = np.array(actions)
        actions[self._fires] = self._fire
        result = self.env.step(actions)
        lives = result[-1]["lives"]
        self._fires = lives < self._lives
        self._lives[:] = lives
        return result


class _EndsWithLives(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Ends an episode at each lost life. The next reset then takes one no-op step in the same game, unless the game is over
    or `reset` gets a seed.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self._lives = 0
        self._goes_on = False  # whether the newest step lost a life without ending the game

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        goes_on = self._goes_on and seed is None
        self._goes_on = False
        if goes_on:
            observation, _, terminated, truncated, info = self.env.step(NOOP)
            goes_on = not (terminated or truncated)
        if not goes_on:
            observation, info = self.env.reset(seed=seed, options=options)
        self._lives = _lives_left(self.env)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        before = self._lives
        self._lives = _lives_left(self.env)
        life_lost = self._lives < before
        self._goes_on = life_lost and not (terminated or truncated)
        return observation, reward, terminated or life_lost, truncated, info


class _StepAfterLives(VectorWrapper):
    """Makes the step after a lost life look like a reset, without reward or end, just as in a loop over env copies.

    In this step, the emulator continues the game with the policy's action. If this step itself ends the game or loses a
    life, the end is reported one step later, so the episode has one step.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        self._ended = np.zeros(env.num_envs, bool)  # whether the newest step ended an episode
        self._hidden = np.zeros(env.num_envs, bool)  # whether the newest step hid the end of an episode

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._ended[:] = self._hidden[:] = False
        return self.env.reset(seed=seed, options=options)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(actions)
        plays = ~self._ended
        ends = terminated | truncated
        terminated = (terminated & plays) | self._hidden
        truncated = truncated & plays
        self._ended = terminated | truncated
        self._hidden = ends & ~plays
        return observation, np.where(plays, reward, 0), terminated, truncated, info


def _has_fire(env: gymnasium.Env[Any, Any]) -> bool:
    return env.unwrapped.get_action_meanings()[FIRE] == "FIRE"  # type: ignore[attr-defined, no-any-return]


def _lives_left(env: gymnasium.Env[Any, Any]) -> int:
    lives: int = env.unwrapped.ale.lives()  # type: ignore[attr-defined]
    return lives


def _silence_emulator() -> None:
    """Keep the emulator from printing its name and version in every process."""
    import ale_py

    ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)


def _envpool(**kwargs: Any) -> tuple[str, dict[str, Any]]:
    """The game's name and options in envpool. Raises `UsageError` for settings that have another meaning there."""
    settings = GameSettings(**kwargs)
    if settings.noop_max < 1:
        raise UsageError(f"envpool: noop_max: expected at least 1, got {settings.noop_max}; use --vector native or loop")
    fires = settings.fire_on_reset and settings.terminal_on_life_loss
    if settings.fire_after_life_loss != fires:
        raise UsageError(
            "envpool: it presses FIRE after each lost life exactly if fire_on_reset and terminal_on_life_loss are True: "
            f"expected fire_after_life_loss {fires}, got {settings.fire_after_life_loss}; use --vector native or loop"
        )
    options = {
        "noop_max": settings.noop_max,
        "use_fire_reset": settings.fire_on_reset,
        "repeat_action_probability": settings.repeat_action_probability,
        "episodic_life": settings.terminal_on_life_loss,
        "reward_clip": settings.clip_rewards,
    }
    sizes = {"frame_skip": SKIP, "stack_num": FRAMES, "max_episode_steps": MAX_FRAMES // SKIP}
    return f"{settings.game}-v5", options | sizes


make_game.envpool = _envpool  # type: ignore[attr-defined]  # read by `millrace.extras.envs.envpool`
