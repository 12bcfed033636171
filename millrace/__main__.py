"""`python -m millrace`, and `millrace`: the command line as a process of its own."""

from __future__ import annotations

import gc
import sys
from typing import NoReturn

from millrace.cli.main import main


def command() -> NoReturn:
    """`main`, and the end of the process."""
    code = main()
    gc.freeze()  # else the interpreter looks for garbage among torch's objects before it ends: a tenth of a short run
    sys.exit(code)


if __name__ == "__main__":
    command()
