"""The tables in docs/explanation/wall_clock.md: minutes until a policy reaches a return, from curves and rates. Pure.

Rule: a seed's minutes are the env steps of its first evaluation that reaches the return, divided by the env steps/s. The
return is the one that millrace's SAC reaches at about 300,000 env steps. If a seed never reaches it, its time is infinite.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

from benchmarks.markdown_tables import table
from benchmarks.scores import return_text, steps_text
from benchmarks.wall_clock_curves import Curve
from benchmarks.wall_clock_programs import ENVS, NAMES, OURS, PROGRAMS, THEIRS, Program
from benchmarks.wall_clock_rates import Rate, RateAt, largest_error, rate_at
from benchmarks.wall_clock_returns import comparison, returns_table

STEP_TIMES_S = (0.01, 0.05, 1.0)
NEAR = range(275_000, 325_001)
"""the env steps whose evaluations determine a task's return"""
BETWEEN = 24
"""number of intervals between two step times of the table, to find where the quickest algorithm changes"""
NO_MINUTES = "No rates are kept yet, so there are no minutes; `benchmarks/README.md` says how to measure them."
NOTHING = "No figures are kept yet; `benchmarks/README.md` says how to make them.\n"


class Row(NamedTuple):
    """A program on a task."""

    program: Program
    env_steps: list[float]
    """for each seed, the env steps until the return was reached; infinite if it wasn't"""
    rates: list[Rate]

    def minutes(self, step_s: float) -> list[float]:
        """Minutes of each seed at this step time; empty without a rate."""
        rate = rate_at(step_s, self.rates)
        return [] if rate is None else [steps / rate.per_s / 60 for steps in self.env_steps]

    def median(self, step_s: float) -> float:
        """Minutes of the median seed; infinite if that seed didn't reach the return, or if there is no rate."""
        return statistics.median(self.minutes(step_s) or [math.inf])


def steps_until(points: Sequence[tuple[int, float]], target: float) -> float:
    """The env steps of the first evaluation with at least this return; infinite if there is none."""
    return next((float(env_steps) for env_steps, returned in points if returned >= target), math.inf)


def target_of(curves: Sequence[Curve], env: str) -> float | None:
    """The return to reach in this task: the median over the seeds of millrace's SAC, rounded to two digits.

    A seed's return is the mean of its evaluations between 275,000 and 325,000 env steps. None if no seed has any.
    """
    means = []
    for curve in curves:
        if (curve.env, curve.system, curve.algo) == (env, OURS, "sac"):
            near = [returned for env_steps, returned in curve.points if env_steps in NEAR]
            means += [statistics.mean(near)] if near else []
    return float(f"{statistics.median(means):.2g}") if means else None


def rows_of(curves: Sequence[Curve], rates: Sequence[Rate], env: str, target: float) -> list[Row]:
    """The programs that have a curve on this task, one algorithm after the other."""
    rows = []
    for program in sorted(PROGRAMS, key=lambda program: list(NAMES).index(program.algo)):
        its_curves = [curve for curve in curves if (curve.env, curve.system, curve.algo) == (env, *program)]
        its_rates = [rate for rate in rates if (rate.env, rate.system, rate.algo) == (env, *program)]
        if its_curves:
            rows.append(Row(program, [steps_until(curve.points, target) for curve in its_curves], its_rates))
    return rows


def minutes_table(rows: Sequence[Row]) -> str:
    """The table of minutes until the return is reached. The quickest of each column is bold."""
    head = ("", "env steps", *(f"steps of {step_text(step_s)}" for step_s in STEP_TIMES_S))
    least = {step_s: min(row.median(step_s) for row in rows) for step_s in STEP_TIMES_S}
    cells = []
    for row in rows:
        line = [name_of(row.program), spread(row.env_steps, lambda steps: steps_text(round(steps)))]
        for step_s in STEP_TIMES_S:
            rate = rate_at(step_s, row.rates)
            text = "" if rate is None else spread(row.minutes(step_s), minutes_text, about=rate.computed)
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


def quickest(rows: Sequence[Row]) -> list[tuple[Program, float]]:
    """The quickest programs, each with the step time from which on it is the quickest.

    Step times at which no program reaches the return are skipped.
    """
    found: list[tuple[Program, float]] = []
    for step_s in step_times():
        best = min(rows, key=lambda row: row.median(step_s), default=None)
        if best is not None and best.median(step_s) < math.inf and (not found or found[-1][0] != best.program):
            found.append((best.program, step_s))
    return found


