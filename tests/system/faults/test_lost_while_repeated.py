"""A worker is killed, and what continues its episodes breaks while it repeats them.

Rule: a loss is not a failure. A process that dies is replaced, and the episodes continue once more, so the policy is that of
the undisturbed run. An environment that raises or hangs would do so again: its lane begins new episodes.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from tests.system.stage.preloaded import workers_of
from tests.system.stage.processes import START_S, Learner, Stage

TRAP = "tests.system.environments.slow_envs:BreaksWhileRepeated"
CONTINUES = r"lane \d continues on worker w\d: \d+ env steps are replayed first"
ANEW = r"lane \d continues on worker w\d: 2 env copies begin new episodes"


def started(stage: Stage, name: str, trap: Path) -> Learner:
    runs = stage.tmp_path / name
    flags = "--steps 3200 --workers 2 --envs 4 --lanes 2 --rollout-steps 16 --batch-size 32 --n-epochs 1 --eval-episodes 1"
    waits = ["--env-kwargs", "trap", str(trap), "--step-timeout-s", "1.5", "--seed", "3", "--run-dir", str(runs)]
    command = [sys.executable, "-m", "millrace", "train", TRAP, *flags.split(), *waits, "--log-json"]
    learner = Learner(command, stage.tmp_path / f"{name}.log", runs)
    stage.started.append(learner)
    return learner


def disturbed(stage: Stage, trap: Path, what: str) -> Learner:
    """A run whose worker was killed, when the trap said `what`."""
    learner = started(stage, "disturbed", trap)
    learner.until(lambda row: row["time/iterations"] >= 8, START_S, "the middle of an episode")
    trap.write_text(what)
    workers_of(learner.pid)[0].kill()
    learner.hears(CONTINUES)
    return learner


def policy(learner: Learner) -> bytes:
    assert learner.ends() == 0, learner.said()
    return (learner.folder / "policy.safetensors").read_bytes()


def test_episodes_continue_although_the_next_worker_dies_too(stage: Stage) -> None:
    trap = stage.tmp_path / "trap"
    reference = started(stage, "undisturbed", trap)
    learner = disturbed(stage, trap, "dies")
    learner.hears(CONTINUES, times=2)
    assert policy(learner) == policy(reference)
    assert not trap.exists()
    assert not re.search(ANEW, learner.said())


@pytest.mark.soak
@pytest.mark.parametrize(
    ("what", "why"),
    [
        ("raises", "the trap was sprung"),
        ("hangs", r"a step of an episode that it replays took longer than 1.5 s \(--step-timeout-s\), at .*slow_envs.py"),
    ],
)
def test_a_lane_whose_environment_fails_while_it_is_repeated_begins_new_episodes(stage: Stage, what: str, why: str) -> None:
    learner = disturbed(stage, stage.tmp_path / "trap", what)
    learner.hears(why)
    learner.hears(ANEW)
    policy(learner)
