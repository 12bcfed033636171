"""The faults of a killed run: which are drawn and when they happen."""

from __future__ import annotations

import json
import random
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.killed import FAULTS, FIRST_STEPS, KINDS, LAST_PART, drawn
from tests.system.stage.run_folders import policy_of


def test_each_kind_is_drawn_once_and_the_seed_decides_the_rest() -> None:
    faults = drawn(40, 10_000, ["worker", "learner"], random.Random(1))
    assert {fault.kind for fault in faults} == {kind for kind in KINDS if not kind.startswith("simulator")}
    assert [fault.due for fault in faults] == sorted(fault.due for fault in faults)
    assert FIRST_STEPS <= faults[0].due <= faults[-1].due <= LAST_PART * 10_000
    assert faults == drawn(40, 10_000, ["worker", "learner"], random.Random(1))
    assert faults != drawn(40, 10_000, ["worker", "learner"], random.Random(2))


@pytest.mark.soak
def test_a_killed_run_has_the_policy_of_an_undisturbed_one(tmp_path: Path) -> None:
    policies = set()
    for faults in (0, 4):
        folder = tmp_path / f"{faults} faults"
        python = [sys.executable, "-m"]
        flags = f"--faults {faults} --victims worker learner --"
        run = "CartPole-v1 --steps 40000 --seed 3 --workers 2 --lanes 4 --envs 8 --checkpoint-every-s 0.2 --eval-episodes 1"
        killed = [*python, "benchmarks.killed", str(folder), *flags.split()]
        command = [*killed, *python, "millrace", "train", *run.split(), "--log-json"]
        subprocess.run(command, check=True, timeout=240)
        happened = [json.loads(line) for line in (folder / FAULTS).read_text().splitlines()]
        assert len(happened) == faults
        (summary,) = folder.glob("*/summary.json")
        policies.add(policy_of(summary.parent))
    assert len(policies) == 1
