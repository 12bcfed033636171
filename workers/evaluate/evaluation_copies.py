"""The env copies on which a worker evaluates. They have no autoreset: a copy is stepped until its episode ends.

Rule: only the copies that are named are stepped, so that an episode that has ended costs nothing.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import partial
from time import perf_counter
from typing import Any, NamedTuple, Protocol

import gymnasium

from protocol.arrays import Array
from protocol.env_spec import EnvSpec
from protocol.envs.action_masks import without_mask
from protocol.envs.env_copy import EnvCopy
from protocol.envs.spaces import make_flatten
from protocol.errors import UsageError
from workers.activity import EVALUATING, activity
from workers.copies.env_copies import made_without_order_check
from workers.copies.env_errors import CopyFailed
from workers.copies.env_loop import PULSE_S, EnvLoop, Pulse
from workers.copies.env_results import missing_leaf
from workers.copies.facts import facts_of_info
from workers.copies.mask_reader import MaskReader


class CopyStep(NamedTuple):
    """Result of one step of one copy."""

    leaves: tuple[Any, ...]
    """the arrays of the observation; in a masked run the mask follows"""
    reward: Any
    terminated: Any
    truncated: Any
    facts: tuple[float, ...] = ()
    """numbers in `info` that belong to the episode, if the run asks for them and it ends in this step"""


class CopiesLost(Exception):
    """A worker was lost, and with it copies whose episodes had not ended. The episodes must be played again."""


class EvaluationCopies(Protocol):
    """Env copies without autoreset. What the environment raises arrives as `CopyFailed`, what `pulse` raises passes.

    `step` may raise `CopiesLost`.
    """

    count: int
    observation_space: gymnasium.Space[Any]
    action_space: gymnasium.Space[Any]

    def reset(self, seeds: Sequence[int], pulse: Pulse) -> list[tuple[Any, ...]]:
        """Start episodes in the first copies, with a seed for each. Returns the arrays of each observation."""
        ...

    def step(self, actions: Array, copies: Sequence[int], pulse: Pulse) -> list[CopyStep]:
        """Step these copies, with actions [count, *action] of which only theirs are used."""
        ...

    def render(self, copy: int) -> Any:
        """What the environment renders."""
        ...

    def close(self) -> None:
        """Close the copies. Raises nothing."""
        ...


class LoopedEvaluationCopies:
    """A loop over environments in this process."""

    def __init__(
        self,
        env: EnvSpec,
        count: int,
        render_mode: str | None,
        pulse: Pulse,
        facts: Sequence[str] = (),
        *,
        masked: bool = False,
    ) -> None:
        """`render_mode`: None, or `rgb_array`. Raises `UsageError` if the environment does not render so.

        `facts`: names of the numbers in `info` that belong to an episode. `masked`: read masks of the allowed actions.
        """
        self.count, self._activity, self._facts = count, activity(), facts
        make = partial(made_without_order_check, partial(env.for_evaluation().make, render_mode))
        with warnings.catch_warnings():
            if render_mode is not None:
                warnings.simplefilter("ignore")  # gymnasium's, about a render mode that is refused below
            self._loop = EnvLoop([make] * count, pulse, "Disabled", first=EnvCopy(evaluation=True))
        self._steps = [0] * count
        first = self._loop.envs[0]
        self.observation_space, self.action_space = first.observation_space, first.action_space
        self._masks = MaskReader(self.observation_space, self.action_space) if masked else None
        if masked:
            self.observation_space = without_mask(self.observation_space, self.action_space)
        self._read = make_flatten(self.observation_space)
        modes = first.metadata.get("render_modes", [])
        if render_mode is not None and (first.render_mode != render_mode or render_mode not in modes):
            self.close()
            raise UsageError(f"environment {env.id} cannot be filmed: expected it to render {render_mode}, got {modes}")

    def reset(self, seeds: Sequence[int], pulse: Pulse) -> list[tuple[Any, ...]]:
        """Start episodes in the first copies, with a seed for each. Returns the arrays of each observation."""
        observations: list[Any] = [None] * len(seeds)
        infos = dict(self._loop.reset(range(len(seeds)), seeds, observations, pulse))
        self._steps[: len(seeds)] = [0] * len(seeds)
        return [self._leaves(n, observation, infos.get(n, {}), False, False) for n, observation in enumerate(observations)]

    def step(self, actions: Array, copies: Sequence[int], pulse: Pulse) -> list[CopyStep]:
        """Step these copies one after another, with actions [count, *action] of which only theirs are used."""
        results = []
        self._activity.begin(EVALUATING)
        pulse_due_s = perf_counter() + PULSE_S
        for n in copies:
            try:
                observation, reward, terminated, truncated, info = self._loop.envs[n].step(actions[n])
                facts = facts_of_info(self._facts, info, n) if self._facts and (terminated or truncated) else ()
                leaves = self._leaves(n, observation, info, terminated, truncated)
                results.append(CopyStep(leaves, reward, terminated, truncated, facts))
            except CopyFailed as error:
                raise CopyFailed(n, f"step {self._steps[n]}", error.line) from error
            except BaseException as error:
                raise CopyFailed(n, f"step {self._steps[n]}") from error
            self._steps[n] += 1
            if perf_counter() > pulse_due_s:
                self._activity.end()
                pulse()
                self._activity.begin(EVALUATING)
                pulse_due_s = perf_counter() + PULSE_S
        self._activity.end(len(results))
        return results

    def _leaves(self, n: int, observation: Any, info: dict[str, Any], terminated: Any, truncated: Any) -> tuple[Any, ...]:
        """The arrays of an observation of copy `n`; in a masked run the mask follows. Raises `CopyFailed`."""
        try:
            leaves = self._read(observation)
        except (LookupError, TypeError) as error:
            raise missing_leaf(n, observation, error) from error
        if self._masks is None:
            return leaves
        return (*leaves, self._masks.read(n, observation, info, terminated, truncated))

    def render(self, copy: int) -> Any:
        """What the environment renders."""
        try:
            with self._activity.during(EVALUATING):
                return self._loop.envs[copy].render()
        except BaseException as error:
            raise CopyFailed(copy, "render") from error

    def close(self) -> None:
        """Close every copy. What a copy raises is ignored."""
        self._loop.close()
