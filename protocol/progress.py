"""The progress of a run: one record that the learner sends, writes into the run folder, and shows. Pure.

Rule: the record is plain data of bounded size, so that it can be sent, and read from a folder that may come from a stranger.
Everything that shows the progress of a run renders this record, and counts nothing itself.
"""

from __future__ import annotations

import msgspec

from millrace.protocol.bounds import Figure, Line, Moment, Name, Natural, Real


class RunProgress(msgspec.Struct, frozen=True, kw_only=True):
    """The progress of a run at one moment. Returns are sums of raw rewards. A number that does not exist is None."""

    at_s: Moment = 0.0
    """the time of this moment; 0 if it is not known"""
    env_steps: Natural = 0
    """env steps that updates have used so far, including those before a resume"""
    collected: Natural = 0
    """env steps of the rollouts that the learner is waiting for, as workers report them; 0 while it waits for none"""
    total_steps: Natural = 0
    """env steps to train for; 0 if there is no end, as for your own learner, or a vector environment"""
    updates: Natural = 0
    """updates made so far, including those before a resume"""
    wall_s: Figure = 0.0
    """seconds of training, including those before a resume; evaluations do not count"""
    steps_per_s: Figure = 0.0
    """env steps per second of training since this process started, `collected` included"""
    return_mean: Real | None = None
    """mean return of the last 100 training episodes, in raw rewards; None before the first has ended"""
    length_mean: Figure | None = None
    """mean length of the same episodes, in env steps"""
    lag_mean: Figure = 0.0
    """mean lag of the rollouts of the last update, in versions of the weights"""
    lag_max: Natural = 0
    """the largest lag of these rollouts"""
    workers_alive: Natural = 0
    """workers that have joined and are not lost"""
    workers_expected: Natural = 0
    """workers that this run starts; 0 if any number may join"""
    ledger: dict[Name, Natural] = {}
    """number of tickets and transitions in each state"""
    stages: dict[Name, Figure] = {}
    """seconds that the learner, and all workers together, have spent in each stage so far"""
    phase: Name = ""
    """the learner's current activity: starting, gathering rollouts, learning, or evaluating; empty if it is not known"""
    waiting: Line = ""
    """who waits for whom, and for what share of the time, or the progress of an evaluation: "evaluating for 41 s: 37 of 100
    episodes (…"; empty if no one waits for long"""
    stop_reason: Line = ""
    """why the run ended; empty while it continues"""
    cut_short: bool = False
    """whether an error or an interrupt ended the run"""

    @property
    def env_steps_made(self) -> int:
        """Env steps that updates have used, plus those already collected for the next update.

        At the end of a run, workers may collect more than `total_steps`. The rest doesn't count, because no update uses it.
        """
        made = self.env_steps + self.collected
        return max(self.env_steps, min(made, self.total_steps)) if self.total_steps else made

    @property
    def share(self) -> float:
        """The share of the run that is done, from 0 to 1; 0 if the run has no end."""
        return min(1.0, self.env_steps_made / self.total_steps) if self.total_steps else 0.0

    @property
    def left_s(self) -> float | None:
        """Seconds of training that are left, at the speed so far; None if that is not known."""
        if self.steps_per_s <= 0:
            return None
        return max(0, self.total_steps - self.env_steps_made) / self.steps_per_s
