"""The tables in docs/explanation/wall_clock.md: minutes until a policy reaches a return, from curves and rates. Pure.

Rule: a seed's minutes are the env steps of its first evaluation that reaches the return, divided by the env steps/s. There
are two returns for each task: those that millrace's SAC has after about 100,000 and 300,000 env steps. If a seed never
reaches the return, its time is infinite, and the table shows how long its run was.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence, Set
from itertools import pairwise
from typing import NamedTuple

from benchmarks.markdown_tables import table
from benchmarks.scores import return_text, steps_text
from benchmarks.wall_clock_curves import Curve
from benchmarks.wall_clock_programs import ENVS, NAMES, OURS, PROGRAMS, THEIRS, Program
from benchmarks.wall_clock_rates import Rate, RateAt, largest_error, rate_at
from benchmarks.wall_clock_returns import FEW, MANY, comparison, returns_table

STEP_TIMES_S = (0.01, 0.05, 1.0)
AFTER = (FEW, MANY)
"""the env steps after which SAC's returns are those to reach"""
NEAR = 25_000
"""the evaluations at most this many env steps before or after them determine the return"""
BETWEEN = 24
"""number of intervals between two step times of the table, to find where the quickest algorithm changes"""
NO_MINUTES = "No rates are kept yet, so there are no minutes; `benchmarks/README.md` says how to measure them."
NOTHING = "No figures are kept yet; `benchmarks/README.md` says how to make them.\n"


class Goal(NamedTuple):
    """A return to reach on a task."""

    env: str
    after: int
    """the env steps after which millrace's SAC has this return"""
    target: float

    @property
    def name(self) -> str:
        """The task and the return."""
        return f"{self.env}, {return_text(self.target)}"


class Row(NamedTuple):
    """A program on a task."""

    program: Program
    env_steps: list[float]
    """for each seed, the env steps until the return was reached; infinite if it wasn't"""
    trained: list[int]
    """for each seed, the env steps of its run"""
    rates: list[Rate]

    @property
    def least_env_steps(self) -> float:
        """The median seed needs at least these env steps, as a seed that reached no such return needs more than its run."""
        return statistics.median(map(min, self.env_steps, self.trained))

    def minutes(self, step_s: float) -> list[float]:
        """Minutes of each seed at this step time; empty without a rate."""
        rate = rate_at(step_s, self.rates)
        return [] if rate is None else [steps / rate.per_s / 60 for steps in self.env_steps]

    def median(self, step_s: float) -> float:
        """Minutes of the median seed; infinite if that seed didn't reach the return, or if there is no rate."""
        return self._minutes_of(statistics.median(self.env_steps), step_s)

    def least(self, step_s: float) -> float:
        """The median seed needs at least these minutes; infinite without a rate."""
        return self._minutes_of(self.least_env_steps, step_s)

    def _minutes_of(self, env_steps: float, step_s: float) -> float:
        rate = rate_at(step_s, self.rates)
        return math.inf if rate is None else env_steps / rate.per_s / 60


def steps_until(points: Sequence[tuple[int, float]], target: float) -> float:
    """The env steps of the first evaluation with at least this return; infinite if there is none."""
    return next((float(env_steps) for env_steps, returned in points if returned >= target), math.inf)


def goals_of(curves: Sequence[Curve]) -> list[Goal]:
    """The returns to reach, one task after the other."""
    goals = []
    for env in ENVS:
        for after in AFTER:
            target = target_of(curves, env, after)
            goals += [] if target is None else [Goal(env, after, target)]
    return goals


def target_of(curves: Sequence[Curve], env: str, after: int) -> float | None:
    """The return to reach in this task: the median over the seeds of millrace's SAC, rounded to two digits.

    A seed's return is the mean of its evaluations near these env steps. None if no seed has any.
    """
    means = []
    for curve in curves:
        if (curve.env, curve.system, curve.algo) == (env, OURS, "sac"):
            near = [returned for env_steps, returned in curve.points if abs(env_steps - after) <= NEAR]
            means += [statistics.mean(near)] if near else []
    return float(f"{statistics.median(means):.2g}") if means else None


