"""HDF5 files of episodes: they are what Minari reads, and no failure of a write ends the process."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from millrace.extras.datasets.episode_file import append_episodes

h5py = pytest.importorskip("h5py")
pytest.importorskip("minari")
FEW = 3  # episodes


def episodes(first: int, count: int = FEW) -> list[Any]:
    from minari.data_collector import EpisodeBuffer

    return [
        EpisodeBuffer(
            seed=n,
            observations={"a": np.full((3, 2), n, np.float32), "b": (np.arange(3), np.zeros((3, 40, 40), np.uint8))},
            actions=np.full(2, n),
            rewards=np.zeros(2, np.float32),
            terminations=np.array([False, True]),
            truncations=np.zeros(2, bool),
        )
        for n in range(first, first + count)
    ]


def test_episodes_are_appended(tmp_path: Path) -> None:
    path = tmp_path / "a.hdf5"
    for first in (0, FEW, 2 * FEW):
        append_episodes(path, first, episodes(first))
    with h5py.File(path) as file:
        assert set(file) == {f"episode_{n}" for n in range(3 * FEW)}
        for n in range(3 * FEW):
            group = file[f"episode_{n}"]
            assert dict(group.attrs) == {"id": n, "seed": n, "total_steps": 2}
            assert group["observations/a"][()].tolist() == [[n, n]] * 3
            assert group["observations/b/_index_0"][()].tolist() == [0, 1, 2]
            assert group["observations/b/_index_1"].shape == (3, 40, 40)
            assert group["actions"][()].tolist() == [n, n]


def failing(call: int, real: Callable[..., Any], part: int = 0) -> Callable[..., Any]:
    """A call of the system that fails from this `call` on; before, it writes a part of the data."""
    calls = 0

    def fails(descriptor: int, data: Any, *rest: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls < call:
            return real(descriptor, data, *rest)
        if part and calls == call:
            return real(descriptor, data[:part], *rest)
        raise OSError(errno.ENOSPC, "No space left on device")

    return fails


@pytest.mark.parametrize("part", [0, 1])
@pytest.mark.parametrize("first", [0, FEW])
def test_a_disk_may_be_full_at_any_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, first: int, part: int) -> None:
    """HDF5 would end the process if it knew. The call raises as often as there are writes."""
    real, raised = os.pwrite, 0
    for call in range(1, 10_000):
        path = tmp_path / f"{call}.hdf5"
        if first:
            append_episodes(path, 0, episodes(0))
        with monkeypatch.context() as patched:
            patched.setattr(os, "pwrite", failing(call, real, part))
            try:
                append_episodes(path, first, episodes(first))
                break
            except OSError as error:
                raised += error.errno == errno.ENOSPC
        path.unlink()
    assert raised == call - 1 > 20
    with h5py.File(path) as file:
        assert len(file) == first + FEW


@pytest.mark.parametrize("name", ["ftruncate", "close"])
def test_what_fails_at_the_end_is_raised_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    real, path = getattr(os, name), tmp_path / "a.hdf5"
    append_episodes(path, 0, episodes(0))

    def fails(descriptor: int, *rest: Any) -> None:
        if not os.path.samestat(os.fstat(descriptor), path.stat()):
            real(descriptor, *rest)
            return
        if name == "close":
            real(descriptor)
        raise OSError(errno.EDQUOT, "Disk quota exceeded")

    monkeypatch.setattr(os, name, fails)
    with pytest.raises(OSError, match="Disk quota exceeded"):
        append_episodes(path, FEW, episodes(FEW))


def test_a_link_is_not_written_through(tmp_path: Path) -> None:
    target = tmp_path / "precious"
    target.write_bytes(b"precious")
    (tmp_path / "a.hdf5").symlink_to(target)
    with pytest.raises(OSError, match="link"):
        append_episodes(tmp_path / "a.hdf5", 0, episodes(0))
    assert target.read_bytes() == b"precious"
