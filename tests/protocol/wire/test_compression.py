"""Packed arrays: they come back bit for bit and travel as few bytes; whatever else is said in their form is refused."""

from __future__ import annotations

import sys
import tracemalloc
from contextlib import suppress
from typing import Any

import gymnasium
import msgspec
import numpy as np
import numpy.typing as npt
import pytest
import zstandard
from gymnasium import spaces
from gymnasium.wrappers import FrameStackObservation
from hypothesis import given
from hypothesis import strategies as st

from millrace.protocol.arrays import Bytes
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.errors import BadMessage
from millrace.protocol.rollout import Rollout, rollout_bytes
from millrace.protocol.specs import ActionSpec, ExtraArray, Leaf, PolicySpec, RunSpec
from millrace.protocol.wire.codec import decode_to_learner, decode_to_worker, encode
from millrace.protocol.wire.compression import Packing, has_zstd, pack_stack, unpack_array, unpack_stack
from millrace.protocol.wire.message_sizes import MAX_FRAME_BYTES
from tests.support.conversation.example_messages import example
from tests.support.examples import examples
from tests.support.in_process.collectors import collect, loop_over, random_collector, run_around, run_of

U1 = np.dtype(np.uint8)


def frame_stacks(steps: int, copies: int, k: int, frame: tuple[int, ...], resets: float = 0.0, seed: int = 0) -> Bytes:
    """Stacks [steps, copies, k, *frame] of noise; so many of the steps show frames of their own."""
    rng = np.random.default_rng(seed)
    obs = rng.integers(0, 256, (steps, copies, k, *frame), dtype=np.uint8)
    for t in range(1, steps):
        for n in range(copies):
            if rng.random() >= resets:
                obs[t, n, :-1] = obs[t - 1, n, 1:]
    return obs


@examples(100)
@given(
    st.integers(1, 40),
    st.integers(1, 5),
    st.integers(2, 16),
    st.sampled_from([(8, 8), (9, 9), (5, 14), (6, 17), (4, 4, 4), (3, 7, 9)]),
    st.sampled_from([0.0, 0.05, 0.3, 1.0]),
    st.integers(0, 99),
)
def test_a_frame_stack_comes_back_as_it_went(
    steps: int, copies: int, k: int, frame: tuple[int, ...], resets: float, seed: int
) -> None:
    obs = frame_stacks(steps, copies, k, frame, resets, seed)
    payload = pack_stack(obs)
    if payload is None:
        assert resets > 0 or k > 2 * steps or steps < 4
        return
    assert payload.size <= 0.76 * obs.size
    back = unpack_stack(payload.data, obs.dtype, obs.shape)
    assert back.shape == obs.shape
    assert back.dtype == obs.dtype
    assert back.tobytes() == obs.tobytes()
    assert not back.flags.writeable


def test_every_frame_is_sent_once() -> None:
    obs = frame_stacks(129, 4, 4, (12, 11))
    obs[70:, 2] = frame_stacks(59, 1, 4, (12, 11), seed=1)[:, 0]  # an episode begins
    payload = pack_stack(obs)
    assert payload is not None
    assert payload.size == 128 * 4 // 8 + (129 * 4 + 3 * 4 + 3) * 12 * 11
    moved = np.unpackbits(payload[:64], bitorder="little").reshape(4, 128)
    assert np.argwhere(moved == 0).tolist() == [[2, 69]]
    frames = payload[64:].reshape(-1, 12, 11)
    assert (frames[:4] == obs[0, 0]).all()
    assert (frames[4:132] == obs[1:, 0, -1]).all()
    assert (frames[132:136] == obs[0, 1]).all()


