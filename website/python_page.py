"""reference/python.md: the public names in groups. mkdocstrings replaces each `:::` line with signature and docstring."""

from __future__ import annotations

from importlib import import_module

HEAD = """# Python

Look here for the signature, the arguments and the errors of a public name. `import millrace` gives all names of the first
sections. What is in none of these sections is internal: it may change in any version.

"""
GROUPS = {
    "Train and look at runs": (
        "train", "Run", "Metrics", "Summary", "Evaluation", "evaluate", "record", "RecordedDataset", "Dashboard",
    ),
    "Use a policy": ("load", "LoadedPolicy"),
    "Callbacks": ("Callback", "Progress"),
    "Vector environment": ("make_vec",),
    "Env copies": ("EnvCopy", "env_copy"),
    "Wrappers": ("ResetAhead",),
    "Rollouts for a learner of your own": ("RolloutService", "RolloutBatch", "Normalizer"),
    "Policies that act in workers": ("MLP", "CNN", "Recurrent", "OwnPolicy", "PolicyParameters", "Piece"),
    "Errors": (
        "MillraceError", "UserFacingError", "UsageError", "RunError", "CheckpointError", "NoWorkers", "WorkerLost",
        "Stalled", "EnvironmentFailed", "PolicyFailed",
    ),
}  # fmt: skip
"""The names of `millrace.__all__`; its modules and `__version__` have sections of their own"""
MODULES = {
    "algorithms": "What an algorithm of your own needs. Importing this module imports PyTorch.",
    "testing": "Tests of what you write.",
    "integrations": "Callbacks for other tools.",
    "sb3": "The vector environment for Stable-Baselines3 (`pip install 'millrace-rl[peers]'`).",
}
"""Public modules, and the first sentence of the section of each"""


def page() -> str:
    """The page."""
    parts = [HEAD]
    for title, names in GROUPS.items():
        parts.append(f"## {title}\n\n" + "".join(f"::: millrace.{name}\n\n" for name in names))
    parts.append("## Version\n\n`millrace.__version__` is the version of the installed package, as text.\n\n")
    for module, about in MODULES.items():
        parts.append(f"## millrace.{module}\n\n{about}\n\n" + "".join(f"::: {name}\n\n" for name in names_of(module)))
    return "".join(parts)


def names_of(module: str) -> list[str]:
    """The full public names of a module."""
    found = import_module(f"millrace.{module}")
    names = getattr(found, "__all__", None) or [
        name for name, value in vars(found).items() if not name.startswith("_") and _is_from(value, found.__name__)
    ]
    return [f"millrace.{module}.{name}" for name in names]


def _is_from(value: object, module: str) -> bool:
    return callable(value) and getattr(value, "__module__", None) == module


def anchors() -> set[str]:
    """The anchors that mkdocstrings makes: the full name of each object."""
    return {f"millrace.{name}" for names in GROUPS.values() for name in names} | {
        name for module in MODULES for name in names_of(module)
    }
