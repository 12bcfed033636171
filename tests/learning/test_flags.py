"""Flags are learned whatever their dtype: bytes with the bounds 0 and 1 are the numbers 0 and 1."""

from __future__ import annotations

from pathlib import Path

import pytest

import millrace

pytestmark = [pytest.mark.learning, pytest.mark.timeout(1200)]


@pytest.mark.parametrize("algo", ["a2c", "impala"])
def test_bytes_are_learned_as_other_integers_are(algo: str, tmp_path: Path) -> None:
    """The same policy, bit for bit. Divided by 255, bytes led to 3 of 10."""
    policies = []
    for dtype in ("uint8", "int8"):
        run = millrace.train(
            "tests.support.users_code.flag_env:Flags", env_kwargs={"dtype": dtype}, algo=algo, steps=10_000, seed=1,
            workers=1, transport="inproc", eval_episodes=20, run_dir=str(tmp_path / dtype), progress=False,
        )  # fmt: skip
        assert run.summary is not None
        assert run.summary.evaluation is not None
        assert run.summary.evaluation.return_mean == 10
        policies.append((run.path / "policy.safetensors").read_bytes())
    assert policies[0] == policies[1]
