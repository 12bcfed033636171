"""Environments of the package gym, which gymnasium has replaced: how the package shimmy makes them gymnasium's.

Rule: gym is not imported here. Where a module has imported it, what it has registered there is looked up.
"""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Callable
from typing import Any

import gymnasium

from protocol.envs.found_names import attribute

INSTALL = "pip install gym==0.26.2 shimmy"


def is_of_old_gym(made: object) -> bool:
    """Whether this is an environment of gym: by its classes, or, as if it does without gym, by its methods and spaces."""
    if any(kind.__module__.partition(".")[0] == "gym" for kind in type(made).__mro__):
        return True
    space = getattr(made, "action_space", None)
    methods = (getattr(made, name, None) for name in ("reset", "step"))
    return all(map(callable, methods)) and not (space is None or callable(space) or isinstance(space, gymnasium.Space))


def instead_of_object(made: Any) -> str:
    """What a callable should return instead of an environment of gym."""
    version = _version(made.reset)
    wrap = f"`{INSTALL}`, and return shimmy.Gym{version}CompatibilityV0(env=it)"
    return f"it has the interface of the old package gym: {wrap}{_about_seed(made, version)}"


def instead_of_id(env_id: str) -> str:
    """What to write instead of an id that is registered in gym; empty if it is not."""
    registry = attribute(sys.modules.get("gym"), "envs.registration.registry")
    known = getattr(registry, "env_specs", registry)
    spec = known.get(env_id.rpartition(":")[2]) if isinstance(known, dict) else None
    if spec is None:
        return ""
    point: Any = spec.entry_point
    try:
        module, _, name = str(point).partition(":")
        point = attribute(importlib.import_module(module), name) if isinstance(point, str) else point
        version = _version(point.reset)
    except Exception:  # another package's code, or a function that makes the environment
        version = "V26"
    write = f"`{INSTALL}`, then write shimmy:Gym{version}Environment-v0 --env-kwargs env_id {env_id}"
    return f"{write}{_about_seed(point, version)}"


def _about_seed(of: object, version: str) -> str:
    """What to do about an environment, or its class, that shimmy cannot seed, as the end of a line; else nothing."""
    if version != "V21" or hasattr(of, "seed"):
        return ""
    return "; it also needs a method seed(seed), as under 'Old gym environments' in docs/how-to/third_party_environments.md"


def _version(reset: Callable[..., object]) -> str:
    """Of gym's two interfaces the one that this `reset` is of, as shimmy names it."""
    return "V26" if "seed" in inspect.signature(reset).parameters else "V21"
