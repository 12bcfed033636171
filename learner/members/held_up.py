"""What a member is doing, and what holds it up, as human-readable text. Pure.

Rule: a member counts as held up if a single call to the user's code takes long, or if the member is silent. If it is slow
because of many short calls, its env steps per second are shown instead.
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
"""The words for what a worker is doing. This is known only of workers with a supervisor."""
MOST_TOLD = 4  # the largest number of workers named in one line
LONG_S = 2.0  # shorter times aren't shown; by default, heartbeats are sent every second


def in_words(doing: str, seconds: float) -> str:
    """What a worker is doing and, if it has taken at least `LONG_S`, for how long."""
    words = DOING.get(doing, doing or "-")
    return f"{words} for {seconds:.0f} s" if seconds >= LONG_S else words


def held_up(member: Member, now: float) -> tuple[float, float, str]:
    """For how many seconds a member has been held up, its negated env steps per second, and a line about it.

    The line says which worker it is, on which host, and what it is doing. The largest of several such tuples belongs to the
    member that has been held up longest or, if none is held up, to the slowest one.
    """
    row = member.status(now)
    seconds = 0.0
    silent_s = now - member.alive_s
    # A speed is known only after two heartbeats that each reported more steps.
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
    """What the workers are doing, in one line, and a line for each worker that wrote something.

    Members come first, those held up longest at the top. They are followed by the worker processes that have not joined.
    `said` has the last line of each worker's log, by the worker's name.
    """
    members = list(members)
    lines = [line for *_, line in sorted((held_up(member, now) for member in members), reverse=True)]
    joined = {member.hello.worker for member in members}
    lines += [f"worker {one.worker}: {in_words(one.doing, one.for_s)}" for one in running if one.worker not in joined]
    more = [f"{len(lines) - MOST_TOLD} more"] if len(lines) > MOST_TOLD else []
    return ", ".join([*lines[:MOST_TOLD], *more]), [f"{name} wrote: {line}" for name, line in [*said.items()][:MOST_TOLD]]
