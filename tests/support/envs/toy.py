"""Toy environments for tests: with known returns, with every supported space, slow ones and faulty ones.

Importing this file registers each class under its name: `gymnasium.make("tests.support.envs.toy:Countdown-v0", k=3)`.
"""

from __future__ import annotations

import os
import signal
import time
from copy import deepcopy
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

Floats = npt.NDArray[np.float32]
Info = dict[str, Any]


class Scripted(gymnasium.Env[Floats, Any]):
    """Plays a script again and again, one letter for each step: `.` goes on, `t` terminates, `u` truncates, `b` does both.

    Observations are [episode, steps in it], both from 0. The reward of a step is the number of steps in the episode, from 1.
    """

    def __init__(self, script: str = "...t") -> None:
        self.observation_space = spaces.Box(0, np.inf, (2,), np.float32)
        self.action_space = spaces.Discrete(2)
        self._script = script
        self._played = self._steps = 0
        self._episode = -1

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Floats, Info]:
        """Start the next episode. The script goes on where it was; with a seed, all begins anew."""
        super().reset(seed=seed)
        if seed is not None:
            self._played, self._episode = 0, -1
        self._episode += 1
        self._steps = 0
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Floats, float, bool, bool, Info]:
        """Play the next letter."""
        letter = self._script[self._played % len(self._script)]
        self._played += 1
        self._steps += 1
        return self._observation(), float(self._steps), letter in "tb", letter in "ub", {}

    def _observation(self) -> Floats:
        return np.array([self._episode, self._steps], np.float32)


class OneStep(Scripted):
    """Every episode is truncated at its first step."""

    def __init__(self) -> None:
        super().__init__("u")


class Both(Scripted):
    """Every episode is terminated and truncated at once, at its third step."""

    def __init__(self) -> None:
        super().__init__("..b")


class Countdown(gymnasium.Env[Floats, Any]):
    """Terminates after `k` steps; the observation is [remaining / k], every step gives `reward`."""

    def __init__(self, k: int = 5, reward: float = 1.0) -> None:
        self.observation_space = spaces.Box(0, 1, (1,), np.float32)
        self.action_space = spaces.Discrete(2)
        self._k, self._reward, self._left = k, reward, k

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Floats, Info]:
        """Start at `k`."""
        super().reset(seed=seed)
        self._left = self._k
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Floats, float, bool, bool, Info]:
        """Count down by one."""
        self._left -= 1
        return self._observation(), self._reward, self._left == 0, False, {}

    def _observation(self) -> Floats:
        return np.array([self._left / self._k], np.float32)


class Identity(gymnasium.Env[Floats, Any]):
    """Shows one of `n` signs, one-hot. The reward is 1 if the action is the number of the sign. Truncates after 10 steps."""

    def __init__(self, n: int = 4) -> None:
        self.observation_space = spaces.Box(0, 1, (n,), np.float32)
        self.action_space = spaces.Discrete(n)
        self._n = n
        self._sign = self._steps = 0

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Floats, Info]:
        """Show the first sign."""
        super().reset(seed=seed)
        self._steps = 0
        return self._show(), {}

    def step(self, action: Any) -> tuple[Floats, float, bool, bool, Info]:
        """Reward the action, and show the next sign."""
        reward = float(int(action) == self._sign)
        self._steps += 1
        return self._show(), reward, False, self._steps == 10, {}

    def _show(self) -> Floats:
        self._sign = int(self.np_random.integers(self._n))
        return np.equal(np.arange(self._n), self._sign).astype(np.float32)


class Steer(Identity):
    """Shows one of four signs. The action is a Tuple of a number and a choice.

    A right choice gets 1, and the number loses its squared distance from -1 for the first sign to 1 for the last.
    """

    def __init__(self) -> None:
        super().__init__(4)
        self.action_space: Any = spaces.Tuple([spaces.Box(-1, 1, (1,), np.float32), spaces.Discrete(4, start=1)])

    def step(self, action: Any) -> tuple[Floats, float, bool, bool, Info]:
        """Reward both parts, and show the next sign."""
        if not self.action_space.contains(action):
            raise ValueError(f"action: expected one of {self.action_space}, got {action!r}")
        number, choice = action
        lost = float(number[0] - (2 * self._sign / 3 - 1)) ** 2
        shown, reward, terminated, truncated, info = super().step(choice - 1)
        return shown, reward - lost, terminated, truncated, info


