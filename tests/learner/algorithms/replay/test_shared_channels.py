"""Images whose channels are stored once: what is read is what was written, and nothing is kept that no slot needs."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from millrace.learner.algorithms.replay.replay_buffer import ReplayBuffer
from millrace.learner.algorithms.replay.shared_channels import SharedChannels
from millrace.protocol.arrays import Bytes
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import Leaf
from tests.support.examples import examples

FIRST = Leaf("", "box", (3, 32, 33), "uint8", divisor=255)
LAST = Leaf("", "box", (32, 33, 3), "uint8", divisor=255)
LEAVES = pytest.mark.parametrize("leaf", [FIRST, LAST], ids=["channels first", "channels last"])


def stacked(leaf: Leaf, frames: Bytes) -> Bytes:
    """Frames [..., 3, 32, 33] as images of this leaf."""
    return np.moveaxis(frames, -3, -1) if leaf.has_channels_last else frames


def distinct(leaf: Leaf, images: Bytes) -> int:
    channels = np.moveaxis(images, -1, 1) if leaf.has_channels_last else images
    return len(np.unique(channels.reshape(-1, 1056), axis=0))


@LEAVES
@examples(50)
@given(data=st.data())
def test_what_is_read_is_what_was_written(leaf: Leaf, data: st.DataObject) -> None:
    """Of few frames, so that channels are shared between slots and places, and overwritten by themselves."""
    generator = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    frames = generator.integers(0, 256, (6, 32, 33), np.uint8)
    size = data.draw(st.integers(1, 9))
    shared, plain = SharedChannels(size, leaf), np.zeros((size, *leaf.shape), np.uint8)
    written: set[int] = set()
    for _ in range(data.draw(st.integers(1, 8))):
        slots = generator.permutation(size)[: generator.integers(1, size + 1)]
        images = stacked(leaf, frames[generator.integers(0, 6, (len(slots), 3))])
        shared[slots], plain[slots] = images, images
        written |= set(slots.tolist())
        every = np.arange(size)
        np.testing.assert_array_equal(shared[every], plain)
        kept = [uses for uses in shared._uses if uses]
        assert sum(kept) == 3 * len(written)
        assert len(kept) == len(shared._number) == distinct(leaf, plain[sorted(written)])


@LEAVES
def test_what_was_saved_is_restored_and_does_not_depend_on_the_past(leaf: Leaf) -> None:
    generator = np.random.default_rng(0)
    frames = generator.integers(0, 256, (6, 32, 33), np.uint8)
    images = stacked(leaf, frames[generator.integers(0, 6, (5, 3))])
    one, other = SharedChannels(5, leaf), SharedChannels(5, leaf)
    one[np.arange(5)] = images
    for slot in (3, 1, 0, 4, 2):
        other[np.array([slot])] = stacked(leaf, frames[generator.integers(0, 6, (1, 3))])
    for slot in (4, 2, 1, 3, 0):
        other[np.array([slot])] = images[slot : slot + 1]
    for saved, expected in zip(other.saved(5), one.saved(5), strict=True):
        np.testing.assert_array_equal(saved, expected)
    restored = SharedChannels(5, leaf)
    restored.load(*one.saved(5))
    np.testing.assert_array_equal(restored[np.arange(5)], images)


def played(seed: int, first: bool, stacks: bool, steps: int = 6, copies: int = 2) -> Batch:
    """A rollout of frame stacks, or of pictures that share nothing."""
    generator = np.random.default_rng(seed)
    frames = generator.integers(0, 256, (steps + 3, copies, 32, 33), np.uint8)
    if not stacks:
        obs = generator.integers(0, 256, (steps + 1, copies, 3, 32, 33), np.uint8)
    else:
        obs = np.stack([frames[t : t + 3].swapaxes(0, 1) for t in range(steps + 1)])
    ends = generator.random((steps, copies)) < 0.2
    ends[0] &= ~ends[0]
    valid = np.concatenate([np.ones((1, copies), bool), ~ends[:-1]])
    return Batch(
        obs=(obs,),
        action=np.zeros((steps, copies), np.int64),
        log_prob=np.zeros((steps, copies), np.float32),
        reward=generator.normal(size=(steps, copies)).astype(np.float32),
        terminated=ends & valid,
        truncated=np.zeros_like(ends),
        valid=valid,
        state=np.zeros((copies, 0), np.float32),
        lane=np.zeros(copies, np.int64),
        fresh=np.full(copies, first),
        columns_per_rollout=copies,
        episodes=(),
    )


def replay(size: int = 40) -> ReplayBuffer:
    return ReplayBuffer((FIRST,), size=size, n_step=2, gamma=0.9, seed=0, alpha=0.5)


def filled(into: ReplayBuffer) -> ReplayBuffer:
    for seed in range(5):
        into.add(played(seed, first=seed == 0, stacks=True))
    return into


def saved(buffer: ReplayBuffer) -> bytes:
    file = io.BytesIO()
    torch.save(buffer.state_dict(), file)
    return file.getvalue()


def test_a_replay_of_frame_stacks_draws_what_a_plain_one_draws_and_takes_less(monkeypatch: pytest.MonkeyPatch) -> None:
    sharing = filled(replay())
    assert isinstance(sharing._obs[0], SharedChannels)
    monkeypatch.setattr(SharedChannels, "worthwhile", lambda *_: False)
    plain = filled(replay())
    assert not isinstance(plain._obs[0], SharedChannels)
    for one, other in zip(sharing.sample(60)[1], plain.sample(60)[1], strict=True):
        np.testing.assert_array_equal(one, other)
    assert 1056 * len(sharing._obs[0]._number) < 0.6 * plain._obs[0].nbytes
    assert len(saved(sharing)) < len(saved(plain))


def test_pictures_that_share_nothing_are_stored_as_they_are() -> None:
    buffer = replay()
    buffer.add(played(0, first=True, stacks=False))
    assert not isinstance(buffer._obs[0], SharedChannels)


def drawn(buffer: ReplayBuffer) -> list[Any]:
    sample = buffer.sample(30)
    return [sample.slots, sample.leaves[0], sample.reward, sample.next_leaves[0]]


def test_it_is_restored_and_returns_to_what_was_remembered() -> None:
    buffer = filled(replay())
    other = replay()
    other.load_state_dict(buffer.state_dict())
    for one, restored in zip(drawn(buffer), drawn(other), strict=True):
        np.testing.assert_array_equal(one, restored)
    buffer.remember()
    before = saved(buffer)
    for seed in (7, 8, 9):
        buffer.add(played(seed, first=False, stacks=True))
    assert saved(buffer) != before
    buffer.roll_back()
    assert saved(buffer) == before
    for each in (buffer, other):
        each.add(played(11, first=False, stacks=True))
    assert saved(buffer) == saved(other)


def test_the_memory_that_is_said_is_what_it_takes() -> None:
    buffer = filled(replay())
    stored = buffer._obs[0]
    assert isinstance(stored, SharedChannels)
    plain = 40 * 3 * 1056
    assert buffer.bytes == replay().bytes - plain + stored.nbytes
