"""`millrace:StackImages`, a wrapper that stacks the last frames of each image along the image's channels.

Rule: a stacked image is an image, too, so it goes through the convolutions. All other parts of a Dict observation, such as
`action_mask`, stay as they are. A stack contains only frames of its episode: at a reset, all of them are the first frame.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from msgspec.structs import replace

from millrace.protocol.arrays import Array
from millrace.protocol.envs.spaces import observation_leaves
from millrace.protocol.errors import UsageError


class StackImages(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment that shows the last `n` frames of each image, stacked along the channels, the newest last.

    The observation is an image, or a Dict whose images are stacked and whose other parts stay as they are. (gymnasium's
    `FrameStackObservation` stacks every part of a Dict along a new first dimension, so images and `action_mask` become
    arrays that are neither.) `--wrappers "millrace:StackImages(n=4)"` wraps every env copy.

    >>> import gymnasium, millrace, numpy as np
    >>> class Camera(gymnasium.Env):
    ...     observation_space = gymnasium.spaces.Dict(
    ...         view=gymnasium.spaces.Box(0, 255, (24, 24, 3), np.uint8), speed=gymnasium.spaces.Box(0, 9, (1,))
    ...     )
    >>> env = millrace.StackImages(Camera(), n=4)
    >>> env.observation_space["view"].shape, env.observation_space["speed"].shape
    ((24, 24, 12), (1,))
    """

    def __init__(self, env: gymnasium.Env[Any, Any], n: int = 4) -> None:
        """Raises `UsageError` if the observation has no images, or a stack of them would not be an image."""
        super().__init__(env)
        if n < 1:
            raise UsageError(f"StackImages: n: expected at least 1, got {n}")
        self._n = n
        space = env.observation_space
        self._is_dict = isinstance(space, spaces.Dict)
        parts = {**space.spaces} if isinstance(space, spaces.Dict) else {"": space}
        self._axes = {key: axis for key, part in parts.items() if (axis := _axis_of_channels(key, part, n)) is not None}
        if not self._axes:
            raise UsageError(f"StackImages: expected an image (a uint8 Box with three dimensions), got {space}")
        self._stacks: dict[str, Array] = {}
        for key, axis in self._axes.items():
            box: Any = parts[key]
            low, high = (np.concatenate([bound] * n, axis) for bound in (box.low, box.high))
            parts[key] = spaces.Box(low, high, dtype=np.uint8)
        self.observation_space = spaces.Dict(parts) if self._is_dict else parts[""]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See `gymnasium.Env.reset`."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._stacks = {}
        return self._stacked(observation), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """See `gymnasium.Env.step`."""
        observation, *others = self.env.step(action)
        return self._stacked(observation), *others

    def _stacked(self, observation: Any) -> Any:
        """The observation with each image replaced by the stack of its last frames."""
        parts = {**observation} if self._is_dict else {"": observation}
        for key, axis in self._axes.items():
            if (stack := self._stacks.get(key)) is None:
                frames = [parts[key]] * self._n
            else:
                frames = [*np.split(stack, self._n, axis)[1:], parts[key]]
            parts[key] = self._stacks[key] = np.concatenate(frames, axis)  # a copy, because frames may be overwritten
        return parts if self._is_dict else parts[""]


def _axis_of_channels(key: str, space: gymnasium.Space[Any], n: int) -> int | None:
    """The axis along which `n` frames of this space are stacked; None if it isn't an image.

    Raises `UsageError` if the stack would not be an image with the same axis, because it would have too many channels.
    """
    if not isinstance(space, spaces.Box) or not (leaf := observation_leaves(space)[0]).is_image:
        return None
    axis = 2 if leaf.has_channels_last else 0
    shape = tuple(side * n if i == axis else side for i, side in enumerate(leaf.shape))
    stack = replace(leaf, shape=shape)
    if stack.has_channels_last != leaf.has_channels_last or not stack.is_image:
        raise UsageError(
            f"StackImages: {key or 'the observation'} {list(leaf.shape)}: expected fewer than {n} frames, because "
            f"{list(shape)} has more channels than {'rows' if axis == 2 else 'columns'}; take a smaller n, or larger images"
        )
    return axis
