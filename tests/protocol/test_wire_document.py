"""`protocol/README.md` cannot lie: its generated parts are made here from the code, and the test fails when they differ.

python -m tests.protocol.test_wire_document        (or `make docs`) writes them
"""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
import typing
from collections.abc import Iterable, Mapping
from enum import Enum
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import msgspec
import numpy as np
import pytest

from millrace.learner.members import join_limiter, membership
from millrace.learner.rollouts import ticket_coordinator
from millrace.protocol import (
    bounds,
    call_timeouts,
    env_spec,
    lane_past,
    messages,
    progress,
    rollout,
    space_spec,
    specs,
)
from millrace.protocol.keys import handshake_failures
from millrace.protocol.messages import (
    PROTOCOL_VERSION,
    Collect,
    Hello,
    Permit,
    Received,
    Rollout,
    ToLearner,
    ToWorker,
    Weights,
)
from millrace.protocol.rules import in_document
from millrace.protocol.wire import codec, message_sizes, socket_options
from millrace.protocol.wire import compression as packing
from millrace.workers.conversation import held, session, worker_states
from tests.support.conversation.example_messages import example

ROOT = Path(__file__).parents[2]
DOCUMENT = ROOT / "protocol" / "README.md"
BEGIN, END = "<!-- generated {name}: `make docs` writes what follows -->", "<!-- end of {name} -->"

