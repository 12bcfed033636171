"""Spaces as records: equal spaces come back, from the wire too; a record that describes no space is refused."""

from __future__ import annotations

import random
from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest
from gymnasium import spaces

from millrace.protocol.bounds import MAX_NAME
from millrace.protocol.envs.description import DescribedEnv, describe_env, read_description
from millrace.protocol.envs.space_records import describe_space, make_space
from millrace.protocol.errors import BadMessage, UsageError
from millrace.protocol.messages import Described
from millrace.protocol.space_spec import (
    MAX_ELEMENTS,
    MAX_LEAVES,
    MAX_SEATS,
    BoxSpace,
    DictSpace,
    DiscreteSpace,
    EnvDescription,
    MultiBinarySpace,
    MultiDiscreteSpace,
    SpaceSpec,
    TupleSpace,
    check_size,
)
from millrace.protocol.wire.codec import decode_to_learner, encode
from millrace.protocol.wire.plain_values import pack
from tests.support.envs.toy import ACTIONS, OBSERVATIONS, UNSUPPORTED_OBSERVATIONS
from tests.support.in_process.described import with_spaces
from tests.support.numbers.bit_equality import bit_equal

FLOATS, WHOLE = ("float16", "float32", "float64"), ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64")


def random_space(draw: random.Random, depth: int = 0) -> gymnasium.Space[Any]:
    numbers = np.random.default_rng(draw.getrandbits(64))
    shape = tuple(draw.choices(range(4), k=draw.randrange(4)))
    kinds = ["box", "ints", "bools", "discrete", "multi", "binary", *(["dict", "tuple"] if depth < 3 else [])]
    match draw.choice(kinds):
        case "box":
            dtype = np.dtype(draw.choice(FLOATS))
            low, high = (numbers.normal(size=shape).astype(dtype) for _ in range(2))
            low, high = np.minimum(low, high), np.maximum(low, high)
            if draw.random() < 0.3:
                low, high = np.full(shape, -np.inf, dtype), np.full(shape, 0.1, dtype)
            return spaces.Box(low, high, shape, dtype)
        case "ints":
            dtype = np.dtype(draw.choice(WHOLE))
            low = numbers.integers(0, 100, shape).astype(dtype)
            return spaces.Box(low, (low + numbers.integers(0, 27, shape).astype(dtype)).astype(dtype), shape, dtype)
        case "bools":
            return spaces.Box(0, 1, shape, np.bool_)
        case "discrete":
            return spaces.Discrete(draw.randrange(1, 10**6), start=draw.randrange(-1000, 1000))
        case "multi":
            shape = (2, *shape)[: draw.randrange(1, 3)]
            start = numbers.integers(-9, 9, shape)
            return spaces.MultiDiscrete(numbers.integers(1, 9, shape), draw.choice((np.int64, np.int32)), start=start)
        case "binary":
            return spaces.MultiBinary(draw.choice((3, [2, 3], [1, 4, 2])))
        case "dict":
            names = draw.sample(["b", "a", "c/d", "é", ""], draw.randrange(5))
            return spaces.Dict([(name, random_space(draw, depth + 1)) for name in names])
        case _:
            return spaces.Tuple([random_space(draw, depth + 1) for _ in range(draw.randrange(4))])


def described(observation: SpaceSpec) -> EnvDescription:
    return EnvDescription(observation, DiscreteSpace(2, 0, "int64"), np.frombuffer(pack({}), np.uint8), "", 0, "")


def over_the_wire(spec: SpaceSpec) -> SpaceSpec:
    frames = [bytes(frame) for frame in encode(Described(1, 1, described(spec)))]
    message = decode_to_learner(frames)
    assert isinstance(message, Described)
    return message.description.observation


def facts(space: Any) -> object:
    """All that must be equal, bit for bit and in this order: gymnasium's == compares bounds with a tolerance."""
    match space:
        case spaces.Dict():
            return [(key, facts(inner)) for key, inner in space.spaces.items()]
        case spaces.Tuple():
            return [facts(inner) for inner in space.spaces]
        case spaces.Box():
            return space.shape, space.dtype, space.low.tobytes(), space.high.tobytes()
        case spaces.Discrete():
            return int(space.n), int(space.start), space.dtype
        case spaces.MultiDiscrete():
            return space.shape, space.dtype, space.nvec.tobytes(), space.start.tobytes()
        case _:
            return space.shape, space.dtype


def test_every_space_comes_back_equal() -> None:
    draw = random.Random(1)
    for _ in range(300):
        space = random_space(draw)
        back = make_space(over_the_wire(describe_space(space)))
        assert back == space
        assert facts(back) == facts(space)


@pytest.mark.parametrize("space", [*OBSERVATIONS.values(), *ACTIONS.values()], ids=str)
def test_the_toy_s_spaces_come_back_or_are_refused_in_one_line(space: gymnasium.Space[Any]) -> None:
    if space in [OBSERVATIONS[name] for name in UNSUPPORTED_OBSERVATIONS]:
        with pytest.raises(UsageError, match=r"observation space .* is not supported"):
            describe_space(space, "observation space")
    else:
        assert facts(make_space(describe_space(space))) == facts(space)


