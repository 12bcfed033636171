"""Advice for environments of the package gym, which gymnasium has replaced: the package shimmy converts them.

Rule: gym is not imported here. If another module has imported it, its registry is used.
"""

from __future__ import annotations

import importlib
import inspect
import sys
from typing import Any

import gymnasium

from millrace.protocol.envs.found_names import attribute
from millrace.protocol.errors import words_an_error

INSTALL = "pip install gym==0.26.2 shimmy"


def is_of_old_gym(made: object) -> bool:
    """Whether this is a gym environment: one of its classes is gym's, or its methods and spaces look like gym's."""
    if any(str(kind.__module__).partition(".")[0] == "gym" for kind in type(made).__mro__):
        return True
    space = attribute(made, "action_space")
    methods = (attribute(made, name) for name in ("reset", "step"))
    return all(map(callable, methods)) and not (space is None or callable(space) or isinstance(space, gymnasium.Space))


@words_an_error
def instead_of_object(made: object) -> str:
    """What a callable should return instead of a gym environment."""
    version = _version(made)
    wrap = f"`{INSTALL}`, and return shimmy.Gym{version}CompatibilityV0(env=it)"
    return f"it has the interface of the old package gym: {wrap}{_about_seed(made, version)}"


@words_an_error
def instead_of_id(env_id: str) -> str:
    """What to write instead of an id that is registered in gym; empty if it isn't registered there."""
    registry = attribute(sys.modules.get("gym"), "envs.registration.registry")
    known = getattr(registry, "env_specs", registry)
    spec = known.get(env_id.rpartition(":")[2]) if isinstance(known, dict) else None
    if spec is None:
        return ""
    point = _class_of(spec)
    version = _version(point)
    write = f"`{INSTALL}`, then write shimmy:Gym{version}Environment-v0 --env-kwargs env_id {env_id}"
    return f"{write}{_about_seed(point, version)}"


def _class_of(spec: object) -> object:
    """The class or function that a gym spec names; None if it cannot be found. In gym 0.9 the attribute is private."""
    point = attribute(spec, "entry_point") or attribute(spec, "_entry_point")
    if not isinstance(point, str):
        return point
    module, _, name = point.partition(":")
    try:
        return attribute(importlib.import_module(module), name)
    except Exception:  # another package's code
        return None


def _about_seed(of: object, version: str) -> str:
    """What to do if shimmy can't seed `of`, an environment or its class, as the end of a line; empty if shimmy can."""
    if version != "V21" or attribute(of, "seed") is not None:
        return ""
    return "; it also needs a method seed(seed), as under 'Old gym environments' in docs/how-to/third_party_environments.md"


def _version(of: object) -> str:
    """Which of gym's two interfaces an environment, or its class, has: shimmy calls them V21 and V26.

    Returns V26 if `of` has no `reset`, for example because it is a function that makes the environment.
    """
    reset: Any = attribute(of, "reset")
    try:
        return "V26" if "seed" in inspect.signature(reset).parameters else "V21"
    except (TypeError, ValueError):
        return "V26"
