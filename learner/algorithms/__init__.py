"""The learning algorithms. They use no sockets and no files.

Each algorithm is one class in one file. Its settings are one record in `millrace.learner.config.hyperparameters`.
`ALGORITHMS` and `HYPERPARAMETERS` in `millrace.learner.config` list them by name. Importing this module does not import
torch; calling `algorithm_class` does.
"""

from __future__ import annotations

from pkgutil import resolve_name

import millrace.protocol.machine.waiting_threads  # noqa: F401  # must precede torch; importing any algorithm runs this
from millrace.learner.algorithms.algorithm import Algorithm
from millrace.learner.config.algorithm_names import ALGORITHMS, is_own, own_class

__all__ = ["ALGORITHMS", "Algorithm", "algorithm_class"]


def algorithm_class(name: str) -> type[Algorithm]:
    """Import and return the class of this algorithm: a built-in one from `ALGORITHMS`, or your own.

    Your own class must have the methods of `Algorithm` but need not derive from it. Raises `UsageError` if your class cannot
    be found or lacks a method, and KeyError if there is no built-in algorithm with this name.
    """
    if is_own(name):
        own: type[Algorithm] = own_class(name)
        return own
    found: type[Algorithm] = resolve_name(ALGORITHMS[name])
    return found
