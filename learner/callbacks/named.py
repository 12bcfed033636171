"""Creates a callback from its name, `module:factory`: imports the module, and calls the factory or class without arguments.

Rule: for an error in the name, the message is one line that quotes the name. If the user's code raised, the traceback is the
error's detail.
"""

from __future__ import annotations

from millrace.protocol.own_module import own_callable, own_code_failed


def named_callback(name: str) -> object:
    """Create the callback with this name. Raises `UsageError` if it isn't found, or if the factory raises."""
    what = f"callback {name}"
    found = own_callable(name, what, "mine:EarlyStop")
    try:
        made: object = found()
    except (Exception, SystemExit) as error:
        raise own_code_failed(f"{what}: {name.partition(':')[2]}()", error) from error
    return made