@pytest.mark.parametrize(
    "array",
    [
        np.random.default_rng(0).integers(0, 256, (65, 4, 4, 8, 8), dtype=np.uint8),
        np.random.default_rng(0).integers(0, 256, (65, 4, 16, 16, 3), dtype=np.uint8),
        np.zeros((65, 4, 4, 8, 8), np.int8),
        np.zeros((65, 4, 4, 8, 8), np.float32),
        np.zeros((65, 4, 1, 8, 8), np.uint8),
        np.zeros((65, 4, 17, 8, 8), np.uint8),
        np.zeros((65, 4, 4, 64), np.uint8),
        np.zeros((65, 4, 4, 7, 9), np.uint8),
        np.zeros((1, 4, 4, 8, 8), np.uint8),
        np.zeros((65, 0, 4, 8, 8), np.uint8),
        np.zeros((65, 4, 4, 8, 0), np.uint8),
        frame_stacks(65, 4, 4, (8, 8), resets=0.9),
    ],
    ids=["noise", "picture", "int8", "float32", "k=1", "k=17", "no image", "tiny", "a step", "nobody", "empty", "resets"],
)
def test_what_is_no_stack_goes_as_it_lies(array: npt.NDArray[Any]) -> None:
    assert pack_stack(array) is None
    frame, names = Packing(stack=True).pack(array)
    assert (bytes(frame), names) == (array.tobytes(), [])


def test_an_array_that_does_not_lie_in_order_is_packed_as_well() -> None:
    obs = frame_stacks(9, 3, 4, (8, 8)).swapaxes(0, 1).copy().swapaxes(0, 1)
    payload = pack_stack(obs)
    assert payload is not None
    assert (unpack_stack(payload.tobytes(), U1, obs.shape) == obs).all()


class Dice(gymnasium.Env[Bytes, Any]):
    """Noise; an episode takes seven steps."""

    observation_space = spaces.Box(0, 255, (9, 9), np.uint8)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Bytes, dict[str, Any]]:
        super().reset(seed=seed)
        self._at = 0
        return self._noise(), {}

    def step(self, action: Any) -> tuple[Bytes, float, bool, bool, dict[str, Any]]:
        self._at += 1
        return self._noise(), 0.0, self._at == 7, False, {}

    def _noise(self) -> Bytes:
        return self.np_random.integers(0, 256, (9, 9), np.uint8)


@pytest.mark.parametrize("padding", ["reset", "zero"])
def test_what_a_worker_collects_of_gymnasiums_frame_stacks_is_packed(padding: str) -> None:
    def make() -> gymnasium.Env[Any, Any]:
        return FrameStackObservation(Dice(), 4, padding_type=padding)

    run = msgspec.structs.replace(run_around(make(), 40), copies=3)
    (rollout,) = collect(random_collector(run, loop_over([make] * 3)), run)
    (obs,) = rollout.obs
    payload = pack_stack(obs)
    assert payload is not None
    moved = np.unpackbits(payload[:15], bitorder="little").reshape(3, 40).T.astype(bool)
    assert (moved == rollout.valid).all()  # the row that resets, and no other, shows frames of its own
    assert (unpack_stack(payload.data, U1, obs.shape) == obs).all()


# ------------------------------------------------------------------------------------------------ in messages

STACKS = RunSpec(
    EnvSpec("Stacks-v0"),
    PolicySpec((Leaf("", "box", (4, 8, 8), "uint8", divisor=255),), ActionSpec("discrete", (), "int64", (2,), (0,))),
    rollout_steps=16,
    copies=2,
    lanes=1,
    seed=1,
)
ROOM = rollout_bytes(STACKS)
OBS = 1 + Rollout.__struct_fields__.index("obs")
"""its place in the head"""


def a_rollout(obs: tuple[npt.NDArray[Any], ...] = (frame_stacks(17, 2, 4, (8, 8)),)) -> Rollout:
    floats, flags = np.zeros((16, 2), np.float32), np.zeros((16, 2), bool)
    return example(
        Rollout,
        session=7,
        ticket=1,
        obs=obs,
        action=np.zeros((16, 2), np.int64),
        log_prob=floats,
        reward=floats,
        terminated=flags,
        truncated=flags,
        valid=flags,
        state=np.zeros((2, 0), np.float32),
        memory=(np.zeros((2, 2)),),
    )


