"""Makes reference/settings.md: every setting of a run, from the records that define them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from enum import Enum
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import msgspec

from benchmarks.markdown_tables import table
from millrace.flags.field_texts import field_texts
from millrace.learner.config.command_line import BASIC, GROUPS, LAYERS, RunFlags
from millrace.learner.config.config import Config
from millrace.learner.config.hyperparameters import HYPERPARAMETERS
from millrace.learner.config.resume_rules import OnResume, declared
from millrace.protocol.bounds import LARGEST
from website.tables import anchored

HEAD = """# Settings

Every setting of a run, with its range and its default. A setting has one name in three places:

- as a flag of `millrace train` and `millrace learner`, with dashes: `--eval-every 1000`;
- as a key of a TOML file for `--config`, with underscores: `eval_every = 1000`;
- as a keyword of `millrace.train`, with underscores: `eval_every=1000`.

In a TOML file, the settings of an algorithm are in a table with the algorithm's name, such as `[ppo]`, and keyword
arguments of the environment are in the tables `[env_kwargs]` and `[eval_env_kwargs]`. A flag overrides `--config`, and
`--config` overrides a preset. The file `config.toml` of a run folder has every setting of that run.

| kind of setting | as a flag | in a TOML file |
|---|---|---|
| a list | `--net 64 64` | `net = [64, 64]` |
| true or false | `--shared-net`, `--no-shared-net` | `shared_net = true` |
| none, where it is allowed | `--core none` | `core = "none"` |

The column "on resume" says what happens if a [resumed run](../how-to/resume.md) gets another value:

"""
COLUMNS = ("setting", "values", "default", "on resume", "meaning")
KINDS = {bool: "true or false", int: "int", float: "float", str: "text", Path: "path"}


def page() -> str:
    """The page as Markdown."""
    parts = [HEAD + "".join(f"- **{one.name.lower()}**: {one.value}\n" for one in OnResume)]
    parts.append("\n## Basics\n\n" + _table(Config, [name for name in BASIC if name not in LAYERS]))
    parts.append(
        "\n## Where settings come from\n\nThese flags are no settings, so TOML files and run folders don't contain them.\n\n"
        + _table(RunFlags, LAYERS)
    )
    for title, names in GROUPS.items():
        parts.append(f"\n## {title.capitalize()}\n\n" + _table(Config, [name for name in names if name not in LAYERS]))
    for algo, record in HYPERPARAMETERS.items():
        about = " ".join((record.__doc__ or "").split())
        parts.append(
            f"\n## Algorithm {algo}\n\n{about} `--algo {algo}`, TOML table `[{algo}]`.\n\n"
            + _table(record, list(field_texts(record)), f"{algo}.")
        )
    return "".join(parts)


def shown_names() -> list[str]:
    """All settings and flags that the page shows, those of algorithms as `ALGO.NAME`."""
    names = [*BASIC, *LAYERS, *(name for group in GROUPS.values() for name in group)]
    return sorted({*names, *(f"{algo}.{name}" for algo, record in HYPERPARAMETERS.items() for name in field_texts(record))})


def _table(record: type[msgspec.Struct], names: Sequence[str], prefix: str = "") -> str:
    hints = get_type_hints(record, include_extras=True)
    texts = field_texts(record)
    resumed = {} if record is RunFlags else declared(record)
    defaults = record()
    return table(
        COLUMNS,
        (
            (
                anchored(f"{prefix}{name}", f"`{flag(name)}`"),
                values(hints[name]),
                default(getattr(defaults, name)),
                resumed[name].name.lower() if name in resumed else "–",
                texts[name],
            )
            for name in names
        ),
    )


def flag(name: str) -> str:
    """How a setting is written on the command line."""
    return "ENV" if name == "env" else f"--{name.replace('_', '-')}"


def default(value: Any) -> str:
    """A default as it is written on the command line."""
    if value is None:
        return "none"
    if value in ("", (), {}):
        return "–"
    match value:
        case bool():
            return str(value).lower()
        case tuple():
            return f"`{' '.join(map(str, value))}`"
        case _:
            return f"`{value}`"


def values(hint: Any) -> str:
    """The values that a type allows, in words."""
    kind, notes = _bare(hint)
    if kind in KINDS:
        return KINDS[kind] + "".join(notes)
    arguments = get_args(kind)
    match get_origin(kind):
        case origin if origin is Literal:
            return ", ".join(f"`{one}`" for one in arguments)
        case origin if origin in (Union, UnionType):
            some = [values(one) for one in arguments if one is not NoneType]
            return " or ".join([*some, "none"] if NoneType in arguments else some)
        case origin if origin is tuple:
            return f"list of {values(arguments[0])}"
        case origin if origin is dict:
            return "table"
    raise TypeError(f"settings page: expected a type that it can describe, got {hint}")


def _bare(hint: Any) -> tuple[Any, list[str]]:
    """A type without annotations, and its bounds in words."""
    if get_origin(hint) is not Annotated:
        return hint, []
    inner, *marks = get_args(hint)
    kind, notes = _bare(inner)
    for mark in marks:
        if isinstance(mark, msgspec.Meta):
            notes += _bounds(mark)
        elif isinstance(mark, Enum):
            continue
    return kind, notes


def _bounds(meta: msgspec.Meta) -> Iterator[str]:
    le = None if meta.le == LARGEST else meta.le  # too large to matter to a reader
    if meta.ge is not None and le is not None:
        yield f", {meta.ge:g} to {le:g}"
        return
    for sign, bound in (("≥", meta.ge), (">", meta.gt), ("≤", le), ("<", meta.lt)):
        if bound is not None:
            yield f" {sign} {bound:g}"
