"""millrace/keywords.py says what the records of settings and flags say. `python -m tests.millrace.test_keywords` writes it.

Rule: a keyword has the type of its field without bounds, as wide as the function takes it: any sequence for a tuple, a path
for a folder, 1e6 for a large number. The text under it is that of the field; where algorithms differ, the text of each.
"""

from __future__ import annotations

import inspect
import textwrap
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import pytest

import millrace
from millrace.flags.field_texts import field_texts
from millrace.learner.config.config import Config
from millrace.learner.config.hyperparameters import HYPERPARAMETERS
from millrace.learner.config.rollout_config import RolloutConfig
from millrace.play_flags import EvaluateFlags, PlayFlags, RecordFlags

MODULE = Path(millrace.__file__).with_name("keywords.py")
HEAD = '''"""The keywords of `train`, `RolloutService`, `evaluate` and `record`, for editors and type checkers.

Made of the records that hold these settings and flags: `python -m tests.millrace.test_keywords` writes this file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Literal, TypedDict
'''
PATHS = ("run_dir", "keys", "start_from")
LARGE = ("steps", "eval_every", "eval_max_steps", "learning_starts", "replay_size", "epsilon_steps", "prior_steps")
"""Numbers that people write as 1e6"""
PLAIN = {bool: "bool", int: "int", float: "float", str: "str", Path: "str | PathLike[str]", NoneType: "None"}


def module() -> str:
    """The text of millrace/keywords.py. Arguments that stand in the signature of a function itself are left out."""
    in_signature = ("env", "wrappers", "callbacks", "algorithm", "run", "episodes", "out")
    records = (
        ("RolloutKeywords", "TypedDict", RolloutConfig, in_signature),
        ("TrainKeywords", "RolloutKeywords", Config, (*in_signature, *RolloutConfig.__struct_fields__)),
        ("PlayKeywords", "TypedDict", PlayFlags, in_signature),
        ("EvaluateKeywords", "PlayKeywords", EvaluateFlags, (*in_signature, *PlayFlags.__struct_fields__)),
        ("RecordKeywords", "PlayKeywords", RecordFlags, (*in_signature, *PlayFlags.__struct_fields__, "steps")),
    )
    functions = (
        "`millrace.RolloutService`",
        "`millrace.train`",
        "`millrace.evaluate` and `millrace.record`",
        "`millrace.evaluate`",
        "`millrace.record`",
    )
    parts = [HEAD]
    for (name, base, record, without), function in zip(records, functions, strict=True):
        parts.append(f'\n\nclass {name}({base}, total=False):\n    """Keywords of {function}."""\n\n')
        hints, texts = get_type_hints(record, include_extras=True), field_texts(record)
        parts += [entry(field, [hints[field]], text) for field, text in texts.items() if field not in without]
        parts += of_algorithms() if record is Config else ()
    return "".join(parts)


def of_algorithms() -> Iterator[str]:
    """The settings of all algorithms. A text names the algorithms that it is of, unless it is of all."""
    hints = {algo: get_type_hints(record, include_extras=True) for algo, record in HYPERPARAMETERS.items()}
    texts = {algo: field_texts(record) for algo, record in HYPERPARAMETERS.items()}
    for name in dict.fromkeys(name for fields in texts.values() for name in fields):
        algos_of: dict[str, list[str]] = {}
        for algo, fields in texts.items():
            if name in fields:
                algos_of.setdefault(fields[name], []).append(algo)
        lines = [text if len(algos) == len(texts) else f"{', '.join(algos)}: {text}" for text, algos in algos_of.items()]
        yield entry(name, (fields[name] for fields in hints.values() if name in fields), "\n".join(lines))


def entry(name: str, hints: Iterable[Any], text: str) -> str:
    """A keyword, and the text under it."""
    lines = [line for one in text.split("\n") for line in textwrap.wrap(one, 115, break_on_hyphens=False)]
    end = "" if len(lines) == 1 else "\n    "
    said = "\n    ".join(lines)
    return f'    {name}: {union(name, hints)}\n    """{said}{end}"""\n'


def union(name: str, hints: Iterable[Any]) -> str:
    """The type of a keyword that takes what any of these fields takes, in Python's words."""
    found = dict.fromkeys(part for hint in hints for part in parts_of(name, hint))
    literals = [part for part in found if part.startswith('"')]
    others = sorted((part for part in found if part not in literals), key="None".__eq__)
    return " | ".join([f"Literal[{', '.join(literals)}]"] * bool(literals) + others)


def parts_of(name: str, hint: Any) -> Iterator[str]:
    """The types of which a field takes any, each value of a Literal by itself."""
    match get_origin(hint), get_args(hint):
        case origin, (kind, *_) if origin is Annotated:
            yield from parts_of(name, kind)
        case origin, kinds if origin in (Union, UnionType):
            for kind in kinds:
                yield from parts_of(name, kind)
        case origin, values if origin is Literal:
            yield from (f'"{value}"' for value in values)
        case origin, (kind, *_) if origin is tuple:
            yield f"Sequence[{union('', [kind])}]"
        case origin, (key, value) if origin is dict:
            yield f"Mapping[{union('', [key])}, {union('', [value])}]"
        case _ if name == "algo":
            yield from (*(f'"{algo}"' for algo in HYPERPARAMETERS), "str", "type")
        case _:
            yield PLAIN[hint]
            yield from ["float"] * (name in LARGE) + ["PathLike[str]"] * (name in PATHS)


def test_the_module_says_what_the_records_say() -> None:
    assert MODULE.read_text("utf-8") == module()


def test_what_type_checkers_refuse_is_refused_when_it_runs() -> None:
    """`mypy --strict`, which reads the tests, would call an `ignore` that hides no error an error."""
    with pytest.raises(millrace.UsageError, match=r"unknown setting worker; did you mean workers\?$"):
        millrace.train("CartPole-v1", worker=2)  # type: ignore[call-arg]
    with pytest.raises(millrace.UsageError, match=r"""^train: workers: expected int or "none", got 'two'$"""):
        millrace.train("CartPole-v1", workers="two")  # type: ignore[arg-type]
    with pytest.raises(
        millrace.UsageError, match=r"^RolloutService: transport: expected one of inproc, ipc, tcp, got 'udp'$"
    ):
        millrace.RolloutService("CartPole-v1", transport="udp")  # type: ignore[arg-type]
    with pytest.raises(millrace.UsageError, match=r"^evaluate: unknown keyword copy; did you mean copies\?$"):
        millrace.evaluate("runs/none", copy=2)  # type: ignore[call-arg]
    for run, given in ((Path("runs/none"), 1e6), ("runs/none", 1_000_000)):
        with pytest.raises(millrace.UsageError, match=r"^run runs/none"):
            millrace.train(
                resume=run, steps=given, net=[64, 64], keys=Path("keys"), env_kwargs={"a": 1}, core=None, algo="ppo"
            )


@pytest.mark.parametrize(
    ("function", "workers"),
    [
        (millrace.train, "int | None"),
        (millrace.RolloutService, "int | None"),
        (millrace.evaluate, "int | None"),
        (millrace.record, "int | None"),
    ],
)
def test_a_signature_shows_every_keyword(function: Callable[..., object], workers: str) -> None:
    parameters = inspect.signature(function).parameters
    assert not [name for name, each in parameters.items() if each.kind is inspect.Parameter.VAR_KEYWORD]
    assert str(parameters["workers"]) == f"workers: '{workers}' = ..."


if __name__ == "__main__":
    MODULE.write_text(module(), "utf-8")
