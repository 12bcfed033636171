"""`python -m tests.versions NAME ...`: the tests on other Pythons, and with the lowest versions that pyproject.toml allows.

Rule: each name has a virtual environment of its own in `.versions/`. `3.12` is the tested versions (constraints.txt) on
`python3.12`; `lowest` is every direct dependency at its lower bound on this Python, and what they need at its newest. A
Python that is not installed, or a package that cannot be, is an error: nothing is left out in silence.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
ENVIRONMENTS = ROOT / ".versions"
LOWEST = "lowest"
VERSIONS = """
import platform, numpy, torch
print("Python", platform.python_version(), "torch", torch.__version__, "numpy", numpy.__version__)
"""
BOUND = re.compile(r"^(?P<name>[\w.-]+)(\[[\w,]+\])?>=(?P<version>[\w.]+)$")


def lower_bounds() -> dict[str, str]:
    """The lowest version of each direct dependency and of what the tests need, from pyproject.toml."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    asked = [*project["dependencies"], *project["optional-dependencies"]["dev"]]
    return {found["name"]: found["version"] for each in asked if (found := BOUND.match(each))}


def tested_versions() -> dict[str, str]:
    """The versions in constraints.txt."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    return dict(line.split("==") for line in lines if "==" in line)


def constraints(name: str, overrides: dict[str, str]) -> str:
    """The content of the constraints file for this environment. `overrides`: versions of packages that come first."""
    versions = lower_bounds() if name == LOWEST else tested_versions()
    return "".join(f"{package}=={version}\n" for package, version in {**versions, **overrides}.items())


def make(name: str, overrides: dict[str, str], *, system: bool, gpu: bool) -> Path:
    """Make the virtual environment, or bring it up to date. Returns its interpreter. `system` and `gpu`: see the flags."""
    folder = ENVIRONMENTS / name
    interpreter = sys.executable if name == LOWEST else shutil.which(f"python{name}")
    if interpreter is None:
        sys.exit(f"{name}: expected an interpreter python{name} on PATH; install it, or name other environments")
    if not folder.exists():
        subprocess.run([interpreter, "-m", "venv", *(["--system-site-packages"] if system else []), folder], check=True)
    pinned = folder / "constraints.txt"
    pinned.write_text(constraints(name, overrides))
    pip = [str(folder / "bin" / "python"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, "pip>=24"], check=True)  # older ones download what a dry run would install
    install = [*pip, "--constraint", str(pinned), "--editable", ".[dev]"]
    if not gpu and (found := libraries_for_gpus(install)):
        sys.exit(
            f"{name}: expected a PyTorch for CPUs, got one with {len(found)} packages for GPUs ({found[0]}); point pip to "
            "a CPU build (PIP_FIND_LINKS), name one of another version (--with), or take it (--gpu)"
        )
    subprocess.run(install, cwd=ROOT, check=True)
    return folder / "bin" / "python"


def libraries_for_gpus(install: list[str]) -> list[str]:
    """What pip would install only for the sake of a GPU: gigabytes, which no test needs."""
    asks = [*install, "--dry-run", "--report", "-"]
    report = json.loads(subprocess.run(asks, cwd=ROOT, capture_output=True, text=True, check=True).stdout)
    names = sorted(each["metadata"]["name"] for each in report["install"])
    return [name for name in names if name.startswith(("nvidia", "cuda", "triton"))]


def main() -> int:
    """Make each environment and run the tests in it. Returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", metavar="NAME", help=f"3.12, 3.13 ..., or {LOWEST}")
    parser.add_argument("--with", nargs="*", default=[], dest="overrides", metavar="PACKAGE==VERSION", help="instead")
    parser.add_argument("--system", action="store_true", help="use what the system's Python has installed, as PyTorch")
    parser.add_argument("--gpu", action="store_true", help="download libraries for GPUs too, if PyTorch asks for them")
    parser.add_argument("--pytest", nargs=argparse.REMAINDER, default=[], help="arguments of pytest; default: all tests")
    flags = parser.parse_args()
    overrides = dict(each.split("==") for each in flags.overrides)
    failed = []
    for name in flags.names:
        python = make(name, overrides, system=flags.system, gpu=flags.gpu)
        said = subprocess.run([python, "-c", VERSIONS], cwd=ROOT, capture_output=True, text=True, check=True).stdout
        print(f"\n{name}: {said}", end="", flush=True)
        tests = [python, "-m", "pytest", *(flags.pytest or ["--numprocesses", str((os.cpu_count() or 1) + 1)])]
        if subprocess.run(tests, cwd=ROOT, check=False).returncode:
            failed.append(name)
    if failed:
        print(f"\nfailed: {', '.join(failed)}")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
