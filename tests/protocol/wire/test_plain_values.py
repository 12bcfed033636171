"""Plain values come back with their types; what is not plain is named; hostile bytes raise one error."""

from __future__ import annotations

import ctypes
import itertools
import math
import tracemalloc
from array import array as buffer
from collections import OrderedDict, UserString, defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from enum import IntEnum
from typing import Any, NamedTuple

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from millrace.protocol.bounds import MAX_LINE, MOST_OTHER_KEYS, MOST_WITH_ONE_HASH
from millrace.protocol.errors import BadMessage
from millrace.protocol.key_limit import KeyLimit
from millrace.protocol.wire import plain_values
from millrace.protocol.wire.plain_values import (
    MAX_DEPTH,
    MAX_DIMENSIONS,
    TOO_SLOW,
    ReprString,
    pack,
    pack_each,
    repr_paths,
    unpack,
)
from tests.support.numbers.bit_equality import bit_equal

scalars = hnp.arrays(
    st.one_of(hnp.scalar_dtypes(), hnp.byte_string_dtypes(), hnp.unicode_string_dtypes()).filter(
        lambda d: d.kind in "biufcSUmM" and d.itemsize <= 16
    ),
    hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3),
)
leaves = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.complex_numbers(), st.text(), st.binary(), scalars,
    scalars.filter(lambda a: a.size > 0).map(lambda a: a.ravel()[0]),
)  # fmt: skip
values = st.recursive(
    leaves,
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.lists(inner, max_size=3).map(tuple),
        st.dictionaries(st.text(max_size=3), inner, max_size=3),
        st.dictionaries(st.integers() | st.text(max_size=3), inner, max_size=3),
    ),
    max_leaves=8,
)


@given(values)
def test_plain_values_come_back_with_their_types(value: Any) -> None:
    assert bit_equal(unpack(pack(value)), value)


def test_arrays_of_objects_come_back() -> None:
    array = np.array([None, "a", 3], dtype=object).reshape(3, 1)
    assert bit_equal(unpack(pack(array)), array)


def packed_dict(keys: Iterable[object]) -> bytes:
    """A dict with these keys, as a program that knows no limit packs it."""
    packed = [*map(pack, keys)]
    length = b"\xdd" + len(packed).to_bytes(4, "big")
    pairs = b"\x92" + length + b"".join(packed) + length + b"\xc0" * len(packed)
    return b"\xc9" + len(pairs).to_bytes(4, "big") + b"\x02" + pairs


@pytest.mark.parametrize("key", [int, complex, lambda n: (n,), lambda n: str(n).encode()])
def test_a_dict_with_too_many_keys_that_are_not_text_is_refused(key: Callable[[int], Any]) -> None:
    """They can be chosen so that each collides with all others: 700,000 numbers, in 3.5 MB, take minutes."""
    few, many = ({key(n): None for n in range(count)} for count in (MOST_OTHER_KEYS, MOST_OTHER_KEYS + 1))
    assert unpack(pack(few)) == few == unpack(packed_dict(few))
    for keys in ([*many], ["a", *many]):
        with pytest.raises(BadMessage, match="more than 10,000 keys that aren't text"):
            unpack(packed_dict(keys))
    with pytest.raises(TypeError, match=r"^a: expected plain data .*, got dict with more than 10,000 keys that aren't text"):
        pack({"a": many})
    assert type(unpack(pack({"a": many}, use_repr=True))["a"]) is ReprString


@pytest.mark.parametrize(
    "key",
    [
        lambda n: (2**61 - 1) * n,
        lambda n: complex(-1_000_003 * n, n),
        lambda n: tuple(-1 - (n >> bit & 1) for bit in reversed(range(211))),
    ],
    ids=["whole numbers", "complex numbers", "long tuples"],
)
def test_a_dict_whose_keys_have_the_same_hash_is_refused(key: Callable[[int], Any]) -> None:
    """Python would compare each in full with all others: 2,000 long tuples, in 436 kB, take a second."""
    few, many = ({key(n): None for n in range(1, count + 1)} for count in (MOST_WITH_ONE_HASH, MOST_WITH_ONE_HASH + 1))
    assert len({hash(each) for each in many}) == 1
    assert unpack(pack(few | {"a": None})) == few | {"a": None}
    for keys in ([*many], ["a", 1, *many]):
        with pytest.raises(BadMessage, match="more than 64 with the same hash"):
            unpack(packed_dict(keys))
    with pytest.raises(TypeError, match=r"^a: expected plain data .*, got dict with .* more than 64 with the same hash"):
        pack({"a": many})
    assert type(unpack(pack({"a": many}, use_repr=True))["a"]) is ReprString


