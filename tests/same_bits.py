"""`python -m tests.same_bits --base COMMIT`: small runs in this tree and in that commit, compared bit for bit.

Rule: both sides run the same command lines (`RUNS`) on this machine, with the same packages: this tree with 1 and with 3
workers, and a worktree of the commit, which is made for it and removed, with 3. Both use the toy environments of this tree,
which import nothing of millrace. What both sides name is compared: arrays of policies, columns of metrics without those that
tell of time, evaluations, arrays of recorded datasets, and the state of the algorithm in the newest checkpoint. A name that
only one side has is printed and is no difference.

Exit code 1: something differs that `--expect-different` does not name, or a side refused such a run.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import torch
from safetensors.numpy import load_file

from millrace.learner.algorithm_check.same_bits import first_difference
from millrace.learner.run_folder.metrics_log import METRICS_FILE, read_rows

ROOT = Path(__file__).parents[1]
TOYS = ROOT / "tests" / "support" / "envs"
COMMON = "--preset none --seed 3 --lanes 4 --envs 8 --device cpu --torch-threads 1 --worker-timeout-s 60 --run-dir runs"
ON_POLICY = "--rollout-steps 32 --steps 1500 --eval-every 700 --eval-episodes 4"
REPLAY = "--rollout-steps 8 --learning-starts 200 --batch-size 32 --net 32 --steps 900 --eval-every 400 --eval-episodes 4"
NORMALIZED = "--normalize-observations --normalize-rewards"
HINDSIGHT = "--hindsight 0.8 --goal-reward sparse:0.1"
IMAGES = "--env-kwargs observation nested action multibinary"
RECORDED = "same/training-v0"
RUNS: dict[str, tuple[str, ...]] = {
    "ppo": (f"train CartPole-v1 --algo ppo {ON_POLICY}",),
    "a2c": (f"train Pendulum-v1 --algo a2c {NORMALIZED} {ON_POLICY}",),
    "reinforce": (f"train toy:Identity-v0 --algo reinforce {ON_POLICY}",),
    "impala": (f"train CartPole-v1 --algo impala {ON_POLICY}",),
    "dqn": (f"train CartPole-v1 --algo dqn {REPLAY}",),
    "rainbow": (f"train CartPole-v1 --algo rainbow --gradient-steps 16 {REPLAY}",),
    "sac": (f"train Pendulum-v1 --algo sac --updates-per-step 0.5 {REPLAY}",),
    "td3": (f"train Pendulum-v1 --algo td3 --updates-per-step 0.5 {NORMALIZED} {REPLAY}",),
    "tqc": (f"train Pendulum-v1 --algo tqc --updates-per-step 0.5 {REPLAY}",),
    "crossq": (f"train Pendulum-v1 --algo crossq --critic-net 32 32 --updates-per-step 0.5 {REPLAY}",),
    "xqc": (f"train Pendulum-v1 --algo xqc --critic-net 32 32 --updates-per-step 0.5 {REPLAY}",),
    "hindsight": (f"train reach:Reach-v0 --algo sac {HINDSIGHT} --updates-per-step 0.5 --n-step 2 {REPLAY}",),
    "lstm": (f"train toy:Recall-v0 --algo ppo --core lstm --core-size 16 {ON_POLICY}",),
    "dqn lstm": (f"train toy:Recall-v0 --algo dqn --core lstm --core-size 16 --gradient-steps 8 {REPLAY}",),
    "sac gru": (f"train Pendulum-v1 --algo sac --core gru --core-size 16 --updates-per-step 0.1 {REPLAY}",),
    "images": (f"train toy:Spaces-v0 {IMAGES} --algo ppo {ON_POLICY}",),
    "masks": (f"train Taxi-v4 --algo ppo --action-masks info {ON_POLICY}",),
    "mixed": (f"train toy:Spaces-v0 --env-kwargs action mixed --algo ppo --record {RECORDED} {ON_POLICY}",),
    "shared": (f"train CartPole-v1 --algo ppo --shared-net {ON_POLICY}",),
    "per": (f"train CartPole-v1 --algo dqn --priority-alpha 0.6 --n-step 3 --normalize-observations {REPLAY}",),
    "prior": (f"train CartPole-v1 --algo dqn --prior {RECORDED} --prior-steps 20 {REPLAY}",),
    "clone": (f"train CartPole-v1 --algo ppo --prior {RECORDED} --clone-epochs 3 {ON_POLICY}",),
    "record": (
        f"train CartPole-v1 --algo a2c --record {RECORDED} {ON_POLICY}",
        "record RUN --out same/greedy-v0 --steps 100",
        "record RUN --out same/sampled-v0 --steps 100 --stochastic",
    ),
}
"""The commands of each run, in one folder. COMMON is added to `train`, and RUN is its run folder."""
FROM_RECORDED = {"prior", "clone"}
"""Runs that learn from the dataset of the run `record` of the base."""
LAGS = {"ppo": 1, "a2c": 2, "impala": 2, "dqn": 1, "sac": 2, "xqc": 1, "lstm": 2, "masks": 1}
RUNS |= {f"{name} at lag {lag}": (f"{RUNS[name][0]} --max-lag {lag}",) for name, lag in LAGS.items()}
TIMES = ("stage/", "time/fps", "time/time_elapsed", "ledger/transitions_received", "ledger/transitions_waiting")
EVALUATED = ("env_steps", "updates", "return_mean_100", "evaluation", "best")
PARTS = ("policy", "metrics", "evaluation", "dataset", "checkpoint")

Part = dict[str, Any]
"""What is compared, by name: arrays, numbers, and dicts and lists of these."""


class Side(NamedTuple):
    """A tree whose code makes the runs, how many workers they have, and the folder that has a folder for each run."""

    tree: Path
    workers: int
    files: Path


class Compared(NamedTuple):
    """Two folders of the same run."""

    differing: dict[str, str]
    """Where the parts that differ do so first."""
    lacking: list[str]
    """Names that only one of them has."""


def parts(folder: Path) -> dict[str, Part]:
    """What a run left in its folder: `runs/`, with one run folder, and perhaps `datasets/`."""
    (run,) = (folder / "runs").iterdir()
    columns: Part = {}
    for index, row in enumerate(read_rows(run / METRICS_FILE)):
        for name in row:
            if not name.startswith(TIMES):
                columns.setdefault(name, {})[f"row {index}"] = row[name]
    summary = json.loads((run / "summary.json").read_text())
    newest = max((run / "checkpoints").iterdir())
    return {
        "policy": {file.stem: load_file(file) for file in sorted(run.glob("*.safetensors"))},
        "metrics": columns,
        "evaluation": _flat({name: summary[name] for name in EVALUATED if name in summary}),
        "dataset": {file.parents[1].name: _arrays(file) for file in sorted((folder / "datasets").rglob("*.hdf5"))},
        "checkpoint": torch.load(newest, map_location="cpu", weights_only=True)["state"]["algorithm"],
    }


def _flat(found: Mapping[str, Any], before: str = "") -> Part:
    """The values of records in records, each with a name of its own."""
    values: Part = {}
    for name, value in found.items():
        values |= _flat(value, f"{before}{name} ") if isinstance(value, dict) else {before + name: value}
    return values


def _arrays(path: Path) -> Part:
    names: list[str] = []
    with h5py.File(path) as file:
        file.visit(names.append)
        return {name: file[name][()] for name in names if isinstance(file[name], h5py.Dataset)}


def compare(one: Path, other: Path) -> Compared:
    """Compare what two runs left in their folders."""
    differing, lacking = {}, []
    ours, theirs = parts(one), parts(other)
    for part in PARTS:
        both = ours[part].keys() & theirs[part].keys()
        lacking += [f"{part} {name}" for name in sorted(ours[part].keys() ^ theirs[part].keys())]
        left, right = ({name: value for name, value in each[part].items() if name in both} for each in (ours, theirs))
        if (difference := first_difference(left, right)) is not None:
            differing[part] = difference
    return Compared(differing, lacking)


@contextmanager
def worktree(commit: str, folder: Path) -> Iterator[Path]:
    """A worktree of this commit in a new folder. It is removed at the end."""
    git = ["git", "-C", str(ROOT), "worktree"]
    subprocess.run([*git, "add", "--quiet", "--detach", str(folder), commit], check=True)
    try:
        yield folder
    finally:
        subprocess.run([*git, "remove", "--force", str(folder)], check=True)


def python(side: Side, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run this interpreter in a folder, with the code of this side's tree."""
    path = os.pathsep.join([str(side.tree), str(TOYS)])
    environment = {**os.environ, "PYTHONPATH": path, "MINARI_DATASETS_PATH": str(folder / "datasets")}
    command = [sys.executable, "-P", *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300, check=False)


