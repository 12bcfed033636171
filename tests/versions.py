"""`python -m tests.versions NAME ...`: the tests on other Pythons, and with the lowest versions that pyproject.toml allows.

Rule: each name has a virtual environment of its own in `.versions/`, which `uv` fills. `3.12` is the tested versions
(constraints.txt) on Python 3.12; `lowest` is every direct dependency as low as its bound and the others let it, on this
Python, and what they need at its newest. A Python that is not installed, or a package that cannot be, is an error: nothing
is left out in silence. A PyTorch with libraries for GPUs is refused, because they are gigabytes and no test needs them;
`--gpu-libraries` accepts them, where no CPU build is to be had.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
ENVIRONMENTS = ROOT / ".versions"
LOWEST = "lowest"
NEED_NEWER = re.compile(r"(ale-py|sb3-contrib|stable-baselines3)\b")
"""Packages of `dev` that need newer versions than ours of what we also need. Their tests are skipped without them."""
NEED_OLDER = ("mpmath>=1.3,<1.4", "pyparsing>=3.1,<3.3")
"""The lowest torch (by sympy) and matplotlib use names of these packages that are deprecated since. The lowest versions of
these packages are older than this Python.
"""
ASKS = """
import platform, numpy, torch
print("Python", platform.python_version(), "torch", torch.__version__, "numpy", numpy.__version__)
"""


def requirements(name: str, given: list[str]) -> list[str]:
    """What to install for this environment. `given` requirements are added to those of pyproject.toml."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    asked = [*project["dependencies"], *project["optional-dependencies"]["dev"]]
    if name == LOWEST:
        asked = [*(each for each in asked if not NEED_NEWER.match(each)), *NEED_OLDER]
    return [*asked, *given]


def uv() -> Path:
    """Install uv, if need be. Returns its path."""
    folder = ENVIRONMENTS / "uv"
    if not (folder / "bin" / "uv").exists():
        subprocess.run([sys.executable, "-m", "venv", folder], check=True)
        subprocess.run([folder / "bin" / "python", "-m", "pip", "install", "--quiet", "uv"], check=True)
    return folder / "bin" / "uv"


def make(name: str, given: list[str], gpu_libraries: bool) -> Path:
    """Make the virtual environment anew. Returns its interpreter."""
    folder = ENVIRONMENTS / name
    asked, exact = ENVIRONMENTS / f"{name}.in", ENVIRONMENTS / f"{name}.txt"
    python = sys.executable if name == LOWEST else name
    how = ["--resolution", "lowest-direct"] if name == LOWEST else ["--constraint", ROOT / "constraints.txt"]
    tool = uv()
    asked.write_text("\n".join(requirements(name, given)))
    subprocess.run([tool, "venv", "--quiet", "--clear", "--python", python, folder], check=True)
    interpreter = folder / "bin" / "python"
    subprocess.run([tool, "pip", "compile", "--quiet", "--python", interpreter, *how, asked, "-o", exact], check=True)
    for_gpus = re.findall(r"^(?:nvidia|cuda|triton)[\w-]*", exact.read_text(), re.MULTILINE)
    if for_gpus and not gpu_libraries:
        sys.exit(
            f"{name}: expected a PyTorch for CPUs, got one with {for_gpus[0]}; say where a CPU build is (UV_FIND_LINKS) "
            "and which version it has (--with torch==...), or accept this one (--gpu-libraries)"
        )
    subprocess.run([tool, "pip", "install", "--quiet", "--python", interpreter, "-r", exact], check=True)
    subprocess.run([tool, "pip", "install", "--quiet", "--python", interpreter, "--no-deps", "-e", ROOT], check=True)
    return interpreter


def main() -> int:
    """Make each environment and run the tests in it. Returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", metavar="NAME", help=f"3.12, 3.13 ..., or {LOWEST}")
    parser.add_argument("--with", action="append", default=[], dest="given", metavar="PACKAGE==VERSION", help="instead")
    parser.add_argument("--gpu-libraries", action="store_true", help="accept a PyTorch with libraries for GPUs")
    parser.add_argument("--pytest", nargs=argparse.REMAINDER, default=[], help="arguments of pytest; default: all tests")
    flags = parser.parse_args()
    failed = []
    for name in flags.names:
        python = make(name, flags.given, flags.gpu_libraries)
        said = subprocess.run([python, "-c", ASKS], cwd=ROOT, capture_output=True, text=True, check=True).stdout
        print(f"\n{name}: {said}", end="", flush=True)
        tests = [python, "-m", "pytest", *(flags.pytest or ["-n", str((os.cpu_count() or 1) + 1), "--dist=worksteal"])]
        if subprocess.run(tests, cwd=ROOT, check=False).returncode:
            failed.append(name)
    if failed:
        print(f"\nfailed: {', '.join(failed)}")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
