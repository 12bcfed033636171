"""The size of one exploration, and the times of the model.

Rule: one tick of time is one second, and times are small, so that few ticks matter: a Heartbeat every tick; after more than
two ticks of silence either half gives the other up. A worker looks for its learner for ever.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

from millrace.learner.rollouts.opponent_pool import OpponentPool, PoolSettings
from millrace.protocol.specs import RunSpec
from tests.support.conversation.fake_ends import run_spec

TICK_S = 1.0
TIMEOUT_S = 2.0
FOR_EVER_S = math.inf
SEED = 16  # of the pool: a version meets itself, the one before it, or the one before that


@dataclass(frozen=True)
class Settings:
    """What is explored completely."""

    workers: int
    lanes: int
    updates: int
    """number of updates after which a run has reached its target"""
    faults: int
    """number of faults, of any kinds, at any moments"""
    max_lag: int = 0
    only: tuple[str, ...] = ()
    """kinds of faults; empty: all"""
    opponents: int = 0
    """how many versions of the policy are opponents, the newest ones; 0: the policy plays all seats"""

    @property
    def few_losses(self) -> bool:
        """Whether at most two messages are lost. One of them makes that time passes, so at most one Heartbeat is lost."""
        return self.faults <= 2 and bool(self.only) and set(self.only) <= {"drop up", "drop down"}

    @cached_property
    def run(self) -> RunSpec:
        return run_spec(self.lanes, heartbeat_s=TICK_S, learner_timeout_s=TIMEOUT_S)

    def pool(self, newest: int) -> OpponentPool | None:
        """The opponents when this is the newest version; -1: there is none."""
        if not self.opponents:
            return None
        pool = OpponentPool(PoolSettings(SEED, self.opponents, save_steps=1, latest=0.0, max_lag=self.max_lag))
        for version in range(newest + 1):
            pool.made(version, version)
        return pool

    def __str__(self) -> str:
        size = f"{self.workers} workers, {self.lanes} lanes, {self.updates} updates, {self.faults} faults"
        size += f", max_lag {self.max_lag}" + (f", {self.opponents} opponents" if self.opponents else "")
        return ", ".join([size, *[f"only {each}" for each in self.only]])