def check_code(side: Side) -> None:
    """End with a message if the code that runs for this side is not that of its tree."""
    ended = python(side, side.files, "-c", "import millrace; print(millrace.__file__)")
    if ended.stdout.strip() != str(side.tree / "millrace" / "__init__.py"):
        sys.exit(f"{side.files.name}: expected the code of {side.tree}, got {ended.stdout or ended.stderr}")
    print(f"{side.files.name}: {side.workers} workers, code of {side.tree}", flush=True)


def make(side: Side, name: str, recorded: Path) -> str:
    """Make a run. Returns why it was refused, or nothing. `recorded`: the datasets of the run `record` of the base."""
    folder = side.files / name
    (folder / "datasets").mkdir(parents=True)
    if name in FROM_RECORDED and (recorded / RECORDED).exists():
        shutil.copytree(recorded / RECORDED, folder / "datasets" / RECORDED)
    for line in RUNS[name]:
        words = line.split()
        if words[0] == "train":
            words += [*COMMON.split(), "--workers", str(side.workers)]
        else:
            words = [str(next((folder / "runs").iterdir())) if word == "RUN" else word for word in words]
        ended = python(side, folder, "-m", "millrace", *words)
        if ended.returncode:
            return f"{words[0]}: exit code {ended.returncode}: {(ended.stderr.strip() or 'nothing said').splitlines()[-1]}"
    return ""