def rows_of(curves: Sequence[Curve], rates: Sequence[Rate], goal: Goal) -> list[Row]:
    """The programs that have a curve on this task, one algorithm after the other."""
    rows = []
    for program in sorted(PROGRAMS, key=lambda program: list(NAMES).index(program.algo)):
        its_curves = [curve for curve in curves if (curve.env, curve.system, curve.algo) == (goal.env, *program)]
        its_rates = [rate for rate in rates if (rate.env, rate.system, rate.algo) == (goal.env, *program)]
        if its_curves:
            env_steps = [steps_until(curve.points, goal.target) for curve in its_curves]
            rows.append(Row(program, env_steps, [curve.points[-1][0] for curve in its_curves], its_rates))
    return rows


def minutes_table(rows: Sequence[Row]) -> str:
    """The table of minutes until the return is reached. The quickest of each column is bold."""
    head = ("", "env steps", *(f"steps of {step_text(step_s)}" for step_s in STEP_TIMES_S))
    least = {step_s: min(row.median(step_s) for row in rows) for step_s in STEP_TIMES_S}
    cells = []
    for row in rows:
        line = [name_of(row.program), spread(row.env_steps, row.least_env_steps, lambda steps: steps_text(round(steps)))]
        for step_s in STEP_TIMES_S:
            rate = rate_at(step_s, row.rates)
            text = ""
            if rate is not None:
                text = spread(row.minutes(step_s), row.least(step_s), minutes_text, about=rate.computed)
            quickest = row.median(step_s) == least[step_s] < math.inf
            line.append(f"**{text}**" if quickest else text)
        cells.append(line)
    return table(head, cells)


def rates_table(rows: Sequence[Row]) -> str:
    """The table of these programs' env steps/s."""
    head = ("env steps/s", *(f"steps of {step_text(step_s)}" for step_s in STEP_TIMES_S))
    return table(
        head,
        [
            [name_of(row.program), *(rate_text(rate_at(step_s, row.rates)) for step_s in STEP_TIMES_S)]
            for row in rows
            if row.rates
        ],
    )


def quickest(rows: Sequence[Row]) -> list[tuple[Program | None, float]]:
    """The quickest programs, each with the step time from which on it is the quickest.

    None stands for step times at which a program might be the quickest whose runs were too short to tell. Step times at
    which no program reaches the return are skipped.
    """
    found: list[tuple[Program | None, float]] = []
    for step_s in step_times():
        best = min(rows, key=lambda row: row.median(step_s), default=None)
        if best is None or best.median(step_s) == math.inf:
            continue
        sure = all(best.median(step_s) <= row.least(step_s) for row in rows if row is not best)
        program = best.program if sure else None
        if not found or found[-1][0] != program:
            found.append((program, step_s))
    return found


def step_times() -> list[float]:
    """The step times of the table, and others between them at equal ratios."""
    times = [STEP_TIMES_S[0]]
    for first, last in pairwise(STEP_TIMES_S):
        times += [first * (last / first) ** (n / BETWEEN) for n in range(1, BETWEEN)] + [last]
    return times


def quickest_table(goals: Mapping[Goal, Sequence[Row]]) -> str:
    """A table of the quickest algorithm at each step time, among all programs and among Stable-Baselines3's."""
    head = ("task and return", "of all", f"of {THEIRS}")
    theirs = {goal: [row for row in rows if row.program.system == THEIRS] for goal, rows in goals.items()}
    return table(head, [[goal.name, ranges_text(rows), ranges_text(theirs[goal])] for goal, rows in goals.items()])


def ranges_text(rows: Sequence[Row]) -> str:
    """The quickest programs as text, such as `millrace XQC; from 50 ms on millrace TQC`."""
    texts = []
    for program, step_s in quickest(rows):
        since = "" if step_s == STEP_TIMES_S[0] else f"from {step_text(step_s)} on "
        texts.append(f"{since}{'not known' if program is None else name_of(program)}")
    return "; ".join(texts) or "–"