def step_times() -> list[float]:
    """The step times of the table, and others between them at equal ratios."""
    times = [STEP_TIMES_S[0]]
    for first, last in pairwise(STEP_TIMES_S):
        times += [first * (last / first) ** (n / BETWEEN) for n in range(1, BETWEEN)] + [last]
    return times


def quickest_table(tasks: Mapping[str, Sequence[Row]]) -> str:
    """A table of the quickest algorithm at each step time, among all programs and among Stable-Baselines3's."""
    head = ("task", "of all", f"of {THEIRS}")
    theirs = {env: [row for row in rows if row.program.system == THEIRS] for env, rows in tasks.items()}
    return table(head, [[env, ranges_text(rows), ranges_text(theirs[env])] for env, rows in tasks.items()])


def ranges_text(rows: Sequence[Row]) -> str:
    """The quickest programs as text, such as `millrace XQC; from 50 ms on millrace TQC`."""
    texts = []
    for program, step_s in quickest(rows):
        since = "" if step_s == STEP_TIMES_S[0] else f"from {step_text(step_s)} on "
        texts.append(f"{since}{name_of(program)}")
    return "; ".join(texts) or "–"


def page_part(curves: Sequence[Curve], rates: Sequence[Rate]) -> str:
    """The part of the page about these curves and rates, as Markdown."""
    if not curves:
        return NOTHING
    parts = ["Returns of greedy episodes:", returns_table(curves), comparison(curves)]
    targets = {env: target for env in ENVS if (target := target_of(curves, env)) is not None}
    if targets and rates:
        parts += _minutes(curves, rates, targets)
    else:
        parts.append(NO_MINUTES)
    return "\n\n".join(part.rstrip("\n") for part in parts if part) + "\n"


def _minutes(curves: Sequence[Curve], rates: Sequence[Rate], targets: dict[str, float]) -> list[str]:
    """The paragraphs and tables of minutes and rates. `targets`: the return to reach in each task."""
    parts = [_sources(curves, rates, targets)]
    for processor in sorted({rate.processor for rate in rates}) or [""]:
        here = [rate for rate in rates if rate.processor == processor]
        tasks = {env: rows_of(curves, here, env, target) for env, target in targets.items()}
        for env, rows in tasks.items():
            where = f" on {processor}" if processor else ""
            parts += [f"**{env}**, minutes until a return of {return_text(targets[env])}{where}:", minutes_table(rows)]
        rated = {env: rows for env, rows in tasks.items() if any(row.rates for row in rows)}
        if rated:
            parts += ["The quickest algorithm, by the time of a step:", quickest_table(rated)]
        for env, rows in rated.items():
            parts += [f"The rates on {env}:", rates_table(rows)]
    return parts


def _sources(curves: Sequence[Curve], rates: Sequence[Rate], targets: dict[str, float]) -> str:
    seeds = sorted({sum(other.key[:3] == curve.key[:3] for other in curves) for curve in curves if curve.env in targets})
    count = str(seeds[0]) if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]}"
    text = f"Each row has {count} {'seed' if count == '1' else 'seeds'}."
    if any(rate.env in targets for rate in rates):
        rounds = min(len(rate.rates) for rate in rates)
        text += f" A measured rate is the median of at least {rounds} {'round' if rounds == 1 else 'rounds'}."
    error = largest_error(rates)
    if error is not None:
        text += f" Where a rate was both computed and measured, the two differ by at most {100 * error:.0f} %."
    return text


def name_of(program: Program) -> str:
    """The name of a program: its system and algorithm."""
    return f"{program.system} {NAMES[program.algo]}"


def spread(values: Sequence[float], text: Callable[[float], str], *, about: bool = False) -> str:
    """The median and range over seeds as text. If some seeds are infinite, their share replaces the range.

    If the median seed is infinite, a dash replaces the median. `about`: mark the median as approximate.
    """
    reached = sorted(value for value in values if value < math.inf)
    middle = statistics.median(values)
    share = f"{len(reached)} of {len(values)}"
    if middle == math.inf:
        return f"– ({share})"
    shown = f"{'≈ ' if about else ''}{text(middle)}"
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
