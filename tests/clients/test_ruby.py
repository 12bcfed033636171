"""The Ruby client, and the page that writes it: the wire document, training, environments that are slow or raise."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from millrace.extras.conformance.profiles import PROFILES
from tests.clients.client_page import Step, steps
from tests.system.stage.processes import ROOT, START_S, Learner, Running, Stage, free_port

pytestmark = [pytest.mark.clients, pytest.mark.timeout(400), pytest.mark.usefixtures("ruby")]
RUBY = ROOT / "clients" / "ruby"
GRID_WORLD = RUBY / "examples" / "grid_world.rb"
OTHER = """require "{grid_world}"
class Other < GridWorld
  def step(action)
    {before}
    super
  end
end
exit Worker.new(ARGV[0], Other, ARGV[1] || "other").run
"""


def learner(stage: Stage, address: str, *flags: str) -> Learner:
    """`millrace learner` at this address, which acts for its workers."""
    command = [sys.executable, "-m", "millrace", "learner", "GridWorld-v0", "--bind", address, "--run-dir", str(stage.runs)]
    settings = ["--inference", "learner", "--lanes", "2", "--worker-timeout-s", "2"]
    made = Learner([*command, *settings, *flags], stage.tmp_path / "learner.log", stage.runs)
    stage.started.append(made)
    return made


def client(stage: Stage, program: Path, address: str, name: str) -> Running:
    return stage.start(["ruby", str(program), address, name], name)


def other(stage: Stage, before: str) -> Path:
    """A program whose environment does this before each step."""
    program = stage.tmp_path / "other.rb"
    program.write_text(OTHER.format(grid_world=GRID_WORLD, before=before))
    return program


DECLINED = 3  # checks: two autoreset modes, and options of `reset`


def conform(program: Path, *flags: str) -> str:
    """What `millrace conform` says of a client."""
    command = [sys.executable, "-m", "millrace", "conform", "--env", "GridWorld-v0", "--patience-s", "20", *flags]
    done = subprocess.run([*command, "--", "ruby", str(program), "{address}"], capture_output=True, text=True, timeout=300)
    return done.stdout + done.stderr


def test_it_conforms_to_the_wire_document() -> None:
    said = conform(GRID_WORLD)
    assert f"{len(PROFILES['environment']) - DECLINED} checks passed, 0 failed, {DECLINED} skipped" in said, said


def test_it_conforms_with_one_copy() -> None:
    said = conform(GRID_WORLD, "--copies", "1", "--only", "step")
    assert ": the client conforms" in said, said


@pytest.mark.parametrize("step", steps(), ids=lambda step: step.title)
def test_after_each_step_of_the_page_its_checks_pass(step: Step, tmp_path: Path) -> None:
    (tmp_path / "millrace.rb").write_text(step.client)
    (tmp_path / "examples").mkdir()
    program = Path(shutil.copy(GRID_WORLD, tmp_path / "examples"))
    for check in step.checks:
        assert f"ok       {check}\n" in conform(program, "--only", check)


def test_a_learner_trains_with_two_clients(stage: Stage) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    runs = learner(stage, address, "--steps", "12000", "--min-workers", "2", "--eval-episodes", "10")
    clients = [client(stage, GRID_WORLD, address, name) for name in ("first", "second")]
    assert runs.ends(START_S + 60) == 0, runs.said()
    assert [each.ends() for each in clients] == [0, 0]
    returns = [row["rollout/ep_rew_mean"] for row in runs.rows()]
    assert returns[0] < -15, "random actions take 25 steps"
    assert returns[-1] > -8, "the way takes 4 steps on average"
    ledger = runs.ledger()
    assert ledger["lost"] == ledger["messages_bad"] == 0


def test_it_sends_heartbeats_while_its_environment_works(stage: Stage) -> None:
    program = other(stage, "sleep 3")
    assert ": the client conforms" in conform(
        program, "--copies", "1", "--patience-s", "20", "--only", "beats while it steps"
    )


def test_what_the_environment_raises_is_told_to_the_learner(stage: Stage) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    runs = learner(stage, address)
    raises = client(stage, other(stage, 'raise "no such tile"'), address, "raises")
    assert raises.ends(START_S) == 1
    assert "no such tile" in raises.said()
    runs.hears("no such tile")
