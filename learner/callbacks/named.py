"""A callback by its name, `module:factory`: the module is imported, and the factory (or class) is called without arguments.

Rule: an error in the name is one line that quotes it. If user code raised, its traceback is the detail.
"""

from __future__ import annotations

from millrace.protocol.own_module import own_callable, own_code_failed


def named_callback(name: str) -> object:
    """Make the callback of this name. Raises `UsageError`."""
    what = f"callback {name}"
    found = own_callable(name, what, "mine:EarlyStop")
    try:
        made: object = found()
    except (Exception, SystemExit) as error:
        raise own_code_failed(f"{what}: {name.partition(':')[2]}()", error) from error
    return made
