"""The codec: every message comes back as it went; whatever bytes come instead, `BadMessage` and nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
import tracemalloc
import types
import typing
from pathlib import Path
from typing import Any, Literal

import msgpack
import msgspec
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from millrace.protocol.env_spec import PickledCallable
from millrace.protocol.errors import BadMessage
from millrace.protocol.messages import (
    Collect,
    Heartbeat,
    Hello,
    Inquire,
    Refuse,
    ToLearner,
    ToWorker,
    Weights,
    Welcome,
)
from millrace.protocol.space_spec import DictSpace, GeneratorState, Shape, SpaceSpec, TupleSpace
from millrace.protocol.wire.codec import DTYPES, decode_to_learner, decode_to_worker, encode
from millrace.protocol.wire.message_sizes import MAX_FRAMES, MAX_HEAD_BYTES
from tests.support.conversation.example_messages import example
from tests.support.conversation.fake_ends import fake_rollout, run_spec
from tests.support.examples import examples

OF_HEARTBEAT = len(Heartbeat.__struct_fields__)
KINDS = [*typing.get_args(ToLearner), *typing.get_args(ToWorker)]
BY_NAME = (Hello, Refuse)
ROOT = Path(__file__).parents[3]
Frames = list[bytes]
UNBOUNDED = msgspec.Meta()
SPACES = typing.get_args(SpaceSpec)
LEAF_SPACES = [kind for kind in SPACES if kind not in (DictSpace, TupleSpace)]

arrays = st.sampled_from(sorted(DTYPES)).flatmap(
    lambda dtype: hnp.arrays(np.dtype(dtype), hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=3))
)


def head(content: object, *frames: bytes) -> Frames:
    return [msgpack.packb(content), *frames]


def head_of(kind: type[msgspec.Struct], **wrong: object) -> list[object]:
    """The head of a message without arrays, with these values in its fields."""
    name, *values = msgspec.to_builtins(example(kind))
    return [name, *(wrong.get(field, value) for field, value in zip(kind.__struct_fields__, values, strict=True))]


def values(wanted: Any, bounds: msgspec.Meta = UNBOUNDED) -> st.SearchStrategy[Any]:
    """Anything of this type within its bounds: made from the fields of a message, so that a new one needs no new test."""
    printable = st.characters(exclude_categories=["Cc", "Cs", "Zl", "Zp"])
    plain: dict[Any, st.SearchStrategy[Any]] = {
        int: st.integers(
            -(2**63) if bounds.ge is None else int(bounds.ge), 2**64 - 1 if bounds.le is None else int(bounds.le)
        ),
        float: st.floats(bounds.ge, bounds.le, allow_nan=False),
        bool: st.booleans(),
        str: st.text(printable if bounds.pattern else st.characters(exclude_categories=["Cs"]), max_size=20),
        PickledCallable: st.binary(max_size=20).map(PickledCallable),
        types.NoneType: st.none(),
        Shape: st.lists(st.integers(0, 9), max_size=3).map(tuple),
        SpaceSpec: st.one_of([values(kind) for kind in SPACES]) if wanted is SpaceSpec else st.nothing(),
    }
    origin, inner = typing.get_origin(wanted), typing.get_args(wanted)
    if wanted == GeneratorState:
        return st.from_regex(inner[1].pattern)
    if wanted in plain:
        return plain[wanted]
    if origin is typing.Annotated:
        return values(inner[0], inner[1])
    if isinstance(wanted, type) and issubclass(wanted, msgspec.Struct):
        hints = typing.get_type_hints(wanted, include_extras=True)
        return st.builds(wanted, **{name: values(hints[name]) for name in wanted.__struct_fields__})
    if origin is np.ndarray:
        return arrays
    if origin is tuple:
        of = st.one_of([values(kind) for kind in LEAF_SPACES]) if inner[0] == SpaceSpec else values(inner[0])
        return st.lists(of, min_size=bounds.min_length or 0, max_size=3).map(tuple)
    if origin is dict:
        return st.dictionaries(values(inner[0]), values(inner[1]), max_size=3)
    if origin is Literal:
        return st.sampled_from(inner)
    return st.one_of([values(one) for one in inner])


messages = st.one_of([values(kind) for kind in KINDS])


def sent(message: Any) -> Frames:
    return [bytes(frame) for frame in encode(message)]


def decode(frames: Frames, kind: type) -> Any:
    return (decode_to_learner if kind in typing.get_args(ToLearner) else decode_to_worker)(frames)


def plainly(message: Any) -> object:
    """The message with its arrays spelled out, so that it can be compared."""

    def spelled(value: Any) -> object:
        return value.data if isinstance(value, PickledCallable) else (value.dtype.str, value.shape, value.tobytes())

    return msgspec.to_builtins(message, enc_hook=spelled)


@examples(200)
@given(messages)
def test_every_message_comes_back_as_it_went(message: Any) -> None:
    back = decode(sent(message), type(message))
    assert type(back) is type(message)
    assert plainly(back) == plainly(message)
    assert encode(back) == encode(message)


@pytest.mark.parametrize("kind", KINDS)
def test_no_message_is_taken_for_one_of_the_other_side(kind: type) -> None:
    wrong_side = decode_to_worker if kind in typing.get_args(ToLearner) else decode_to_learner
    with pytest.raises(BadMessage, match=f"Invalid value '{kind.__name__}'"):
        wrong_side(head({"type": kind.__name__} if kind in BY_NAME else [kind.__name__]))


FIRST_DECODE_IN_MANY_THREADS = """
import os, sys, threading
from millrace.protocol.wire.codec import decode_to_worker