def test_equal_bounds_travel_as_one_number() -> None:
    big = describe_space(spaces.Box(0, 255, (210, 160, 3), np.uint8))
    assert isinstance(big, BoxSpace)
    assert big.low.shape == big.high.shape == ()
    mixed = describe_space(spaces.Box(np.array([0.0, -0.0]), np.ones(2), dtype=np.float64))
    assert isinstance(mixed, BoxSpace)
    assert mixed.low.shape == (2,)  # -0.0 and 0.0 are different bits


@pytest.mark.parametrize(
    ("space", "says"),
    [
        (spaces.Text(5), "space Text"),
        (spaces.Dict({"text": spaces.Text(5)}), "Text"),
        (spaces.Dict({3: spaces.Discrete(2)}), "keys of a Dict that are text"),  # type: ignore[dict-item]
        (spaces.Dict({"a\nb": spaces.Discrete(2)}), "keys of a Dict that are text"),
        (spaces.Tuple([spaces.Discrete(2)] * (MAX_LEAVES + 1)), f"at most {MAX_LEAVES} arrays"),
        (spaces.Discrete(2**60), "is not supported"),
    ],
    ids=str,
)
def test_a_space_that_cannot_travel_is_named(space: gymnasium.Space[Any], says: str) -> None:
    with pytest.raises(UsageError, match=says) as caught:
        describe_space(space)
    assert "\n" not in str(caught.value)


def test_a_deep_space_is_refused() -> None:
    space: gymnasium.Space[Any] = spaces.Discrete(2)
    for _ in range(9):
        space = spaces.Tuple([space])
    with pytest.raises(UsageError, match="8 levels"):
        describe_space(space)


ONE, TWO = np.ones((), np.float32), np.ones(2, np.float32)


@pytest.mark.parametrize(
    "spec",
    [
        BoxSpace((3,), "float32", TWO, TWO),
        BoxSpace((2,), "float64", TWO, TWO),
        BoxSpace((2,), "float32", TWO, -TWO),
        BoxSpace((2,), "float32", TWO * np.float32(np.nan), TWO),
        BoxSpace((2,), "float32", ONE, ONE * np.float32(np.nan)),
        BoxSpace((2,), "float32", TWO[:, None], TWO),
        DiscreteSpace(300, 0, "int8"),
        DiscreteSpace(2, 127, "int8"),
        DiscreteSpace(2, -1, "uint8"),
        DiscreteSpace(2, 0, "float32"),
        DiscreteSpace(2, 0, "bool"),
        MultiDiscreteSpace("int64", np.array([2.0]), np.array([0])),
        MultiDiscreteSpace("int64", np.array([2, 2]), np.array([0])),
        MultiDiscreteSpace("int64", np.array([2, 0]), np.array([0, 0])),
        MultiDiscreteSpace("int64", np.array([2, 2**62]), np.array([0, 2**62])),
        MultiDiscreteSpace("int8", np.array([2, 200]), np.array([0, 0])),
        MultiDiscreteSpace("float64", np.array([2, 2]), np.array([0, 0])),
        MultiBinarySpace((0, -1)),
        DictSpace(("a",), ()),
        DictSpace(("a", "a"), (DiscreteSpace(2, 0, "int64"),) * 2),
        DictSpace((), (DiscreteSpace(2, 0, "int64"),)),
        TupleSpace((BoxSpace((2,), "float32", TWO, -TWO),)),
    ],
    ids=lambda spec: str(spec)[:60],
)
def test_a_record_that_describes_no_space_is_a_bad_message(spec: SpaceSpec) -> None:
    with pytest.raises(BadMessage) as caught:
        make_space(spec)
    assert "\n" not in str(caught.value)


def test_sizes_are_refused_at_decoding_before_anything_is_allocated() -> None:
    huge = BoxSpace((MAX_ELEMENTS + 1,), "float64", np.zeros(()), np.ones(()))
    with pytest.raises(BadMessage, match="elements"):
        over_the_wire(huge)
    with pytest.raises(BadMessage, match="elements"):
        check_size(described(TupleSpace((BoxSpace((MAX_ELEMENTS,), "float64", np.zeros(()), np.ones(())),) * 2)))


# -------------------------------------------------------------------------------------------------- the whole environment


def test_an_environment_is_read_as_it_was_described() -> None:
    env = gymnasium.make("CartPole-v1", render_mode="rgb_array")
    modes = {"render_modes": ["human", "rgb_array"], "render_fps": 50}
    env.unwrapped.metadata = {**modes, "odd": object(), "text": "é", "nested": {"fps": (1, 2)}}
    found = read_description(describe_env(env))
    assert (found.observation_space, found.action_space) == (env.observation_space, env.action_space)
    assert found.metadata == {name: value for name, value in env.metadata.items() if name != "odd"}
    assert found.spec == env.spec
    assert (found.max_episode_steps, found.render_mode) == (500, "rgb_array")
    assert {f"gymnasium.wrappers.common:{name}" for name in ("TimeLimit", "OrderEnforcing")} < found.wrappers
    env.close()