def sent(rollout: Rollout) -> list[bytes]:
    return [bytes(frame) for frame in encode(rollout, Packing(stack=True))]


def test_the_room_of_a_run_is_what_its_rollouts_come_to() -> None:
    for run in (run_of("CartPole-v1", core="lstm", core_size=9), run_of("Pendulum-v1", T=3, N=5)):
        (rollout,) = collect(random_collector(run), run)
        assert rollout_bytes(run) == sum(map(len, encode(rollout)[1:]))
    assert sum(map(len, encode(a_rollout())[1:])) == ROOM
    (choices,) = STACKS.policy.action.sizes
    whole = msgspec.structs.replace(a_rollout(), mask=np.ones((17, 2, choices), bool), extras=(np.zeros((16, 2, 3)),))
    run = msgspec.structs.replace(STACKS, masked=True, extras=(ExtraArray("wind", (3,), "float64"),))
    assert rollout_bytes(run) == sum(map(len, encode(whole)[1:]))


def test_a_packed_rollout_comes_back_as_it_went() -> None:
    rollout = a_rollout()
    frames = sent(rollout)
    assert len(frames[1]) == 4 + (17 * 2 + 3 * 2) * 64
    back = decode_to_learner(frames, ROOM)
    assert isinstance(back, Rollout)
    assert encode(back) == encode(rollout)
    assert not back.obs[0].flags.writeable


def test_who_gives_no_room_takes_no_packed_array() -> None:
    frames = sent(a_rollout())
    with pytest.raises(BadMessage, match="packed arrays expected at most 0 bytes together, got 8704"):
        decode_to_learner(frames)
    with pytest.raises(BadMessage):
        decode_to_worker(frames)
    empty = [bytes(frame) for frame in encode(a_rollout((np.zeros(0, np.uint8),)))]
    head = msgspec.msgpack.decode(empty[0])
    head[OBS][0].append(["zstd"])
    with pytest.raises(BadMessage, match="packed arrays expected at most 0 bytes together, got 0"):
        decode_to_learner([msgspec.msgpack.encode(head), *empty[1:]])
    assert decode_to_learner(frames, 8704)
    with pytest.raises(BadMessage, match="packed arrays expected at most 8703 bytes together, got 8704"):
        decode_to_learner(frames, 8703)


def test_packed_arrays_share_the_room() -> None:
    obs = a_rollout().obs
    frames = sent(a_rollout(obs * 2))
    assert decode_to_learner(frames, 2 * 8704)
    with pytest.raises(BadMessage, match="packed arrays expected at most 17407 bytes together, got 17408"):
        decode_to_learner(frames, 2 * 8704 - 1)


def test_a_packed_array_is_no_larger_than_a_frame_may_be() -> None:
    frames = sent(a_rollout())
    head = msgspec.msgpack.decode(frames[0])
    head[OBS][0][1] = [2**16, 2**4, 16, 8, 9]
    with pytest.raises(BadMessage, match=f"packed array expected at most {MAX_FRAME_BYTES} bytes, got {2**27 * 9}"):
        decode_to_learner([msgspec.msgpack.encode(head), *frames[1:]], 2**40)


def test_a_frame_is_not_unpacked_twice() -> None:
    """Else a head of a megabyte could have one frame unpacked thirty thousand times."""
    frames = sent(a_rollout())
    head = msgspec.msgpack.decode(frames[0])
    head[OBS] *= 2
    with pytest.raises(BadMessage, match="array frame 1 expected one array, got two"):
        decode_to_learner([msgspec.msgpack.encode(head), *frames[1:]], 10 * ROOM)


