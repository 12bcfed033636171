"""One vector environment split into lanes: its workers step the env copies, and a collector chooses the actions.

Rule: a lane returns, bit for bit, what a loop over its copies would return. The lane chooses its copies' seeds and actions,
and the vector environment's autoreset is NextStep, like the loop's. The lanes are stepped in two parts: the policy acts for
one part while the copies of the other step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any, Protocol, TypeVar

import gymnasium
import numpy as np

from millrace.protocol.arrays import Array, Bools
from millrace.protocol.envs.action_masks import without_mask
from millrace.protocol.envs.spaces import make_batched, make_flatten
from millrace.protocol.errors import WorkerLost
from millrace.protocol.policy.masks import MASK
from millrace.protocol.specs import RunSpec
from millrace.workers.copies.env_copies import EnvCopies, Leaves, StepResult
from millrace.workers.copies.env_errors import CopyFailed, environment_failed
from millrace.workers.copies.env_loop import Pulse
from millrace.workers.copies.episode_facts import Facts, facts_of_info
from millrace.workers.copies.mask_reader import MaskReader
from millrace.workers.copies.set_attributes import CallsCopies, SetAttributes

RESETS = 3  # how often copies are reset if each reset loses a worker, and with it the attributes that were set
Result = TypeVar("Result")


class PulsedWait(Protocol):
    """Makes a call that may wait for workers, and calls the pulse meanwhile."""

    def __call__(self, call: Callable[[], Result], pulse: Pulse) -> Result:
        """Returns what `call` returns."""


def _without_pulse(call: Callable[[], Result], pulse: Pulse) -> Result:
    return call()


class StepsLanes(CallsCopies, Protocol):
    """A vector environment that can step some of its lanes while others step.

    It also has the infos as each copy returned them.
    """

    num_envs: int
    single_observation_space: gymnasium.Space[Any]
    single_action_space: gymnasium.Space[Any]
    merge_infos: bool
    """whether to return infos, merged as gymnasium does"""
    infos_by_row: dict[int, dict[str, Any]]
    """the infos of the last step or reset that are not empty, by copy"""

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Begin episodes, in the copies that `options["reset_mask"]` selects."""

    def begin_step(self, lanes: Sequence[int], actions: Any) -> None:
        """Order the copies of these lanes to step. `actions` has a row for every copy of the vector environment."""

    def end_step(self, lanes: Sequence[int]) -> Any:
        """Wait until these lanes have stepped. Returns what gymnasium's `step` returns; only these lanes' rows are valid."""

    def abandon(self) -> None:
        """Stop waiting for steps in progress."""


