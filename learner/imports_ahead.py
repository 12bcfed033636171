"""Imports PyTorch and the other modules of a run in a second thread, while workers start and describe the environment."""

from __future__ import annotations

import importlib
import logging
import os
import sys
import threading
from collections.abc import Callable

from millrace.learner.algorithms import ALGORITHMS

MODULES = ("torch", "millrace.learner.open_run")
POLL_S = 0.05
THREAD = "imports"


class ImportsAhead:
    """The imports that one run needs. They begin when this object is created."""

    def __init__(self, algo: str) -> None:
        # The module of a user-defined algorithm has already been imported, for its settings.
        self._modules = (*MODULES, ALGORITHMS[algo].partition(":")[0]) if algo in ALGORITHMS else MODULES
        self._error: BaseException | None = None
        # Not a daemon, because ending a thread in the middle of importing PyTorch can crash the process.
        self._thread = threading.Thread(target=self._import, name=THREAD)
        self._thread.start()

    def wait(self, check_interrupt: Callable[[], None]) -> None:
        """Wait until everything is imported. Raises any exception from an import or from `check_interrupt`."""
        while self._thread.is_alive():
            self._thread.join(POLL_S)
            check_interrupt()
        if self._error is not None:
            raise self._error

    def _import(self) -> None:
        try:
            for name in self._modules:
                importlib.import_module(name)
        except BaseException as error:
            self._error = error


def exit_if_importing(exit_code: int) -> None:
    """End this process at once if an import is still running, because the interpreter would wait for it for seconds.

    Call this last: if it ends the process, nothing else is cleaned up.
    """
    if any(thread.name == THREAD for thread in threading.enumerate()):
        logging.shutdown()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(exit_code)
