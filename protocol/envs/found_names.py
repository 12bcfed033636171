"""Names of user-defined functions and classes: whether another process can find them, and how a run records them.

Rule: `module:qualname` can be imported in any process. `__main__:name` is an attribute of the program's own script or
notebook, and only that program can find it. `<name>` can't be found anywhere: it stands for a lambda, a function defined
inside another function, or an object.
"""

from __future__ import annotations

import importlib.util
import re
import sys

MAIN = "__main__"


def name_of(made: object) -> str:
    """The name under which `made` can be found again, or a name in `<>` if it can't."""
    module = attribute(made, "__module__")
    qualname = attribute(made, "__qualname__")
    if not isinstance(module, str) or not isinstance(qualname, str):
        return f"<{type(made).__name__}>"
    if attribute(sys.modules.get(module), qualname) is not made:
        return f"<{qualname.rpartition('.')[2].strip('<>')}>"
    if module == MAIN:
        spec = getattr(sys.modules[MAIN], "__spec__", None)
        # In a program started by `python -m mine`, other processes import the module as `mine`. They can't import a script.
        return f"{MAIN}:{qualname}" if spec is None or spec.name.endswith(MAIN) else f"{spec.name}:{qualname}"
    return f"{module}:{qualname}" if importable(module) else f"<{qualname}>"


def found_by_others(name: str) -> bool:
    """Whether another process can find an object by this name (see `name_of`)."""
    return not name.startswith((f"{MAIN}:", "<"))


def in_main(name: str) -> object:
    """The object that `__main__:name` names in this program's script or notebook; None if there is none."""
    module, _, qualname = name.partition(":")
    return attribute(sys.modules.get(MAIN), qualname) if module == MAIN else None


def moved(before: str, now: str) -> bool:
    """Whether the object once called `before` may now be called `now`: the name is the same, or was only given a module."""
    without_module = not found_by_others(before) or ":" not in before
    return before == now or (without_module and last_part(before) == last_part(now))


def last_part(name: str) -> str:
    """The name without its module, outer classes and arguments: `Clip` for `mine:Outer.Clip(0.5)` and for `<Clip>`."""
    name = name.strip("<>").partition("(")[0].rpartition(":")[2]
    return name if "/" in name else name.rpartition(".")[2]


def names_a_function(env_id: str) -> bool:
    """Whether this names a function or a class: `module:name`, where the name has no version.

    `package.module_v1` counts as well (see `names_a_module`).
    """
    _, colon, name = env_id.partition(":")
    return all(word.isidentifier() for word in name.split(".")) if colon else names_a_module(env_id)


def names_a_module(env_id: str) -> bool:
    """Whether this is `package.module_v1`.

    PettingZoo's environments are modules with such names, and have a function `parallel_env` or `env`.
    """
    return re.fullmatch(r"[^\W\d]\w*(\.\w+)*\.\w+_v\d+", env_id) is not None


def attribute(module: object, qualname: str) -> object:
    """The attribute of a module, or an object, with this dotted name; None if there is none."""
    value = module
    for part in qualname.split("."):
        try:
            value = getattr(value, part, None)
        except Exception:  # raised by a property, or by a module that imports its names lazily, such as supersuit
            return None
    return value


def importable(module: str) -> bool:
    """Whether another process with the same search path could import this module."""
    try:
        return importlib.util.find_spec(module) is not None
    except Exception:  # any type of error: `find_spec` imports the parent package
        return False
