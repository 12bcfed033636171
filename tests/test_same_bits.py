"""`tests.same_bits`: what two runs left is compared bit for bit, and times are not compared."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from safetensors.numpy import save_file

from tests.same_bits import PARTS, Compared, compare

ONE, NEXT = np.float32(1), np.nextafter(np.float32(1), np.float32(2))


def left(folder: Path, fps: float = 1.0, **bits: Any) -> Path:
    """A folder as a run leaves it. `bits`: for a part, the number that stands in it for 1."""
    got = dict.fromkeys(PARTS, ONE) | bits
    run = folder / "runs" / "CartPole"
    (run / "checkpoints").mkdir(parents=True)
    save_file({"actor": np.array([0, got["policy"]])}, run / "policy.safetensors")
    rows = [{"time/total_timesteps": 8, "time/fps": fps}, {"time/total_timesteps": 16, "train/loss": float(got["metrics"])}]
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (run / "summary.json").write_text(json.dumps({"wall_s": fps, "evaluation": {"return_mean": float(got["evaluation"])}}))
    state = {"algorithm": {"optimizer": [torch.tensor(got["checkpoint"])]}, "past": {"wall_s": fps}}
    torch.save({"state": state}, run / "checkpoints" / "000000000016.pt")
    data = folder / "datasets" / "same" / "training-v0" / "data"
    data.mkdir(parents=True)
    with h5py.File(data / "main_data.hdf5", "w") as file:
        file["episode_0/rewards"] = np.array([got["dataset"]])
    return folder


def test_runs_that_differ_in_times_only_are_the_same(tmp_path: Path) -> None:
    assert compare(left(tmp_path / "a", fps=1.0), left(tmp_path / "b", fps=2.0)) == Compared({}, [])


@pytest.mark.parametrize(
    ("part", "where"),
    [
        ("policy", "['policy']['actor']"),
        ("metrics", "['train/loss']['row 1']"),
        ("evaluation", "['evaluation return_mean']"),
        ("dataset", "['training-v0']['episode_0/rewards']"),
        ("checkpoint", "['optimizer'][0]"),
    ],
)
def test_one_bit_is_found(tmp_path: Path, part: str, where: str) -> None:
    found = compare(left(tmp_path / "a"), left(tmp_path / "b", **{part: NEXT}))
    assert found == Compared({part: where}, [])


def test_what_only_one_has_is_named_and_is_no_difference(tmp_path: Path) -> None:
    more = left(tmp_path / "b")
    save_file({"critic": np.zeros(1)}, more / "runs" / "CartPole" / "best.safetensors")
    assert compare(left(tmp_path / "a"), more) == Compared({}, ["policy best"])