class Recall(gymnasium.Env[Floats, Any]):
    """Shows one of `n` signs, one-hot, for one step. The action `delay` steps later gets 1 if it is the number of the sign.

    All other observations are zeros, so the mean return of a policy without memory is 1 / n.
    """

    def __init__(self, n: int = 3, delay: int = 3) -> None:
        self.observation_space = spaces.Box(0, 1, (n,), np.float32)
        self.action_space = spaces.Discrete(n)
        self._n, self._delay = n, delay
        self._sign = self._steps = 0

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Floats, Info]:
        """Show a sign."""
        super().reset(seed=seed)
        self._steps, self._sign = 0, int(self.np_random.integers(self._n))
        return np.eye(self._n, dtype=np.float32)[self._sign], {}

    def step(self, action: Any) -> tuple[Floats, float, bool, bool, Info]:
        """Show zeros; reward the last action of the episode."""
        self._steps += 1
        last = self._steps > self._delay
        return np.zeros(self._n, np.float32), float(last and int(action) == self._sign), last, False, {}


class Slow(Countdown):
    """A countdown whose step takes `seconds`, and MILLRACE_TOY_SLEEPS_S more, so that one worker may be slower."""

    def __init__(self, seconds: float = 0.01, k: int = 5) -> None:
        super().__init__(k)
        self._seconds = seconds + float(os.environ.get("MILLRACE_TOY_SLEEPS_S", "0"))

    def step(self, action: Any) -> tuple[Floats, float, bool, bool, Info]:
        """Sleep, then count down."""
        time.sleep(self._seconds)
        return super().step(action)


class Frames(gymnasium.Env[npt.NDArray[np.uint8], Any]):
    """Random frames 84 x 84 x 4, of the size of Atari observations, drawn at the start. An episode has 100 steps."""

    def __init__(self) -> None:
        self.observation_space = spaces.Box(0, 255, (84, 84, 4), np.uint8)
        self.action_space = spaces.Discrete(6)
        self._frames = np.random.default_rng(0).integers(0, 256, (8, 84, 84, 4), np.uint8)
        self._steps = 0

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[npt.NDArray[np.uint8], Info]:
        """Start at the first frame."""
        super().reset(seed=seed)
        self._steps = 0
        return self._frames[0].copy(), {}

    def step(self, action: Any) -> tuple[npt.NDArray[np.uint8], float, bool, bool, Info]:
        """Show the next frame."""
        self._steps += 1
        return self._frames[self._steps % 8].copy(), 0.0, False, self._steps >= 100, {}


class Faulty(Countdown):
    """A countdown that fails at its step number `after` (from 0) and at all later ones. `fault` says how.

    With `once`, a path, it fails only if it can create that file: one time, even if the environment is made again.
    With `only_seed` it fails only if that was the seed of its first reset: in one copy of one incarnation of one lane.
    """

    def __init__(self, after: int = 3, once: str = "", k: int = 5, only_seed: int | None = None) -> None:
        super().__init__(k)
        self._after, self._once, self._total = after, once, 0
        self._only_seed = only_seed
        self._seed: int | None = None

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Floats, Info]:
        """Start at `k`."""
        self._seed = seed if self._seed is None else self._seed
        return super().reset(seed=seed)

    def step(self, action: Any) -> tuple[Floats, float, bool, bool, Info]:
        """Count down, or fail."""
        row = super().step(action)
        self._total += 1
        return self.fault(*row) if self._total > self._after and self._due() else row

    def _due(self) -> bool:
        if self._only_seed not in (None, self._seed):
            return False
        if self._once:
            try:
                os.close(os.open(self._once, os.O_CREAT | os.O_EXCL))
            except FileExistsError:
                return False
        return True

    def fault(
        self, observation: Floats, reward: float, terminated: bool, truncated: bool, info: Info
    ) -> tuple[Floats, float, bool, bool, Info]:
        """Fail, or return a wrong row instead of this one."""
        raise NotImplementedError


