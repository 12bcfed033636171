"""Steps a policy over the env copies of lanes, in rollouts as in evaluations.

Rule: lanes that are run together are stepped in lock-step, with one forward pass for all of them [L, N · A, ·]. The result
of a lane depends only on the lane and the weights, not on the other lanes. An evaluation differs in its lane
(`Lane.autoresets`), in how its actions are chosen, and in how many rows are run at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from time import perf_counter

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

StepAll = Callable[[Sequence[int], Array, Pulse], None]
"""Called with the numbers of L lanes and their actions [L, N, *action], before each of them is stepped."""


def no_step_for_all(lanes: Sequence[int], actions: Array, pulse: Pulse) -> None:
    """Do nothing: each lane steps its own copies."""


class LaneRunner:
    """Steps lanes with the actions of one policy."""

    def __init__(self, run: RunSpec, policy: Policy | CalledPolicy, step_all: StepAll = no_step_for_all) -> None:
        """`step_all`: steps the env copies of all lanes at once, if one vector environment holds them all."""
        self.acting = acting_of(run, policy)
        self.stages: Stages = {"open": 0.0, "act": 0.0, "step": 0.0}
        """seconds spent opening lanes (making copies and their first reset), choosing actions and stepping copies"""
        self._run = run
        self._stored = stored_leaves(run)
        self._step_all = step_all
        self._to_env_action = action_converter_of(run.policy)

    def run(self, rows: Rows, actions: StepActions, pulse: Pulse) -> None:
        """Fill these rows; in an evaluation, until all its episodes are over. `pulse` is called at every step and may raise.

        Raises `EnvironmentFailed` and `PolicyFailed`, and `EpisodesLost` in an evaluation. The values of the rows are not
        checked, unless something raised.
        """
        try:
            self._fill(rows, actions, pulse)
        except (EnvironmentFailed, PolicyFailed, IndexError):
            # An invalid observation or reward may have caused the error. Then these checks raise a clearer one.
            self.check(rows)
            raise

    def check(self, rows: Rows) -> None:
        """Check what the environments returned in the rows that are filled. Raises `EnvironmentFailed`."""
        filled = rows.filled
        axes = self._run.row_axes
        for each in rows.of_lanes:
            number = each.lane.number
            check_observed(number, self._stored, [leaf[: filled + 1] for leaf in each.obs], axes, rows.first_step)
            check_rewards(number, each.reward[:filled], axes, rows.first_step)

    def _fill(self, rows: Rows, actions: StepActions, pulse: Pulse) -> None:
        lanes = rows.of_lanes
        stages = self.stages
        step_all = self._step_all
        to_env_action = self._to_env_action
        with_seats = bool(self._run.seats)
        counts_rows = with_seats or not lanes[0].lane.autoresets
        forgets = rows.state.size > 0 and not counts_rows
        resets = rows.resets[:, 0].copy()  # [L, N] whether row t only resets
        for t in range(rows.steps):
            rows.begin_row()
            pulse()
            began = perf_counter()
            with np.errstate(all="ignore"):  # a NaN is reported once the rows are complete
                before = rows.state.copy() if with_seats else rows.state
                chosen = actions.act(t, [leaf[:, t] for leaf in rows.obs], rows.state)
                taken = to_env_action(chosen)
                if with_seats:
                    for i, each in enumerate(lanes):
                        each.acted(t, actions.written(i), before[i], taken[i])
            acted = perf_counter()
            step_all(rows.numbers, taken, pulse)
            for i, each in enumerate(lanes):
                each.step(t, taken[i], pulse)
            ended = perf_counter()
            rows.step_end_s.append(ended)
            stages["act"] += acted - began
            stages["step"] += ended - acted
            if counts_rows:
                for each in lanes:
                    each.count(t, ended)
                if rows.are_over:
                    break
            elif forgets:
                rows.state[resets] = 0.0
                resets = rows.terminated[:, t] | rows.truncated[:, t]
        if not counts_rows:
            for each in lanes:
                each.count_all()
