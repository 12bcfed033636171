"""What is said of observations that look like images, and go straight into a dense layer."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import millrace
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.spaces import observation_leaves
from millrace.protocol.policy.flattened_images import flattened_images
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec

ACTION = ActionSpec("discrete", (), "int64", sizes=(2,), start=(0,))


def lines(shape: tuple[int, ...], dtype: str = "uint8", **policy: Any) -> list[str]:
    return list(flattened_images(PolicySpec((Leaf("", "box", shape, dtype),), ACTION, **policy)))


@pytest.mark.parametrize(
    ("shape", "dtype", "advice"),
    [
        (
            (4, 96, 96, 3),
            "uint8",
            'stack them along the channels (--wrappers "millrace:StackImages(n=4)"), or give --encoder',
        ),
        (
            (3, 24, 24, 3),
            "uint8",
            'stack them along the channels (--wrappers "millrace:StackImages(n=3)"), or give --encoder',
        ),
        ((84, 84), "uint8", "stack them (--wrappers "),
        ((84, 84, 3), "float32", "make them uint8 from 0 to 255, of three dimensions"),
        ((2, 4, 84, 84, 3), "uint8", "make them uint8 from 0 to 255, of three dimensions"),
    ],
)
def test_what_looks_like_images_gets_a_line(shape: tuple[int, ...], dtype: str, advice: str) -> None:
    (line,) = lines(shape, dtype, net=(64,))
    numbers = int(np.prod(shape))
    assert line.startswith(f"observation {dtype}{list(shape)} goes through no convolutions: its {numbers:,} numbers")
    assert f"a layer of {numbers * 64:,} weights; if these are images, {advice}" in line


@pytest.mark.parametrize(
    ("shape", "dtype"), [((84, 84, 3), "uint8"), ((4, 84, 84), "uint8"), ((1000,), "float32"), ((3, 3, 3, 2), "uint8")]
)
def test_images_and_other_arrays_get_none(shape: tuple[int, ...], dtype: str) -> None:
    assert not lines(shape, dtype)


class Camera(gymnasium.Env[Any, Any]):
    """Shows what it sees in colors."""

    observation_space = gymnasium.spaces.Box(0, 255, (36, 40, 3), np.uint8)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        return np.zeros((36, 40, 3), np.uint8), {}

    def step(self, action: Any) -> Any:
        return np.zeros((36, 40, 3), np.uint8), 1.0, bool(self.np_random.random() < 0.5), False, {}


def test_the_wrappers_that_it_names_make_images_of_stacked_frames() -> None:
    stack = "gymnasium.wrappers:FrameStackObservation(stack_size=4)"
    gray = "gymnasium.wrappers:GrayscaleObservation"
    channels = "millrace:StackImages(n=4)"
    images = {
        wrappers: [leaf.is_image for leaf in observation_leaves(EnvSpec.of(Camera, {}, wrappers).make().observation_space)]
        for wrappers in ((stack,), (gray,), (gray, stack), (f"{gray}(keep_dim=True)",), (channels,))
    }
    assert list(images.values()) == [[False], [False], [True], [True], [True]]


def test_a_run_says_it(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    millrace.train(
        Camera, wrappers=["gymnasium.wrappers:FrameStackObservation(stack_size=2)"], run_dir=str(tmp_path), preset="none",
        steps=8, envs=2, lanes=1, rollout_steps=4, workers=1, net=(4,), n_epochs=1, transport="inproc", eval_episodes=1,
        torch_threads=1, progress=False,
    )  # fmt: skip
    assert "observation uint8[2, 36, 40, 3] goes through no convolutions: its 8,640 numbers go into a layer" in caplog.text
