"""Descriptions of a run in words: how far it has got, what slows it down, what went wrong, and how it ended. Pure.

Everything that shows a `RunProgress` takes its words from here, so that the same words are used everywhere.

Rule: the side that waits less is the slower one. If learner and workers take turns, one waits while the other works, so
their shares of waiting time add up to about 1. If they work at the same time, only the faster one waits. If the shares add
up to more than 1, both sides sometimes wait at the same time, for some of the workers or for messages on their way. A
sentence says so only if the learner waits for longer than it works, because otherwise faster workers or messages would
change little.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping

from millrace.protocol.messages import Status
from millrace.protocol.progress import RunProgress

ABOUT_EQUAL = 0.2  # learner and workers whose shares of waiting time differ by less count as equally fast
BOTH_WAIT = 0.1  # how far the sum of the two shares must exceed 1 before both sides are said to wait at once
LEAST_PER_S = 1e-4  # one env step in three hours; a lower speed is shown as 0
LONG_RETURN = 1e12  # larger returns are rounded, because all their digits would make a table too wide
COLLECTING = ("act", "step", "wait")
WRONG = {
    "lost": ("rollout was lost and dealt again", "rollouts were lost and dealt again"),
    "transitions_duplicate": ("env step came twice", "env steps came twice"),
    "transitions_late": ("env step came too late", "env steps came too late"),
    "transitions_invalid": ("env step was invalid", "env steps were invalid"),
    "messages_bad": ("message could not be read", "messages could not be read"),
    "late_actions": ("action came too late", "actions came too late"),
}
"""For each ledger count, the wording for one and for several."""


def steps_in_words(progress: RunProgress) -> str:
    """How many env steps have been made, and how many the run has in total."""
    made = f"{progress.env_steps_made:,}"
    return f"{made} of {progress.total_steps:,}" if progress.total_steps else made


def percent(progress: RunProgress) -> str:
    """How much of the run is done, rounded down, so that it is 100% only once all of it is done."""
    return f"{math.floor(100 * progress.share)}%"


def return_in_words(mean: float | None) -> str:
    """The mean return of the last training episodes."""
    if mean is None:
        return "none yet"
    return f"{mean:,.1f}" if abs(mean) < LONG_RETURN else f"{mean:.3g}"


def workers_in_words(progress: RunProgress) -> str:
    """How many workers are alive, and how many are expected."""
    expected = f" of {progress.workers_expected}" if progress.workers_expected else ""
    return f"{progress.workers_alive}{expected}"


def lag_in_words(progress: RunProgress) -> str:
    """The lag of the rollouts of the last update. Empty before the first."""
    if not progress.ledger.get("used", 0):
        return ""
    largest = f", largest {progress.lag_max}" if progress.lag_max > progress.lag_mean else ""
    return f"lag {progress.lag_mean:.1f}{largest}"


def weights_in_words(version: int, newest: int) -> str:
    """How old a worker's weights are: `version` compared with the `newest`. Version -1 means that it has none."""
    if version < 0:
        return "none"
    return f"{newest - version} behind" if version < newest else "newest"


def workers_here(status: Status) -> str:
    """How many workers collect for a learner, and how many could have a lane."""
    evaluating = sum(worker.state == "evaluating" for worker in status.workers)
    here = f"{len(status.workers) + status.workers_left_out - evaluating} here"
    return f"{here}, {status.workers_wanted} wanted (one for each lane)" if status.workers_wanted else here


def bottleneck(progress: RunProgress) -> str:
    """Whom the learner waits for now or, if nobody, which part of the run takes most of the time. Empty if unknown."""
    return who_waits(progress) or slowest_part(progress.stages)


def who_waits(progress: RunProgress) -> str:
    """Whom the learner waits for now. Empty if the learner has not waited for long, or if the run has ended."""
    waiting = progress.waiting
    if not waiting or progress.stop_reason:
        return ""
    return f"The learner {'' if waiting.startswith('waited') else 'has been '}{waiting}."


def slowest_part(stages: Mapping[str, float | None]) -> str:
    """Which part of a run takes most of the time, according to the seconds in each stage. Empty while nothing is known."""
    learner = {name: stages.get(f"learner_{name}") or 0.0 for name in ("wait", "update", "other", "evaluate")}
    worker = {name: stages.get(f"worker_{name}") or 0.0 for name in COLLECTING}
    all_s = sum(learner.values())
    collecting_s = sum(worker.values())
    training_s = all_s - learner["evaluate"]
    if learner["evaluate"] > all_s / 2 > 0:
        return f"Evaluations are the slowest part: they take {learner['evaluate'] / all_s:.0%} of the time."
    if not (training_s and collecting_s):
        return ""
    waits = learner["wait"] / training_s
    idle = worker["wait"] / collecting_s
    worker_s = sum(seconds or 0.0 for name, seconds in stages.items() if name.startswith("worker_"))
    both_wait = learner["wait"] / all_s + worker["wait"] / worker_s > 1 + BOTH_WAIT
    if both_wait and learner["wait"] > learner["update"] + learner["other"]:
        which = f"the learner for {waits:.0%} of the time, and workers for {idle:.0%}"
        return f"Both sides wait, for slower workers or for messages: {which}."
    if abs(waits - idle) < ABOUT_EQUAL:
        return f"No part is the slowest: the learner waits for {waits:.0%} of the time, and workers for {idle:.0%}."
    if waits > idle:
        return f"Collecting is the slowest part: the learner waits for {waits:.0%} of the time, and workers for {idle:.0%}."
    what = "Updates are"
    did = "updates"
    seconds = learner["update"]
    if learner["other"] > seconds:
        what = "Callbacks, checkpoints and metrics are"
        did = "is busy with them"
        seconds = learner["other"]
    of_time = f"{seconds / training_s:.0%} of the time, and workers wait for {idle:.0%}"
    return f"{what} the slowest part: the learner {did} for {of_time}."


def per_second(steps: float) -> str:
    """Env steps per second. Low speeds are shown with decimals, so that a slow simulator does not look dead."""
    return f"{steps:.2g}" if LEAST_PER_S <= steps < 9.95 else f"{steps:,.0f}"


def duration(seconds: float) -> str:
    """A duration in s, min or h."""
    if not 100 <= seconds < math.inf:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def last_sign(progress: RunProgress) -> str:
    """Words that say since when (local time) a run without results has shown no sign of life. Empty if it is not known."""
    if not progress.at_s:
        return ""
    return time.strftime("no sign since %Y-%m-%d %H:%M:%S", time.localtime(progress.at_s))


def ending(reason: str, after: str = "", *, cut_short: bool) -> str:
    """How a run ended, and why. `after` says, in words, how long it ran."""
    how = "Interrupted" if cut_short else "Finished"
    return f"{how}{after}" if reason == how.lower() else f"{how}{after}: {reason}"


def went_wrong(counts: Mapping[str, float | None]) -> str:
    """What was lost, dropped or unreadable, according to these counts of the ledger. Empty if nothing was."""
    found = ((counts.get(name) or 0, texts) for name, texts in WRONG.items())
    return ", ".join(f"{count:,.0f} {texts[count != 1]}" for count, texts in found if count > 0)
