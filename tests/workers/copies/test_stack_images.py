"""`StackImages` stacks the last frames of each image, and of nothing else, so that a stack is an image, too."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from millrace.protocol.arrays import Array
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.action_masks import has_mask
from millrace.protocol.envs.spaces import observation_leaves
from millrace.protocol.errors import UsageError
from millrace.workers.copies.stack_images import StackImages

SPACES: dict[str, spaces.Space[Any]] = {
    "last": spaces.Box(0, 255, (24, 20, 3), np.uint8),
    "first": spaces.Box(0, 255, (2, 20, 24), np.uint8),
    "speed": spaces.Box(0, 99, (3,), np.float32),
    "action_mask": spaces.MultiBinary(7),
}


class Counts(gymnasium.Env[Any, Any]):
    """Each image is filled with the number of the call. The env writes its frames to the same arrays."""

    action_space = spaces.MultiDiscrete([5, 2])

    def __init__(self, space: spaces.Space[Any] | None = None) -> None:
        self.observation_space = spaces.Dict(SPACES) if space is None else space
        self.calls = 0
        self.frames = {key: np.zeros(space.shape or (), space.dtype) for key, space in SPACES.items()}

    def observe(self) -> Any:
        self.calls += 1
        for key in ("last", "first", "speed"):
            self.frames[key][...] = self.calls
        self.frames["last"][..., 1] = 0  # one channel differs from the others
        return dict(self.frames) if isinstance(self.observation_space, spaces.Dict) else self.frames["last"]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        return self.observe(), {}

    def step(self, action: Any) -> Any:
        return self.observe(), 1.0, False, False, {}


def numbers(stack: Array, axis: int, channels: int) -> list[int]:
    """The number of the call in each frame of a stack, which must be a number for the whole frame."""
    frames = np.split(stack, stack.shape[axis] // channels, axis)
    return [int(frame.max()) for frame in frames]


def test_each_image_shows_its_last_frames_and_everything_else_stays_as_it_is() -> None:
    env = StackImages(Counts(), n=3)
    seen, _ = env.reset(seed=1)
    assert numbers(seen["last"], 2, 3) == numbers(seen["first"], 0, 2) == [1, 1, 1]
    for last in (2, 3, 4):
        before, kept = seen["first"], seen["first"].copy()
        seen, reward, terminated, truncated, info = env.step([0, 0])
        assert (reward, terminated, truncated, info) == (1.0, False, False, {})
        expected = [max(1, last - 2), last - 1, last]
        assert numbers(seen["last"], 2, 3) == numbers(seen["first"], 0, 2) == expected
        assert seen["last"][..., 1::3].max() == 0
        assert seen["speed"].tolist() == [last] * 3
        assert env.observation_space.contains(seen)
        assert np.array_equal(before, kept)
    seen, _ = env.reset()
    assert numbers(seen["first"], 0, 2) == [5, 5, 5]


def test_stacks_are_images_and_the_mask_stays_one() -> None:
    env = EnvSpec.of(Counts, {}, ("millrace:StackImages(n=4)",)).make()
    leaves = {leaf.path: leaf for leaf in observation_leaves(env.observation_space)}
    assert [leaf.shape for leaf in leaves.values() if leaf.is_image] == [(8, 20, 24), (24, 20, 12)]
    assert [leaf.divisor for leaf in leaves.values() if leaf.is_image] == [255, 255]
    assert has_mask(env.observation_space, env.action_space)


def test_an_observation_that_is_one_image_becomes_one_stack() -> None:
    env = StackImages(Counts(SPACES["last"]), n=2)
    env.reset()
    seen, *_ = env.step([0, 0])
    assert seen.shape == env.observation_space.shape == (24, 20, 6)
    assert numbers(seen, 2, 3) == [1, 2]


@pytest.mark.parametrize(
    ("shape", "n", "line"),
    [
        (
            (24, 20),
            4,
            "StackImages: expected an image (a uint8 Box with three dimensions), got Box(0, 255, (24, 20), uint8)",
        ),
        ((7, 7, 3), 4, "[7, 7, 3]: expected fewer than 4 frames, because [7, 7, 12] has more channels than rows"),
        ((3, 7, 8), 3, "[3, 7, 8]: expected fewer than 3 frames, because [9, 7, 8] has more channels than columns"),
        ((7, 7, 3), 0, "StackImages: n: expected at least 1, got 0"),
    ],
)
def test_what_would_not_be_an_image_is_refused(shape: tuple[int, ...], n: int, line: str) -> None:
    with pytest.raises(UsageError) as refused:
        StackImages(Counts(spaces.Box(0, 255, shape, np.uint8)), n=n)
    assert line in str(refused.value)