def told(name: str, left: Side, right: Side, refused: dict[tuple[Side, str], str]) -> tuple[list[str], list[str], str]:
    """A run on two sides: the parts that differ, or its name if a side refused it; names that one lacks; the verdict."""
    if why := [f"{side.files.name} refuses {refused[side, name]}" for side in (left, right) if refused[side, name]]:
        return [name], [], "; ".join(why)
    differing, lacking = compare(left.files / name, right.files / name)
    places = ", ".join(f"{part} {where}" for part, where in differing.items())
    return list(differing), lacking, f"differs: {places}" if places else "same"


def main() -> int:
    """Make all runs, and print what differs. Returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--base", required=True, metavar="COMMIT", help="what to compare this tree with")
    parser.add_argument("--only", nargs="+", choices=RUNS, default=list(RUNS), metavar="NAME", help="only these runs")
    parser.add_argument(
        "--expect-different", nargs="+", choices=[*RUNS, *PARTS], default=[], metavar="NAME",
        help=f"runs that may differ from the base, or parts that may in all runs: {', '.join(PARTS)}",
    )  # fmt: skip
    flags = parser.parse_args()
    began_s, unexpected = time.monotonic(), 0
    with tempfile.TemporaryDirectory(prefix="same_bits-") as temporary:
        files = Path(temporary).resolve()
        with worktree(flags.base, files / "tree") as tree:
            base, here, alone = Side(tree, 3, files / "base"), Side(ROOT, 3, files / "here"), Side(ROOT, 1, files / "alone")
            for side in (base, here, alone):
                side.files.mkdir()
                check_code(side)
            recorded = base.files / "record" / "datasets"
            first = [(base, "record")] if {"record", *FROM_RECORDED} & {*flags.only} else []
            jobs = [job for name in flags.only for side in (base, here, alone) if (job := (side, name)) not in first]
            refused = {(side, name): make(side, name, recorded) for side, name in first}
            with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
                refused |= zip(jobs, pool.map(lambda job: make(job[0], job[1], recorded), jobs), strict=True)
        for name in flags.only:
            for beside, label in ((base, "base and here"), (alone, "1 and 3 workers")):
                differing, lacking, verdict = told(name, beside, here, refused)
                allowed = beside is base and (name in flags.expect_different or {*differing} <= {*flags.expect_different})
                unexpected += bool(differing) and not allowed
                print(f"{name:10} {label:16} {verdict}" + (f" (only one has: {', '.join(lacking)})" if lacking else ""))
    print(f"{time.monotonic() - began_s:.0f} s")
    return bool(unexpected)


if __name__ == "__main__":
    sys.exit(main())
