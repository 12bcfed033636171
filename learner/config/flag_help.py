"""`millrace train --help` and `millrace learner --help`: the settings of a run in groups, the basic ones first.

Flags are parsed as one flat record (`command_line.RunFlags`). tyro shows each nested record in a box of its own, so for the
help the same fields are nested, one record for each group.
"""

from __future__ import annotations

import ast
import inspect
import itertools
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, NoReturn, get_args, get_origin, get_type_hints

import msgspec
from tyro.conf import arg

from learner.config.flag_parser import parse_flags, plain_type
from learner.config.hyperparameters import HYPERPARAMETERS

BASIC = (
    "env", "algo", "steps", "seed", "workers", "envs", "env_kwargs", "wrapper", "start_from", "from_parts", "device",
    "preset", "config", "resume", "run_dir", "eval_episodes", "eval_every", "target_return", "target_mean_return",
)  # fmt: skip
GROUPS = {
    "evaluation": ("eval_env_kwargs", "eval_copies", "eval_max_steps", "info_keys"),
    "worker": (
        "lanes", "max_lag", "vector", "action_masks", "inference", "acting_dtype", "torch_threads", "max_env_copies",
        "min_workers", "launched_workers",
    ),
    "network": ("transport", "bind", "advertise", "keys", "insecure"),
    "timeout and failure": (
        "worker_timeout_s", "no_workers_timeout_s", "start_timeout_s", "step_timeout_s", "grace_s", "max_env_failures",
    ),
    "file and log": (
        "checkpoint_every_s", "keep_checkpoints", "record", "prior",
        "callback", "metrics_bind", "log_json", "debug",
    ),
}  # fmt: skip
"""The settings of each group, by its title. Before them come `BASIC` and the settings of the algorithm."""
METAVARS = {
    "algo": f"{{{','.join(HYPERPARAMETERS)}}}|MODULE:CLASS",
    "env_kwargs": "NAME VALUE ...",
    "eval_env_kwargs": "NAME VALUE ...",
    "wrapper": "MODULE:CLASS",
    "net": "INT ...",
    "callback": "MODULE:FACTORY",
    "config": "PATH",
    "resume": "PATH",
    "start_from": "PATH",
}
"""How the help shows the values of a flag, where tyro's own way is hard to read."""
DESCRIPTIONS = {
    "train": "Train a policy on this machine. Flags override --config and presets.",
    "learner": "Listen at --bind and train with the workers that connect. Flags override --config and presets.",
}
WIDEST_COLUMNS = 120  # tyro puts boxes of a wider help side by side, which mixes up their order
TYPE_NAMES = {bool: "True,False", int: "INT", float: "FLOAT", str: "STR", Path: "PATH"}


def show_help(flags: Any, command: str) -> NoReturn:
    """Print the help and raise SystemExit(0). `flags` is a `RunFlags` with the values to show as defaults."""
    os.environ["COLUMNS"] = str(min(shutil.get_terminal_size().columns, WIDEST_COLUMNS))
    groups = _grouped(flags, DESCRIPTIONS[command])
    parse_flags(type(groups), ["--help"], command, groups)
    raise AssertionError("tyro ends the process after --help")


def _grouped(flags: Any, description: str) -> msgspec.Struct:
    """The same settings with the same values, nested in groups."""
    algorithm = flags.algorithm
    groups = {flags.algo.rpartition(":")[2]: _fields(algorithm, list(field_texts(type(algorithm))))}
    groups |= {title: _fields(flags, names) for title, names in GROUPS.items()}
    nested: list[tuple[str, Any, msgspec.Struct]] = []
    for title, fields in groups.items():
        group = msgspec.defstruct("Group", fields, frozen=True, kw_only=True)
        nested.append((f"group_{len(nested)}", Annotated[group, arg(name=title, help="")], group()))
    help_record = msgspec.defstruct("Help", [*_fields(flags, BASIC), *nested], frozen=True, kw_only=True)
    help_record.__doc__ = description
    return help_record()


def field_texts(record: type) -> dict[str, str]:
    """The text under each field of a record in the source code, empty if it has none. Inherited fields come first."""
    texts: dict[str, str] = {}
    for base in reversed(record.__mro__):
        if base is msgspec.Struct or not issubclass(base, msgspec.Struct):
            continue
        texts |= {name: "" for name in base.__struct_fields__ if name not in texts}
        body = _class_body(base)
        for statement, following in itertools.pairwise(body):
            match statement, following:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                    texts[name] = " ".join(text.split())
    return texts


def _class_body(record: type) -> list[ast.stmt]:
    """The statements of a class; none if its source code cannot be read, as that of a class typed into a Python prompt."""
    try:
        source = inspect.getsource(record)
        # The source of a class in a class is indented.
        tree = ast.parse(f"if True:\n{source}" if source[:1].isspace() else source)
    except (OSError, TypeError, SyntaxError):
        return []
    return next((node.body for node in ast.walk(tree) if isinstance(node, ast.ClassDef)), [])


def _fields(record: msgspec.Struct, names: Sequence[str]) -> list[tuple[str, Any, Any]]:
    """Name, type (annotated for tyro) and value of these fields."""
    types, texts = get_type_hints(type(record), include_extras=True), field_texts(type(record))
    return [
        (
            name,
            Annotated[
                types[name],
                arg(
                    help=texts[name],
                    metavar=_metavar(name, types[name]),
                    help_behavior_hint=_hint(name, getattr(record, name)),
                ),
            ],
            getattr(record, name),
        )
        for name in names
    ]


def _metavar(name: str, hint: Any) -> str | None:
    """Placeholder for the values of a flag in the help text. None: tyro's default."""
    options = get_args(plain_type(hint))
    if name in METAVARS or NoneType not in options:
        return METAVARS.get(name)
    kind = plain_type(next(option for option in options if option is not NoneType))
    if get_origin(kind) is Literal:
        return f"{{{','.join(map(str, get_args(kind)))},none}}"
    return f"{{{TYPE_NAMES[kind]},none}}" if kind is bool else f"{TYPE_NAMES[kind]}|none"


def _hint(name: str, value: Any) -> str | None:
    """The hint after the help text. None: `(default: VALUE)`."""
    if value is None:
        return "" if name in METAVARS else "(default: none)"
    return "" if value in ("", {}, ()) else None
