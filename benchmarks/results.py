"""docs/results.md from run folders, what was learned by which command: `python -m benchmarks.results RUN …`.

A run counts by the policy that did best in its own evaluations, tried again on 100 other episodes; the final policy stands
beside it. Runs that differ in nothing but their seed make one row.
"""

from __future__ import annotations

import argparse
import shlex
from collections import defaultdict
from pathlib import Path

import msgspec

from learner.config import Config, resolve
from learner.run_folder import RunFolder, Summary

OUT = Path(__file__).parents[1] / "docs" / "results.md"
HEAD = """# Results

Greedy episodes, each seed's mean return over 100 of them (or as the command says). *Best* is the policy that did best in the
run's own evaluations, tried again on other episodes than those it was chosen by; *final* is the last one. Made by
`python -m benchmarks.results RUN …` from run folders.

| environment | algorithm | env steps | best | final | seconds | command (for each seed) |
|---|---|---|---|---|---|---|
"""


def command(config: Config) -> str:
    """The shortest command line that makes this run, without its seed and run folder."""
    words = ["millrace", "train", config.env, "--seed", "S"]
    if config.algo != "ppo":
        words += ["--algo", config.algo]
    usual = msgspec.to_builtins(resolve(config.env, algo=config.algo))
    own = msgspec.to_builtins(config)
    usual |= usual.pop("algorithm")
    own |= own.pop("algorithm")
    for name, value in own.items():
        if name in ("env", "algo", "seed", "run_dir") or value == usual[name]:
            continue
        words.append(f"--{name.replace('_', '-')}")
        words += [str(item) for item in value] if isinstance(value, list | tuple) else [str(value)]
    return shlex.join(words)


def row(runs: list[tuple[Config, Summary]]) -> str:
    """One line of the table."""
    runs = sorted(runs, key=lambda run: run[0].seed)
    config = runs[0][0]
    best = [f"{s.best.evaluation.return_mean:.0f}" if s.best else "–" for _, s in runs]
    final = [f"{s.evaluation.return_mean:.0f}" if s.evaluation else "–" for _, s in runs]
    steps = f"{max(s.env_steps for _, s in runs):,}"
    seconds = f"{max(s.wall_s for _, s in runs):.0f}"
    cells = [config.env, config.algo, steps, ", ".join(best), ", ".join(final), seconds, f"`{command(config)}`"]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description="docs/results.md from run folders")
    parser.add_argument("runs", type=Path, nargs="+")
    groups: dict[str, list[tuple[Config, Summary]]] = defaultdict(list)
    for path in parser.parse_args().runs:
        folder = RunFolder.open(path)
        config, summary = folder.config(), folder.summary()
        if summary is not None:
            groups[command(config)].append((config, summary))
    rows = [row(runs) for _, runs in sorted(groups.items(), key=lambda item: (item[1][0][0].env, item[1][0][0].algo))]
    versions = sorted({", ".join(f"{k} {v}" for k, v in s.versions.items()) for runs in groups.values() for _, s in runs})
    OUT.write_text(HEAD + "\n".join(rows) + "\n\nTwo cores, no GPU. Versions: " + "; ".join(versions) + ".\n")
    print(OUT)


if __name__ == "__main__":
    main()
