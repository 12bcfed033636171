"""`python -m millrace` and the command `millrace`: run the command line and end the process."""

from __future__ import annotations

import gc
import sys
from typing import NoReturn

from millrace.cli.main import main


def command() -> NoReturn:
    """Run the command line and exit."""
    code = main()
    if "learner.imports_ahead" in sys.modules:
        from learner.imports_ahead import exit_if_importing

        exit_if_importing(code)
    gc.freeze()  # skips the garbage collection of torch's objects at exit, which is a tenth of a short run
    sys.exit(code)


if __name__ == "__main__":
    command()