def over_the_wire_and_read(env: gymnasium.Env[Any, Any]) -> DescribedEnv:
    message = decode_to_learner([bytes(frame) for frame in encode(Described(1, 1, describe_env(env)))])
    assert isinstance(message, Described)
    return read_description(message.description)


def test_a_seeded_space_goes_on_with_its_own_samples() -> None:
    draw = random.Random(2)
    for seed in range(100):
        env = with_spaces(random_space(draw), random_space(draw))
        env.observation_space.seed(seed)
        if seed % 2:
            env.action_space.seed(seed)
            env.action_space.sample()  # which may leave half of a drawn number behind
        found = over_the_wire_and_read(env)
        assert bit_equal(found.observation_space.sample(), env.observation_space.sample())
        if seed % 2:
            assert bit_equal([found.action_space.sample() for _ in range(3)], [env.action_space.sample() for _ in range(3)])


def test_a_space_that_nobody_seeded_stays_so() -> None:
    env = with_spaces(spaces.Dict({"a": spaces.Discrete(9), "b": spaces.Discrete(9, seed=3)}), spaces.Discrete(9))
    found = over_the_wire_and_read(env)
    for space in (env, found):
        assert isinstance(space.observation_space, spaces.Dict)
        assert [inner._np_random is None for inner in space.observation_space.spaces.values()] == [True, False]
        assert [outer._np_random is None for outer in (space.observation_space, space.action_space)] == [True, True]
    assert describe_env(gymnasium.make("CartPole-v1")).generators == ()


STATE = "0" * 64 + "0" + "0" * 8


@pytest.mark.parametrize(
    "states",
    [
        (STATE,),
        (STATE, STATE, STATE),
        ("0" * 73 + "0", ""),
        (STATE[:-1] + "g", ""),
        (STATE.replace("0", "2"), ""),
        ("", STATE + "\n"),
    ],
)
def test_generators_that_no_space_has_are_a_bad_message(states: tuple[str, ...]) -> None:
    description = msgspec.structs.replace(described(DiscreteSpace(2, 0, "int64")), generators=states)
    with pytest.raises(BadMessage):
        message = decode_to_learner([bytes(frame) for frame in encode(Described(1, 1, description))])
        assert isinstance(message, Described)
        read_description(message.description)


def test_an_environment_without_a_spec_is_described_too() -> None:
    env = gymnasium.make("CartPole-v1").unwrapped
    env.spec = None
    found = read_description(describe_env(env))
    assert (found.spec, found.max_episode_steps, found.render_mode) == (None, None, None)


def test_an_entry_point_that_json_cannot_hold_leaves_the_spec_out() -> None:
    class Mine(gymnasium.Env[Any, Any]):
        observation_space, action_space = spaces.Discrete(2), spaces.Discrete(2)

    env = Mine()
    env.spec = gymnasium.envs.registration.EnvSpec("Mine-v0", entry_point=lambda **_: Mine(), max_episode_steps=7)
    found = read_description(describe_env(env))
    assert (found.spec, found.max_episode_steps) == (None, 7)


@pytest.mark.parametrize(
    "seats", [("a",) * (MAX_SEATS + 1), ("a" * (MAX_NAME + 1),), ("a\n",), ("\x1b[31m",), (1,), "ab", None]
)
def test_a_description_with_names_of_seats_that_are_none_is_not_decoded(seats: Any) -> None:
    description = msgspec.structs.replace(described(DiscreteSpace(2, 0, "int64")), seats=seats)
    with pytest.raises(BadMessage, match=r"description\[8\]"):
        decode_to_learner([bytes(frame) for frame in encode(Described(1, 1, description))])


@pytest.mark.parametrize(
    "changes",
    [
        {"metadata": np.frombuffer(b"\xc1", np.uint8)},
        {"metadata": np.frombuffer(pack([1]), np.uint8)},
        {"metadata": np.frombuffer(pack({1: 2}), np.uint8)},
        {"metadata": np.zeros(1 << 20, np.uint8)},
        {"metadata": np.zeros(8)},
        {"spec": "["},
        {"spec": "[" * 60_000},
        {"spec": "3"},
        {"spec": '{"id": 3, "additional_wrappers": []}'},
        {"seats": ("a", "b", "a")},
        {"takes_turns": True},
    ],
    ids=str,
)
def test_a_description_that_cannot_be_read_is_a_bad_message(changes: dict[str, Any]) -> None:
    with pytest.raises(BadMessage):
        read_description(msgspec.structs.replace(described(DiscreteSpace(2, 0, "int64")), **changes))


def test_a_description_of_as_many_arrays_as_may_be_fits_into_a_message() -> None:
    own = spaces.Box(np.array([0.0, 1.0]), np.array([2.0, 3.0]), dtype=np.float64)
    space = describe_space(spaces.Tuple([own] * MAX_LEAVES))
    both = msgspec.structs.replace(described(space), action=space)
    message = decode_to_learner([bytes(frame) for frame in encode(Described(1, 1, both))])
    assert isinstance(message, Described)
    assert facts(make_space(message.description.action)) == facts(make_space(space))
