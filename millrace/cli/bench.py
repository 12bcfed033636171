"""`millrace bench`: start the benchmarks as a process of their own. They use this package and are not installed with it."""

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
    """Run them. Returns the exit code."""
    clone = next((folder for folder in (INSTALLED_IN, Path.cwd()) if (folder / "benchmarks" / "program.py").is_file()), None)
    if clone is None and asks_for_help(argv):
        show_help("bench", f"{COMMANDS['bench'].about.capitalize()}.", {})
    if clone is None:
        raise UsageError("bench: not part of the installed package; run it in a clone of the repository (make bench)")
    path = os.pathsep.join(filter(None, [str(clone), os.environ.get("PYTHONPATH")]))
    command = [sys.executable, "-P", "-m", "benchmarks.program", *(flag for flag in argv if flag != "--debug")]
    with subprocess.Popen(command, env={**os.environ, "PYTHONPATH": path}) as process:
        try:
            return process.wait()
        except KeyboardInterrupt:
            process.terminate()  # it ends its benchmark
            process.wait()
            raise