class Raises(Faulty):
    """Raises in `step`."""

    def fault(self, *row: Any) -> tuple[Floats, float, bool, bool, Info]:
        """Raise."""
        raise ValueError("the toy is broken, as it was asked to be")


class NaNReward(Faulty):
    """Returns a reward of NaN."""

    def fault(self, observation: Floats, reward: float, *rest: Any) -> tuple[Floats, float, bool, bool, Info]:
        """Replace the reward."""
        return (observation, np.nan, *rest)


class NaNObservation(Faulty):
    """Returns an observation of NaN."""

    def fault(self, observation: Floats, *rest: Any) -> tuple[Floats, float, bool, bool, Info]:
        """Replace the observation."""
        return (observation * np.float32(np.nan), *rest)


class Hangs(Faulty):
    """Does not return from `step` for an hour."""

    def fault(self, *row: Any) -> tuple[Floats, float, bool, bool, Info]:
        """Hang."""
        time.sleep(3600)
        return row


class Dies(Faulty):
    """Kills its process, as a crash in C code would."""

    def fault(self, *row: Any) -> tuple[Floats, float, bool, bool, Info]:
        """Kill the process."""
        os.kill(os.getpid(), signal.SIGKILL)
        return row


_BOX = spaces.Box(-1, 1, (3,), np.float32)
_DISCRETE = spaces.Discrete(4, start=-1)
_IMAGE = spaces.Box(0, 255, (12, 12, 3), np.uint8)
_TABLE = spaces.MultiDiscrete(np.array([[2, 3], [4, 5]]), start=np.array([[1, 0], [0, -2]]))

OBSERVATIONS: dict[str, gymnasium.Space[Any]] = {
    "box": _BOX,
    "scalar": spaces.Box(-1, 1, (), np.float32),
    "unbounded": spaces.Box(-np.inf, np.inf, (2, 3), np.float64),
    "integers": spaces.Box(-5, 5, (2,), np.int16),
    "bytes": spaces.Box(0, 255, (128,), np.uint8),
    "image": _IMAGE,
    "discrete": _DISCRETE,
    "multidiscrete": _TABLE,
    "multibinary": spaces.MultiBinary((2, 2)),
    "dict": spaces.Dict({"position": _BOX, "door": _DISCRETE}),
    "one": spaces.Dict({"only": _BOX}),
    "tuple": spaces.Tuple((_BOX, spaces.MultiBinary(3))),
    "nested": spaces.Dict({"camera": spaces.Dict({"left": _IMAGE}), "arm": spaces.Tuple((_DISCRETE, _BOX))}),
    "text": spaces.Text(5),
    "words": spaces.Dict({"said": spaces.Text(5)}),
}
ACTIONS: dict[str, gymnasium.Space[Any]] = {
    "discrete": spaces.Discrete(3),
    "offset": spaces.Discrete(3, start=5),
    "multidiscrete": spaces.MultiDiscrete([2, 3]),
    "table": _TABLE,
    "multibinary": spaces.MultiBinary(4),
    "box": spaces.Box(-0.1, 0.1, (2,), np.float32),
    "scalar": spaces.Box(-0.1, 0.1, (), np.float32),
    "doubles": spaces.Box(-0.1, 0.1, (2,), np.float64),
    "half": spaces.Box(np.array([0, -np.inf]), np.array([np.inf, 0]), dtype=np.float64),
    "unbounded": spaces.Box(-np.inf, np.inf, (2, 2), np.float32),
    "pair": spaces.Tuple([spaces.Discrete(3), spaces.Box(-0.1, 0.1, (2,), np.float32)]),
    "mixed": spaces.Dict(
        {
            "speed": spaces.Box(-0.1, 0.1, (2,), np.float64),
            "arm": spaces.Tuple([spaces.Discrete(3, start=5), _TABLE, spaces.Dict({"grip": spaces.MultiBinary(2)})]),
            "brake": spaces.Box(0, np.inf, (), np.float32),
            "gear": spaces.Discrete(4),
        }
    ),
    "integers": spaces.Box(0, 5, (2,), np.int64),
    "text": spaces.Text(5),
    "integers inside": spaces.Tuple([spaces.Discrete(2), spaces.Box(0, 5, (2,), np.int64)]),
}
UNSUPPORTED_OBSERVATIONS = ("text", "words")
UNSUPPORTED_ACTIONS = ("integers", "text", "integers inside")


