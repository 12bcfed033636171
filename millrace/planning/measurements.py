"""What was measured of an environment, of this machine and of millrace on it. Plain data; times are in seconds."""

from __future__ import annotations

from typing import Literal

import msgspec

COMPUTES = 0.5  # with a larger share of CPU time
WORKER_BYTES = 50 << 20
"""Memory of a worker without an env copy."""

ActionKind = Literal["box", "discrete", "other"]
"""box: a Box with finite bounds"""


class StepCosts(msgspec.Struct, frozen=True, kw_only=True):
    """What a step costs while some workers step side by side, each one copy, or several if steps are short."""

    workers: int
    """number of workers"""
    steps: int
    """number of steps that were measured, of all copies"""
    mean_s: float
    median_s: float
    p95_s: float
    """95 of 100 steps take no longer"""
    std_s: float
    """standard deviation"""
    cpu_s: float
    """CPU time of a step, with that of the processes which the environment has started"""
    delay_s: float = 0.0
    """time in which it could go on and had no core, because others had them all"""
    slowest_copy: float = 1.0
    """mean step time of the slowest copy, divided by that of the median copy"""

    @property
    def wait_s(self) -> float:
        """The part of a step in which the copy waits for something else than a core."""
        return max(0.0, self.mean_s - self.cpu_s - self.delay_s)

    @property
    def own_s(self) -> float:
        """What a step takes if a core is free."""
        return self.cpu_s + self.wait_s

    @property
    def cpu_share(self) -> float:
        """How many cores a copy keeps busy while it is stepped: about 1 if it computes, about 0 if it waits."""
        return self.cpu_s / max(self.own_s, 1e-12)

    @property
    def computes(self) -> bool:
        """Whether a step computes for most of its time; else it waits."""
        return self.cpu_share > COMPUTES

    @property
    def steps_per_s(self) -> float:
        """Env steps/s of these workers, if none of them ever waits for another one."""
        return self.workers / max(self.mean_s, 1e-12)


class Measurements(msgspec.Struct, frozen=True, kw_only=True):
    """What was measured of an environment, with random actions."""

    env: str
    agents: int = 1
    action: ActionKind = "other"
    images: bool = False
    goals: bool = False
    """whether its observations have goals, as hindsight needs them"""
    observation_bytes: int = 0
    side_by_side: tuple[StepCosts, ...]
    """by number of workers, the least first; never empty"""
    reset_s: float = 0.0
    """mean wall time of a reset"""
    reset_cpu_s: float = 0.0
    resets: int = 0
    """number of resets that were measured"""
    episode_steps: float | None = None
    """mean length of an episode, or the time limit if no episode has ended; None: neither is known"""
    start_s: float = 0.0
    """from the start of a worker until its copy is made"""
    worker_bytes: int = 0
    """memory of a worker with one copy, and of what the copy has started"""
    repeats: bool | None = None
    """whether another copy shows and gives the same for the same seed and actions; None: nobody knows"""
    findings: tuple[str, ...] = ()
    """what else was found, each in a line: a crash, a step that hung"""

    @property
    def alone(self) -> StepCosts:
        """The costs of a step of one copy alone."""
        return self.side_by_side[0]

    @property
    def ends_every(self) -> float:
        """Steps between two resets of a copy; infinite if none is known."""
        return self.episode_steps or float("inf")

    @property
    def step_with_reset_s(self) -> float:
        """Mean time of a step if a core is free, with its share of a reset."""
        return self.alone.own_s + self.reset_s / self.ends_every

    def costs(self, workers: int) -> StepCosts:
        """Those that were measured with as many workers, or with the next larger number; else with the most."""
        return next((each for each in self.side_by_side if each.workers >= workers), self.side_by_side[-1])


class Machine(msgspec.Struct, frozen=True, kw_only=True):
    """What this machine, or the job or container here, leaves to a run."""

    cores: int
    free_bytes: int | None = None
    """None: the system does not say"""
    most_copies: int = 0
    """so many env copies are allowed at the same time, as by licences; 0: any number"""
    load: float = 0.0
    """the load average of the minute before: processes of others that used a core or waited for one"""


class Overheads(msgspec.Struct, frozen=True, kw_only=True):
    """What millrace itself takes on this machine, with an environment that does nothing.

    A worker that holds l lanes with n copies in all takes `row_s + l · lane_row_s + n · copy_row_s` for a step of all of
    them, and `l · sent_s` for their rollouts. A round of L lanes and R env steps then takes the learner
    `round_s + L · rollout_s + R · received_s` until all of it is gathered, and `R · update_s` for the update.
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
    """memory that a worker needs in addition if it acts with this policy"""

    def worker_s(self, lanes: int, copies: int, steps: int) -> float:
        """What a round takes a worker with so many lanes and copies, without the time of the copies."""
        return steps * (self.row_s + lanes * self.lane_row_s + copies * self.copy_row_s) + lanes * self.sent_s

    def gathering_s(self, lanes: int, steps: float) -> float:
        """What a round of so many lanes and env steps takes the learner until all of it is gathered."""
        return self.round_s + lanes * self.rollout_s + steps * self.received_s