def payload_of(bits: int = 0xFFFF_FFFF, frames: int = 40) -> bytes:
    """Of a stack [17, 2, 4, 8, 8]: 32 bits, then frames, 40 of them if every bit is set."""
    return bits.to_bytes(4, "little") + bytes(64 * frames)


SHAPE = [17, 2, 4, 8, 8]


def test_the_hand_made_stack_is_a_good_one() -> None:
    assert unpack_array(payload_of(), ["stack"], U1, SHAPE).shape == (17, 2, 4, 8, 8)
    assert unpack_array(payload_of(0xFFFF_FFFE, 43), ["stack"], U1, SHAPE).shape == (17, 2, 4, 8, 8)


@pytest.mark.parametrize(
    ("payload", "packings", "dtype", "shape", "says"),
    [
        (b"", ["stack"], U1, SHAPE, "expected at least 2564 bytes, got 0"),
        (payload_of()[:-1], ["stack"], U1, SHAPE, "expected at least 2564 bytes, got 2563"),
        (payload_of() + b"\0", ["stack"], U1, SHAPE, "expected 2564 bytes, according to its bits, got 2565"),
        (payload_of(0xFFFF_FFFE), ["stack"], U1, SHAPE, "expected 2756 bytes, according to its bits, got 2564"),
        (payload_of(frames=43), ["stack"], U1, SHAPE, "expected 2564 bytes, according to its bits, got 2756"),
        (b"\xff\xff\xff\xff" + bytes(64 * 38), ["stack"], U1, [16, 2, 4, 8, 8], "expected zeros after the first 30 bits"),
        (payload_of(), ["stack"], np.dtype(np.int8), SHAPE, "stack: expected uint8"),
        (payload_of(), ["stack"], np.dtype(bool), SHAPE, "stack: expected uint8"),
        (payload_of(), ["stack"], U1, [17, 2, 17, 8, 8], "stack: expected uint8"),
        (payload_of(), ["stack"], U1, [17, 2, 1, 8, 8], "stack: expected uint8"),
        (payload_of(), ["stack"], U1, [17, 2, 4, 64], "stack: expected uint8"),
        (payload_of(), ["stack"], U1, [2**20, 2**20, 16, 7, 9], "stack: expected uint8"),
        (payload_of(), ["stack"], U1, [0, 2, 4, 8, 8], "stack: expected uint8"),
        (payload_of(), ["stack"], U1, [1, 2, 4, 8, 8], "stack: expected uint8"),
        (payload_of(), ["stack"], U1, [17, 0, 4, 8, 8], "stack: expected uint8"),
        (payload_of(), ["stack"], U1, [17, 2, 4, 8, 0], "stack: expected uint8"),
        (payload_of(), ["stack"], U1, [2**10, 2**10, 2, 8, 8], "expected at least"),
        (payload_of(), [], U1, SHAPE, "packings: expected"),
        (payload_of(), ["stack", "stack"], U1, SHAPE, "packings: expected"),
        (payload_of(), ["pickle"], U1, SHAPE, "packings: expected"),
        (payload_of(), [b"stack"], U1, SHAPE, "packings: expected"),
        (payload_of(), [["stack"]], U1, SHAPE, "packings: expected"),
        (payload_of(), ["x" * 100_000], U1, SHAPE, "packings: expected"),
    ],
)
def test_what_is_not_quite_a_packed_array_is_refused(
    payload: bytes, packings: list[Any], dtype: np.dtype[Any], shape: list[int], says: str
) -> None:
    with pytest.raises(BadMessage) as caught:
        unpack_array(payload, packings, dtype, shape)
    assert says in str(caught.value)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("packings", [None, True, 1, "stack", {"stack": 1}, b"stack", 0.5])
def test_packings_are_a_list(packings: Any) -> None:
    frames = sent(a_rollout())
    head = msgspec.msgpack.decode(frames[0])
    head[OBS][0][3] = packings
    with pytest.raises(BadMessage):
        decode_to_learner([msgspec.msgpack.encode(head), *frames[1:]], ROOM)


