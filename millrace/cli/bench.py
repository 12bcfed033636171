"""`millrace bench`: starts the benchmarks in their own process. They use this package, but aren't installed with it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from millrace.cli.commands import COMMANDS
from millrace.cli.main import INSTALLED_IN
from millrace.flags.parse import asks_for_help, show_help
from millrace.protocol.errors import UsageError


def run(argv: list[str]) -> int:
    """Run the benchmarks. Returns the exit code."""
    places = (INSTALLED_IN, Path.cwd())
    repository = next((folder for folder in places if (folder / "benchmarks" / "program.py").is_file()), None)
    if repository is None:
        if asks_for_help(argv):
            show_help("bench", f"{COMMANDS['bench'].about.capitalize()}.", {})
        raise UsageError("bench: not part of the installed package; run it in a clone of the repository (make bench)")
    # -P keeps the current folder, whose modules aren't millrace's, out of the search path. Only the repository is added.
    path = os.pathsep.join(filter(None, [str(repository), os.environ.get("PYTHONPATH")]))
    flags = [flag for flag in argv if flag != "--debug"]  # a flag of `millrace` itself
    command = [sys.executable, "-P", "-m", "benchmarks.program", *flags]
    with subprocess.Popen(command, env={**os.environ, "PYTHONPATH": path}) as process:
        try:
            return process.wait()
        except KeyboardInterrupt:
            process.terminate()  # the process then also ends the benchmark that it runs
            process.wait()
            raise
