"""A stranger's dataset runs nothing and reads no other file; one that is not what it says is refused in one line."""

from __future__ import annotations

import io
import json
import random
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from millrace.extras.datasets.prior_dataset import PriorDataset
from millrace.protocol.envs.spaces import action_spec, observation_leaves
from millrace.protocol.errors import UsageError
from millrace.protocol.specs import PolicySpec

minari = pytest.importorskip("minari")
h5py = pytest.importorskip("h5py")
NAME = "toy/stranger-v0"
BOX = spaces.Box(-1, 1, (2,), np.float32)
IMAGE = spaces.Box(0, 255, (32, 40, 3), np.uint8)
LENGTHS = (3, 5)
EPISODE = "/episode_1"


def arrays(observation: gymnasium.Space[Any], L: int) -> dict[str, Any]:
    observation.seed(L)
    last = np.arange(L) == L - 1
    return {
        "observations": np.stack([observation.sample() for _ in range(L + 1)]),
        "actions": np.arange(L) % 2,
        "rewards": np.linspace(0, 1, L),
        "terminations": last,
        "truncations": np.zeros(L, bool),
    }


class Stored:
    """A dataset of two episodes, to be changed."""

    def __init__(self, folder: Path, observation: gymnasium.Space[Any] = BOX) -> None:
        from minari.data_collector import EpisodeBuffer

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            minari.create_dataset_from_buffers(
                NAME,
                buffer=[EpisodeBuffer(id=n, infos={}, **arrays(observation, L)) for n, L in enumerate(LENGTHS)],
                observation_space=observation,
                action_space=spaces.Discrete(2),
                data_format="hdf5",
            )
        self.metadata, self.arrays = (folder / NAME / "data" / name for name in ("metadata.json", "main_data.hdf5"))
        self.policy = PolicySpec(observation_leaves(observation), action_spec(spaces.Discrete(2)))

    def say(self, **facts: Any) -> None:
        """Write facts into metadata.json; those that are None are removed."""
        all_facts = json.loads(self.metadata.read_text()) | facts
        self.metadata.write_text(json.dumps({name: fact for name, fact in all_facts.items() if fact is not None}))

    def refusal(self) -> str:
        with pytest.raises(UsageError) as refused:
            list(PriorDataset(NAME, self.policy).batches())
        assert "\n" not in str(refused.value)
        assert str(refused.value).startswith(f"prior {NAME}: ")
        return str(refused.value)


@pytest.fixture
def datasets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    return tmp_path / "datasets"


@pytest.mark.parametrize("missing", ["observation_space", "action_space"])
def test_no_environment_is_made(datasets: Path, tmp_path: Path, missing: str) -> None:
    stored, marker = Stored(datasets), tmp_path / "it_ran"
    spec = gymnasium.envs.registration.EnvSpec("Any-v0", entry_point="os:mkdir", kwargs={"path": str(marker)}).to_json()
    stored.say(env_spec=spec, **{missing: None})
    assert f"expected {missing} in metadata.json, got none" in stored.refusal()
    assert not marker.exists()


@pytest.mark.parametrize(
    ("facts", "says"),
    [
        ({"total_steps": 5}, "expected 5 steps, as metadata.json says, got 8"),
        ({"total_steps": 9}, "expected 9 steps, as metadata.json says, got 8"),
        ({"total_episodes": 1}, "expected 1 episodes, as metadata.json says, got 2"),
        ({"total_episodes": 3}, "expected 3 episodes, as metadata.json says, got 2"),
        ({"total_episodes": -1}, "metadata.json: "),
        ({"total_steps": None}, "metadata.json: "),
        ({"data_format": "arrow"}, "expected data_format hdf5 in metadata.json, got arrow"),
        ({"observation_space": "["}, "metadata.json: "),
        ({"observation_space": "[" * 100_000}, "metadata.json: "),
        ({"observation_space": json.dumps({"type": "MultiBinary", "n": [1 << 20, 1 << 20]})}, "at most 16777216 elements"),
        (
            {"observation_space": json.dumps({"type": "Box", "shape": [2], "dtype": "V99", "low": 0, "high": 1})},
            "metadata.json: ",
        ),
        (
            {"observation_space": json.dumps({"type": "Box", "shape": [2], "dtype": "int8", "low": 0, "high": 999})},
            "metadata.json: ",
        ),
        ({"action_space": json.dumps({"type": "Discrete", "n": 0, "start": 0})}, "metadata.json: "),
    ],
)
def test_what_the_metadata_says_is_compared_before_it_is_believed(datasets: Path, facts: dict[str, Any], says: str) -> None:
    stored = Stored(datasets)
    stored.say(**facts)
    assert says in stored.refusal()


def of_another_file(group: Any, other: Path) -> None:
    with h5py.File(other, "w") as file:
        file["observations"] = np.zeros((6, 2), np.float32)


def external_link(group: Any, other: Path) -> None:
    of_another_file(group, other)
    group["observations"] = h5py.ExternalLink(str(other), "/observations")


def soft_link(group: Any, other: Path) -> None:
    group["observations"] = h5py.SoftLink("/episode_0/observations")


def external_storage(group: Any, other: Path) -> None:
    other.write_bytes(bytes(48))
    group.create_dataset("observations", shape=(6, 2), dtype=np.float32, external=[(str(other), 0, 48)])


def virtual(group: Any, other: Path) -> None:
    of_another_file(group, other)
    layout = h5py.VirtualLayout((6, 2), np.float32)
    layout[:] = h5py.VirtualSource(str(other), "observations", (6, 2))
    group.create_virtual_dataset("observations", layout)


