"""Brings a lane back: continues its episodes on new env copies, from the lane's history (`protocol/lane_past.py`).

Rule: each episode begins as it did before, and its actions are replayed without the policy, row by row, in all copies
together. Then the copies' observations, returns and lengths are compared with the history. If they differ, the environment
is not deterministic, and the copy begins a new episode, with the next start number. Replayed steps are subject to the
environment's usual timeouts, but don't count as env steps. If an environment has saved its state, the state is loaded
instead, and nothing is replayed. The history comes from another worker, which may be hostile, so what can't be compared is
checked: it must be possible in the run, and the policy must be able to act on observations that aren't replayed. Otherwise
the lane's next rollouts could be refused, or the policy could fail.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from time import perf_counter

import msgspec
import numpy as np

from millrace.protocol.arrays import Array, Doubles
from millrace.protocol.bounds import INVALID
from millrace.protocol.envs.env_actions import action_converter_of
from millrace.protocol.envs.seats import columns_of
from millrace.protocol.errors import PolicyFailed
from millrace.protocol.lane_past import LanePast
from millrace.protocol.policy.masks import not_allowed, stored_leaves
from millrace.protocol.policy.recurrent import is_possible
from millrace.protocol.rows.array_checks import wrong_values
from millrace.protocol.specs import RunSpec
from millrace.workers.acting import RolloutActions
from millrace.workers.copies.env_copies import LoopedCopies, StepResult, copy_seed
from millrace.workers.copies.env_errors import environment_failures
from millrace.workers.copies.env_loop import Pulse
from millrace.workers.copies.row_writers import write_numbers
from millrace.workers.copies.saved_state import SavedCopy, unpacked
from millrace.workers.lanes.lane import Lane

NOT_DETERMINISTIC = (
    "the environment isn't deterministic: when a lost episode was begun again with the same seed and its actions were "
    "replayed, or its saved state was loaded, {}; so a new episode began instead, and results depend on who was lost"
)
IMPOSSIBLE = (
    "the state of a lane, as the worker that had the lane sent it, isn't possible in this run; so new episodes began "
    "instead, and results depend on who was lost"
)


def bring_back(
    run: RunSpec, lane: Lane, past: LanePast, attributes: bytes, pulse: Pulse, actions: RolloutActions | None = None
) -> str:
    """Continue a lane from its history (`past`) on a new `Lane`. The copies of the new lane must not have been reset yet.

    At the end, the copies have these `attributes` (packed). `actions` are the policy's for one lane; what they have written
    is overwritten. If the history doesn't fit the lane, it is not continued, and new episodes begin instead.
    Returns a line for the user, or an empty string if there is nothing to report. Raises `EnvironmentFailed` if a copy
    raises.
    """
    copies = lane.copies
    continued: list[int] = []
    states: list[SavedCopy] = []
    saved = any(last.saved for last in past.copies)
    memory = past.memory[:-1] if saved else past.memory
    why = ""
    if isinstance(copies, LoopedCopies) and lane.remembers and any(last.goes_on for last in past.copies):
        if _fits(past, memory, lane, run, actions) and (not saved or _can_act(past, memory, lane, run, actions)):
            continued = [n for n, last in enumerate(past.copies) if last.goes_on]
            states = _states(past.memory[-1], lane) if saved else []
        else:
            why = IMPOSSIBLE
    if not isinstance(copies, LoopedCopies) or not continued:  # if `why` is empty, the learner knows why
        lane.set_attributes(attributes, pulse)
        starts = [last.start + 1 for last in past.copies]
        lane.start(starts if len(starts) == lane.count else [max(starts, default=1)] * lane.count, pulse)
        return why
    repeated = _Repeated(run, lane, copies, msgspec.structs.replace(past, memory=memory), continued, pulse)
    with environment_failures(lane.number, "while its episode was continued"), copies.repeating():
        repeated.repeat()
        repeated.load(states)
        lane.set_attributes(attributes, pulse)
        repeated.compare()
        repeated.start_others()
    repeated.hand_over()
    return NOT_DETERMINISTIC.format(repeated.why) if repeated.why else ""


class _Repeated:
    """The copies of a lane while their episodes are replayed."""

    def __init__(
        self, run: RunSpec, lane: Lane, copies: LoopedCopies, past: LanePast, continued: list[int], pulse: Pulse
    ) -> None:
        self.continued = continued
        """the copies that can still be continued, because they have matched the history so far"""
        self.why = ""
        """how the first copy that didn't match the history differed from it; empty if all have matched"""
        self._run = run
        self._lane = lane
        lane.starts = [last.start for last in past.copies]
        self._copies = copies
        self._past = past
        self._pulse = pulse
        self._seats = run.seats_of_copy
        self._acts = np.zeros(lane.columns, bool)
        self._waits = np.zeros(lane.columns, bool)
        self._obs = [np.empty_like(leaf) for leaf in past.obs]
        self._returns = np.zeros((lane.count, self._seats))
        self._sizes = np.zeros(lane.count)  # [N] sum of the rewards' absolute values
        self._numbers = (np.zeros(lane.columns), np.zeros(lane.columns, bool), np.zeros(lane.columns, bool))

    def repeat(self) -> None:
        """Begin the episodes as they began before, and replay their actions. Raises `CopyFailed` if a copy raises."""
        past = self._past
        attributes = past.attributes.by_row()
        taken = action_converter_of(self._run.policy)(past.action)
        self._lane.set_attributes(attributes.get(0, b""), self._pulse)
        self._seed(self.continued)
        for row in range(len(past.action)):
            if row and row in attributes:
                self._lane.set_attributes(attributes[row], self._pulse)
            if late := [n for n in self.continued if self._first(n) == row > 0 and self._begins_with_start(n)]:
                self._seed(late)
            if playing := [n for n in self.continued if self._first(n) <= row and past.copies[n].is_repeated]:
                result = self._step(taken[row], playing)
                if row == len(past.action) - 1:
                    self._see(result, playing)
            if next_ones := [n for n in self.continued if self._first(n) == row + 1 and self._follows(n)]:
                self._reset(next_ones)
        for n in list(self.continued):
            if past.copies[n].over and not past.copies[n].saved:
                self._set_random(n)

    def load(self, states: list[SavedCopy]) -> None:
        """Load the saved states. If the episode of a copy is over, let the next step reset the copy."""
        for n in list(self.continued):
            last = self._past.copies[n]
            if not last.saved:
                continue
            damaged = n >= len(states) or not (last.over or {last.steps}.issuperset(states[n].elapsed))
            if why := "its state is damaged" if damaged else self._copies.load(n, states[n]):
                self._differs(n, why)
        self._copies.end([n for n in self.continued if self._past.copies[n].over])

    def compare(self) -> None:
        """Compare the copies with the history, and stop continuing those that differ."""
        past = self._past
        returns = past.memory[0][:, :-1]
        for n in list(self.continued):
            if not past.copies[n].is_repeated:
                continue
            columns = columns_of([n], self._seats)
            most = self._sizes[n] * np.finfo(np.float64).eps * (len(past.action) - self._first(n) + 1)
            if any((new[columns] != old[columns]).any() for new, old in zip(self._obs, past.obs, strict=True)):
                self._differs(n, "it shows another observation")
            elif not np.abs(self._returns[n] - returns[n]).max() <= most < np.inf:  # tolerates another order of summation
                self._differs(n, "its rewards add up to another return")
            elif self._run.masked and self._forbidden(columns):
                self._differs(n, "an agent waits after an action that its mask forbids")

    def start_others(self) -> None:
        """Begin a new episode in each copy that isn't continued, with its next start number."""
        lane = self._lane
        anew = [n for n in range(lane.count) if n not in self.continued]
        for n in anew:
            lane.starts[n] += 1
        lane.new_starts = anew
        self._seed(anew)

    def hand_over(self) -> None:
        """Give the lane the state that the lost lane had after its last row, except for copies that aren't continued."""
        lane = self._lane
        past = self._past
        over = [n for n in self.continued if past.copies[n].over]
        shown = columns_of([n for n in self.continued if not past.copies[n].is_repeated], self._seats)
        for new, old in zip(self._obs, past.obs, strict=True):
            new[shown] = old[shown]
        self._acts[columns_of(over, self._seats)] = False
        lane.obs = tuple(self._obs)
        lane.playing[over] = False
        lane.episodes.begin(perf_counter())
        lane.episodes.returns += self._returns
        lane.recall(past.memory, [last.steps for last in past.copies], self.continued)
        lane.episodes.returns[over] = 0.0
        lane.episodes.lengths[over] = 0
        if lane.seats is not None:
            lane.seats.acts = self._acts
            lane.seats.waits = self._waits

    def _forbidden(self, columns: Sequence[int]) -> bool:
        """Whether the mask of one of these seats forbids the action after which the seat waits."""
        wrong = not_allowed(self._past.action[-1], self._past.obs[-1], self._run.policy.action)
        return bool((wrong & self._waits)[columns].any())

    def _first(self, n: int) -> int:
        """The row of the first action in the episode of copy n."""
        return self._past.copies[n].first

    def _begins_with_start(self, n: int) -> bool:
        """Whether the episode of copy n began with a reset with the seed of the copy's start."""
        last = self._past.copies[n]
        return last.is_repeated and last.random == b""

    def _follows(self, n: int) -> bool:
        """Whether the episode of copy n began with the automatic reset in a step, which has no seed."""
        last = self._past.copies[n]
        return bool(last.random) and last.is_repeated

    def _seed(self, copies: list[int]) -> None:
        """Reset these copies, each with the seed that its start number determines."""
        if copies:
            lane = self._lane
            assert lane.number is not None
            self._began(copies, [copy_seed(self._run.seed, lane.number, lane.starts[n], n) for n in copies])

    def _reset(self, copies: list[int]) -> None:
        """Begin the next episodes of these copies, from the random states that the copies had when these episodes began."""
        if able := [n for n in copies if self._set_random(n)]:
            self._began(able, [None] * len(able))

    def _set_random(self, n: int) -> bool:
        random = self._past.copies[n].random
        if random and self._copies.set_random_state(n, random):
            return True
        self._differs(n, "the state of its np_random could not be set")
        return False

    def _began(self, copies: list[int], seeds: Sequence[int | None]) -> None:
        result = self._copies.reset_some(copies, seeds, self._pulse)
        self._see(result, copies)
        self._waits[columns_of(copies, self._seats)] = False
        self._returns[copies] = 0.0
        self._sizes[copies] = 0.0
        if result.columns is not None:
            self._count(copies, result.columns.outside)

    def _see(self, result: StepResult, copies: list[int]) -> None:
        """Store the observations of these copies."""
        columns = columns_of(copies, self._seats)
        self._lane.writer.write_some(self._obs, columns, result.leaves)
        if result.columns is not None:
            self._acts[columns] = result.columns.acts[columns]

    def _step(self, taken: Array, copies: list[int]) -> StepResult:
        """Step these copies, and add up their rewards. A copy whose episode ends is no longer continued."""
        self._pulse()
        columns = columns_of(copies, self._seats)
        self._waits[columns] |= self._acts[columns]
        result = self._copies.step(taken[columns], self._pulse, copies)
        write_numbers(self._numbers, slice(None), (result.reward, result.terminated, result.truncated))
        reward, terminated, truncated = self._numbers
        self._count(copies, reward)
        over = terminated | truncated
        if result.columns is not None:
            self._count(copies, result.columns.outside)
            over = result.columns.over
            self._waits[columns] &= ~result.columns.complete[columns]
            self._acts[columns] = result.columns.acts[columns]
        for n in copies:
            if over[n]:
                self._differs(n, "it ended earlier")
        return result

    def _count(self, copies: list[int], rewards: Doubles) -> None:
        """Add the rewards [N · A] of these copies to their returns."""
        by_copy = rewards.reshape(-1, self._seats)[copies]
        self._returns[copies] += by_copy
        self._sizes[copies] += np.abs(by_copy).sum(axis=1)

    def _differs(self, n: int, why: str) -> None:
        self.continued.remove(n)
        self.why = self.why or why


