"""The picture of what the policy sees: which pixels stand where."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
import pytest

from millrace.learner.run_folder.image_sample import GAP, GRAY, image_samples, png
from millrace.protocol.specs import Leaf

T, COPIES, SIDE = 9, 2, 7


def pixels_of(file: bytes) -> np.ndarray[Any, Any]:
    """The pixels of a PNG file without filters; the checksum of each chunk is checked."""
    chunks, at = {}, 8
    assert file[:8] == b"\x89PNG\r\n\x1a\n"
    while at < len(file):
        length = struct.unpack(">I", file[at : at + 4])[0]
        name, data = file[at + 4 : at + 8], file[at + 8 : at + 8 + length]
        assert struct.unpack(">I", file[at + 8 + length : at + 12 + length])[0] == zlib.crc32(name + data)
        chunks[name], at = data, at + 12 + length
    width, height, depth, color, *rest = struct.unpack(">IIBBBBB", chunks[b"IHDR"])
    assert (depth, rest, list(chunks)) == (8, [0, 0, 0], [b"IHDR", b"IDAT", b"IEND"])
    lines = np.frombuffer(zlib.decompress(chunks[b"IDAT"]), np.uint8).reshape(height, -1)
    assert not lines[:, 0].any()
    return lines[:, 1:].reshape((height, width, 3) if color == 2 else (height, width))


def rollout(*shape: int) -> np.ndarray[Any, Any]:
    return np.random.default_rng(0).integers(0, 256, (T + 1, COPIES, *shape), np.uint8)


def test_stacked_frames_are_side_by_side_and_a_row_is_a_step() -> None:
    obs = rollout(4, SIDE, SIDE)
    (file,) = image_samples([obs], [Leaf("", "box", (4, SIDE, SIDE), "uint8", divisor=255)]).values()
    shown = pixels_of(file)
    each = SIDE + GAP
    assert shown.shape == (4 * each - GAP, 4 * each - GAP)
    for row, t in enumerate((0, 3, 6, 9)):
        for channel in range(4):
            part = shown[row * each :, channel * each :][:SIDE, :SIDE]
            np.testing.assert_array_equal(part, obs[t, 0, channel])
    assert (shown[SIDE : SIDE + GAP] == GRAY).all()
    assert (shown[:, SIDE : SIDE + GAP] == GRAY).all()


@pytest.mark.parametrize("shape", [(SIDE, SIDE + 1, 3), (3, SIDE, SIDE + 1)])
def test_three_channels_are_colors_wherever_they_stand(shape: tuple[int, ...]) -> None:
    obs = rollout(*shape)
    (file,) = image_samples([obs], [Leaf("", "box", shape, "uint8", divisor=255)]).values()
    shown = pixels_of(file)
    first = obs[0, 0] if shape[2] == 3 else obs[0, 0].transpose(1, 2, 0)
    np.testing.assert_array_equal(shown[:SIDE, : SIDE + 1], first)


def test_planes_of_0_and_1_are_black_and_white() -> None:
    obs = rollout(SIDE, SIDE, 1) % 2
    (file,) = image_samples([obs], [Leaf("", "box", (SIDE, SIDE, 1), "uint8")]).values()
    np.testing.assert_array_equal(pixels_of(file)[:SIDE], obs[0, 0, ..., 0] * 255)


def test_each_image_of_an_observation_has_a_file_and_other_arrays_have_none() -> None:
    image = Leaf("camera/left", "box", (SIDE, SIDE, 1), "uint8", divisor=255)
    leaves = [image, Leaf("speed", "box", (2,), "float32"), Leaf("tiny", "box", (3, 3, 1), "uint8", divisor=255)]
    obs = [rollout(SIDE, SIDE, 1), np.zeros((T + 1, COPIES, 2), np.float32), rollout(3, 3, 1)]
    found = image_samples(obs, leaves)
    assert list(found) == ["observation-camera-left.png"]
    assert pixels_of(found["observation-camera-left.png"]).shape == (4 * (SIDE + GAP) - GAP, SIDE)


def test_a_short_rollout_has_fewer_rows() -> None:
    (file,) = image_samples([rollout(1, SIDE, SIDE)[:2]], [Leaf("", "box", (1, SIDE, SIDE), "uint8", divisor=255)]).values()
    assert pixels_of(file).shape == (2 * (SIDE + GAP) - GAP, SIDE)


def test_a_picture_survives_its_file() -> None:
    pixels = np.random.default_rng(1).integers(0, 256, (5, 6), np.uint8)
    np.testing.assert_array_equal(pixels_of(png(pixels)), pixels)
