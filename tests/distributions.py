"""`python -m tests.distributions`: build sdist and wheel, look into them, and train from each in a clean environment.

Rule: each is installed into a new virtual environment with the versions of constraints.txt, and is used from a folder
that is not the repository. What is missing in a distribution is an error.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tomllib
import zipfile
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).parents[1]
DIST = ROOT / "dist"
READ = {"protocol/README.md"}
"""pages that the program reads"""
PARTS = ("learner", "workers", "protocol")
"""packages of millrace that stand beside its folder in the repository, which has links to them"""
PACKAGES = ("millrace", *(f"millrace/{part}" for part in PARTS))
TRAINING = ["CartPole-v1", "--steps", "20000", "--workers", "1", "--eval-episodes", "2", "--run-dir", "runs"]


def data_files() -> set[str]:
    """The files of the packages that are no Python, as a distribution must have them."""
    tracked = subprocess.run(["git", "ls-files", "millrace", *PARTS], cwd=ROOT, capture_output=True, text=True, check=True)
    paths = {path for path in tracked.stdout.splitlines() if not path.endswith((".py", ".md"))} - {*PACKAGES} | READ
    return {path if path.startswith("millrace/") else f"millrace/{path}" for path in paths}


def mistakes(names: set[str], data: set[str]) -> list[str]:
    """What is wrong with the files of a distribution, by their paths in it."""
    missing = sorted({*data, *(f"{package}/__init__.py" for package in PACKAGES)} - names)
    tests = sorted(name for name in names if PurePosixPath(name).parts[0] in ("tests", "benchmarks", "website", ".ci"))
    bare = sorted(name for name in names if PurePosixPath(name).parts[0] in PARTS)
    lines = [f"{name} is missing" for name in missing]
    lines += [f"{name}: expected no tests, benchmarks or site, got this file" for name in tests[:1]]
    return lines + [f"{name}: expected it below millrace/ alone" for name in bare[:1]]


def names_in(distribution: Path) -> set[str]:
    """The paths in a wheel, or in an sdist below its own folder."""
    if distribution.suffix == ".whl":
        with zipfile.ZipFile(distribution) as wheel:
            return set(wheel.namelist())
    with tarfile.open(distribution) as sdist:
        return {name.partition("/")[2] for name in sdist.getnames()}


def build() -> list[Path]:
    """Build both distributions. Returns their paths."""
    shutil.rmtree(DIST, ignore_errors=True)
    subprocess.run([sys.executable, "-m", "hatchling", "build"], cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    return [DIST / f"millrace_rl-{version}.tar.gz", DIST / f"millrace_rl-{version}-py3-none-any.whl"]


def install_and_train(distribution: Path, folder: Path) -> str:
    """Install a distribution into a new environment below `folder` and train from there. Returns its version."""
    environment, work = folder / "environment", folder / "work"
    work.mkdir(parents=True)
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    subprocess.run([sys.executable, "-m", "venv", environment], check=True)
    pip: list[str | Path] = [
        environment / "bin" / "python",
        "-m",
        "pip",
        "install",
        "--quiet",
        "--constraint",
        ROOT / "constraints.txt",
    ]
    subprocess.run([*pip, distribution], check=True, cwd=work, env=clean)
    millrace = environment / "bin" / "millrace"
    said = subprocess.run(
        [millrace, "--version"], cwd=work, env=clean, capture_output=True, text=True, check=True, timeout=60
    )
    subprocess.run([millrace, "train", *TRAINING], cwd=work, env=clean, check=True, timeout=300, stdout=subprocess.DEVNULL)
    (run,) = (work / "runs").iterdir()
    for name in ("summary.json", "policy.safetensors"):
        if not (run / name).is_file():
            raise SystemExit(f"{distribution.name}: expected {name} in the run folder, got none")
    return said.stdout.strip()


def main() -> int:
    """Build, look, install, train. Returns the exit code."""
    data = data_files()
    for distribution in build():
        if wrong := mistakes(names_in(distribution), data):
            sys.stderr.write("\n".join(f"{distribution.name}: {line}" for line in wrong) + "\n")
            return 1
        with tempfile.TemporaryDirectory() as folder:
            version = install_and_train(distribution, Path(folder))
        print(f"{distribution.name}: {distribution.stat().st_size:,} bytes, {version}, trains")
    return 0


if __name__ == "__main__":
    sys.exit(main())