def _states(blob: Array, lane: Lane) -> list[SavedCopy]:
    """Decode the states of all copies. Returns an empty list if they are damaged."""
    try:
        states = unpacked(blob)
    except INVALID:
        return []
    return states if len(states) == lane.count else []


def _fits(past: LanePast, memory: Sequence[Array], lane: Lane, run: RunSpec, actions: RolloutActions | None) -> bool:
    """Whether the arrays fit this lane. They come from another worker, by way of the learner, and so may be wrong."""
    if len(past.copies) != lane.count or len(past.obs) != len(stored_leaves(run)):
        return False
    action = run.policy.action
    rows = past.action.shape[0] if past.action.ndim else 0
    expected: Iterable[tuple[Array, tuple[int, ...], str]] = [
        (past.action, (rows, lane.columns, *action.shape), action.stored_dtype),
        *(
            (array, (lane.columns, *leaf.shape), leaf.dtype)
            for array, leaf in zip(past.obs, stored_leaves(run), strict=True)
        ),
    ]
    shapes = all(array.shape == shape and array.dtype == dtype for array, shape, dtype in expected)
    before = [1 if last.random and last.is_repeated else 0 for last in past.copies]  # 1 if the row of the reset comes first
    firsts = all(least <= last.first <= rows for least, last in zip(before, past.copies, strict=True))
    written = () if lane.seats is None or actions is None else actions.written(0)
    if not (shapes and firsts and lane.can_recall(memory, written, [last.steps for last in past.copies])):
        return False
    return actions is None or not written or _held_fits(past, memory[len(memory) - len(written) :], run, actions)


