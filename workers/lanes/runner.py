"""Steps the env copies of lanes with a policy's actions, in rollouts and in evaluations.

Rule: lanes that are run together are stepped in lock-step, with one forward pass for all of them [L, N · A, ·]. The result
of a lane depends only on the lane and the weights, not on the other lanes. An evaluation differs from a rollout in its lane
(`Lane.autoresets`), in how its actions are chosen, and in how many rows are run at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from millrace.protocol.arrays import Array
from millrace.protocol.bounds import Stages
from millrace.protocol.envs.env_actions import action_converter_of
from millrace.protocol.errors import EnvironmentFailed, PolicyFailed
from millrace.protocol.policy.called_policy import CalledPolicy
from millrace.protocol.policy.masks import stored_leaves
from millrace.protocol.policy.policy import Policy
from millrace.protocol.specs import RunSpec
from millrace.workers.acting import StepActions, acting_of
from millrace.workers.copies.env_loop import Pulse
from millrace.workers.copies.value_checks import check_observed, check_rewards
from millrace.workers.lanes.rows import Rows


class TogetherSteps(Protocol):
    """Steps the copies of several lanes at once, because one vector environment holds them all.

    `begin` orders them to step. `end` waits for them; after that, each lane's own step returns its part of the result.
    """

    def parts(self, lanes: int) -> Sequence[slice]:
        """Divide this many lanes into parts: the policy acts for one part while the copies of the other parts step."""

    def begin(self, lanes: Sequence[int], actions: Array, pulse: Pulse) -> None:
        """Order the copies of these L lanes to step, with actions [L, N, *action]."""

    def end(self, lanes: Sequence[int], pulse: Pulse) -> None:
        """Wait for the copies of these lanes."""


class NoneTogether:
    """Each lane steps its own copies."""

    def parts(self, lanes: int) -> Sequence[slice]:
        """A single part with all lanes."""
        return (slice(None),)

    def begin(self, lanes: Sequence[int], actions: Array, pulse: Pulse) -> None:
        """Do nothing."""

    def end(self, lanes: Sequence[int], pulse: Pulse) -> None:
        """Do nothing."""


Actions = TypeVar("Actions", bound=StepActions, covariant=True)


class Part(NamedTuple, Generic[Actions]):
    """Lanes that are stepped in lock-step: their rows, and the actions that fill them."""

    rows: Rows
    actions: Actions


class LaneRunner:
    """Steps lanes with the actions of one policy."""

    def __init__(self, run: RunSpec, policy: Policy | CalledPolicy, together: TogetherSteps | None = None) -> None:
        """`together` steps the env copies of all lanes at once, if one vector environment holds them all."""
        self.acting = acting_of(run, policy)
        self.stages: Stages = {"open": 0.0, "act": 0.0, "step": 0.0}
        """seconds spent opening lanes (making copies and their first reset), choosing actions and stepping copies"""
        self.together: TogetherSteps = NoneTogether() if together is None else together
        self.to_env_action = action_converter_of(run.policy)
        self._run = run
        self._stored = stored_leaves(run)

    def run(self, parts: Sequence[Part[StepActions]], pulse: Pulse) -> None:
        """Fill the rows of these parts. In an evaluation, stop when all its episodes are over.

        With two parts, the policy acts for one while the copies of the other step. `pulse` is called at every step and may
        raise. Raises `EnvironmentFailed` and `PolicyFailed`, and `EpisodesLost` in an evaluation. The values of the rows are
        not checked, unless something raised.
        """
        stepped = [_SteppedPart(self._run, part, self) for part in parts]
        try:
            for t in range(parts[0].rows.steps):
                for each in stepped:
                    each.end(pulse)
                    each.begin(t, pulse)
            for each in stepped:
                each.end(pulse)
        except (EnvironmentFailed, PolicyFailed, IndexError):
            # An invalid observation or reward may have caused the error. In that case, these checks raise a clearer error.
            for part in parts:
                self.check(part.rows)
            raise
        for each in stepped:
            each.complete()

    def check(self, rows: Rows) -> None:
        """Check what the environments returned in the rows that are filled. Raises `EnvironmentFailed`."""
        filled = rows.filled
        axes = self._run.row_axes
        for each in rows.of_lanes:
            number = each.lane.number
            check_observed(number, self._stored, [leaf[: filled + 1] for leaf in each.obs], axes, rows.first_step)
            check_rewards(number, each.reward[:filled], axes, rows.first_step)


class _SteppedPart:
    """A part that is being stepped: `begin` chooses the actions and orders a step; `end` waits for the step to finish."""

    def __init__(self, run: RunSpec, part: Part[StepActions], runner: LaneRunner) -> None:
        self._rows, self._actions = part
        self._together = runner.together
        self._stages = runner.stages
        self._to_env_action = runner.to_env_action
        self._with_seats = bool(run.seats)
        self._counts_rows = self._with_seats or not self._rows.of_lanes[0].lane.autoresets
        self._forgets = self._rows.state.size > 0 and not self._counts_rows
        self._resets = self._rows.resets[:, 0].copy()  # [L, N] whether the next row only resets
        self._row: int | None = None  # the row of the step that has begun
        self._taken: Array  # [L, N · A, *action] of this row
        self._over = False

    def begin(self, t: int, pulse: Pulse) -> None:
        """Choose the actions of row t, and order the copies to step. In an evaluation that is over, do nothing."""
        if self._over:
            return
        rows = self._rows
        rows.begin_row()
        pulse()
        began = perf_counter()
        with np.errstate(all="ignore"):  # a NaN is reported once the rows are complete
            before = rows.state.copy() if self._with_seats else rows.state
            chosen = self._actions.act(t, [leaf[:, t] for leaf in rows.obs], rows.state)
            taken = self._taken = self._to_env_action(chosen)
            if self._with_seats:
                for i, each in enumerate(rows.of_lanes):
                    each.acted(t, self._actions.written(i), before[i], taken[i])
        acted = perf_counter()
        self._together.begin(rows.numbers, taken, pulse)
        self._row = t
        self._stages["act"] += acted - began
        self._stages["step"] += perf_counter() - acted

    def end(self, pulse: Pulse) -> None:
        """Wait for the step that has begun, if any, and write what it returned."""
        if (t := self._row) is None:
            return
        self._row = None
        rows = self._rows
        began = perf_counter()
        self._together.end(rows.numbers, pulse)
        for i, each in enumerate(rows.of_lanes):
            each.step(t, self._taken[i], pulse)
        ended = perf_counter()
        rows.step_end_s.append(ended)
        self._stages["step"] += ended - began
        if self._counts_rows:
            for each in rows.of_lanes:
                each.count(t, ended)
            self._over = rows.are_over
        elif self._forgets:
            rows.state[self._resets] = 0.0
            self._resets = rows.terminated[:, t] | rows.truncated[:, t]

    def complete(self) -> None:
        """Finish the part, now that all rows are filled."""
        if not self._counts_rows:
            for each in self._rows.of_lanes:
                each.count_all()
