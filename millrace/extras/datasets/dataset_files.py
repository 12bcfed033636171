"""Reads the files of a Minari dataset as data: its spaces from metadata.json, its episodes from main_data.hdf5.

Rule: a dataset may come from an untrusted source. Nothing that it names is made, imported or called, and the content of
metadata.json is checked against the arrays before it is used. (Minari itself is less strict. If a dataset has no spaces, it
makes the dataset's environment, which runs any code that the entry point names. It also follows links to other files, and
lets Pillow open images of any format.)
"""

from __future__ import annotations

import io
import json
import math
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import msgspec
import numpy as np
from gymnasium import spaces

from millrace.extras.datasets.minari_spaces import space_of_json
from millrace.extras.datasets.self_contained_hdf5 import SelfContainedHDF5, UnfitFile
from millrace.learner.run_folder.regular_files import read, reason
from millrace.protocol.arrays import Array
from millrace.protocol.bounds import Natural, one_line
from millrace.protocol.envs.spaces import STORED_KINDS, action_spec, observation_leaves
from millrace.protocol.errors import UsageError
from millrace.protocol.specs import Leaf

METADATA = "metadata.json"
ARRAYS = "main_data.hdf5"
MOST_METADATA_BYTES = 1 << 24  # room for two bounds for each element of a space
REWARD = Leaf("", "box", (), "float32")
END = Leaf("", "box", (), "bool")


class StoredEpisode(NamedTuple):
    """An episode of L steps. Arrays have the shapes and dtypes of the dataset's spaces."""

    number: int
    obs: tuple[Array, ...]  # [L+1, *leaf] for each leaf of the observation
    action: tuple[Array, ...]  # [L, *part] for each part of the action, as the environment took it
    reward: Array  # [L] float32
    terminated: Array  # [L] bool
    truncated: Array  # [L] bool


class _Metadata(msgspec.Struct):
    """The part of metadata.json that is used."""

    data_format: str
    total_episodes: Natural
    total_steps: Natural
    observation_space: str | None = None
    action_space: str | None = None
    jpeg_encoding: bool = True


class DatasetFiles:
    """A dataset whose metadata was checked against its arrays. Needs h5py, and Pillow for JPEG images."""

    def __init__(self, name: str, folder: Path) -> None:
        """`name`: how error messages begin. `folder`: the folder of the two files.

        Raises `UsageError` if the dataset can't be used.
        """
        self._name = name
        self._folder = folder
        with self._as_usage_error(METADATA):
            if not stat.S_ISDIR(folder.lstat().st_mode):
                raise ValueError(f"{folder}: expected a folder, got a link or a file")
            metadata = msgspec.convert(json.loads(read(folder / METADATA, MOST_METADATA_BYTES)), _Metadata)
            if metadata.data_format != "hdf5":
                raise UsageError(f"{name}: expected data_format hdf5 in {METADATA}, got {metadata.data_format}")
            self._observation_space = self._space("observation_space", metadata.observation_space)
            self._action_space = self._space("action_space", metadata.action_space)
        self.observation = observation_leaves(self._observation_space)
        self.action = action_spec(self._action_space)
        self._parts = observation_leaves(self._action_space)
        self.rows = metadata.total_steps
        self.episodes = metadata.total_episodes
        """the numbers of steps (`rows`) and of episodes"""
        self._has_jpeg = metadata.jpeg_encoding
        self._check_counts()

    def read_episodes(self) -> Iterator[StoredEpisode]:
        """Yield the episodes, in order. Raises `UsageError` when it reaches one that can't be used."""
        with self._as_usage_error(ARRAYS), SelfContainedHDF5.open(self._folder / ARRAYS) as file:
            for number in range(self.episodes):
                yield self._episode(file, number)

    def _check_counts(self) -> None:
        """Raise `UsageError` unless the numbers of episodes and steps match the metadata, and a file of this size can
        contain them.
        """
        with self._as_usage_error(ARRAYS), SelfContainedHDF5.open(self._folder / ARRAYS) as file:
            if (episodes := len(file.root)) != self.episodes:
                raise UnfitFile(f"expected {self.episodes} episodes, as {METADATA} says, got {episodes}")
            groups = (file.group(file.root, f"episode_{number}") for number in range(episodes))
            if (rows := sum(_length(file.array(group, "rewards")) for group in groups)) != self.rows:
                raise UnfitFile(f"expected {self.rows:,} steps, as {METADATA} says, got {rows:,}")
            leaves = (*self.observation, *self._parts)
            size = rows * sum(math.prod(leaf.shape) * np.dtype(leaf.dtype).itemsize for leaf in leaves)
            if size > file.most_bytes:
                raise UnfitFile(f"expected at most {file.most_bytes:,} bytes in a file of this size, got {size:,}")

    def _episode(self, file: SelfContainedHDF5, number: int) -> StoredEpisode:
        group = file.group(file.root, f"episode_{number}")
        rewards = file.array(group, "rewards")
        L = _length(rewards)
        if not L:
            raise UnfitFile(f"{group.name}: expected steps, got none")
        stored = zip(_leaves(file, group, "observations", self._observation_space), self.observation, strict=True)
        actions = zip(_leaves(file, group, "actions", self._action_space), self._parts, strict=True)
        return StoredEpisode(
            number,
            tuple(self._read_leaf(array, L + 1, leaf, space) for (array, space), leaf in stored),
            tuple(_read(array, L, part) for (array, _), part in actions),
            _read(rewards, L, REWARD),
            _read(file.array(group, "terminations"), L, END),
            _read(file.array(group, "truncations"), L, END),
        )

    def _read_leaf(self, stored: Any, rows: int, leaf: Leaf, space: gymnasium.Space[Any]) -> Array:
        """Read the array [rows, *leaf] of one leaf of the observations."""
        from minari.dataset.minari_storage import is_image_space

        if self._has_jpeg and is_image_space(space):
            return _read_images(stored, (rows, *leaf.shape))
        return _read(stored, rows, leaf)

    def _space(self, name: str, text: str | None) -> gymnasium.Space[Any]:
        if text is None:
            raise UsageError(
                f"{self._name}: expected {name} in {METADATA}, got none; only the environment that the dataset names could "
                "tell it, and making that may run any code. Write the dataset again with a newer Minari"
            )
        return space_of_json(name, text)

    @contextmanager
    def _as_usage_error(self, file: str) -> Iterator[None]:
        try:
            yield
        except UsageError:
            raise
        except Exception as error:  # json, msgspec, numpy, HDF5 and Pillow raise a dozen exception types for damaged files
            why = one_line(reason(error), 500)
            raise UsageError(f"{self._name}: {file}: {why}; get the dataset again, or record another") from error


