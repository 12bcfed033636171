"""How long it takes to train a good policy if a step takes 10 ms, 50 ms or 1 s: `python -m benchmarks.wall_clock COMMAND`.

Rule: nothing waits for hours of slow steps. If the lag is the same, what is learned from an env step doesn't depend on how
long the step takes. The minutes are therefore computed from two measurements: curves (greedy return over env steps, trained
on fast env copies) and rates (env steps/s on 16 copies whose steps take a given time). Both are kept in the repository.

`commands` prints the commands that train the curves. `collect FOLDER ...` adds the curves of all runs in these folders to
curves.json. `rates` measures rates and adds them to rates.json; all programs take turns. `table` writes
docs/explanation/wall_clock.md from both.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Iterator
from itertools import product
from pathlib import Path

from benchmarks import wall_clock_curves
from benchmarks.kept_records import merged
from benchmarks.wall_clock_curves import Curve, read_curves, write_curves
from benchmarks.wall_clock_programs import ALGORITHMS, ENVS, NAMES, PROGRAMS, Program, curve_command, rate_command
from benchmarks.wall_clock_rates import Rate, can_be_measured, measure, read_rates, write_rates
from benchmarks.wall_clock_tables import page_part
from benchmarks.writing import processor

PAGE = Path(__file__).parents[1] / "docs" / "explanation" / "wall_clock.md"
BEGIN = "<!-- generated: `python -m benchmarks.wall_clock table` writes what follows -->"
END = "<!-- end of what is generated -->"


def with_part(text: str, part: str) -> str:
    """The page's text with this part between its markers. Raises ValueError if they are missing."""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"{PAGE.name}: expected the markers {BEGIN} and {END}")
    return f"{before}{begin}\n\n{part}\n{end}{after}"


def table() -> None:
    """Print the tables made from the kept curves and rates, and write them into the page."""
    part = page_part(read_curves(), read_rates())
    PAGE.write_text(with_part(PAGE.read_text(encoding="utf-8"), part), encoding="utf-8")
    print(part)
    print(PAGE)


def collect(folders: list[Path], made_on: str | None) -> None:
    """Add the curves of all runs in these folders to the kept curves."""
    found = [curve for folder in folders for curve in wall_clock_curves.found_in(folder, made_on) if curve.points]
    kept = merged(read_curves(), found)
    for curve in found:
        last, returned = curve.points[-1]
        print(f"{curve.env} {curve.system} {curve.algo} seed {curve.seed}: {returned:,.1f} after {last:,} env steps")
    for line in different(kept):
        print(line, file=sys.stderr)
    write_curves(kept)


def different(curves: list[Curve]) -> Iterator[str]:
    """A line for each row whose seeds have different commands."""
    commands: dict[tuple[str, ...], set[str]] = {}
    for curve in curves:
        commands.setdefault((curve.env, curve.system, curve.algo), set()).add(curve.command)
    for row, several in commands.items():
        if len(several) > 1:
            yield "\n  ".join([f"{' '.join(row)}: the seeds have different commands", *sorted(several)])


def rates(arguments: argparse.Namespace) -> None:
    """Measure rates, and keep each one as soon as it was measured."""
    made_on = arguments.processor or processor()
    found: dict[tuple[Program, str, float], Rate] = {}
    turns = range(1, arguments.rounds + 1)
    for turn, env, program, step_s in product(turns, arguments.env, chosen(arguments), arguments.step_s):
        if not can_be_measured(program, env, step_s, arguments.seconds):
            continue  # this rate will be computed from others
        how = {"threads": arguments.threads, "device": arguments.device}
        try:
            rate = measure(program, env, step_s, turn, seconds=arguments.seconds, **how)
        except RuntimeError as error:
            print(f"left out: {error}", file=sys.stderr)
            continue
        print(f"{env} {program.system} {program.algo}, {step_s:g} s: {rate:,.1f} env steps/s", flush=True)
        words = rate_command(program, env, step_s, "S", **how)
        old = found.get((program, env, step_s))
        found[program, env, step_s] = Rate(
            env=env,
            system=program.system,
            algo=program.algo,
            step_s=step_s,
            processor=made_on,
            command=shlex.join(["python", *words[1:]]),
            rates=[*(old.rates if old else []), round(rate, 2)],
        )
        write_rates(merged(read_rates(), found.values()))


def chosen(arguments: argparse.Namespace) -> list[Program]:
    """The programs that the flags name."""
    return [each for each in PROGRAMS if each.system in arguments.system and each.algo in arguments.algo]


def main() -> None:
    parser = argparse.ArgumentParser(description="how long until a policy is good, by the time of a step")
    names = argparse.ArgumentParser(add_help=False)
    names.add_argument("--env", nargs="+", default=ENVS, choices=ENVS)
    names.add_argument("--system", nargs="+", default=list(ALGORITHMS), choices=list(ALGORITHMS))
    names.add_argument("--algo", nargs="+", default=list(NAMES), choices=list(NAMES))
    commands = parser.add_subparsers(dest="command", required=True)
    training = commands.add_parser("commands", parents=[names], help="print the commands that train the curves")
    training.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3])
    training.add_argument("--out", default="runs/wall_clock", help="the folder of the runs")
    collecting = commands.add_parser("collect", help="add the curves of runs to curves.json")
    collecting.add_argument("folders", nargs="+", type=Path)
    collecting.add_argument("--processor", help="that trained millrace's runs, if not this one")
    measuring = commands.add_parser("rates", parents=[names], help="measure rates, and add them to rates.json")
    measuring.add_argument("--step-s", nargs="+", type=float, default=[0.01, 0.05], help="seconds of a step")
    measuring.add_argument("--seconds", type=float, default=30.0, help="least seconds of a measurement, after its warm-up")
    measuring.add_argument("--rounds", type=int, default=3, help="number of turns, each with another seed")
    measuring.add_argument("--threads", type=int, default=1, help="of PyTorch in the learner")
    measuring.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    measuring.add_argument("--processor", help="what the table calls this machine")
    commands.add_parser("table", help="write the tables into the page, and print them")
    arguments = parser.parse_args()
    match arguments.command:
        case "commands":
            for env in arguments.env:
                for program in chosen(arguments):
                    for seed in arguments.seeds:
                        print(shlex.join(curve_command(program, env, seed, arguments.out)))
        case "collect":
            collect(arguments.folders, arguments.processor)
        case "rates":
            rates(arguments)
        case _:
            table()


if __name__ == "__main__":
    main()