class SplitVectorEnv:
    """The lanes of a run, with the same number of copies each. Lane 0 has the first copies of the vector environment."""

    def __init__(self, env: StepsLanes, run: RunSpec, evaluation_copies: int = 0, wait: PulsedWait = _without_pulse) -> None:
        """`evaluation_copies` is how many of the copies are for evaluation; these come last, and may be all.

        `wait` makes each call that may wait for the vector environment.
        """
        env.merge_infos = False  # in merged infos, all copies would have the same dtype and shape
        self.env = env
        self._count = run.copies  # number of copies per lane
        self._evaluation_copies = evaluation_copies
        self._lanes = (env.num_envs - evaluation_copies) // run.copies  # lanes that collect rollouts
        self.in_parts = min(self._lanes, 2)
        """number of parts in which the lanes are stepped"""
        self._facts = run.info_keys
        observation = env.single_observation_space
        action = env.single_action_space
        self._masks = MaskReader(observation, action) if run.masked else None
        self.observation_space = without_mask(observation, action) if run.masked else observation
        """observation space of one copy"""
        self._wait = wait
        self._actions: Array | None = None  # [num_envs, *action]
        self._read = make_flatten(self.observation_space)
        self._batched = make_batched(action)
        self._result: StepResult | None = None
        self._attributes = SetAttributes(env)

    def open_lane(self, run: RunSpec, lane: int, pulse: Pulse) -> EnvCopies:
        """The copies of this lane. Pass this method to a `Collector` as its `open_copies`."""
        return SplitLane(self, lane * self._count, self._count)

    def evaluation_lane(self) -> SplitLane:
        """The evaluation copies. Each of them is a lane of one copy, after the other lanes."""
        return SplitLane(self, self.env.num_envs - self._evaluation_copies, self._evaluation_copies)

    def parts(self, lanes: int) -> Sequence[slice]:
        """Divide the lanes into parts of consecutive lanes, as equal as possible. No part is empty."""
        ends = [lanes * (i + 1) // self.in_parts for i in range(self.in_parts)]
        return [slice(begin, end) for begin, end in zip([0, *ends[:-1]], ends, strict=True) if end > begin]

    def begin(self, lanes: Sequence[int], actions: Array, pulse: Pulse) -> None:
        """Order the copies of these lanes to step, with actions [L, N, *action]; see `TogetherSteps`.

        Raises `ValueError` unless these are all the lanes of one part, because the rounding of the policy's results may
        depend on which lanes act together.
        """
        order = sorted(range(len(lanes)), key=lanes.__getitem__)
        in_order = actions[order].reshape(-1, *actions.shape[2:])  # [L · N, *action]
        lanes = [lanes[i] for i in order]
        if lanes not in [[*range(part.start, part.stop)] for part in self.parts(self._lanes)]:
            raise ValueError(f"lanes: expected all lanes of one part, got {lanes}")
        self._order(lanes, self._copies_of(lanes), in_order, pulse)

    def end(self, lanes: Sequence[int], pulse: Pulse) -> None:
        """Wait for the copies of these lanes. Then `SplitLane.step` returns their results."""
        with self._errors_of_lanes():
            self._result = self._ended(lanes, self._copies_of(lanes), pulse)

    def step_evaluation(self, first: int, copies: Sequence[int], actions: Array, pulse: Pulse) -> None:
        """Step evaluation copies. `copies` are counted from the first evaluation copy, which is copy `first`."""
        lanes = [self._lanes + n for n in copies]
        chosen = [first + n for n in copies]
        self._order(lanes, chosen, actions, pulse)
        self._result = self._ended(lanes, chosen, pulse)

    def _copies_of(self, lanes: Sequence[int]) -> list[int]:
        return [lane * self._count + n for lane in lanes for n in range(self._count)]

    @contextmanager
    def _errors_of_lanes(self) -> Iterator[None]:
        """A context in which errors of copies become errors of their lanes."""
        try:
            yield
        except CopyFailed as error:
            lane, copy = divmod(error.copy or 0, self._count)
            raise environment_failed(lane, CopyFailed(copy, "step", error.line)) from error

    def _order(self, lanes: Sequence[int], copies: list[int], actions: Array, pulse: Pulse) -> None:
        """Order these lanes to step with these actions. `copies` are the copies of the lanes."""
        self._set_missing(copies, pulse)
        if self._actions is None:
            self._actions = np.resize(actions, (self.env.num_envs, *actions.shape[1:]))  # arbitrary, but valid
        padded = self._actions
        padded[copies] = actions
        self._wait(lambda: self.env.begin_step(lanes, self._batched(padded)), pulse)

    def _ended(self, lanes: Sequence[int], copies: list[int], pulse: Pulse) -> StepResult:
        """Wait for these lanes. `copies` are their copies. The result has a row for each copy of all lanes."""
        return self._read_result(self._wait(lambda: self.env.end_step(lanes), pulse), copies)

    def _read_result(self, returned: Any, copies: list[int]) -> StepResult:
        """The result of a step of these copies. It has a row for each copy of the vector environment."""
        observation, reward, terminated, truncated, _ = returned
        infos = self.env.infos_by_row
        count = self.env.num_envs
        lost = None
        if lost_rows := [n for n, info in infos.items() if info.get("worker_lost") is True]:
            lost = np.zeros(count, bool)
            lost[lost_rows] = True
        facts: Facts = {}
        if self._facts:
            ended = np.zeros(count, bool)
            ended[copies] = terminated[copies] | truncated[copies]
            facts = {n: facts_of_info(self._facts, infos.get(n, {}), n) for n in np.flatnonzero(ended).tolist()}
        leaves: Leaves = self._read(observation)
        if self._masks is not None:
            waits = np.ones(count, bool)  # copies that were not stepped have no new mask
            waits[copies] = False
            leaves = [*leaves, self._read_masks(self._masks, observation, terminated | waits, truncated)]
        return StepResult(leaves, reward, terminated, truncated, lost, facts)

    def _read_masks(self, masks: MaskReader, observation: Any, terminated: Bools, truncated: Bools) -> Bools:
        """The masks [num_envs, choices] after a step or a reset; see `MaskReader.read_all`."""
        infos = self.env.infos_by_row
        of_copies = [infos.get(n, {}).get(MASK) for n in range(self.env.num_envs)]
        return masks.read_all(observation, {MASK: of_copies}, terminated, truncated)

    def abandon(self) -> None:
        """Stop waiting for steps in progress, because a rollout was dropped."""
        self.env.abandon()

    def result(self, copies: slice) -> StepResult:
        """The part of the last step's result that belongs to these copies."""
        whole = self._result
        assert whole is not None
        facts = whole.facts
        return StepResult(
            leaves=[leaf[copies] for leaf in whole.leaves],
            reward=whole.reward[copies],
            terminated=whole.terminated[copies],
            truncated=whole.truncated[copies],
            lost=None if whole.lost is None else whole.lost[copies],
            facts={n - copies.start: facts[n] for n in range(copies.start, copies.stop) if n in facts} if facts else {},
        )

    def reset(self, copies: slice, seeds: Sequence[int], pulse: Pulse) -> Leaves:
        """Start episodes in these copies, with a seed for each.

        If a worker is lost meanwhile, the new copies are reset again, after they have got the attributes of the lost ones.
        Raises `WorkerLost` if every attempt loses a worker.
        """
        mask = np.zeros(self.env.num_envs, bool)
        mask[copies] = True
        all_seeds: list[Any] = [None] * self.env.num_envs
        all_seeds[copies] = seeds
        options = {"reset_mask": mask}
        chosen = range(copies.start, copies.stop)
        for _ in range(RESETS):
            self._set_missing(chosen, pulse)
            observation, _ = self._wait(lambda: self.env.reset(seed=all_seeds, options=options), pulse)
            if not self._attributes.lacking(chosen):
                break
        else:
            names = ", ".join(sorted({name for _, name in self._attributes.lacking(chosen)}))
            raise WorkerLost(
                f"copies {copies.start} to {copies.stop - 1}: each of {RESETS} resets lost a worker, so new copies lack the "
                f"attribute {names}"
            )
        leaves: Leaves = self._read(observation)
        if self._masks is not None:
            leaves = [*leaves, self._read_masks(self._masks, observation, ~mask, np.zeros_like(mask))]
        return [leaf[copies] for leaf in leaves]

    def assign(self, copies: slice, name: str, packed: bytes, pulse: Pulse) -> None:
        """Set an attribute of these copies, and of later replacements for lost ones."""
        self._attributes.record(copies, name, packed)
        self._set_missing(range(copies.start, copies.stop), pulse)

    def _set_missing(self, chosen: Sequence[int], pulse: Pulse) -> None:
        """Before these copies are stepped or reset, set the attributes that they lack. Other copies are left for later.

        Other copies may be in the middle of a step. If a worker is lost meanwhile, the next step or reset tries again.
        """
        for key in self._attributes.lacking(chosen):
            with suppress(WorkerLost):
                self._wait(partial(self._attributes.set, key), pulse)


class SplitLane:
    """The env copies of one lane, or those for evaluation.

    If a copy is lost during an evaluation, all running episodes of the evaluation are lost.
    """

    def __init__(self, split: SplitVectorEnv, first: int, count: int) -> None:
        self._split = split
        self._first = first
        self.count = count
        self._copies = slice(first, first + count)
        self.note = ""
        self.observation_space = split.observation_space
        self.action_space = split.env.single_action_space

    def reset(self, seeds: Sequence[int], pulse: Pulse) -> Leaves:
        """Start episodes in all copies, or in the first ones, with a seed for each."""
        with self._own_numbers():
            return self._split.reset(slice(self._first, self._first + len(seeds)), seeds, pulse)

    def step(self, actions: Array, pulse: Pulse, copies: Sequence[int] | None = None) -> StepResult:
        """The result of the step that `SplitVectorEnv.end` waited for; in an evaluation, of a step of these copies."""
        if copies is not None:
            with self._own_numbers():
                self._split.step_evaluation(self._first, copies, actions, pulse)
        return self._split.result(self._copies)

    def assign(self, name: str, packed: bytes, pulse: Pulse) -> None:
        """Set an attribute of these copies."""
        self._split.assign(self._copies, name, packed, pulse)

    def render(self, copy: int) -> Any:
        """Not supported: these copies were made without a render mode."""
        raise ValueError("render: copies of a vector environment cannot be filmed; use millrace evaluate --video")

    def close(self) -> None:
        """Stop waiting for a step. The copies belong to the vector environment, and are reset when the lane starts again.

        A lane is closed when its rollout is dropped. After that, no lane needs the result of a step in progress.
        """
        self._split.abandon()

    @contextmanager
    def _own_numbers(self) -> Iterator[None]:
        """A context in which errors name a copy by its number in this lane, instead of that in the vector environment."""
        try:
            yield
        except CopyFailed as error:
            copy = None if error.copy is None else error.copy - self._first
            raise CopyFailed(copy, error.doing, error.line) from error.__cause__
