"""A callback by its name, `module:factory`: the module is imported, and the factory (or class) is called without arguments.

Rule: whatever is wrong with the name is one line that quotes it. What the user's code raised has its traceback as detail.
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
