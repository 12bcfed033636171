"""The loop that calls `env.step`, for rollouts and evaluations (`LoopedCopies`) and for vector environments (`SteppedLane`).

Autoreset is gymnasium's (`gymnasium.vector.AutoresetMode`). NextStep: the step after an episode's end ignores the action and
resets that copy. SameStep: the step that ends an episode resets the copy, and returns the last observation and info inside
the new info, as `final_obs` and `final_info`. Disabled: the caller resets.

Rule: a copy that is recreated after some episodes (`restart_episodes`) continues exactly as it would have otherwise. The new
environment is reset with the seed with which the copy began. It then gets the old environment's random state and, if the
environment can save its state, the saved state. Finally, it is reset again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import replace
from itertools import repeat
from time import perf_counter
from typing import Any, Literal

import gymnasium
import numpy as np

from millrace.protocol.bounds import one_line
from millrace.protocol.envs.answers import STEP, reset_answer, wrong_step
from millrace.protocol.envs.tuple_of_agents import agents_in_tuples
from millrace.protocol.envs.which_copy import FIRST_COPY, EnvCopy
from millrace.protocol.errors import UsageError, safe_repr
from millrace.workers.activity import (
    DOING,
    ENV_CALLS,
    MAKING,
    RESETTING,
    SINCE_S,
    STEPPING,
    WAITING,
    activity,
)
from millrace.workers.copies.env_errors import CopyFailed
from millrace.workers.copies.random_state import pack, repeatable, set_state, state_of
from millrace.workers.copies.saved_state import CannotSave, SavedCopy, load, save, saver
from millrace.workers.copy_slots import Dress, as_made, close_copy, make_copy

Autoreset = Literal["NextStep", "SameStep", "Disabled"]
CopyInfos = list[tuple[int, dict[str, Any]]]
"""Pairs of a copy's number and its info, for each info that isn't empty. Its dicts and arrays are copies (`_kept`)."""
Pulse = Callable[[], None]
"""Called regularly during long work, so that the worker can answer the learner. It may raise to end the work."""

CHECKED_STEPS = 2  # in how many of the first steps numbers are checked; two, because one may be a reset
PULSE_S = 0.05  # a loop over slow copies calls `pulse` at this interval
CANNOT_RESTART = (
    "restart_episodes: the env copies of training are not made anew, because nobody could go on with the random numbers of "
    "their environment; expected a reset that calls super().reset(seed=seed), and no ResetAhead"
)


class EnvLoop:
    """N environments that are stepped one after another. All their exceptions are raised as `CopyFailed`."""

    def __init__(
        self,
        makes: Iterable[Callable[[], gymnasium.Env[Any, Any]]],
        pulse: Pulse,
        autoreset: Autoreset = "NextStep",
        *,
        ended: bool = False,
        first: EnvCopy = FIRST_COPY,
        stepping: int = STEPPING,
        dress: Dress[gymnasium.Env[Any, Any]] = as_made,
        restart_episodes: int = 0,
    ) -> None:
        """Make the copies, without resetting them.

        If `ended`, they count as truncated, so with NextStep the first step resets them. `first` identifies the first copy;
        the others follow it. `stepping` is the worker's activity during a step. `dress` takes each copy, and returns the
        environment to step in its place; see `make_copy`. After `restart_episodes` resets, each copy is closed and recreated
        before the next reset; 0 means never.
        """
        self.envs: list[gymnasium.Env[Any, Any]] = []
        self._activity = activity()
        self._makes = list(makes)
        self._first = first
        self._dress = dress
        for n in range(len(self._makes)):
            pulse()
            try:
                self.envs.append(self._made(n))
            except UsageError:
                self.close()
                raise
            except BaseException as error:  # including SystemExit: the environment must not silently end the worker
                self.close()
                raise CopyFailed(n, "make") from error
        self.steps = 0
        """number of calls to `step`"""
        self.reward: list[Any] = [0.0] * len(self.envs)
        """[N] as returned by the last step"""
        self.terminated: list[Any] = [False] * len(self.envs)
        """[N] as returned by the last step"""
        self.truncated: list[Any] = [ended] * len(self.envs)
        """[N] as returned by the last step"""
        self.random_states: dict[int, dict[str, Any] | None] = {}
        """for each copy that a step has reset, the state of its random generator before the last such reset"""
        self._step_functions = [env.step for env in self.envs]
        self._inner = [repeatable(env) for env in self.envs]
        self._restart_episodes = restart_episodes
        self._resets = [0] * len(self.envs)  # number of resets of each current environment
        self._seeds: list[int | None] = [None] * len(self.envs)  # the last seed with which each copy was reset
        self.stepping = stepping
        """the worker's activity during a step"""
        self._all = range(len(self.envs))
        # rules NEXT_STEP, SAME_STEP, DISABLED
        self._next_step = autoreset == "NextStep"
        self._same_step = autoreset == "SameStep"

    def reset(
        self,
        copies: Iterable[int],
        seeds: Sequence[int | None],
        into: list[Any],
        pulse: Pulse,
        options: Sequence[Any] = (),
    ) -> CopyInfos:
        """Begin episodes in these copies, with a seed for each, and options for each if any are given.

        Writes the observation of copy n into `into[n]`, and returns the infos.
        """
        infos: CopyInfos = []
        keywords: Iterable[Mapping[str, Any]] = [{"options": each} for each in options] or repeat({}, len(seeds))
        for n, seed, further in zip(copies, seeds, keywords, strict=True):  # rule SEEDED
            pulse()
            try:
                with self._activity.during(RESETTING):
                    into[n], info = self._reset(n, seed, **further)
                if info:
                    infos.append((n, _kept(info)))
            except BaseException as error:
                raise CopyFailed(n, "reset") from error
            self.reward[n] = 0.0  # rule AFTER_RESET
            self.terminated[n] = False
            self.truncated[n] = False
        return infos

    def step(self, actions: Iterable[Any], into: list[Any], pulse: Pulse, copies: Sequence[int] | None = None) -> CopyInfos:
        """Step every copy, or only `copies`, with an action for each; with NextStep, reset those whose episodes have ended.

        Writes the observation of copy n into `into[n]`, and returns the infos. The rest of the result is in `reward`,
        `terminated` and `truncated`.
        """
        chosen: Sequence[int] = self._all
        steps = self._step_functions
        if copies is not None:
            chosen = copies
            steps = [steps[n] for n in copies]
        stepping = self.stepping
        reward = self.reward
        terminated = self.terminated
        truncated = self.truncated
        next_step = self._next_step
        same_step = self._same_step
        infos: CopyInfos = []
        # The worker's activity is written inline, because this loop must be fast: once per call to this method, at each
        # reset of a copy, and every `PULSE_S` seconds.
        numbers = self._activity.numbers
        seconds = self._activity.seconds
        begin = self._activity.begin
        counted = 0
        seconds[SINCE_S] = now_s = perf_counter()
        numbers[DOING] = stepping
        pulse_due_s = now_s + PULSE_S
        for n, step, action in zip(chosen, steps, actions, strict=True):
            resets = next_step and (terminated[n] or truncated[n])
            try:
                if resets:
                    self.random_states[n] = state_of(self._inner[n])
                    begin(RESETTING)
                    observation, info = self._reset(n, None)
                    begin(stepping)
                    reward[n] = 0.0
                    terminated[n] = False
                    truncated[n] = False
                else:
                    answer = step(action)
                    try:
                        observation, reward[n], terminated[n], truncated[n], info = answer
                    except (TypeError, ValueError) as error:
                        raise wrong_step(answer) from error
                    if type(info) is not dict and info is not None and not isinstance(info, Mapping):
                        raise wrong_step(answer)
                    if same_step and (terminated[n] or truncated[n]):
                        resets = True
                        # Copied, because the reset may overwrite them.
                        last = {"final_obs": deepcopy(observation), "final_info": _kept(info)}
                        begin(RESETTING)
                        observation, info = reset_answer(self.envs[n].reset())
                        begin(stepping)
                        info = last | dict(info)
                into[n] = observation
                if info:
                    infos.append((n, _kept(info)))  # copied now, because the next copy may change the same dict
            except BaseException as error:
                begin(WAITING)
                raise CopyFailed(n, "reset" if resets else f"step {self.steps}") from error
            if (now_s := perf_counter()) > pulse_due_s:
                numbers[ENV_CALLS] += (done := chosen.index(n) + 1) - counted
                counted = done
                numbers[DOING] = WAITING
                pulse()
                seconds[SINCE_S] = now_s = perf_counter()
                numbers[DOING] = stepping
                pulse_due_s = now_s + PULSE_S
        numbers[ENV_CALLS] += len(chosen) - counted
        seconds[SINCE_S] = now_s
        numbers[DOING] = WAITING
        if self.steps < CHECKED_STEPS:
            self._check_numbers(chosen)
        self.steps += 1
        return infos

    def _made(self, n: int) -> gymnasium.Env[Any, Any]:
        """Make copy n, and return it."""
        first = self._first
        with self._activity.during(MAKING):
            return make_copy(replace(first, number=first.number + n, copy=first.copy + n), self._makes[n], self._dress)

    def _reset(self, n: int, seed: int | None, **further: Any) -> tuple[Any, Any]:
        """Reset copy n. If it has had `restart_episodes` resets, it is recreated first."""
        if self._restart_episodes:
            if self._resets[n] >= self._restart_episodes:
                self._make_anew(n, seed)
            self._resets[n] += 1
            self._seeds[n] = self._seeds[n] if seed is None else seed
        return reset_answer(self.envs[n].reset(seed=seed, **further))

    def _make_anew(self, n: int, seed: int | None) -> None:
        """Close copy n, and recreate it. If `seed` is None, its next reset returns what the old copy's would have."""
        state = state_of(self._inner[n])
        if seed is None and state is None:
            return  # without a seed and a random state, a new environment couldn't continue like this one
        saved = self._saved(n) if seed is None else None
        close_copy(self.envs[n])
        env = self.envs[n] = self._made(n)
        self._step_functions[n] = env.step
        self._inner[n] = repeatable(env)
        self._resets[n] = 0
        if seed is None:
            with self._activity.during(RESETTING):
                env.reset(seed=self._seeds[n])
            if saved is None:
                set_state(self._inner[n], pack(state) or b"")
            else:
                with self._activity.during(self.stepping):
                    load(env, saved)

    def never_anew(self) -> str:
        """Why no copy can be recreated although the run asks for that; empty if copies can be, or if the run doesn't ask."""
        return CANNOT_RESTART if self._restart_episodes and self.random_state(0) is None else ""

    def _saved(self, n: int) -> SavedCopy | None:
        """The saved state of copy n; None if its environment can't save it."""
        if saver(self.envs[n]) is None:
            return None
        with suppress(CannotSave), self._activity.during(self.stepping):
            return save(self.envs[n])
        return None

    def random_state(self, copy: int) -> dict[str, Any] | None:
        """The current state of the copy's random generator; None if it can't be read."""
        return state_of(self._inner[copy])

    def set_random_state(self, copy: int, packed: bytes) -> bool:
        """Set the state of the copy's random generator. Returns False if the copy has no generator with such a state."""
        return set_state(self._inner[copy], packed)

    def _check_numbers(self, copies: Iterable[int]) -> None:
        """Raise `CopyFailed` for text, which numpy would silently convert to True or 1, and for a reward of None (NaN)."""
        for n in copies:
            if why := self._rewards_of_agents(n):
                raise CopyFailed(n, f"step {self.steps}", why)
            for name, value in (
                ("reward", self.reward[n]),
                ("terminated", self.terminated[n]),
                ("truncated", self.truncated[n]),
            ):
                if isinstance(value, str | bytes) or (value is None and name == "reward"):
                    wrong = f"{name}: expected a number, got {one_line(safe_repr(value), 80)}"
                    raise CopyFailed(n, f"step {self.steps}", f"{wrong}; its step must return ({STEP})")

    def _rewards_of_agents(self, n: int) -> str:
        """Advice, in one line, if copy `n` has returned a reward for each element of its Tuple spaces; else empty."""
        reward = self.reward[n]
        if not isinstance(reward, list | tuple | np.ndarray):
            return ""
        count = agents_in_tuples(self.envs[n].observation_space, self.envs[n].action_space)
        if count < 2 or np.shape(reward) != (count,):
            return ""
        return (
            f"reward: expected a number, got one for each of {count} elements of its Tuple spaces; if these are agents, add "
            "--wrappers millrace:TupleOfAgents"
        )

    def close(self) -> None:
        """Close every copy. Exceptions of the copies are ignored."""
        for env in self.envs:
            close_copy(env)


def _kept(info: Any, copies: dict[int, tuple[Any, Any]] | None = None) -> Any:
    """The info with its dicts and arrays copied, just as gymnasium copies them. Other values aren't copied, because some
    can't be.

    `copies` has each dict so far, with its copy, by its `id`, because a dict may occur in many places, even in itself.
    """
    if not isinstance(info, dict):
        return info.copy() if isinstance(info, np.ndarray) else info
    kept: dict[Any, Any] = {}
    if copies is None:
        copies = {}  # without the info itself, which must arrive as a dict even if it contains itself
    elif id(info) in copies:
        return copies[id(info)][1]
    else:
        copies[id(info)] = info, kept
    kept |= {key: value if type(value) in _IMMUTABLE else _kept(value, copies) for key, value in info.items()}
    return kept


_IMMUTABLE = frozenset({bool, int, float, str, type(None), np.bool_, np.int64, np.float32, np.float64})
