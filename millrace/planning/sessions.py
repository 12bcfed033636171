"""What happened in the sessions of a probe, and whether copies failed because of their number. Pure.

Rule: copies failed because of their number only if all tries with this number failed, and either not all copies could take
a few steps, or one copy alone took at least `RARER` times as many steps for each failure. Any other failure, such as a crash
or a hang now and then, can happen to each copy and limits nothing, so it is only counted. If it happens early and there is
enough time, the same number of copies is stepped again, and what was measured before and after it is added up.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import gymnasium

from millrace.planning.in_words import counted, number_in_words
from millrace.planning.probe_sizes import SessionSize
from millrace.planning.random_actions import SeenMasks
from millrace.planning.stopwatch import CopyTimes

WARM_UP = 2  # this many steps at the beginning of a copy aren't counted
TRIES = 3  # how often a number of copies is tried, if they fail
EARLY = 0.5  # a failure is early if it leaves more than this share of the time in which copies were to be stepped
RARER = 3
SLOWER = 3.0  # a call that hangs has taken at least this many times as long as the slowest call that returned
GRACE_S = 1.0  # how long after its deadline a session waits for the last steps
OF_ITS_OWN = "if a copy needs a port, a folder or a licence of its own, see docs/how-to/simulators.md"
MORE_TIME = "allow more time with --seconds"
STARTS_AGAIN = "a run starts a failed copy again, as docs/explanation/faults.md describes"


class SteppedCopies(NamedTuple):
    """The record of a session in which some copies were stepped side by side."""

    size: SessionSize
    times: list[CopyTimes]
    traces: list[list[int]]
    """for each copy and call, a checksum of the observation, reward and flags that it returned"""
    start_s: float
    wrong: str
    """what went wrong, as one line; empty if nothing did"""
    cut_off: bool
    """whether the deadline has passed before all copies had answered"""
    stepped_s: float
    """how long the copies had been stepped when the last call returned"""
    masks: SeenMasks
    observation_space: gymnasium.Space[Any]
    action_space: gymnasium.Space[Any]
    seats: tuple[str, ...]
    time_limit: int | None
    no_slot: str = ""
    """why this machine had no slots for all copies, because of other programs; empty if it had"""

    @property
    def has_stepped(self) -> bool:
        """Whether all copies took so many steps that some can be counted."""
        return sum(len(each.steps) > WARM_UP for each in self.times) == self.size.copies

    @property
    def is_whole(self) -> bool:
        """Whether all copies took steps, in time, and nothing went wrong."""
        return self.has_stepped and not self.wrong and not self.cut_off

    @property
    def is_too_slow(self) -> bool:
        """Whether the deadline passed before all copies had taken a few steps and answered."""
        return not self.is_whole and not self.wrong

    @property
    def steps_together(self) -> int:
        """The steps that all copies took until the slowest one stopped; 0 if one took none."""
        if len(self.times) < self.size.copies:
            return 0
        return self.size.copies * min(len(each.steps) for each in self.times)

    @property
    def calls(self) -> int:
        """How many steps and resets the copies have answered."""
        return sum(map(len, self.traces))

    @property
    def calls_s(self) -> float:
        """The wall time of the steps and resets."""
        return sum(float(each.steps[:, 1].sum() + each.resets[:, 1].sum()) for each in self.times)


class Tries(NamedTuple):
    """The sessions with the same number of copies: one, or several if they failed."""

    sessions: tuple[SteppedCopies, ...]
    alone: Tries | None
    """the sessions with one copy; None if these sessions have only one copy themselves"""

    @property
    def size(self) -> SessionSize:
        """The size of each of these sessions."""
        return self.sessions[0].size

    @property
    def longest(self) -> SteppedCopies:
        """The session with the most steps."""
        return max(self.sessions, key=lambda session: session.steps_together)

    @property
    def times(self) -> list[CopyTimes]:
        """The times to measure: those of all sessions in which all copies took a few steps, or of the longest session."""
        measured = [session for session in self.sessions if session.has_stepped] or [self.longest]
        return [each for session in measured for each in session.times]

    @property
    def stepped_s(self) -> float:
        """How long the copies were stepped in all sessions."""
        return sum(session.stepped_s for session in self.sessions)

    @property
    def steps_for_each_failure(self) -> float:
        """The steps of all sessions, divided by the number of failures plus one, because the next failure may be near."""
        return sum(session.steps_together for session in self.sessions) / (1 + len(self.failed))

    @property
    def failed(self) -> list[SteppedCopies]:
        """The sessions in which something went wrong."""
        return [session for session in self.sessions if session.wrong]

    @property
    def show_a_limit(self) -> bool:
        """Whether the copies failed because of their number, by the rule at the top of this file."""
        failed = self.failed
        if not failed or any(session.is_whole for session in self.sessions):
            return False
        if not any(session.has_stepped for session in failed):
            return True
        if self.alone is None:
            return False
        together = sum(session.steps_together for session in failed) / len(failed)
        return self.alone.steps_for_each_failure >= RARER * together

    def need_another(self, seconds: float, left_s: float) -> bool:
        """Whether the copies failed so early that they should be stepped again.

        `seconds`: how long they were to be stepped in total. `left_s`: the time until the deadline. Unless their number
        seems to be the reason why they failed, at least half of this time stays for other numbers of copies.
        """
        last = self.sessions[-1]
        if not last.wrong or len(self.sessions) == TRIES:
            return False
        rest_s = seconds - self.stepped_s
        return self.show_a_limit or (rest_s > EARLY * seconds and 2 * (last.start_s + rest_s) < left_s)

    @property
    def worked(self) -> bool:
        """Whether the copies were stepped side by side, even if one of them failed later for another reason."""
        return not self.show_a_limit and any(each.is_whole or (each.wrong and each.has_stepped) for each in self.sessions)

    @property
    def decide_about_two(self) -> bool:
        """Whether two copies in one worker would show nothing more: two have failed, or several in one worker have not."""
        return self.size.copies == 2 if self.show_a_limit else self.size.each > 1

    @property
    def were_cut_off(self) -> bool:
        """Whether this number of copies could not be measured because the time was up."""
        return not (self.worked or self.show_a_limit) and self.sessions[-1].is_too_slow

    def finding(self, enough_s: float) -> str:
        """Why this number of copies could not be measured, as one line; empty if it was.

        `enough_s`: about how long a plan has to take so that all numbers of copies can be measured.
        """
        copies = _copies(self.size)
        last = self.sessions[-1]
        if self.show_a_limit and self.size.copies > 1:
            failed = self.failed
            tries = f"in all {len(failed)} tries" if len(failed) > 1 else "there was no time for a second try"
            return f"{copies}: {failed[-1].wrong} ({tries}); {OF_ITS_OWN}"
        if not self.were_cut_off:
            return ""
        if last.no_slot:
            return f"{copies} were not measured, because {last.no_slot}"
        if self.size.copies == 1:
            why = "the time was up before another one returned, so no more copies were tried"
            return f"one copy, after {last.calls} calls: {why}; unless it hangs, {MORE_TIME} {enough_s:.0f}"
        why = "the time was up before all had taken a few steps"
        return f"{copies} were not measured, because {why}; unless they hang, {MORE_TIME} {enough_s:.0f}"


def hangs(now_s: float, called_s: float, deadline_s: float, slowest_s: float) -> bool:
    """Whether a call counts as one that hangs: it has taken half of the time that was left, and much longer than others.

    `called_s`: when the newest call began, or when no more were to begin, if that is later. `slowest_s`: the longest time
    that a call has taken so far.
    """
    half_s = (deadline_s - called_s) / 2
    return now_s - called_s > max(half_s + GRACE_S, SLOWER * slowest_s)


def _copies(size: SessionSize) -> str:
    if size.copies == 1:
        return "one copy"
    return f"{size.copies} copies {'in one worker' if size.workers == 1 else 'side by side'}"


class Failures(NamedTuple):
    """The failures that did not depend on the number of copies."""

    sessions: tuple[SteppedCopies, ...]
    """the sessions that they ended"""
    calls: int
    """the number of steps and resets in all sessions that these or no failures ended"""
    calls_s: float
    """the wall time of these steps and resets"""

    @classmethod
    def of(cls, tried: Sequence[Tries]) -> Failures:
        """The failures in all sessions."""
        counted = [tries for tries in tried if not (tries.show_a_limit and tries.size.copies > 1)]
        sessions = [session for tries in counted for session in tries.sessions]
        return cls(
            tuple(session for session in sessions if session.wrong),
            sum(session.calls for session in sessions),
            sum(session.calls_s for session in sessions),
        )

    @property
    def finding(self) -> str:
        """What went wrong, and how often, as one line; empty if nothing did."""
        if not self.sessions:
            return ""
        last = self.sessions[-1]
        often = f"{counted(len(self.sessions), 'failure')} in {self.calls:,} steps and resets"
        share = f"{number_in_words(100 * len(self.sessions) / max(1, self.calls))}%"
        such_as = "such as " if len(self.sessions) > 1 else ""
        return f"{often} ({share}), {such_as}{_copies(last.size)}, after {last.calls} calls: {last.wrong}; {STARTS_AGAIN}"
