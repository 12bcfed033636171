"""The table of returns in docs/explanation/wall_clock.md: how good each program's policy is after some env steps. Pure.

Rule: a seed's return is that of its first evaluation after at least the given number of env steps, not the best one so far.
The last column compares XQC after few env steps with SAC after many, to show how much less experience the newer algorithm
needs.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence

from benchmarks.markdown_tables import table
from benchmarks.scores import steps_text
from benchmarks.wall_clock_curves import Curve
from benchmarks.wall_clock_programs import ENVS, NAMES, OURS, PROGRAMS, Program

FEW, MANY = 100_000, 300_000
NEW, OLD = Program(OURS, "xqc"), Program(OURS, "sac")


def return_after(curve: Curve, env_steps: int) -> float | None:
    """The return of the first evaluation after at least this number of env steps; None if the run is shorter."""
    late = (returned for at, returned in curve.points if at >= env_steps)
    return next(late, None)


def returns_after(curves: Sequence[Curve], env: str, program: Program, env_steps: int) -> list[float]:
    """A program's returns on a task, in the order of seeds, for all seeds with at least this many env steps."""
    mine = [curve for curve in curves if (curve.env, curve.system, curve.algo) == (env, *program)]
    found = (return_after(curve, env_steps) for curve in sorted(mine, key=lambda curve: curve.seed))
    return [returned for returned in found if returned is not None]


def ratio(curves: Sequence[Curve], env: str) -> float | None:
    """XQC's mean return after 100,000 env steps, as a multiple of SAC's after 300,000; None if either is missing."""
    new, old = returns_after(curves, env, NEW, FEW), returns_after(curves, env, OLD, MANY)
    return statistics.mean(new) / statistics.mean(old) if new and old else None


def returns_table(curves: Sequence[Curve]) -> str:
    """The table of returns: the mean over seeds, and their range. Empty without curves."""
    head = ("task", "program", *(f"return after {steps_text(steps)} env steps" for steps in (FEW, MANY)))
    lines = []
    for env in ENVS:
        for program in sorted(PROGRAMS, key=lambda program: (list(NAMES).index(program.algo), program.system != OURS)):
            cells = [of_seeds(returns_after(curves, env, program, steps)) for steps in (FEW, MANY)]
            if any(cells):
                lines.append((env, f"{program.system} {NAMES[program.algo]}", *cells))
    return table(head, lines) if lines else ""


def of_seeds(returns: Sequence[float]) -> str:
    """The mean of these returns, their range and their number; empty without returns."""
    if not returns:
        return ""
    mean = f"{statistics.mean(returns):,.0f}"
    if len(returns) == 1:
        return f"{mean} (one seed)"
    return f"{mean} ({min(returns):,.0f} to {max(returns):,.0f}, {len(returns)} seeds)"


def comparison(curves: Sequence[Curve]) -> str:
    """A sentence about XQC's returns as multiples of SAC's later ones; empty unless there are any."""
    ratios = {env: found for env in ENVS if (found := ratio(curves, env)) is not None}
    if not ratios:
        return ""
    each = ", ".join(f"{found:.2f} on {env}" for env, found in ratios.items())
    mean = f"; their mean is {statistics.mean(ratios.values()):.2f}" if len(ratios) > 1 else ""
    return (
        f"XQC's mean return after {steps_text(FEW)} env steps, divided by that of millrace's SAC after {steps_text(MANY)}: "
        f"{each}{mean}."
    )