# Records that travel inside messages, in the order in which a reader meets them.
RECORDS: tuple[type, ...] = (
    messages.Permit,
    lane_past.LanePast,
    lane_past.LastEpisode,
    lane_past.AttributeChanges,
    messages.Received,
    messages.LaneIncarnation,
    messages.WorkerActivity,
    messages.WorkerExit,
    progress.RunProgress,
    messages.WorkerStatus,
    rollout.Episode,
    lane_past.EpisodeBegin,
    space_spec.EnvDescription,
    *typing.get_args(space_spec.SpaceSpec),
    specs.WaitSpec,
    specs.RunSpec,
    specs.StepSpec,
    call_timeouts.CallTimeouts,
    specs.ExtraArray,
    env_spec.EnvSpec,
    specs.PolicySpec,
    specs.EncoderSpec,
    specs.OwnPolicySpec,
    specs.NamedShape,
    specs.Leaf,
    specs.ActionSpec,
    specs.ActionPart,
)
EXAMPLES = (
    example(Hello, pid=7, process_nonce=77, software="millrace", attempt=78),
    example(
        Collect,
        session=1234605616436508,
        version=3,
        permits=(example(Permit, ticket=40, incarnation=1, sequence=11),),
        received=(Received(0, 1, 9, (10,)),),
        keep=(2, 3),
    ),
    Weights(3, np.arange(6, dtype=np.float32), np.zeros(0, np.float32)),
)
# Fields that mean the same wherever they stand, or whose name says it all: used where the code adds nothing to the name.
WORDS: Mapping[str, str] = {
    "session": "number of the session",
    "lane": "number of the lane",
    "incarnation": "incarnation of the lane",
    "ticket": "number of the ticket",
    "tickets": "numbers of tickets",
    "version": "how many updates made the weights",
    "protocol": "`PROTOCOL_VERSION` of the worker",
    "host": "the worker's machine, for people",
    "pid": "process id of the worker; with `host` it distinguishes a repeated Hello from another process of that name",
    "software": "name of the worker's software, for people",
    "reason": "for people: who, what, expected, got, what to do",
    "error": "the exception, in one line",
    "traceback": "the traceback, as text",
    "number": "counts the replies of this session, from 1",
    "permits": "the tickets, each for one rollout",
    "received": "one entry for each lane of this worker; a lane that is not listed belongs to another worker",
    "lanes": "the lanes (in `RunSpec`: their number)",
    "run": "the run that the worker joins",
    "length": "number of steps",
    "seconds": "wall-clock seconds",
    "env": "the environment",
    "policy": "the policy that acts",
    "seed": "seed of the run; env copies and action generators are seeded by (seed, lane, …)",
    "heartbeat_s": "seconds between two heartbeats of a worker",
    "observation": "the arrays of an observation, in order",
    "action": "what the policy chooses",
    "activation": "activation function of the hidden layers",
    "kind": "the gymnasium space it comes from",
    "shape": "without T and N",
    "dtype": "numpy's name of the dtype",
    "low": "lower bounds",
    "high": "upper bounds",
    "n": "number of values",
    "start": "the smallest value",
    "worker": "the worker's name",
    "process_nonce": "`process_nonce` of the worker's Hello",
    "doing": "what it does; code of the user runs in all of these except `starting` and `waiting`",
    "running": "its workers that run",
    "description": "the environment",
    "keys": "the keys, in the order of the space",
    "spaces": "the inner spaces, in order",
    "name": "its name",
    "reward": "raw rewards",
    "render_mode": "gymnasium's render mode; empty if none",
}
VERSION_IN = {
    "clients/cpp/include/millrace/messages.hpp": r"(?<=PROTOCOL_VERSION = )\d+",
    "clients/js/millrace.js": r"(?<=PROTOCOL_VERSION = )\d+",
    "docs/how-to/write_a_client.md": r"(?<=\"protocol\": )\d+",
}
"""Where else the number of the protocol stands. A client that has it must pass its tests."""
# What each limit bounds. A new MAX_* constant without a line here fails a test.
LIMITS: Mapping[tuple[ModuleType, str], str] = {
    (message_sizes, "MAX_FRAMES"): "frames of a message, the head included",
    (message_sizes, "MAX_HEAD_BYTES"): "bytes of the head",
    (message_sizes, "MAX_FRAME_BYTES"): "bytes of any one frame: the connection is closed before more is read",
    (message_sizes, "MAX_ITEMS"): "items of any list or map in the head",
    (message_sizes, "MAX_DIMENSIONS"): "dimensions of an array",
    (bounds, "MAX_NAME"): "characters of a `Name`",
    (bounds, "MAX_LINE"): "characters of a `Line`",
    (bounds, "MAX_TEXT"): "characters of a `Text`",
    (bounds, "MAX_TICKETS"): "tickets in one message; also versions in a Heartbeat",
    (bounds, "MAX_WORKERS"): "workers that one supervisor speaks for",
    (bounds, "MAX_COPIES"): "env copies of one lane",
    (bounds, "MAX_SAVED_BYTES"): "bytes of the state of one env copy that its environment has saved",
    (lane_past, "MAX_RANDOM_BYTES"): "bytes of a `RandomState`",
    (bounds, "MAX_SEEDS"): "episodes of one Evaluate",
    (bounds, "MOST_OTHER_KEYS"): "keys of one dict in `plain_values` that aren't strings",
    (
        bounds,
        "MOST_KEYS_SQUARED",
    ): "sum of the squares of these numbers over all dicts in one value, such as the info of one copy",
    (
        bounds,
        "MOST_WITH_ONE_HASH",
    ): "keys of one dict in `plain_values` that aren't strings and have the same hash in Python",
    (bounds, "MAX_FACTS"): "facts of an episode",
    (bounds, "MOST_FRAMES"): "observations of an episode that come with a frame: the first ones",
    (space_spec, "MAX_LEAVES"): "arrays of an observation or an action",
    (space_spec, "MAX_DEPTH"): "levels of Dict and Tuple spaces",
    (space_spec, "MAX_WRAPPERS"): "classes of an environment's wrappers",
    (space_spec, "MAX_SEATS"): "agents of an environment",
    (space_spec, "MAX_SPACES"): "random generators of an environment's spaces",
    (space_spec, "MAX_ELEMENTS"): "elements of all arrays of a space together",
    (env_spec, "MAX_CALLABLE_BYTES"): "bytes of a pickled callable",
    (packing, "MAX_STACK"): "frames of a stack that travels packed",
    (packing, "MIN_FRAME_BYTES"): "bytes of a frame of such a stack, at least",
    (session, "HELLO_FIRST_S"): "seconds from the first Hello to the second; each wait is twice as long as the last",
    (session, "HELLO_MOST_S"): "seconds between two Hello messages, at most",
    (ticket_coordinator, "STRIKES"): "messages or rollouts that cannot be used, after which a worker is refused",
    (ticket_coordinator, "MOST_NOTES"): "different notes of workers that the learner says",
    (membership, "REMEMBERED"): "refused processes that the learner remembers, so that they do not come back",
    (membership, "MAX_MEMBERS"): "workers of one learner",
    (join_limiter, "AT_ONCE"): "times that the workers of one key may say Hello at once; more are not answered",
    (join_limiter, "PER_S"): "of them in each second, after that",
    (handshake_failures, "HANDSHAKE_MS"): "milliseconds that a handshake may take",
    (socket_options, "LINGER_MS"): "milliseconds for which a closing socket still sends queued messages",
}


