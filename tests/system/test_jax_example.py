"""examples/ppo_jax.py learns, and goes on from what it saved. Needs JAX: `pip install 'millrace-rl[jax]'`."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("jax")

from examples.ppo_jax import Settings, train


def test_it_learns_and_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = str(tmp_path / "state.npz")
    first = train(Settings(steps=12_000, save=file))
    assert first > 30  # a random policy has about 22
    assert train(Settings(steps=24_000, save=file)) > first
    line = capsys.readouterr().out.splitlines()[-1]
    assert int(line.partition(" env steps")[0].replace(",", "")) < 25_000