def nothing_written(group: Any, other: Path) -> None:
    group.create_dataset("observations", shape=(6, 2), dtype=np.float32)


def too_narrow(group: Any, other: Path) -> None:
    group["observations"] = np.zeros((6, 1), np.float32)


def too_short(group: Any, other: Path) -> None:
    group["observations"] = np.zeros((5, 2), np.float32)


def texts(group: Any, other: Path) -> None:
    group["observations"] = np.full((6, 2), b"?")


def a_group(group: Any, other: Path) -> None:
    group.create_group("observations")


def absent(group: Any, other: Path) -> None:
    pass


def huge_chunks(group: Any, other: Path) -> None:
    group.create_dataset("observations", (6, 2), np.float32, chunks=(1 << 28, 2), maxshape=(None, 2), compression="gzip")


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (external_link, "expected a name in this file, got a link"),
        (soft_link, "expected a name in this file, got a link"),
        (external_storage, "expected its data in this file, got an array that names other files"),
        (virtual, "expected its data in this file, got an array that names other files"),
        (nothing_written, "expected all of its data in this file, got a part of them"),
        (too_narrow, "expected float32[6, 2], got float32[6, 1]"),
        (too_short, "expected float32[6, 2], got float32[5, 2]"),
        (texts, "expected float32[6, 2], got |S1[6, 2]"),
        (a_group, "expected an array, got Group"),
        (absent, "expected /episode_1/observations, got none"),
        (huge_chunks, "bytes in a file of this size, got 2,147,483,648"),
    ],
)
def test_an_array_is_of_its_space_and_in_its_file(
    datasets: Path, tmp_path: Path, make: Callable[[Any, Path], None], says: str
) -> None:
    stored = Stored(datasets)
    with h5py.File(stored.arrays, "a") as file:
        del file[EPISODE]["observations"]
        make(file[EPISODE], tmp_path / "other")
    assert f"main_data.hdf5: {'' if make is absent else '/episode_1/observations: '}" in (refusal := stored.refusal())
    assert says in refusal


@pytest.mark.parametrize(
    ("name", "values", "says"),
    [
        ("actions", np.array([0, 1, 0.5, 1, 0]), "expected int64, got 0.5"),
        ("actions", np.array([0, 1, 0]), "expected int64[5], got int64[3]"),
        ("terminations", np.array([0, 0, 0, 0, 2]), "expected bool, got 2"),
        ("truncations", np.zeros((5, 1), bool), "expected bool[5], got bool[5, 1]"),
        ("rewards", np.zeros((5, 1)), "expected a number for each step, got an array [5, 1]"),
        ("rewards", np.array([0, 0, 1e300, 0, 0]), "expected finite values, got inf at step 2"),
    ],
)
def test_an_array_has_a_fitting_value_for_each_step(datasets: Path, name: str, values: Any, says: str) -> None:
    stored = Stored(datasets)
    with h5py.File(stored.arrays, "a") as file:
        del file[EPISODE][name]
        file[EPISODE][name] = values
    assert says in stored.refusal()


def test_more_steps_than_the_file_can_hold_are_not_allocated(datasets: Path) -> None:
    """Rewards that were never written stand for as many numbers as one likes."""
    stored = Stored(datasets)
    with h5py.File(stored.arrays, "a") as file:
        del file[EPISODE]["rewards"]
        file[EPISODE].create_dataset("rewards", shape=(1 << 40,), dtype=np.float64, chunks=True)
    stored.say(total_steps=3 + (1 << 40))
    assert "expected at most " in stored.refusal()


@pytest.mark.parametrize("name", ["metadata", "arrays"])
def test_a_link_in_the_place_of_a_file_is_not_followed(datasets: Path, name: str) -> None:
    stored = Stored(datasets)
    path: Path = getattr(stored, name)
    path.symlink_to(path.rename(path.with_suffix(".elsewhere")))
    assert "expected a file, got a link" in stored.refusal()


def test_an_image_is_decoded_as_jpeg_or_not_at_all(datasets: Path) -> None:
    from PIL import Image

    stored = Stored(datasets, IMAGE)
    (_, batch) = PriorDataset(NAME, stored.policy).batches()
    assert batch.obs[0].shape == (6, 1, *IMAGE.shape)
    for size, form, says in ((32, "PNG", "expected JPEG images, got others"), (99, "JPEG", "got RGB of 99 × 99")):
        file = io.BytesIO()
        Image.new("RGB", (size, size)).save(file, form)
        with h5py.File(stored.arrays, "a") as content:
            del content[EPISODE]["observations"]
            content[EPISODE]["observations"] = np.tile(np.frombuffer(file.getvalue(), np.uint8), (6, 1))
        assert says in stored.refusal()


def test_a_damaged_file_is_one_line(datasets: Path) -> None:
    """Cut short anywhere, or with wrong bytes at its head, where HDF5 keeps the structure."""
    stored = Stored(datasets)
    whole = stored.arrays.read_bytes()
    for size in (0, 7, 100, len(whole) // 2, len(whole) - 1):
        stored.arrays.write_bytes(whole[:size])
        assert "main_data.hdf5: " in stored.refusal()
    generator = random.Random(1)
    for _ in range(50):
        damaged = bytearray(whole)
        for _ in range(8):
            damaged[generator.randrange(2_000)] = generator.randrange(256)
        stored.arrays.write_bytes(damaged)
        with suppress(UsageError):  # some damage changes no number that is used
            list(PriorDataset(NAME, stored.policy).batches())