def _held_fits(past: LanePast, held: Sequence[Array], run: RunSpec, actions: RolloutActions) -> bool:
    """Whether the rows of seats that wait will be valid. They repeat what the policy wrote when these seats `held` acted."""
    for array, of_columns in zip(actions.written(0), held, strict=True):
        array[:] = of_columns
    action = actions.chosen(0)
    if wrong_values(action, run.policy.action) or not (action[-1:] == past.action[-1:]).all():
        return False
    with np.errstate(all="ignore"):
        acted = actions.columns(0)
    return not any(wrong_values(array) for array in (acted.log_prob, *acted.extras))


def _can_act(past: LanePast, memory: Sequence[Array], lane: Lane, run: RunSpec, actions: RolloutActions | None) -> bool:
    """Whether the policy returns valid rows for the last observations. Nothing else checks them if states are loaded: any
    finite numbers may come from an environment, but from some of them, the policy computes infinite ones.
    """
    if actions is None:
        return True
    state = (memory[1] if lane.state.size else lane.state).copy()
    try:
        with np.errstate(all="ignore"):
            actions.act(0, [leaf[None].copy() for leaf in past.obs], state[None])
            for array in actions.written(0):
                array[:] = array[:1]
            acted = actions.columns(0)
    except PolicyFailed:
        return False
    if wrong_values(acted.action, run.policy.action) or not is_possible(run.policy, state):
        return False
    return not any(wrong_values(array) for array in (acted.log_prob, *acted.extras))