def test_nothing_is_set_aside_for_a_promise() -> None:
    """What a few bytes say to be a gigabyte is refused before memory is taken for it."""
    tracemalloc.start()
    for shape in ([2**16, 2**4, 16, 8, 8], [2**10, 2**10, 16, 8, 8], [2, 2**19, 16, 8, 8], [2, 1, 16, 2**13, 2**12]):
        with pytest.raises(BadMessage):
            unpack_array(payload_of(), ["stack"], U1, shape)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 100_000


# ------------------------------------------------------------------------------------------------ compressed


def pictures(steps: int, copies: int, moving: bool = True) -> Bytes:
    """Stacks [steps, copies, 4, 20, 20] of frames in which little is to be seen."""
    obs = np.zeros((steps, copies, 4, 20, 20), np.uint8)
    for t, n, j in np.ndindex(*obs.shape[:3]):
        obs[t, n, j, (t + j) % 20, (7 * n + (t + j if moving else 31 * t + 57 * j)) % 20] = 255
    return obs


@pytest.mark.parametrize(
    ("obs", "stack", "names"),
    [
        (pictures(17, 2), True, ["stack", "zstd"]),
        (pictures(17, 2), False, ["zstd"]),
        (pictures(17, 2, moving=False), True, ["zstd"]),
        (frame_stacks(17, 2, 4, (8, 8)), True, ["stack"]),
        (frame_stacks(17, 2, 4, (8, 8), resets=1.0), True, []),
    ],
    ids=["both", "not stacked", "no stack", "stacked noise", "noise"],
)
def test_what_is_worth_it_is_compressed(obs: Bytes, stack: bool, names: list[str]) -> None:
    frame, packings = Packing(stack=stack, zstd=True).pack(obs)
    assert packings == names
    if names:
        assert len(frame) < obs.nbytes * (0.1 if "zstd" in names else 0.4)
        for received in (bytes(frame), memoryview(bytearray(frame))):
            back = unpack_array(received, packings, obs.dtype, obs.shape)
            assert back.tobytes() == obs.tobytes()
            assert not back.flags.writeable