# -------------------------------------------------------------------- from the code to markdown


def class_of(kind: type) -> ast.ClassDef:
    """The class as it is written in its file."""
    tree = ast.parse(inspect.getsource(inspect.getmodule(kind) or messages))
    return next(node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == kind.__name__)


def one_line(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def marked(meaning: str) -> str:
    """A docstring in one line, behind the marker of the rules that it ends with."""
    text, _, rules = one_line(meaning).partition(" (rule")
    return f"<!-- rule {rules.removeprefix('s').strip(' )')} -->{text}" if rules else text


def in_words(kind: ast.expr) -> str:
    """A type as it is written, in words."""
    match kind:
        case ast.Subscript(ast.Name("Annotated"), ast.Tuple([base, ast.Call(keywords=limits)])):
            bounded = {limit.arg: _limit(limit.value) for limit in limits}
            return f"{in_words(base)}, {bounded.get('min_length', 0)} to {bounded['max_length']}"
        case ast.Subscript(ast.Name("tuple"), ast.Tuple([base, _])):
            return f"list of {in_words(base)}"
        case ast.Subscript(ast.Name("dict"), ast.Tuple([key, value])):
            return f"map of {in_words(key)} to {in_words(value)}"
        case ast.Subscript(ast.Name("Literal"), ast.Tuple(values)):
            return "one of " + ", ".join(f"`{ast.literal_eval(value)}`" for value in values)
        case ast.BinOp(one, ast.BitOr(), other):
            text = f"{in_words(one)} or {in_words(other)}"
            every = " or ".join(f"`{space.__name__}`" for space in typing.get_args(space_spec.SpaceSpec))
            return text.replace(every, "`SpaceSpec`")
        case ast.Constant(None):
            return "null"
    return f"`{ast.unparse(kind)}`"


def _limit(value: ast.expr) -> int:
    """The number of a bound: a constant, or the name of one."""
    if isinstance(value, ast.Constant):
        return int(ast.literal_eval(value))
    (found,) = {
        getattr(module, ast.unparse(value)) for module in (bounds, space_spec) if hasattr(module, ast.unparse(value))
    }
    return int(found)


def fields_of(kind: type) -> list[tuple[str, str, str, str]]:
    """Name, type, default and meaning of each field, as they are written in the class or in its base."""
    bases = [base for base in kind.__bases__ if base is not msgspec.Struct]
    bodies = [class_of(each).body for each in (kind, *bases)]
    written: dict[str, tuple[str, str]] = {}
    for node, after in (pair for body in bodies for pair in zip(body, [*body[1:], None], strict=True)):
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        meaning = ""
        if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) and isinstance(after.value.value, str):
            meaning = after.value.value
        written[node.target.id] = in_words(node.annotation), meaning
    fields = msgspec.structs.fields(kind)
    assert list(written) == [field.name for field in fields]
    return [
        (field.encode_name, of_type, "" if field.required else default_of(field), meaning)
        for field, (of_type, meaning) in zip(fields, written.values(), strict=True)
    ]


def default_of(field: msgspec.structs.FieldInfo) -> str:
    """A field's default, as JSON."""
    made = field.default if field.default is not msgspec.NODEFAULT else field.default_factory()
    return msgspec.json.encode(made).decode()


@cache
def written_sections() -> dict[str, str]:
    """What is written by hand below each heading of the document that has no generated part."""
    text = DOCUMENT.read_text(encoding="utf-8")
    by_hand = re.sub(r"<!-- generated (.+?):.*?<!-- end of \1 -->", "", text, flags=re.DOTALL)
    _, *parts = re.split(r"^#+ (.+)$", by_hand, flags=re.MULTILINE)
    return dict(zip(parts[::2], parts[1::2], strict=True))


def told_in(kind: type) -> list[str]:
    """The sections with rules that name this message; if there are none, those that name it."""
    message, written = re.compile(rf"`{kind.__name__}(?:\.\w+)?`"), written_sections()
    ruled = {words.section for words in in_document().values() if message.search(words.text)} - {"Words"}
    return [section for section in written if section in ruled] or [
        section for section, text in written.items() if message.search(text)
    ]


def links(sections: Iterable[str]) -> str:
    """Links to these headings of the document."""
    anchor = {section: re.sub(r"[^a-z0-9 -]", "", section.lower()).replace(" ", "-") for section in sections}
    *others, last = [f"[{section}](#{anchor[section]})" for section in sections]
    return f"{', '.join(others)} and {last}" if others else last


