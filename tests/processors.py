"""`python -m tests.processors`: the numeric tests with the code that PyTorch and numpy run on other processors.

Rule: a setting counts only if the library that reads it says that it is in force; if not, the exit code is 1. A test is
numeric if its file compares floats (`COMPARES`). NumPy multiplies with OpenBLAS, and its own functions have code for several
processors; PyTorch multiplies with MKL (images: oneDNN), and ATen does the rest. Learners and workers that a test starts
have the same settings.
"""

from __future__ import annotations

import argparse
import ctypes
import importlib
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

ROOT = Path(__file__).parents[1]
COMPARES = re.compile(r"allclose|assert_close|approx\(|assert_within|array_equal|torch\.equal|policy\.safetensors")
PROBED_WITHIN_S = 120.0


class Setting(NamedTuple):
    """A variable, and what its library says when it is in force."""

    variable: str
    value: str
    says: tuple[str, ...]


def cpu_features() -> list[str]:
    """The extensions beyond its baseline for which this numpy has code, and which this process uses."""
    numpy_1 = np.__version__.startswith("1.")
    core: Any = importlib.import_module(f"numpy.{'core' if numpy_1 else '_core'}._multiarray_umath")
    return [name for name in core.__cpu_dispatch__ if core.__cpu_features__[name]]


# OpenBLAS as numpy's wheels have it names the kernels of Prescott by an older name, and runs those of Haswell for Zen.
PRESCOTT = Setting("OPENBLAS_CORETYPE", "Prescott", ("openblas Prescott", "openblas Katmai"))
HASWELL = Setting("OPENBLAS_CORETYPE", "Haswell", ("openblas Haswell",))
ZEN = Setting("OPENBLAS_CORETYPE", "Zen", ("openblas Zen", "openblas Haswell"))
ATEN_DEFAULT = Setting("ATEN_CPU_CAPABILITY", "default", ("aten DEFAULT",))
ATEN_AVX2 = Setting("ATEN_CPU_CAPABILITY", "avx2", ("aten AVX2",))
NUMPY_BASELINE = Setting("NPY_DISABLE_CPU_FEATURES", " ".join(cpu_features()), ("numpy baseline",))
ONEDNN_SSE41 = Setting("ONEDNN_MAX_CPU_ISA", "SSE41", ("onednn Intel SSE4.1",))
ONEDNN_AVX2 = Setting("ONEDNN_MAX_CPU_ISA", "AVX2", ("onednn Intel AVX2",))
MKL_ANY = Setting("MKL_CBWR", "COMPATIBLE", ("mkl COMPATIBLE",))

PROCESSORS = {
    "oldest": (ATEN_DEFAULT, PRESCOTT, NUMPY_BASELINE, ONEDNN_SSE41, MKL_ANY),
    "avx2": (ATEN_AVX2, HASWELL, ONEDNN_AVX2),
    "zen": (ATEN_DEFAULT, ZEN, ONEDNN_AVX2),
}


def numeric_tests() -> list[str]:
    """The test files that compare floats, relative to the root."""
    found = sorted((ROOT / "tests").rglob("test_*.py"))
    return [str(path.relative_to(ROOT)) for path in found if COMPARES.search(path.read_text())]


def say_what_is_in_force() -> None:
    """Print a line for each library: its name, and what it runs on. For a process with settings of its own."""
    import torch

    said = [f"aten {torch.backends.cpu.get_cpu_capability()}", f"numpy {' '.join(cpu_features()) or 'baseline'}"]
    maps = Path("/proc/self/maps").read_text().splitlines()
    for path in sorted({line.split()[-1] for line in maps if "openblas" in line}):
        library = ctypes.CDLL(path)
        for name in ("scipy_openblas_get_corename64_", "openblas_get_corename64_", "openblas_get_corename"):
            if hasattr(library, name):
                asks = getattr(library, name)
                asks.restype = ctypes.c_char_p
                said.append(f"openblas {asks().decode()}")
    print("\n".join(said), flush=True)
    backends: Any = torch.backends  # its classes have no types
    with backends.mkldnn.verbose(backends.mkldnn.VERBOSE_ON):  # it prints to the descriptor
        torch.nn.functional.conv2d(torch.ones(4, 16, 32, 32), torch.ones(32, 16, 3, 3))
    with backends.mkl.verbose(backends.mkl.VERBOSE_ON):
        torch.ones(32, 32) @ torch.ones(32, 32)


def in_force(variables: dict[str, str]) -> set[str]:
    """What the libraries of a process with these variables say, in the words of `Setting.says`."""
    command = [sys.executable, "-m", "tests.processors", "--probe"]
    done = subprocess.run(
        command,
        cwd=ROOT,
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        timeout=PROBED_WITHIN_S,
        check=True,
    )
    said = set(re.findall(r"^(?:aten|numpy|openblas) .+$", done.stdout, re.MULTILINE))
    said |= {f"onednn {isa.strip()}" for isa in re.findall(r"^onednn_verbose.*,cpu,isa:(.+)$", done.stdout, re.MULTILINE)}
    return said | {f"mkl {mode}" for mode in re.findall(r"^MKL_VERBOSE .*CNR:(\w+)", done.stdout, re.MULTILINE)}


def main() -> int:
    """Run the tests on each of the processors. Returns the exit code."""
    parser = argparse.ArgumentParser(description="Run the numeric tests with the code paths of other processors.")
    parser.add_argument("processors", nargs="*", metavar="NAME", help=f"some of {', '.join(PROCESSORS)}; default: all")
    parser.add_argument("--processes", type=int, default=(os.cpu_count() or 1) + 1, help="of pytest; default: %(default)d")
    parser.add_argument("--probe", action="store_true", help=argparse.SUPPRESS)
    flags = parser.parse_args()
    if flags.probe:
        say_what_is_in_force()
        return 0
    if unknown := set(flags.processors) - PROCESSORS.keys():
        parser.error(f"expected some of {', '.join(PROCESSORS)}, got {', '.join(sorted(unknown))}")
    failed = []
    for name in flags.processors or PROCESSORS:
        variables = {each.variable: each.value for each in PROCESSORS[name]}
        said = in_force(variables)
        print(
            f"\n{name}: {' '.join(f'{key}={value}' for key, value in variables.items())}\n{'; '.join(sorted(said))}",
            flush=True,
        )
        if off := [f"{each.variable}={each.value}" for each in PROCESSORS[name] if not said.intersection(each.says)]:
            print(f"{name}: not in force here: {', '.join(off)}")
            failed.append(name)
        command = [sys.executable, "-m", "pytest", "-n", str(flags.processes), "--dist=worksteal", *numeric_tests()]
        if subprocess.run(command, cwd=ROOT, env={**os.environ, **variables}, check=False).returncode:
            failed.append(name)
    if failed:
        print(f"\nfailed: {', '.join(failed)}")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
