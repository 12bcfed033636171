"""What a member does, and what holds it up, in words for people. Pure.

Rule: a member is held up by one call of the user's code, or by its own silence. Many short calls hold it up by their number,
so its env steps per second are said instead.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from millrace.learner.members.member import Member
from millrace.protocol.messages import WorkerActivity

DOING = {
    "describing": "in construction",
    "making": "in construction",
    "preparing": "in the policy's construction",
    "resetting": "in reset",
    "stepping": "in step",
    "repeating": "repeating lost steps",
    "acting": "in the policy",
    "evaluating": "in evaluation",
    "closing": "in close",
}
"""What a worker does, in words. A worker without a supervisor does not say it."""
MOST_TOLD = 4  # workers of which one line says what they do
LONG_S = 2.0  # what takes less time is not worth a word; by default, heartbeats come every second


def in_words(doing: str, seconds: float) -> str:
    """What a worker does, and for how long if that is long."""
    words = DOING.get(doing, doing or "-")
    return f"{words} for {seconds:.0f} s" if seconds >= LONG_S else words


def held_up(member: Member, now: float) -> tuple[float, float, str]:
    """For how many seconds it is held up, its env steps per second below 0, and who is held up where, in what.

    The largest is that of the member that is held up longest, or else of the slowest.
    """
    row = member.status(now)
    seconds = 0.0
    silent_s = now - member.alive_s
    # Its speed is measured between two heartbeats with more steps, so a worker that has made none has no speed.
    unmeasured = "has begun to step" if row.steps else "no env step yet"
    what = f"{row.steps_per_s:,.1f} steps/s" if row.steps_per_s else unmeasured
    if silent_s >= LONG_S:
        seconds = silent_s
        what = f"silent for {silent_s:.0f} s"
    elif row.doing == "repeating" or (row.doing_s >= LONG_S and row.doing in DOING):
        seconds = row.doing_s
        what = in_words(row.doing, row.doing_s)
    return seconds, -row.steps_per_s, f"worker {row.worker} on {row.host}: {what}"


def what_they_do(
    members: Iterable[Member], running: Iterable[WorkerActivity], said: Mapping[str, str], now: float
) -> tuple[str, list[str]]:
    """What the members do, those that are held up longest first, and then the worker processes that have not joined; and a
    line for each worker that wrote something.

    `said`: the last line of each worker's log, by its name.
    """
    members = list(members)
    lines = [line for *_, line in sorted((held_up(member, now) for member in members), reverse=True)]
    joined = {member.hello.worker for member in members}
    lines += [f"worker {one.worker}: {in_words(one.doing, one.for_s)}" for one in running if one.worker not in joined]
    more = [f"{len(lines) - MOST_TOLD} more"] if len(lines) > MOST_TOLD else []
    return ", ".join([*lines[:MOST_TOLD], *more]), [f"{name} wrote: {line}" for name, line in [*said.items()][:MOST_TOLD]]