def record(kind: type[msgspec.Struct]) -> str:
    """A heading, what the class says of itself, and its fields: with their places, if they go by position."""
    config = kind.__struct_config__
    told = f" See {links(told_in(kind))}." if is_message(kind) else ""
    says = marked(inspect.getdoc(kind) or "")
    if "<!--" in says and told:
        says += "<!-- rule -->"
    lines = [f"#### `{kind.__name__}`", "", says + told, ""]
    rows = fields_of(kind)
    if not config.array_like:
        lines += [f"A map; `{config.tag_field}` is `{kind.__name__}`." if config.tag else "A map.", ""]
    elif not rows:
        lines += [f'It has no fields: `["{kind.__name__}"]`.', ""]
    elif config.tag and kind in RECORDS:
        lines += [f"At place 0 stands its name, `{kind.__name__}`.", ""]
    if rows:
        places = "| place " if config.array_like else ""
        lines += [f"{places}| field | type | meaning |", "|---" * (4 if places else 3) + "|"]
        for place, (name, annotation, default, meaning) in enumerate(rows, 1 if config.tag else 0):
            text = annotation + (f" = `{one_line(default)}`" if default else "")
            at = f"| {place} " if places else ""
            lines.append(f"{at}| `{name}` | {text} | {marked(meaning or WORDS.get(name, ''))} |")
        lines.append("")
    return "\n".join(lines)


def state_table(table: Mapping[Any, Mapping[type, Any]]) -> str:
    """One row for each message or (in italics) internal event, one column for each state; a dash: nothing changes."""
    states = list(table)
    events = list(dict.fromkeys(event for row in table.values() for event in row))
    said = [event for event in events if is_message(event)]
    inner = [event for event in events if not is_message(event)]

    def cell(state: Enum, event: type) -> str:
        after = table[state].get(event)
        return "–" if after is None else "stays" if after is state else f"**{after.value}**"

    lines = ["| | " + " | ".join(state.value for state in states) + " |", "|---" * (len(states) + 1) + "|"]
    for event in said + inner:
        name = f"`{event.__name__}`" if is_message(event) else f"*{event.__name__}*"
        lines.append(f"| {name} | " + " | ".join(cell(state, event) for state in states) + " |")
    lines.append("")
    lines += [f"- *{event.__name__}*: {one_line(inspect.getdoc(event) or '').removeprefix('Event: ')}" for event in inner]
    return "\n".join(lines) + "\n"


def is_message(kind: type) -> bool:
    return kind in ToLearner.__args__ + ToWorker.__args__


def shown(head: bytes) -> str:
    """A head, as JSON."""
    return msgspec.json.encode(msgspec.msgpack.decode(head)).decode()


def part_version() -> str:
    return f"This document describes protocol version **{PROTOCOL_VERSION}**.\n"


def part_example() -> str:
    lines = ["```"]
    for message in EXAMPLES:
        head, *arrays = codec.encode(message)
        lines.append(f"frame 0  {shown(bytes(head))}")
        lines += [f"         {row}" for row in textwrap.wrap(bytes(head).hex(" "), 3 * 32)]
        lines += [f"frame {number}  {len(array)} bytes" for number, array in enumerate(arrays, 1)]
        lines.append("")
    lines[-1] = "```"
    return "\n".join(lines) + "\n"


def part_dtypes() -> str:
    names = [f"`{dtype}` is `{codec.DTYPES[dtype].name}`" for dtype in sorted(codec.DTYPES)]
    return "Dtypes, in numpy's letters, and their names in spaces and specifications: " + ", ".join(names) + ".\n"


def part_messages() -> str:
    parts = ["### What a worker says\n"]
    parts += [record(kind) for kind in ToLearner.__args__]
    parts.append("### What the learner says\n")
    parts += [record(kind) for kind in ToWorker.__args__]
    parts.append("### What an observer says, and is told\n")
    parts += [record(messages.Inquire), record(messages.Status)]
    parts.append("### Records inside messages\n")
    parts += [record(kind) for kind in RECORDS]
    return "\n".join(parts)


def part_limits() -> str:
    lines = ["| limit | value | bounds |", "|---|---|---|"]
    for (module, name), meaning in LIMITS.items():
        lines.append(f"| `{module.__name__}.{name}` | {getattr(module, name)} | {meaning} |")
    return "\n".join(lines) + "\n"


