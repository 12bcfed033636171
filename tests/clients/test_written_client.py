"""The client that a page writes: the wire document, training, environments that are slow or raise."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from millrace.extras.conformance.profiles import PROFILES
from tests.clients.client_page import Step, client, steps, written
from tests.system.stage.processes import START_S, Learner, Running, Stage, free_port

pytestmark = [pytest.mark.clients, pytest.mark.timeout(400)]
OTHER = """
import sys
import time

from client import Worker
from grid_world import GridWorld


class Other(GridWorld):
    def step(self, action):
        {before}
        return super().step(action)


sys.exit(Worker(sys.argv[1], Other, "other").run())
"""


def learner(stage: Stage, address: str, *flags: str) -> Learner:
    """`millrace learner` at this address, which acts for its workers."""
    command = [sys.executable, "-m", "millrace", "learner", "GridWorld-v0", "--bind", address, "--run-dir", str(stage.runs)]
    settings = ["--inference", "learner", "--lanes", "2", "--worker-timeout-s", "2"]
    made = Learner([*command, *settings, *flags], stage.tmp_path / "learner.log", stage.runs)
    stage.started.append(made)
    return made


@pytest.fixture
def grid_world(tmp_path: Path) -> Path:
    """The program, beside the whole client."""
    return written(tmp_path, client())


def started(stage: Stage, program: Path, address: str, name: str) -> Running:
    return stage.start([sys.executable, str(program), address, name], name)


def other(grid_world: Path, before: str) -> Path:
    """A program whose environment does this before each step."""
    program = grid_world.with_name("other.py")
    program.write_text(OTHER.format(before=before))
    return program


DECLINED = 3  # checks: two autoreset modes, and options of `reset`


def conform(program: Path, *flags: str) -> str:
    """What `millrace conform` says of a client."""
    command = [sys.executable, "-m", "millrace", "conform", "--env", "GridWorld-v0", "--patience-s", "20", *flags]
    done = subprocess.run(
        [*command, "--", sys.executable, str(program), "{address}"], capture_output=True, text=True, timeout=300
    )
    return done.stdout + done.stderr


def test_it_conforms_to_the_wire_document(grid_world: Path) -> None:
    said = conform(grid_world)
    assert f"{len(PROFILES['environment']) - DECLINED} checks passed, 0 failed, {DECLINED} skipped" in said, said


def test_it_conforms_with_one_copy(grid_world: Path) -> None:
    said = conform(grid_world, "--copies", "1", "--only", "step")
    assert ": the client conforms" in said, said


@pytest.mark.parametrize("step", steps(), ids=lambda step: step.title)
def test_after_each_step_of_the_page_its_checks_pass(step: Step, tmp_path: Path) -> None:
    program = written(tmp_path, step.client)
    for check in step.checks:
        assert f"ok       {check}\n" in conform(program, "--only", check)


def test_a_learner_trains_with_two_clients(stage: Stage, grid_world: Path) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    runs = learner(stage, address, "--steps", "12000", "--min-workers", "2", "--eval-episodes", "10")
    clients = [started(stage, grid_world, address, name) for name in ("first", "second")]
    assert runs.ends(START_S + 60) == 0, runs.said()
    assert [each.ends() for each in clients] == [0, 0]
    returns = [row["rollout/ep_rew_mean"] for row in runs.rows()]
    assert returns[0] < -15, "random actions take 25 steps"
    assert returns[-1] > -8, "the way takes 4 steps on average"
    ledger = runs.ledger()
    assert ledger["lost"] == ledger["messages_bad"] == 0


def test_it_sends_heartbeats_while_its_environment_works(grid_world: Path) -> None:
    program = other(grid_world, "time.sleep(3)")
    assert ": the client conforms" in conform(
        program, "--copies", "1", "--patience-s", "20", "--only", "beats while it steps"
    )


def test_what_the_environment_raises_is_told_to_the_learner(stage: Stage, grid_world: Path) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    runs = learner(stage, address)
    raises = started(stage, other(grid_world, 'raise RuntimeError("no such tile")'), address, "raises")
    assert raises.ends(START_S) == 1
    assert "no such tile" in raises.said()
    runs.hears("no such tile")
