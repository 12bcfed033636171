"""`python -m millrace` and the command `millrace`: run the command line and end the process.

Rule: once `command` has begun, a signal that ends the process results in exit code 130 and no traceback. This is why the
slow imports are inside `command`. It blocks signals during these imports, because an extension module may crash if its
import is interrupted.
"""

from __future__ import annotations

import gc
import signal
import sys
from typing import NoReturn

from millrace.learner.interrupts import stopped_by_signals
from millrace.protocol.machine.deferred_signals import SIGNALS


def command() -> NoReturn:
    """Run the command line and exit."""
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    from millrace.cli.main import main

    try:
        with stopped_by_signals():
            code = main()
    except KeyboardInterrupt:  # a signal during the imports, or while `main` printed another error
        sys.stderr.write("millrace: interrupted\n")
        code = 130
    if "millrace.learner.imports_ahead" in sys.modules:
        from millrace.learner.imports_ahead import exit_if_importing

        exit_if_importing(code)
    gc.freeze()  # skips the garbage collection of torch's objects at exit, which takes a tenth of a short run
    sys.exit(code)


if __name__ == "__main__":
    command()