def part_types() -> str:
    """A row for each bounded type: its base and its bounds."""
    lines = ["| type | is | bounds |", "|---|---|---|"]
    seen = set[str]()
    for module in (bounds, space_spec, env_spec, messages, specs, lane_past):
        for name, kind in vars(module).items():
            if name in seen or not (name[0].isupper() and typing.get_origin(kind)):
                continue
            seen.add(name)
            if typing.get_origin(kind) is typing.Annotated:
                base, meta = typing.get_args(kind)
                told = {"ge": "at least", "le": "at most", "min_length": "length at least", "max_length": "length at most"}
                limits = [f"{said} {limit}" for key, said in told.items() if (limit := getattr(meta, key)) is not None]
                if meta.pattern:
                    limits.append(
                        "no control characters" if kind in (bounds.Name, bounds.Line) else f"matches `{meta.pattern}`"
                    )
                lines.append(f"| `{name}` | `{getattr(base, '__name__', base)}` | {', '.join(limits)} |")
            elif typing.get_origin(kind) is Literal:
                lines.append(f"| `{name}` | `str` | one of {', '.join(f'`{one}`' for one in typing.get_args(kind))} |")
            elif typing.get_origin(kind) is dict:
                lines.append(f"| `{name}` | map | any of the names of `Stage`, each with `Seconds`; it may be empty |")
            elif kind is space_spec.SpaceSpec:
                lines.append(f"| `{name}` | record | {', '.join(f'`{one.__name__}`' for one in typing.get_args(kind))} |")
            elif kind is env_spec.Scalar:
                lines.append(
                    f"| `{name}` | any of these | {', '.join(f'`{one.__name__}`' for one in typing.get_args(kind))} |"
                )
    return "\n".join(lines) + "\n"


PARTS = {
    "types": part_types,
    "version": part_version,
    "example": part_example,
    "dtypes": part_dtypes,
    "messages": part_messages,
    "worker table": lambda: state_table(worker_states.TABLE),
    "limits": part_limits,
}


def rewritten(text: str) -> str:
    """The document, with every generated part made afresh. Raises ValueError when a part's markers are missing."""
    for name, make in PARTS.items():
        begin, end = BEGIN.format(name=name), END.format(name=name)
        before, found, rest = text.partition(begin)
        _, closed, after = rest.partition(end)
        if not found or not closed:
            raise ValueError(f"{DOCUMENT.name}: expected the markers {begin} and {end}")
        text = f"{before}{begin}\n\n{make()}\n{end}{after}"
    return text


# -------------------------------------------------------------------- the tests


def test_the_wire_document_says_what_the_code_does() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    assert rewritten(text) == text, (
        "protocol/README.md differs from the code; run: python -m tests.protocol.test_wire_document"
    )


def test_every_generated_part_of_the_document_has_a_maker() -> None:
    found = re.findall(r"<!-- generated (.+?):", DOCUMENT.read_text(encoding="utf-8"))
    assert sorted(found) == sorted(PARTS)


OF_OBSERVERS = (messages.Inquire, messages.Status)


@pytest.mark.parametrize(
    "kind", [*ToLearner.__args__, *ToWorker.__args__, *OF_OBSERVERS, *RECORDS], ids=lambda kind: kind.__name__
)
def test_every_message_and_field_says_what_it_means(kind: type) -> None:
    assert ast.get_docstring(class_of(kind))
    assert [name for name, _, _, meaning in fields_of(kind) if not (meaning or WORDS.get(name))] == []


@pytest.mark.parametrize("kind", [*ToLearner.__args__, *ToWorker.__args__], ids=lambda kind: kind.__name__)
def test_every_message_is_explained_in_a_section_that_is_written_by_hand(kind: type) -> None:
    assert told_in(kind), f"say in protocol/README.md when a {kind.__name__} is sent, and what follows"


def test_a_message_points_to_the_rules_that_name_it() -> None:
    assert told_in(Collect) == ["The worker's half", "The ticket law", "The heartbeat repairs"]


@pytest.mark.parametrize("path", VERSION_IN)
def test_clients_and_pages_have_the_number_of_the_protocol(path: str) -> None:
    assert re.findall(VERSION_IN[path], (ROOT / path).read_text(encoding="utf-8")) == [str(PROTOCOL_VERSION)]