def _length(rewards: Any) -> int:
    """The number of steps of an episode."""
    if len(rewards.shape) != 1:
        raise UnfitFile(f"{rewards.name}: expected a number for each step, got an array {list(rewards.shape)}")
    return int(rewards.shape[0])


def _leaves(file: SelfContainedHDF5, parent: Any, name: str, space: gymnasium.Space[Any]) -> Iterator[tuple[Any, Any]]:
    """The stored arrays of an observation or an action, in the order of its leaves, with their spaces."""
    match space:
        case spaces.Dict():
            inside = dict(space.spaces)
        case spaces.Tuple():
            inside = {f"_index_{number}": inner for number, inner in enumerate(space.spaces)}
        case _:
            yield file.array(parent, name), space
            return
    group = file.group(parent, name)
    for key, inner in inside.items():
        yield from _leaves(file, group, key, inner)


def _read(stored: Any, rows: int, leaf: Leaf) -> Array:
    """Read an array [rows, *leaf], converted to the dtype of the leaf. Raises `UnfitFile` if that would change a value."""
    shape = (rows, *leaf.shape)
    dtype = stored.dtype
    if stored.shape != shape or dtype.kind not in STORED_KINDS:
        expected = f"{leaf.dtype}{list(shape)}"
        got = f"{dtype}{list(stored.shape)}"
        raise UnfitFile(f"{stored.name}: expected {expected}, got {got}")
    raw: Array = stored[()]
    with np.errstate(over="ignore", invalid="ignore"):  # floats that become infinite are refused later
        array = raw.astype(leaf.dtype, copy=False)
    if array.dtype.kind != "f" and (changed := array != raw).any():
        raise UnfitFile(f"{stored.name}: expected {leaf.dtype}, got {raw[changed][0]}")
    return array


def _read_images(stored: Any, shape: tuple[int, ...]) -> Array:
    """Decode JPEG images, one for each row, into an array [rows, height, width(, 3)]."""
    from PIL import Image, UnidentifiedImageError

    rows, height, width = shape[:3]
    if stored.shape[:1] != (rows,):
        raise UnfitFile(f"{stored.name}: expected {rows} images, got an array {list(stored.shape)}")
    mode = "L" if len(shape) == 3 else "RGB"
    images = np.empty(shape, np.uint8)
    for row, content in enumerate(stored):
        file = io.BytesIO(np.asarray(content, np.uint8).tobytes())
        try:
            image = Image.open(file, formats=["JPEG"])  # only JPEG, because for some formats Pillow starts another program
        except UnidentifiedImageError:
            raise UnfitFile(f"{stored.name}: expected JPEG images, got others") from None
        if (image.size, image.mode) != ((width, height), mode):
            expected = f"{mode} of {width} × {height}"
            got = f"{image.mode} of {image.width} × {image.height}"
            raise UnfitFile(f"{stored.name}: expected images {expected} pixels, got {got}")
        images[row] = np.asarray(image)
    return images
