"""The kinds of env copies: how the N copies of a lane are stepped (`--vector`).

Rule: the name of a kind stands for an object `module:name`, which is imported when a run asks for the kind. Built-in kinds
are in `KINDS`. Other packages install theirs as entry points of the group `millrace.copies`, which are read only for a name
that isn't built in. The learner also imports kinds (except `loop`, which has every ability), so a kind's module must not
import a simulator at its top level.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium

from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.found_names import attribute
from millrace.protocol.envs.which_copy import EnvCopy
from millrace.protocol.errors import UsageError, did_you_mean
from millrace.protocol.own_module import import_own
from millrace.protocol.specs import RunSpec

KINDS = {
    "loop": "millrace.workers.copies.looped_kind:LOOP",
    "native": "millrace.extras.envs.kinds:NATIVE",
    "envpool": "millrace.extras.envs.kinds:ENVPOOL",
}
DEFAULT = "loop"
GROUP = "millrace.copies"


class CopiesKind(NamedTuple):
    """A way to step the env copies of a lane."""

    open: Callable[[RunSpec, EnvCopy, Callable[[], None]], Any]
    """Makes the copies of a lane, and returns them as a `millrace.workers.copies.env_copies.EnvCopies`. The `EnvCopy`
    identifies the first copy. The last argument is called between any two calls to the environment, and may raise. Raises
    `UsageError` if the environment doesn't support such copies.
    """
    spaces: Callable[[EnvSpec], tuple[gymnasium.Space[Any], gymnasium.Space[Any]]] | None = None
    """Returns the observation and action space of one copy; a worker refuses the run if the environment's own spaces differ
    from them. None means that the copies have the environment's own spaces. Raises `UsageError`, like `open`.
    """
    has_masks: bool = True
    """Whether these copies report masks of the allowed actions if the environment does."""
    has_attributes: bool = True
    """Whether attributes can be set on these copies."""


def copies_kind(name: str) -> CopiesKind:
    """Import and return a kind. Raises `UsageError` if it is neither built in nor installed, or can't be imported."""
    what = f"vector {name}"
    module, _, qualname = _place(name).partition(":")
    kind = attribute(import_own(module, what), qualname)
    if not isinstance(kind, CopiesKind):
        raise UsageError(f"{what}: expected {module}:{qualname} to be a CopiesKind, got {type(kind).__name__}")
    return kind


def has_masks(name: str) -> bool:
    """Whether copies of this kind report masks of the allowed actions. Doesn't import `loop`, whose copies always do."""
    return name == DEFAULT or copies_kind(name).has_masks


def has_attributes(name: str) -> bool:
    """Whether attributes can be set on copies of this kind. Doesn't import `loop`, whose copies always allow it."""
    return name == DEFAULT or copies_kind(name).has_attributes


def check_kind(name: str) -> None:
    """Raise `UsageError` if a kind is neither built in nor installed. Imports nothing."""
    _place(name)


def _place(name: str) -> str:
    """Where the kind is, as `module:name`. Raises `UsageError` if it is neither built in nor installed."""
    if name in KINDS:
        return KINDS[name]
    from importlib import metadata

    installed = {each.name: each.value for each in metadata.entry_points(group=GROUP)}
    if name in installed:
        return installed[name]
    known = [*KINDS, *sorted(installed)]
    hint = did_you_mean(name, known) or "; is the package that has it installed here?"
    raise UsageError(f"vector {name}: expected one of {', '.join(known)}{hint}")