def test_no_type_is_written_in_python() -> None:
    tables = part_messages()
    assert not re.findall(r"Annotated|Literal|Meta\(|tuple\[|dict\[", tables)
    types = [row.split(" | ")[-2] for row in tables.splitlines() if row.startswith("| ")]
    named = set(re.findall(r"`([A-Z]\w+)`", " ".join(each for each in types if not each.startswith("one of"))))
    explained = part_types() + "".join(re.findall("#### .*", tables)) + "`Array` `PickledCallable`"
    assert named <= set(re.findall(r"`(\w+)`", explained))


def test_every_record_that_travels_is_described() -> None:
    """Whatever a field's type names, the document has a heading for."""
    described = {*ToLearner.__args__, *ToWorker.__args__, *OF_OBSERVERS, *RECORDS}
    for kind in described:
        for field in msgspec.structs.fields(kind):
            for name in re.findall(r"\b[A-Z]\w+", str(field.type)):
                if isinstance(inner := getattr(messages, name, getattr(specs, name, getattr(space_spec, name, None))), type):
                    assert inner in described or not issubclass(inner, msgspec.Struct), f"{kind.__name__}.{field.name}"


def test_every_limit_is_in_the_document() -> None:
    for module in (
        bounds, space_spec, env_spec, codec, message_sizes, socket_options, packing, session, held, ticket_coordinator,
        messages, rollout, specs, lane_past,
    ):  # fmt: skip
        for name in re.findall(r"^((?:MAX|MOST)_\w+)(?:, MAX_\w+)* = ", inspect.getsource(module), re.MULTILINE):
            assert (module, name) in LIMITS, f"say in LIMITS what {name} bounds"


def test_every_state_has_a_row_in_its_table() -> None:
    assert set(worker_states.TABLE) == set(worker_states.WorkerState)


def test_a_worker_is_told_by_its_table_what_to_do_with_every_message() -> None:
    """Every message to a worker is heeded in some state."""
    heeded = {event for row in worker_states.TABLE.values() for event in row if is_message(event)}
    assert heeded == set(ToWorker.__args__)


def test_a_difference_is_noticed() -> None:
    text = DOCUMENT.read_text(encoding="utf-8").replace("| `sequence` | `Natural`", "| `sequence` | `str`")
    assert rewritten(text) != text


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda message: type(message).__name__)
def test_an_example_is_within_its_bounds(message: Hello | Collect | Weights) -> None:
    decode = codec.decode_to_learner if isinstance(message, Hello) else codec.decode_to_worker
    assert type(decode(codec.encode(message))) is type(message)


def test_a_factory_stands_in_the_head_as_the_document_says() -> None:
    env = env_spec.EnvSpec("mine", factory=env_spec.PickledCallable(b"abc"))
    head, frame = codec.encode(messages.Describe(1, 78, env))
    assert msgspec.msgpack.decode(head)[3]["factory"] == ["|u1", [3], 1]
    assert (bytes(frame), '`["|u1", [bytes], frame]`' in DOCUMENT.read_text(encoding="utf-8")) == (b"abc", True)


def test_rollouts_fields_stand_in_the_order_of_the_code() -> None:
    assert [name for name, *_ in fields_of(Rollout)][:5] == ["session", "lane", "ticket", "version", "sequence"]


@pytest.mark.parametrize("kind", [*ToLearner.__args__, *ToWorker.__args__, *OF_OBSERVERS], ids=lambda kind: kind.__name__)
def test_from_the_document_alone_a_head_can_be_read(kind: type[msgspec.Struct]) -> None:
    """Whatever stands at a place that the document gives to a field comes back as that field."""
    text = record(kind)
    places = {name: int(place) for place, name in re.findall(r"^\| (\d+) \| `(\w+)`", text, re.MULTILINE)}
    fields = {name: f"its {name}" for name in kind.__struct_fields__}
    head = msgspec.to_builtins(kind(**fields))
    if kind in (Hello, messages.Refuse):
        assert "A map; `type` is" in text
        wire_names = dict(zip(kind.__struct_encode_fields__, fields.values(), strict=True))
        assert (places, head) == ({}, {"type": kind.__name__} | wire_names)
    else:
        assert head == [kind.__name__, *fields.values()]
        assert {name: head[place] for name, place in places.items()} == fields


if __name__ == "__main__":
    DOCUMENT.write_text(rewritten(DOCUMENT.read_text(encoding="utf-8")), encoding="utf-8")
    for path, number in VERSION_IN.items():
        page = ROOT / path
        page.write_text(re.sub(number, str(PROTOCOL_VERSION), page.read_text(encoding="utf-8")), encoding="utf-8")