def page_part(curves: Sequence[Curve], rates: Sequence[Rate]) -> str:
    """The part of the page about these curves and rates, as Markdown."""
    if not curves:
        return NOTHING
    parts = ["Returns of greedy episodes:", returns_table(curves), comparison(curves)]
    goals = goals_of(curves)
    if goals and rates:
        parts += _minutes(curves, rates, goals)
    else:
        parts.append(NO_MINUTES)
    return "\n\n".join(part.rstrip("\n") for part in parts if part) + "\n"


def _minutes(curves: Sequence[Curve], rates: Sequence[Rate], goals: Sequence[Goal]) -> list[str]:
    """The paragraphs and tables of minutes and rates."""
    parts = [_sources(curves, rates, {goal.env for goal in goals})]
    for processor in sorted({rate.processor for rate in rates}):
        here = [rate for rate in rates if rate.processor == processor]
        found = {goal: rows_of(curves, here, goal) for goal in goals}
        for goal, rows in found.items():
            whose = f"{return_text(goal.target)} (SAC's after {steps_text(goal.after)} env steps)"
            parts += [f"**{goal.env}**, minutes until a return of {whose} on {processor}:", minutes_table(rows)]
        rated = {goal: rows for goal, rows in found.items() if any(row.rates for row in rows)}
        if rated:
            parts += ["The quickest algorithm, by the time of a step:", quickest_table(rated)]
        for env, rows in {goal.env: rows for goal, rows in rated.items()}.items():
            parts += [f"The rates on {env}:", rates_table(rows)]
    return parts


def _sources(curves: Sequence[Curve], rates: Sequence[Rate], envs: Set[str]) -> str:
    seeds = sorted({sum(other.key[:3] == curve.key[:3] for other in curves) for curve in curves if curve.env in envs})
    count = str(seeds[0]) if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]}"
    text = f"Each row has {count} {'seed' if count == '1' else 'seeds'}."
    if any(rate.env in envs for rate in rates):
        rounds = min(len(rate.rates) for rate in rates)
        text += f" A measured rate is the median of at least {rounds} {'round' if rounds == 1 else 'rounds'}."
    error = largest_error(rates)
    if error is not None:
        text += f" Where a rate was both computed and measured, the two differ by at most {100 * error:.0f} %."
    return text


def name_of(program: Program) -> str:
    """The name of a program: its system and algorithm."""
    return f"{program.system} {NAMES[program.algo]}"


def spread(values: Sequence[float], least: float, text: Callable[[float], str], *, about: bool = False) -> str:
    """The median and range over seeds as text. If some seeds are infinite, their share replaces the range.

    If the median seed is infinite, `least` is known to be too little. `about`: mark the median as approximate.
    """
    reached = sorted(value for value in values if value < math.inf)
    middle = statistics.median(values)
    share = f"{len(reached)} of {len(values)}"
    approximate = "≈ " if about else ""
    if middle == math.inf:
        return f"> {approximate}{text(least)} ({share})"
    shown = f"{approximate}{text(middle)}"
    if len(values) == 1:
        return shown
    return f"{shown} ({text(reached[0])} to {text(reached[-1])})" if len(reached) == len(values) else f"{shown} ({share})"


def minutes_text(minutes: float) -> str:
    """Minutes as text, with one decimal place below ten."""
    return f"{minutes:,.{1 if minutes < 9.95 else 0}f}"


def rate_text(rate: RateAt | None) -> str:
    """Env steps/s as text, marked with ≈ if they were computed."""
    if rate is None:
        return ""
    return f"{'≈ ' if rate.computed else ''}{rate.per_s:,.{0 if rate.per_s >= 99.5 else 1}f}"


def step_text(step_s: float) -> str:
    """A step time as text, with at most two digits."""
    rounded = float(f"{step_s:.2g}")
    return f"{rounded:g} s" if rounded >= 1 else f"{rounded * 1000:g} ms"