class Spaces(gymnasium.Env[Any, Any]):
    """Observations and actions of named spaces. Raises for an action outside its space. Truncates after 4 steps."""

    def __init__(self, observation: str = "box", action: str = "discrete") -> None:
        self.observation_space = deepcopy(OBSERVATIONS[observation])
        self.action_space = deepcopy(ACTIONS[action])
        self._steps = 0

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        """Show a random observation."""
        super().reset(seed=seed)
        self._steps = 0
        self.observation_space.seed(int(self.np_random.integers(2**31)))
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, Info]:
        """Show another random observation. The reward is the sum of the action."""
        if not self.action_space.contains(_with_arrays(action)):
            raise ValueError(f"action: expected one of {self.action_space}, got {action!r} of type {type(action).__name__}")
        self._steps += 1
        return self.observation_space.sample(), _sum(action), False, self._steps == 4, {}


def _with_arrays(action: Any) -> Any:
    """The same action, with an array in place of each number of a Box without dimensions: it iterates as scalars."""
    match action:
        case dict():
            return {key: _with_arrays(inner) for key, inner in action.items()}
        case tuple():
            return tuple(map(_with_arrays, action))
        case _:
            return np.asarray(action) if isinstance(action, np.floating) else action


def _sum(action: Any) -> float:
    """The sum of all numbers of an action."""
    match action:
        case dict():
            return sum(map(_sum, action.values()))
        case tuple():
            return sum(map(_sum, action))
        case _:
            return float(np.sum(action))


class Odd:
    """A value that is not plain data, because only this module has its class."""

    def __repr__(self) -> str:
        return "<odd>"


class Informs(gymnasium.Env[Any, Any]):
    """Episodes of random length, a Dict observation, and infos of every kind: numbers, words, arrays, nested and rare ones.

    With `odd`, one info is not plain data. Words get `wordy` more letters.
    `level` is an attribute to get and set, `shout` a method to call. It renders whatever its render_mode is.
    """

    def __init__(self, odd: bool = False, length: float = 6.0, wordy: int = 0) -> None:
        self.observation_space = spaces.Dict({"arm": spaces.Tuple((_BOX, _DISCRETE)), "clock": spaces.Discrete(1000)})
        self.action_space = spaces.Dict({"move": spaces.Box(-1, 1, (2,), np.float32), "pick": spaces.Discrete(3)})
        self._odd, self._length, self._wordy, self._steps = odd, length, wordy, 0
        self.level = 1

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Any, Info]:
        """Start an episode. The info holds the options."""
        super().reset(seed=seed)
        self._steps = 0
        return self._show(), {"began": True, **(options or {})}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, Info]:
        """The reward depends on all of the action."""
        self._steps += 1
        draw = float(self.np_random.random())
        info: Info = {
            "step": self._steps,
            "draw": draw,
            "word": f"w{self._steps}" + self._wordy * "x",
            "deep": {"array": np.arange(3) * draw},
        }
        if draw < 0.2:
            info |= {"rare": np.float32(draw), "list": [1, "a", None], "pair": (1, 2.5), "nothing": None, "flag": draw < 0.1}
        if self._odd:
            info["odd"] = Odd()
        reward = float(action["move"].sum()) + 10.0 * float(action["pick"]) + self.level
        return self._show(), reward, draw < 1 / self._length, draw > 1 - 1 / self._length, info

    def shout(self, word: str, times: int = 1) -> str:
        """A method to call."""
        return word.upper() * times

    def render(self) -> Any:
        """A picture of the number of steps."""
        return np.full((2, 2, 3), self._steps, np.uint8)

    def _show(self) -> Any:
        box = self.np_random.uniform(-1, 1, 3).astype(np.float32)
        return {"arm": (box, int(self.np_random.integers(-1, 3))), "clock": self._steps}


for _toy in (
    Informs, Scripted, OneStep, Both, Countdown, Identity, Recall, Slow, Frames, Raises, NaNReward, NaNObservation, Hangs,
    Dies, Spaces, Steer,
):  # fmt: skip
    gymnasium.register(id=f"{_toy.__name__}-v0", entry_point=f"{__name__}:{_toy.__name__}")