def test_dicts_that_would_together_take_too_long_are_refused() -> None:
    half = dict.fromkeys(range(MOST_OTHER_KEYS // 2))
    few = [half, {"a": half}, (half,) * 2]
    assert unpack(pack(few)) == few
    one = packed_dict(half)
    assert unpack(b"\x94" + one * 4) == [half] * 4
    for packed in (b"\x95" + one * 4 + packed_dict([1]), b"\x92" + one + b"\x94" + one * 4):
        with pytest.raises(BadMessage, match="or too many such dicts"):
            unpack(packed)
    with pytest.raises(TypeError, match=r"^\[3\]: expected plain data .*, got dict with .*, or too many such dicts$"):
        pack([*few, {1: None}])
    assert unpack(pack([*few, {1: None}, {"a": 1}], use_repr=True)) == [*few, f"<dict with {TOO_SLOW}>", {"a": 1}]


def test_each_of_several_values_arrives_as_it_would_alone() -> None:
    full = dict.fromkeys(range(MOST_OTHER_KEYS))
    values = [{"a": full}, full, {"a": full, "b": {1: 2}}]
    for each in values[:2]:
        assert unpack(pack_each([each]), 1) == [each]
    assert unpack(pack_each(values, use_repr=True), 3) == [*values[:2], {"a": full, "b": f"<dict with {TOO_SLOW}>"}]
    with pytest.raises(TypeError, match=r"^\[2\]\.b: expected plain data"):
        pack_each(values)
    with pytest.raises(BadMessage, match="or too many such dicts"):
        unpack(pack_each(values[:2]), 1)


def test_a_dict_may_have_any_number_of_names() -> None:
    many: dict[object, int] = {str(n): n for n in range(MOST_OTHER_KEYS + 1)}
    assert unpack(pack(many)) == many
    assert unpack(pack(many | {1: 2})) == many | {1: 2}


def test_a_large_dict_of_coordinates_comes_back() -> None:
    """Python's hashes of -1 and -2 are the same."""
    grid = dict.fromkeys(itertools.product(range(-5, 5), repeat=4), 0)
    assert unpack(pack(grid)) == grid


class Odd:
    def __repr__(self) -> str:
        return "<odd>"


def test_what_is_not_plain_is_named() -> None:
    with pytest.raises(TypeError, match=r"^level\.inner\[1\]: expected plain data .*, got Odd$"):
        pack({"level": {"inner": [1, Odd()]}})


def test_what_is_not_plain_is_shown_if_asked_so_and_can_be_found() -> None:
    back = unpack(pack({"a": {"b": Odd()}, "c": "<odd>"}, use_repr=True))
    assert back == {"a": {"b": "<odd>"}, "c": "<odd>"}
    assert type(back["a"]["b"]) is ReprString
    assert repr_paths(back, 9) == ["a.b"]


@pytest.mark.parametrize("key", [10**5000, (10**5000,), np.zeros(1, "M8")[0]], ids=["number", "tuple", "date"])
def test_a_key_is_only_shown_in_an_error_and_may_refuse_to_be_shown(key: Any) -> None:
    shown = f"<{type(key).__name__}, whose repr raised ValueError>"
    assert unpack(pack({"a": {key: 1}}, use_repr=True)) == {"a": {shown: 1}}
    with pytest.raises(TypeError, match=rf"^a\.{shown}\[0\]: expected plain data .*, got Odd$"):
        pack({"a": {key: [Odd()]}})
    with pytest.raises(TypeError, match=r"^a key"):
        pack({"a": {key: 1}})


def test_a_path_is_short_and_safe_to_show() -> None:
    odd = ReprString("odd")
    nest: Any = odd
    for _ in range(MAX_DEPTH):
        nest = {"x" * 1_000: nest}
    (long,) = repr_paths(nest, 9)
    assert len(long) <= MAX_LINE
    assert repr_paths({"\x1b[2J\n": [odd, odd], 1: {(2, "b"): odd}}, 2) == [r"\x1b[2J\n", "1.(2, 'b')"]


def test_only_keys_that_lead_to_a_repr_are_shown_and_each_of_them_once() -> None:
    """Otherwise, a long key would be copied for each of many values below it."""

    class Key(int):
        shown = 0

        def __str__(self) -> str:
            Key.shown += 1
            return "key"

    values = {Key(0): {str(n): n for n in range(9)}, Key(1): {str(n): ReprString() for n in range(9)}}
    assert repr_paths({Key(2): values}, 8) == [f"key.key.{n}" for n in range(8)]
    assert Key.shown == 2


class WithoutRepr:
    def __repr__(self) -> str:
        raise OSError("no repr")


class OddRepr:
    def __repr__(self) -> str:
        return "\udc80"


@pytest.mark.parametrize(
    ("value", "got", "shown"),
    [
        ("a\udc80", "text with a lone surrogate", "'a\\udc80'"),
        (10**5000, "an integer with too many digits", "<int, whose repr raised ValueError>"),
        (WithoutRepr(), "WithoutRepr", "<WithoutRepr, whose repr raised OSError>"),
        (OddRepr(), "OddRepr", "\\udc80"),
    ],
    ids=["surrogate", "digits", "no repr", "repr"],
)
def test_what_cannot_be_encoded_is_not_plain(value: object, got: str, shown: str) -> None:
    with pytest.raises(TypeError, match=rf"^a\[0\]: expected plain data .*, got {got}$"):
        pack({"a": [value]})
    assert unpack(pack({"a": [value]}, use_repr=True)) == {"a": [shown]}


def test_a_key_that_cannot_be_encoded_is_not_plain() -> None:
    with pytest.raises(TypeError, match=r"key: expected plain data .*, got text with a lone surrogate$"):
        pack({"a\udc80": 1})
    assert unpack(pack({"a\udc80": 1, "b": 2}, use_repr=True)) == {"'a\\udc80'": 1, "b": 2}


def test_a_subclass_of_dict_arrives_as_a_dict_if_asked_so() -> None:
    counts = defaultdict(int, {"a": 1})
    assert bit_equal(unpack(pack([OrderedDict(b=counts)], use_repr=True)), [{"b": {"a": 1}}])
    with pytest.raises(TypeError, match="got defaultdict"):
        pack({"level": counts})


class Level(IntEnum):
    LOW = 3


class Seconds(float):
    """A number of a type of its own."""


class Pair(NamedTuple):
    left: Any
    right: Any


class Many(list[Any]):
    """A list of a type of its own."""


class Interface:
    """An object with numpy's older protocol."""

    _array = np.array([1, 0], np.int8)
    __array_interface__ = _array.__array_interface__


class Endless:
    """An object with a length, but more items. It counts the items that were read."""

    items = 0

    def __len__(self) -> int:
        return 2

    def __getitem__(self, index: int) -> int:
        self.items += 1
        if self.items == 100:
            raise RuntimeError("numpy would never stop reading it")
        return index

    def __repr__(self) -> str:
        return "<endless>"


class Tensor:
    """An object of another package that numpy can read."""

    def __init__(self, array: Any) -> None:
        self._array = array

    def __array__(self, dtype: Any = None, copy: Any = None) -> Any:
        if isinstance(self._array, Exception):
            raise self._array
        return np.asarray(self._array)

    def __repr__(self) -> str:
        return "<tensor>"


@pytest.mark.parametrize(
    ("value", "arrives"),
    [
        (Level.LOW, np.int64(3)),
        (Seconds(2.5), np.float64(2.5)),
        (np.ma.masked_array([1, 0], [True, False], np.int8), np.array([1, 0], np.int8)),
        (Tensor(np.float32(0.5)), np.float32(0.5)),
        (Tensor(np.eye(2, dtype=bool)), np.eye(2, dtype=bool)),
        (buffer("i", [1, 0]), np.array([1, 0], np.int32)),
        (memoryview(bytearray([1, 0])), np.array([1, 0], np.uint8)),
        ((ctypes.c_int8 * 2)(1, 0), np.array([1, 0], np.int8)),
        (Interface(), np.array([1, 0], np.int8)),
        (deque([1, Tensor(np.zeros(2))]), [1, np.zeros(2)]),
        (deque(["a", deque([[1], [1, 2]])]), ["a", [[1], [1, 2]]]),
        (Pair(Level.LOW, Many([1, Tensor(np.zeros(2))])), (np.int64(3), [1, np.zeros(2)])),
    ],
    ids=[
        "int",
        "float",
        "masked array",
        "scalar tensor",
        "tensor",
        "array.array",
        "memoryview",
        "ctypes",
        "interface",
        "deque",
        "nested deque",
        "sequences",
    ],
)
def test_what_numpy_reads_as_numbers_arrives_as_numbers_if_asked_so(value: Any, arrives: Any) -> None:
    assert bit_equal(unpack(pack({"a": value}, use_repr=True)), {"a": arrives})
    with pytest.raises(TypeError, match=r"^a: expected plain data"):
        pack({"a": value})


@pytest.mark.parametrize("array", [RuntimeError("requires grad"), np.array([None]), np.array(["a"])])
def test_other_objects_that_numpy_reads_are_shown_if_asked_so(array: Any) -> None:
    assert unpack(pack({"a": Tensor(array)}, use_repr=True)) == {"a": "<tensor>"}


@Sequence.register
class EndlessSequence(Endless):
    """A sequence with a length, but more items, such as a ring buffer that counts indices modulo its length."""


def test_an_object_that_may_have_endless_items_is_not_read() -> None:
    value = Endless()
    assert unpack(pack({"a": value}, use_repr=True)) == {"a": "<endless>"}
    assert not value.items


@pytest.mark.parametrize("value", [EndlessSequence(), UserString("abc"), range(10**12)], ids=["ring", "text", "range"])
def test_a_sequence_that_may_never_end_is_shown_and_not_read(value: Any) -> None:
    assert unpack(pack({"a": deque([value])}, use_repr=True)) == {"a": [repr(value)]}
    assert not getattr(value, "items", 0)


def test_keys_that_may_collide_are_counted_before_they_are_hashed() -> None:
    """A dict in which their hashes are counted would take as long as theirs."""

    class Hashed(int):
        def __hash__(self) -> int:
            raise AssertionError("it was hashed")

    limit = KeyLimit()
    assert plain_values._too_slow([Hashed(n) for n in range(MOST_OTHER_KEYS + 1)], limit)


def test_a_long_text_in_a_sequence_takes_no_memory_for_the_other_texts() -> None:
    tracemalloc.start()
    try:
        pack(deque(["x" * 20_000, *["y"] * 1_000]), use_repr=True)
        _, most_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert most_bytes < 2_000_000  # each text at the length of the longest would take 80 MB


def test_keys_that_numpy_reads_as_numbers_are_shown_because_an_array_cannot_be_a_key() -> None:
    keys = {Tensor(np.zeros(2)): 1, (1, Tensor(np.zeros(2))): 2}
    assert unpack(pack(keys, use_repr=True)) == {"<tensor>": 1, "(1, <tensor>)": 2}


def test_what_is_too_deep_is_refused() -> None:
    deep: Any = 1
    for _ in range(MAX_DEPTH + 2):
        deep = (deep,)
    with pytest.raises(TypeError, match="levels"):
        pack(deep)


def in_array(value: object) -> Any:
    array = np.empty(1, object)
    array[0] = value
    return array


NESTS: dict[str, Callable[[Any], Any]] = {
    "list": lambda inner: [inner],
    "tuple": lambda inner: (inner,),
    "dict": lambda inner: {"a": inner},
    "dict with a number as key": lambda inner: {1: inner},
    "array": in_array,
    "deque": lambda inner: deque([inner]),
}


@pytest.mark.parametrize("nest", NESTS.values(), ids=NESTS)
@pytest.mark.parametrize("leaf", [1, "a", 10**30, np.float32(1), 1j], ids=["int", "text", "large int", "scalar", "complex"])
@pytest.mark.parametrize("use_repr", [False, True])
def test_what_can_be_packed_at_any_depth_can_be_read(nest: Callable[[Any], Any], leaf: Any, use_repr: bool) -> None:
    value = leaf
    for depth in range(MAX_DEPTH + 4):
        if nest is NESTS["tuple"]:
            unpack(pack({value: 1}, use_repr=True))
        try:
            packed = pack(value, use_repr)
        except TypeError:
            assert not use_repr
        else:
            back = unpack(packed)
            assert depth >= MAX_DEPTH - 1 or use_repr or bit_equal(back, value)
            assert bool(repr_paths(back, 9)) <= (depth >= MAX_DEPTH - 1)
        value = nest(value)


@pytest.mark.parametrize("kind", [list, dict, deque, in_array])
def test_of_a_container_that_contains_itself_a_line_is_sent_if_asked_so(kind: Callable[[Any], Any]) -> None:
    value = kind({} if kind is dict else [0, 0])
    if kind is in_array:
        value = np.empty(2, object)
    for key in (0, 1):
        value[key] = value
    with pytest.raises(TypeError, match="got deque" if kind is deque else "that contains itself"):
        pack(value)
    back = unpack(pack([value, {"a": value, "b": 1}], use_repr=True))
    line = f"<{type(value).__name__} that contains itself>"
    assert back == [line, {"a": line, "b": 1}]
    assert type(back[0]) is ReprString


class CountedList(list[Any]):
    """Raises if such lists are read very often."""

    reads = 0

    def __iter__(self) -> Iterator[Any]:
        CountedList.reads += 1
        if CountedList.reads > 1_000:
            raise RuntimeError("read 1,000 times")
        return super().__iter__()


def test_a_graph_is_read_a_few_times_even_if_it_has_many_cycles() -> None:
    """Otherwise, each path would be read: with 20 nodes that all contain each other, 20! paths."""
    CountedList.reads = 0
    shared = [1, 2]
    nodes = [{"odd": WithoutRepr(), "near": CountedList(), "shared": shared} for _ in range(20)]
    for node in nodes:
        node["near"] += [each for each in nodes if each is not node]  # type: ignore[operator]
    leads_to_a_node = {"node": nodes[0], "shared": [shared, shared]}
    back = unpack(pack({"graph": nodes, "more": leads_to_a_node}, use_repr=True))
    line = "<dict that contains itself>"
    *others, last = back["graph"]  # the last one contains only lines
    assert (others, last["near"], last["shared"]) == ([line] * 19, [line] * 19, shared)
    assert back["more"] == {"node": line, "shared": [[1, 2], [1, 2]]}


@pytest.mark.parametrize("use_repr", [False, True])
def test_a_value_in_which_lists_occur_in_too_many_places_is_not_plain(
    monkeypatch: pytest.MonkeyPatch, use_repr: bool
) -> None:
    monkeypatch.setattr(plain_values, "MOST_REPEATED", 200)
    value: Any = 1
    for _ in range(10):
        value = [value, value]
    if not use_repr:
        with pytest.raises(TypeError, match=r"^(\[[01]\])+: expected plain data .*, got list after 200 values that .*$"):
            pack(value)
        return
    (a, b), after = unpack(pack((value, 2), use_repr=True))
    assert (type(a), b, after) == (list, "<list after 200 values that were sent before>", 2)


@pytest.mark.parametrize("use_repr", [False, True])
def test_values_that_occur_once_have_no_limit(monkeypatch: pytest.MonkeyPatch, use_repr: bool) -> None:
    monkeypatch.setattr(plain_values, "MOST_REPEATED", 10)
    value = [[n, n] for n in range(100)]
    assert unpack(pack(value, use_repr)) == value


def test_a_dict_that_is_not_sent_takes_no_keys_from_others() -> None:
    many = dict.fromkeys(range(8000), 0)
    deep: Any = many
    for _ in range(MAX_DEPTH - 1):
        deep = [deep]
    back = unpack(pack({"deep": deep, "many": many}, use_repr=True))
    assert back["many"] == many


def test_the_keys_of_a_dict_that_is_refused_are_read_once() -> None:
    class Keys(dict[Any, Any]):
        reads = 0

        def __iter__(self) -> Iterator[Any]:
            self.reads += 1
            return super().__iter__()

    refused = Keys(dict.fromkeys(range(MOST_OTHER_KEYS + 1)))
    back = unpack(pack([refused] * 100, use_repr=True))
    assert back == [back[0]] * 100
    assert back[0].startswith("<Keys with more than")
    assert refused.reads == 1


def test_a_container_below_too_many_levels_is_not_shown() -> None:
    """Its `repr` would show a list wherever it occurs, which may be in 2^32 places."""
    value: Any = WithoutRepr()
    for _ in range(32):
        value = [value, value]
    for _ in range(MAX_DEPTH):
        value = [value]
    back = unpack(pack(value, use_repr=True))
    for _ in range(MAX_DEPTH):
        (back,) = back
    assert back == f"<list below {MAX_DEPTH} levels>"


@given(st.binary(max_size=200))
def test_hostile_bytes_raise_one_error(data: bytes) -> None:
    with suppress(BadMessage):
        unpack(data)


@given(values, st.integers(0, 400), st.integers(0, 255))
def test_spoiled_bytes_raise_one_error(value: Any, at: int, byte: int) -> None:
    data = bytearray(pack(value))
    data[at % len(data)] = byte
    with suppress(BadMessage):
        unpack(bytes(data))


def extension(code: int, payload: object) -> msgpack.ExtType:
    return msgpack.ExtType(code, msgpack.packb(payload))


def in_two_places(value: object, code: int) -> bytes:
    """Three levels, each of which a careless reader would put into several places: 10 times an item, once a text key."""
    for _ in range(3):
        many = {str(n): None for n in range(9)} | {"inside": value}
        value = extension(code, [[10], many] if code == OBJECTS else many)
    packed: bytes = msgpack.packb(value)
    return packed


TUPLE, PAIRS, ARRAY, SCALAR, OBJECTS, COMPLEX = 1, 2, 3, 4, 5, 7


@pytest.mark.parametrize(
    "packed",
    [
        in_two_places(None, OBJECTS),
        in_two_places(None, TUPLE),
        *(
            msgpack.packb(extension(code, payload))
            for code, payload in [
                (OBJECTS, [[3], "abc"]),
                (OBJECTS, [[3], b"abc"]),
                (OBJECTS, [[1], extension(TUPLE, [1])]),
                (TUPLE, "abc"),
                (TUPLE, b"abc"),
                (PAIRS, ["abc", [1, 2, 3]]),
                (PAIRS, [[1, 2, 3], "abc"]),
                (PAIRS, [{1: None}, {2: None}]),
                (PAIRS, {"a": 1, "b": 2}),
                (COMPLEX, "12"),
                (COMPLEX, ["1", 2.0]),
                (COMPLEX, [extension(COMPLEX, [1.0, 2.0]), 1.0]),
                (SCALAR, ["<i8", [0] * 8]),
                (SCALAR, ["<i8", bytes(16)]),
                (ARRAY, ["<i8", [1], [0] * 8]),
                (ARRAY, [["<i8"], [1], bytes(8)]),
            ]
        ),
    ],
)
def test_the_parts_of_an_extension_have_the_types_that_a_packer_gives_them(packed: bytes) -> None:
    """A dict in the place of a list would be every element of an array, and each level of such arrays would multiply the
    paths that a reader visits.
    """
    with pytest.raises(BadMessage):
        unpack(packed)


@pytest.mark.parametrize("items", [[[1], [2]], [[1, 2], [3, 4]], [[5]], [(1, 2)], [np.eye(2), {"a": 1}], [np.float32(1)]])
def test_an_array_of_objects_may_contain_lists_and_arrays(items: list[Any]) -> None:
    array = np.empty(len(items), object)
    for n, item in enumerate(items):
        array[n] = item
    assert bit_equal(unpack(pack(array)).tolist(), items)


def packed_array(dtype: str, shape: list[int], raw: bytes) -> bytes:
    packed: bytes = msgpack.packb(msgpack.ExtType(3, msgpack.packb([dtype, shape, raw])))
    return packed


@pytest.mark.parametrize("dtype", ["S0", "U0"])
def test_an_array_cannot_be_larger_than_its_bytes(dtype: str) -> None:
    with pytest.raises(BadMessage, match="expected elements of a byte or more"):
        unpack(packed_array(dtype, [10**12], b""))


@pytest.mark.parametrize("code", [ARRAY, OBJECTS])
@pytest.mark.parametrize(
    "shape",
    [
        [10**6, "x"],  # its product is a text of a million characters
        [10**6, b"x"],
        [3, [0]],
        [1] * (MAX_DIMENSIONS + 1),
        [2**63, 0],
        [-1],
        [-1, -1],
        [1.0],
        [True],
        [None],
    ],
)
def test_a_shape_has_few_and_small_dimensions(code: int, shape: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Python would multiply text, and whole numbers of any length."""
    monkeypatch.setattr(math, "prod", None)  # so that a call fails
    packed = msgpack.packb(extension(code, ["|i1", shape, b"\0"] if code == ARRAY else [shape, [None]]))
    with pytest.raises(BadMessage, match="shape: expected at most 64 whole numbers"):
        unpack(packed)


def test_a_shape_that_does_not_fit_the_content_is_refused() -> None:
    for packed in (packed_array("|i1", [3], b"\0"), msgpack.packb(extension(OBJECTS, [[3], [None]]))):
        with pytest.raises(BadMessage, match=r"of shape \[3\]: got 1 "):
            unpack(packed)


@pytest.mark.parametrize("inside", [b"\x91", b"\x81\xa1a"], ids=["lists", "dicts"])
def test_what_arrives_can_be_walked_recursively(inside: bytes) -> None:
    assert not repr_paths(unpack(inside * MAX_DEPTH + b"\xc0"), 9)
    with pytest.raises(BadMessage, match=f"at most {MAX_DEPTH} levels"):
        unpack(inside * (MAX_DEPTH + 1) + b"\xc0")


@pytest.mark.parametrize("order", "<>")
def test_text_has_only_characters_that_there_are(order: str) -> None:
    for last, fine in ((0x10FFFF, True), (0x110000, False)):
        raw = np.array([last], f"{order}u4").tobytes()
        if fine:
            assert unpack(packed_array(f"{order}U1", [1], raw)).tolist() == [chr(last)]
        else:
            with pytest.raises(BadMessage, match="expected characters"):
                unpack(packed_array(f"{order}U1", [1], raw))


def test_a_date_without_a_unit_is_refused_because_numpy_cannot_show_it() -> None:
    """`str` and `repr` of such a date raise, even in code that only warns of an info, or merges infos."""
    kind, date, none = "<M8", bytes(8), np.array(["NaT"], "<M8").tobytes()
    for packed in (
        packed_array(kind, [2], none + date),
        packed_array(">M8", [1], none),  # numpy takes it for NaT, but doesn't change the byte order of its elements
        msgpack.packb(extension(SCALAR, [kind, date])),
        msgpack.packb(extension(PAIRS, [[extension(SCALAR, [kind, date])], [msgpack.ExtType(8, b"x")]])),
    ):
        with pytest.raises(BadMessage, match="a date without a unit"):
            unpack(packed)
    assert str(unpack(packed_array(kind, [1], none))) == "['NaT']"
    assert str(unpack(msgpack.packb(extension(SCALAR, [kind, none])))) == "NaT"


def test_a_date_without_a_unit_is_not_plain() -> None:
    dates = np.zeros(2, "M8")
    for value in (dates, dates[0]):
        with pytest.raises(TypeError, match=rf"^a: expected plain data .*, got {type(value).__name__}$"):
            pack({"a": value})
        shown = f"<{type(value).__name__}, whose repr raised ValueError>"
        assert unpack(pack({"a": value}, use_repr=True)) == {"a": shown}


@pytest.mark.parametrize("kind", ["S", "U"])
def test_an_array_of_nothing_but_empty_text_arrives_with_a_character_for_each(kind: str) -> None:
    """`np.strings.partition` returns such arrays. A reader refuses them, because they could have any number of elements."""
    array = np.zeros(3, f"{kind}4,{kind}0")["f1"]
    assert array.dtype.itemsize == 0
    back = unpack(pack([array, array.reshape(1, 3)[:, :2], array[0]]))
    assert bit_equal(back, [np.zeros(3, f"{kind}1"), np.zeros((1, 2), f"{kind}1"), array[0]])