@pytest.mark.parametrize("dtype", ["<i8", "<f4", "|b1", "<u2"])
def test_arrays_of_any_kind_are_compressed_from_a_kilobyte_on(dtype: str) -> None:
    few, many = np.zeros(1023 // np.dtype(dtype).itemsize, dtype), np.ones((64, 32, 2), dtype)
    assert Packing(zstd=True).pack(few)[1] == []
    frame, packings = Packing(zstd=True).pack(many)
    assert packings == ["zstd"]
    back = unpack_array(frame, packings, many.dtype, many.shape)
    assert (back.dtype, back.shape) == (many.dtype, many.shape)
    assert (back == many).all()


def test_a_compressed_rollout_comes_back_as_it_went() -> None:
    rollout = a_rollout((np.tile(pictures(17, 2), (1, 1, 1, 4, 4)),))
    frames = [bytes(frame) for frame in encode(rollout, Packing(stack=True, zstd=True))]
    assert sum(map(len, frames)) < 0.02 * rollout.obs[0].nbytes
    assert encode(decode_to_learner(frames, rollout.obs[0].nbytes)) == encode(rollout)


def runs_of_zeros(says: int, holds: int) -> bytes:
    """A Zstandard frame by hand: it says that it holds so many bytes, and holds so many, in blocks of one repeated byte."""
    sizes = [1 << 17] * (holds >> 17) + [holds % (1 << 17)]
    blocks = b"".join(
        ((size << 3) | 2 | (i == len(sizes) - 1)).to_bytes(3, "little") + b"\0" for i, size in enumerate(sizes)
    )
    return b"\x28\xb5\x2f\xfd\xe0" + says.to_bytes(8, "little") + blocks


GIGABYTE = 1 << 30
ZEROS = zstandard.ZstdCompressor().compress(bytes(8704))


def test_the_frame_made_by_hand_is_a_good_one() -> None:
    for frame in (runs_of_zeros(8704, 8704), ZEROS):
        assert not unpack_array(frame, ["zstd"], U1, SHAPE).any()
    payload = zstandard.ZstdCompressor().compress(payload_of())
    assert not unpack_array(payload, ["stack", "zstd"], U1, SHAPE).any()


@pytest.mark.parametrize(
    ("frame", "says"),
    [
        (b"", "zstd"),
        (b"\0" * 100, "zstd"),
        (runs_of_zeros(GIGABYTE, GIGABYTE), "got 1073741824"),
        (runs_of_zeros(2**62, 8704), "got 4611686018427387904"),
        (runs_of_zeros(8704, GIGABYTE), "zstd: "),
        (runs_of_zeros(8704, 8703), "zstd: "),
        (runs_of_zeros(8703, 8703), "got 8703"),
        (runs_of_zeros(8705, 8705), "got 8705"),
        (runs_of_zeros(0, 0), "got 0"),
        (zstandard.ZstdCompressor(write_content_size=False).compress(bytes(8704)), "got -1"),
        (b"\x50\x2a\x4d\x18\x04\0\0\0zero", "zstd"),  # a frame to be skipped
        (ZEROS + b"\0", "zstd"),
        (ZEROS + ZEROS, "zstd"),
        (ZEROS[:-1], "zstd: "),
    ],
    ids=lambda value: value if isinstance(value, str) else f"{len(value)} bytes",
)
def test_bombs_and_other_broken_frames_are_refused_before_memory_is_taken_for_them(frame: bytes, says: str) -> None:
    tracemalloc.start()
    with pytest.raises(BadMessage) as caught:
        unpack_array(frame, ["zstd"], U1, SHAPE)
    if says.startswith("got"):  # told by its own words; as a stack it may be smaller than the array
        with pytest.raises(BadMessage):
            unpack_array(frame, ["stack", "zstd"], U1, SHAPE)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert says in str(caught.value)
    assert most < 500_000


def test_packings_are_undone_in_one_order_only() -> None:
    for packings in (["zstd", "stack"], ["zstd", "zstd"], ["stack", "zstd", "zstd"], []):
        with pytest.raises(BadMessage, match="packings: expected"):
            unpack_array(ZEROS, packings, U1, SHAPE)


def test_a_learner_that_cannot_decompress_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zstandard", None)
    assert not has_zstd()
    with pytest.raises(BadMessage, match="zstd was not requested"):
        unpack_array(ZEROS, ["zstd"], U1, SHAPE)


@pytest.mark.parametrize("zstd", [False, True])
@examples(300)
@given(st.data())
def test_damaged_packed_rollouts(zstd: bool, data: st.DataObject) -> None:
    """Each is taken for a rollout, of what its bits say, or refused; nothing else is raised."""
    obs = frame_stacks(17, 2, 4, (8, 8)), frame_stacks(6, 1, 2, (8, 9), 0.2)
    if zstd:
        obs = pictures(17, 2), pictures(6, 1, moving=False)
    frames = [bytes(frame) for frame in encode(a_rollout(obs), Packing(stack=True, zstd=zstd))]
    which = data.draw(st.sampled_from([0, 1, 1, 2, 2, 3]))
    damaged = bytearray(frames[which])
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, min(8, len(damaged) - 1)) | st.integers(0, len(damaged) - 1))
        damaged[at] ^= data.draw(st.integers(1, 255))
    if data.draw(st.booleans()):
        del damaged[data.draw(st.integers(0, len(damaged))) :]
    frames[which] = bytes(damaged)
    with suppress(BadMessage):
        message = decode_to_learner(frames, 100_000)
        assert isinstance(message, Rollout)
        assert not any(array.flags.writeable for array in message.obs)
