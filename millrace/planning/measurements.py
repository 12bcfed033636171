"""Measurements of an environment, of this machine, and of millrace on this machine. Plain data; times are in seconds."""

from __future__ import annotations

from typing import Literal

import msgspec

COMPUTES = 0.5  # if the share of CPU time in a step is above this, the step counts as computing, otherwise as waiting
WORKER_BYTES = 50 << 20
"""Memory of a worker without an env copy."""

NoMore = Literal["", "time", "no faster", "failed"]
"""Why no larger number of workers was measured: the time was up, a larger one was hardly faster, or it failed. Empty if all
numbers that this machine allows were measured.
"""
ActionKind = Literal["box", "discrete", "other"]
"""Kind of action space; `box` means a Box with finite bounds."""


class StepCosts(msgspec.Struct, frozen=True, kw_only=True):
    """The costs of an env step while some workers step side by side, each with one copy, or several if steps are short."""

    workers: int
    """number of workers"""
    steps: int
    """number of measured steps of all copies"""
    mean_s: float
    median_s: float
    p95_s: float
    """95th percentile of the step time"""
    std_s: float
    """standard deviation of the step time"""
    cpu_s: float
    """CPU time of a step, including that of processes which the environment has started"""
    delay_s: float = 0.0
    """time in which the step was ready to run but had to wait for a core"""
    slowest_copy: float = 1.0
    """mean step time of the slowest copy, divided by that of the median copy"""

    @property
    def wait_s(self) -> float:
        """The part of a step in which the copy waits for something other than a core."""
        return max(0.0, self.mean_s - self.cpu_s - self.delay_s)

    @property
    def own_s(self) -> float:
        """The time of a step if a core is free."""
        return self.cpu_s + self.wait_s

    @property
    def cpu_share(self) -> float:
        """How many cores a copy keeps busy while it is stepped: about 1 if it computes, about 0 if it waits."""
        return self.cpu_s / max(self.own_s, 1e-12)

    @property
    def computes(self) -> bool:
        """Whether a step computes for most of its time; otherwise it mostly waits."""
        return self.cpu_share > COMPUTES

    @property
    def steps_per_s(self) -> float:
        """Env steps/s of these workers, if no worker waits for another one."""
        return self.workers / max(self.mean_s, 1e-12)


class Measurements(msgspec.Struct, frozen=True, kw_only=True):
    """Measurements of an environment, made with random actions."""

    env: str
    agents: int = 1
    action: ActionKind = "other"
    images: bool = False
    goals: bool = False
    """whether its observations contain goals, as hindsight replay needs them"""
    masks_in_info: bool = False
    """whether its infos contain masks of the allowed actions, as a run needs them"""
    wrong_masks: str = ""
    """why a run could not use its masks, and when that was found; empty if it could, or if there are none"""
    observation_bytes: int = 0
    side_by_side: tuple[StepCosts, ...]
    """costs of a step for each number of workers that was tried, in ascending order; never empty"""
    no_more: NoMore = ""
    """why `side_by_side` has no larger number of workers"""
    copies_worked: int = 1
    """the largest number of copies that were stepped side by side without a problem that is due to their number"""
    copies_failed: int = 0
    """the smallest number of copies, more than `copies_worked`, that may have had a problem because of their number; 0 if
    there is none
    """
    copies_tried: tuple[int, ...] = ()
    """all numbers of copies that worked at the same time, or failed because of their number, in ascending order"""
    worked_in_one_worker: int = 1
    """the largest number of copies that were stepped in the same worker without such a problem"""
    failed_in_one_worker: int = 0
    """the smallest number of copies, more than one, that may have had a problem because they were in the same worker; 0 if
    there is none
    """
    slowest_step_s: float = 0.0
    """wall time of the slowest step of all copies"""
    reset_s: float = 0.0
    """mean wall time of a reset"""
    reset_cpu_s: float = 0.0
    resets: int = 0
    """number of measured resets"""
    episode_steps: float | None = None
    """mean length of an episode, or the time limit if no episode has ended; None if neither is known"""
    start_s: float = 0.0
    """time from the start of a worker until its env copy is made"""
    worker_bytes: int = 0
    """memory of a worker with one copy, including the processes that the copy has started"""
    deterministic: bool | None = None
    """whether another copy returns the same results for the same seed and actions; None if it isn't known"""
    failures: int = 0
    """number of crashes, exceptions and calls that hung, without those that were due to the number of copies"""
    calls: int = 0
    """number of steps and resets in which these failures happened"""
    calls_s: float = 0.0
    """wall time of these steps and resets together"""
    findings: tuple[str, ...] = ()
    """problems that were found, such as a crash or a step that hung; one line each"""

    @property
    def alone(self) -> StepCosts:
        """The costs of a step while only one worker steps."""
        return self.side_by_side[0]

    @property
    def ends_every(self) -> float:
        """Number of steps between two resets of a copy; infinite if unknown."""
        return self.episode_steps or float("inf")

    @property
    def step_with_reset_s(self) -> float:
        """Mean time of a step if a core is free, plus its share of a reset."""
        return self.alone.own_s + self.reset_s / self.ends_every

    @property
    def copy_bytes(self) -> int:
        """Memory of a copy, without that of its worker; at least 1."""
        return max(1, self.worker_bytes - WORKER_BYTES)

    @property
    def best_apart(self) -> bool:
        """Whether each copy should have its own worker, because steps mostly wait or several copies in one worker failed."""
        return not self.alone.computes or bool(self.failed_in_one_worker)

    def costs(self, workers: int) -> StepCosts:
        """The costs measured with this number of workers or the next larger one; if neither was tried, with the largest."""
        return next((each for each in self.side_by_side if each.workers >= workers), self.side_by_side[-1])


class Machine(msgspec.Struct, frozen=True, kw_only=True):
    """The resources that a run may use on this machine, or in this job or container."""

    cores: int
    free_bytes: int | None = None
    """free memory; None if the system doesn't report it"""
    most_copies: int = 0
    """maximum number of env copies that may train at the same time, for example because of licences; 0: no limit"""
    load: float = 0.0
    """load average over the preceding minute: the number of other processes that used a core or waited for one"""


class Overheads(msgspec.Struct, frozen=True, kw_only=True):
    """The time that millrace itself needs on this machine, measured with an environment that does nothing.

    A worker that has l lanes with n copies in total needs `row_s + l · lane_row_s + n · copy_row_s` for one step of all its
    copies, and `l · sent_s` to send their rollouts. For a round of L lanes and R env steps, the learner needs
    `round_s + L · rollout_s + R · received_s` to gather the rollouts, and `R · update_s` for the update.
    """

    row_s: float
    lane_row_s: float
    copy_row_s: float
    sent_s: float
    round_s: float
    rollout_s: float
    received_s: float
    update_s: float
    update_cores: float = 1.0
    """cores that an update keeps busy"""
    acting_bytes: int = 0
    """additional memory that a worker needs to act with this policy"""

    def worker_s(self, lanes: int, copies: int, steps: int) -> float:
        """The time that a worker with these lanes and copies needs for a round of `steps` steps, on top of the copies' own
        time.
        """
        return steps * (self.row_s + lanes * self.lane_row_s + copies * self.copy_row_s) + lanes * self.sent_s

    def gathering_s(self, lanes: int, steps: float) -> float:
        """The time that the learner needs to gather a round of this many lanes and env steps."""
        return self.round_s + lanes * self.rollout_s + steps * self.received_s