frames = [bytes.fromhex(sys.argv[1])]
sys.setswitchinterval(1e-6)

def decode_all_at_once():
    barrier = threading.Barrier(8)
    threads = [threading.Thread(target=lambda: (barrier.wait(), decode_to_worker(frames))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

for _ in range(20):
    child = os.fork()
    if child == 0:
        decode_all_at_once()
        os._exit(0)
    _, status = os.waitpid(child, 0)
    if status:
        sys.exit(f"a process in which threads decoded their first Welcome ended with status {status}")
"""


@pytest.mark.process
@pytest.mark.skipif(not hasattr(os, "fork"), reason="starts copies of a process that has decoded nothing yet")
def test_threads_may_decode_their_first_welcome_at_the_same_moment() -> None:
    (frame,) = sent(Welcome(session=1, attempt=1, run=run_spec()))
    command = [sys.executable, "-c", FIRST_DECODE_IN_MANY_THREADS, frame.hex()]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr


# ------------------------------------------------------------------------------------------------ the head's form


@examples(200)
@given(messages)
def test_what_goes_by_position_does_not_go_by_name_nor_the_other_way_about(message: Any) -> None:
    first, *rest = sent(message)
    content = msgpack.unpackb(first)
    names = ["type", *message.__struct_encode_fields__]
    by_name = content if type(message) in BY_NAME else dict(zip(names, content, strict=True))
    assert list(by_name) == names
    assert by_name["type"] == type(message).__name__
    for wrong in (list(by_name.values()), by_name):
        if wrong != content:
            with pytest.raises(BadMessage, match=f"Invalid value '{type(message).__name__}'"):
                decode(head(wrong, *rest), type(message))
    with pytest.raises(BadMessage, match="Expected `array`, got `object`"):
        decode(head({name: by_name[name] for name in message.__struct_encode_fields__}, *rest), type(message))


@examples(200)
@given(st.one_of([values(kind) for kind in KINDS if kind not in BY_NAME]), st.data())
def test_a_head_of_another_length_is_refused(message: Any, data: st.DataObject) -> None:
    first, *rest = sent(message)
    content = msgpack.unpackb(first)
    fields = len(message.__struct_fields__)
    given = data.draw(st.integers(0, fields + 3).filter(lambda n: n != fields))
    frames = head([*content[: 1 + given], *[None] * (given - fields)], *rest)
    defaults = type(message).__struct_defaults__
    if fields - len(defaults) <= given < fields:
        left_out = dict(zip(message.__struct_fields__[given:], defaults[given - fields :], strict=True))
        kept = msgspec.structs.replace(message, **left_out)
        assume(len(sent(kept)) == len(frames))  # no array was left out
        assert plainly(decode(frames, type(message))) == plainly(kept)
        return
    with pytest.raises(BadMessage, match=f"{type(message).__name__} expected {fields} fields, got {given}$"):
        decode(frames, type(message))


def test_a_default_stands_at_the_end_alone() -> None:
    """By position nothing else can be left out."""
    for kind in (*KINDS, Inquire):
        required = [field.required for field in msgspec.structs.fields(kind)]
        assert required == sorted(required, reverse=True), kind


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (head_of(Heartbeat, session="7"), "Expected `int`, got `str` - at `Heartbeat.session`"),
        (head_of(Heartbeat, tickets=[1, None]), "Expected `int`, got `null` - at `Heartbeat.tickets[1]`"),
        (head_of(Heartbeat, stages={"act": "x"}), "Expected `float`, got `str` - at `Heartbeat.stages[...]`"),
        (head_of(Heartbeat, resident_bytes=1.5), "Expected `int`, got `float` - at `Heartbeat.resident_bytes`"),
        (head_of(Heartbeat)[:7], f"Heartbeat expected {OF_HEARTBEAT} fields, got 6"),
        ([*head_of(Heartbeat), 0], f"Heartbeat expected {OF_HEARTBEAT} fields, got {OF_HEARTBEAT + 1}"),
        (["Heartbeat"], f"Heartbeat expected {OF_HEARTBEAT} fields, got 0"),
        (["Inquire", 1], "Inquire expected 0 fields, got 1"),
        ({"type": "Hello", "protocol": None}, "Expected `int`, got `null` - at `$.protocol`"),
        ({"type": "Hello"}, "Object missing required field `protocol`"),
        ({"type": "Refuse", "reason": "no"}, "Invalid value 'Refuse'"),
    ],
)
def test_what_is_wrong_in_a_head_is_named(content: object, says: str) -> None:
    with pytest.raises(BadMessage) as caught:
        decode_to_learner(head(content))
    assert str(caught.value) == f"head is not a message of millrace: ValidationError: {says}" or says.startswith("Invalid")
    assert says in str(caught.value)


def test_what_is_wrong_in_a_record_within_a_message_is_named() -> None:
    for permit, says in (
        ([1, 2], "Expected `array` of at least length 5, got 2 - at `Collect.permits[1]`"),
        ([1, 2, [], 0, 0], "Expected `int`, got `array` - at `Collect.permits[1][2]`"),
    ):
        with pytest.raises(BadMessage) as caught:
            decode_to_worker(head(head_of(Collect, permits=[[1, 0, 0, 0, 0], permit])))
        assert says in str(caught.value)


def test_hello_and_refuse_are_for_ever_what_they_were() -> None:
    """Two versions of the protocol part politely, whatever else they send."""
    hello = bytes.fromhex(
        "88a474797065a548656c6c6fa870726f746f636f6c02a6776f726b6572a27730a4686f7374a168a370696407ad70726f6365"
        "73735f6e6f6e63654da8736f667477617265a173a7617474656d707401"
    )
    said = example(Hello, protocol=2, host="h", pid=7, process_nonce=77, software="s", continues=False)
    assert decode_to_learner([hello]) == said
    assert msgpack.unpackb(*sent(said)) == msgpack.unpackb(hello) | {"evaluates": False, "continues": False}
    refuse = bytes.fromhex("82a474797065a6526566757365a6726561736f6ea26e6f")
    assert decode_to_worker([refuse]) == Refuse("no")
    assert sent(Refuse("no")) == [refuse]


def test_the_head_of_a_small_rollout_is_small() -> None:
    head, *_ = encode(fake_rollout(2**63, 0, 1, 0, 0))
    assert len(head) < 120


# ------------------------------------------------------------------------------------------------ hostile bytes


def refused(frames: Frames) -> str:
    """Both ends refuse these frames; what they say of them is short."""
    said = ""
    for decoder in (decode_to_learner, decode_to_worker):
        with pytest.raises(BadMessage) as caught:
            decoder(frames)
        said = str(caught.value)
        assert "\n" not in said
        assert len(said) < 500
    return said


def survives(frames: Frames) -> None:
    """Either end takes the frames for a message, or raises `BadMessage`."""
    for decoder in (decode_to_learner, decode_to_worker):
        try:
            message = decoder(frames)
        except BadMessage:
            continue
        for array in arrays_in(message):
            assert not array.flags.writeable
            assert array.dtype.kind in "biuf"


def arrays_in(message: object) -> list[np.ndarray[Any, Any]]:
    found: list[Any] = []
    msgspec.to_builtins(message, enc_hook=found.append)
    return [each for each in found if not isinstance(each, PickledCallable)]


@examples(150)
@given(messages, st.data())
def test_damaged_messages(message: Any, data: st.DataObject) -> None:
    frames = sent(message)
    which = data.draw(st.integers(0, len(frames) - 1))
    frame = frames[which]
    if data.draw(st.booleans()) and frame:
        at, mask = data.draw(st.integers(0, len(frame) - 1)), data.draw(st.integers(1, 255))
        frame = frame[:at] + bytes([frame[at] ^ mask]) + frame[at + 1 :]
    else:
        frame = frame[: data.draw(st.integers(0, len(frame)))] + data.draw(st.binary(max_size=5))
    survives([*frames[:which], frame, *frames[which + 1 :]])


@examples(150)
@given(st.lists(st.binary(max_size=50), max_size=4))
def test_random_bytes(frames: Frames) -> None:
    survives(frames)


Json = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=5) | st.binary(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5) | st.sampled_from(["type"]), inner),
    max_leaves=8,
)


@examples(150)
@given(messages, st.data(), Json)
def test_a_field_of_another_kind(message: Any, data: st.DataObject, nonsense: Any) -> None:
    frames = sent(message)
    content = msgpack.unpackb(frames[0])
    places = sorted(content) if isinstance(content, dict) else range(len(content))
    content[data.draw(st.sampled_from(places))] = nonsense
    survives(head(content, *frames[1:]))


WEIGHTS = Weights(version=1, parameters=np.arange(3, dtype=np.float32), buffers=np.zeros(0, np.float32))


def weights(parameters: object, *frames: bytes) -> Frames:
    """Weights whose parameters are described so, with these array frames."""
    return head(["Weights", 1, parameters, ["<f4", [0], 1]], b"", *frames)


def test_the_hand_made_weights_are_good_ones() -> None:
    back = decode_to_worker(weights(["<f4", [3], 2], bytes(12)))
    assert isinstance(back, Weights)
    assert back.parameters.tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    ("frames", "says"),
    [
        ([], "expected 1 to 256 frames, got 0"),
        ([b""] * (MAX_FRAMES + 1), "expected 1 to 256 frames, got 257"),
        ([b"\xc0" * (MAX_HEAD_BYTES + 1)], "head expected at most 1048576 bytes"),
        ([b"\x91" * 100_000], "head is not a message of millrace"),  # nested a hundred thousand deep
        ([b"\x81\xa1a" * 100_000], "head is not a message of millrace"),
        ([b"\xdd\xff\xff\xff\xff"], "exceeds max_array_len"),  # says it has four thousand million items
        ([b"\xdf\xff\xff\xff\xff"], "exceeds max_map_len"),
        ([b"\xdb\xff\xff\xff\xff"], "head is not a message of millrace"),
        ([b"\xc7\x01\x05x"], "head is not a message of millrace"),  # an extension type
        ([b"\xd6\xff\x00\x00\x00\x00"], "head is not a message of millrace"),  # a timestamp
        (head([1] * 70_000), "head is not a message of millrace"),
        (head(["Nothing"]), "Invalid value 'Nothing' - at `$[0]`"),
        (head(["Nothing - at `$[1]`"]), "Invalid value 'Nothing - at `$[1]`' - at `$[0]`"),
        (head(["x" * 1_000_000]), "Invalid value 'xxx"),
        (head(["Hello\nworker w1 said: all is well"]), r"Invalid value 'Hello\nworker w1 said"),
        (head([["x" * 100]]), "Expected `str`, got"),
        (head([]), "Expected `array` of at least length 1, got 0"),
        (head({"type": "Nothing"}), "Invalid value 'Nothing' - at `$.type`"),
        (head({"type": "x" * 1_000_000}), "Invalid value 'xxx"),
        (head({"type": "Hello\nworker w1 said: all is well"}), r"Invalid value 'Hello\nworker w1 said"),
        (head({"type": ["x" * 100]}), "Expected `str`, got"),
        (head({1: 2}), "head is not a message of millrace"),
        (head({}), "head is not a message of millrace"),
        (head(None), "head is not a message of millrace"),
        ([*sent(WEIGHTS), b"more"], "Weights: expected 2 arrays, got 3 frames"),
        (sent(WEIGHTS)[:-1], "array frame expected 1 to 1, got 2"),
        (weights(["|O", [1], 2], bytes(8)), "array dtype expected a supported one"),
        (weights(["<U3", [1], 2], bytes(12)), "array dtype expected a supported one"),
        (weights([">f4", [3], 2], bytes(12)), "array dtype expected a supported one"),
        (weights(["<f4,<f4", [1], 2], bytes(8)), "array dtype expected a supported one"),
        (weights(["|V8", [1], 2], bytes(8)), "array dtype expected a supported one"),
        (weights(["<c8", [1], 2], bytes(8)), "array dtype expected a supported one"),
        (weights([["<f4"], [3], 2], bytes(12)), "array expected [dtype, shape, index]"),
        (weights(["<f4", [3], 3], bytes(12)), "array frame expected 1 to 2"),
        (weights(["<f4", [3], 0], bytes(12)), "array frame expected 1 to 2"),
        (weights(["<f4", [3], -1], bytes(12)), "array frame expected 1 to 2"),
        (weights(["<f4", [3], True], bytes(12)), "array frame expected 1 to 2"),
        (weights(["<f4", [3], 2.0], bytes(12)), "array expected [dtype, shape, index]"),
        (weights(["<f4", [4], 2], bytes(12)), "expected 16 bytes, got 12"),
        (weights(["<f4", [-3], 2], bytes(12)), "array shape expected"),
        (weights(["<f4", [-1, -3], 2], bytes(12)), "array shape expected"),
        (weights(["<f4", [2**32, 2**32], 2], bytes(0)), "array shape expected"),
        (weights(["<f4", [2**30] * 8, 2], bytes(12)), " bytes, got 12"),
        (weights(["<f4", [True, 3], 2], bytes(12)), "array shape expected"),
        (weights(["<f4", ["3"], 2], bytes(12)), "array shape expected"),
        (weights(["<f4", [1] * 100 + [3], 2], bytes(12)), "array shape expected"),
        (weights(["<f4", 3, 2], bytes(12)), "array expected [dtype, shape, index]"),
        (weights(["<f4", [3]], bytes(12)), "array expected [dtype, shape, index]"),
        (weights(None, bytes(12)), "array expected [dtype, shape, index]"),
        (weights("x" * 100_000, bytes(12)), "array expected [dtype, shape, index]"),
        (weights(bytes(12), bytes(12)), "array expected [dtype, shape, index]"),
    ],
)
def test_hostile_frames_are_refused(frames: Frames, says: str) -> None:
    assert says in refused(frames)


def test_a_list_of_a_worker_is_bounded_before_it_is_built() -> None:
    with pytest.raises(BadMessage, match="exceeds max_array_len"):
        decode_to_learner(head([1] * 70_000))


def test_the_head_may_not_grow_on_the_way_in() -> None:
    """A few bytes that promise much are refused before anything is set aside for them."""
    tracemalloc.start()
    for promise in (b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff", b"\xdb\xff\xff\xff\xff"):
        refused([promise])
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 1_000_000


def test_arrays_are_read_only_views_on_the_frame() -> None:
    frames = encode(WEIGHTS)
    writable = [bytearray(frame) for frame in frames]
    back = decode_to_worker(writable)  # type: ignore[arg-type]
    assert isinstance(back, Weights)
    assert np.shares_memory(back.parameters, np.frombuffer(writable[1], np.uint8))
    with pytest.raises(ValueError, match="read-only"):
        back.parameters[0] = 1


def test_arrays_are_sent_without_a_copy() -> None:
    parameters = np.arange(4, dtype=np.float32)
    _, frame, _ = encode(Weights(version=0, parameters=parameters, buffers=np.zeros(0, np.float32)))
    assert np.shares_memory(np.frombuffer(frame, np.uint8), parameters)


@pytest.mark.parametrize("array", [np.array([None]), np.array(["a"]), np.zeros(1, complex), np.zeros(1, ">f4")], ids=str)
def test_what_cannot_be_sent_is_not_sent(array: Any) -> None:
    with pytest.raises(TypeError, match="Weights cannot carry an array of"):
        encode(Weights(version=0, parameters=array, buffers=array))


def test_a_head_that_the_other_side_would_refuse_is_not_sent() -> None:
    with pytest.raises(ValueError, match="head expected at most"):
        encode(example(Hello, protocol=1, worker="w", host="h", software="x" * MAX_HEAD_BYTES))
