"""A callback by its name, `module:factory`: the module is imported, and the factory (or class) is called without arguments.

Rule: whatever is wrong with the name is one line that quotes it. What the user's code raised has its traceback as detail.
"""

from __future__ import annotations

from learner.config.did_you_mean import did_you_mean
from learner.config.own_module import import_own, is_name, own_code_failed
from protocol.errors import UsageError


def named_callback(name: str) -> object:
    """Make the callback of this name. Raises `UsageError`."""
    what = f"callback {name}"
    if not is_name(name):
        raise UsageError(f"{what}: expected module:factory, as in mine:EarlyStop")
    module_name, _, path = name.partition(":")
    found: object = import_own(module_name, what)
    for part in path.split("."):
        known = [attribute for attribute in dir(found) if not attribute.startswith("_")]
        found = getattr(found, part, None)
        if found is None:
            raise UsageError(f"{what}: module {module_name} has no {path}{did_you_mean(part, known)}")
    if not callable(found):
        raise UsageError(f"{what}: expected a function or class to call, got {type(found).__name__}")
    try:
        return found()
    except (Exception, SystemExit) as error:
        raise own_code_failed(f"{what}: {path}()", error) from error
