"""The learner runs no environment code: it has no copy, need not have the simulator, and faults hurt only workers."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import millrace
from millrace.learner.vector_env import step_hub
from millrace.protocol.errors import EnvironmentFailed
from millrace.protocol.logs import long_wait
from millrace.protocol.messages import Describe, Described, Hello, Refuse
from millrace.protocol.space_spec import MAX_ELEMENTS, BoxSpace, DiscreteSpace, EnvDescription
from millrace.protocol.wire.codec import encode
from millrace.protocol.wire.plain_values import pack
from millrace.protocol.wire.worker_link import WorkerLink
from tests.learner.config.test_resume_rules import content
from tests.support.conversation.example_messages import example
from tests.support.envs.toy import Countdown
from tests.system.stage import preloaded
from tests.system.stage.processes import ROOT, START_S, Stage, crowding, free_port, wait_for
from tests.system.stage.runs import finish

SIMULATOR = '''
"""A simulator that only some machines have. Its keyword argument says what is wrong with it."""
import os, sys, time
import gymnasium, numpy as np

class Sim(gymnasium.Env):
    observation_space = gymnasium.spaces.Dict(
        {"speed": gymnasium.spaces.Box(-1.5, 2.5, (3,), np.float32), "gear": gymnasium.spaces.Discrete(4, start=1)}
    )
    action_space = gymnasium.spaces.Box(-0.1, 0.1, (2,), np.float64)
    metadata = {"render_modes": [], "maker": "us"}

    def __init__(self, fault="", seconds=0.0, once=""):
        self.fault, self.t = fault, 0
        if not once or not os.path.exists(once):
            time.sleep(seconds)
        if once:
            open(once, "w").close()
        if fault == "sys.exit":
            sys.exit(0)
        if fault == "os._exit":
            os._exit(0)
        if fault == "raises":
            raise OSError("no display")

    def _obs(self):
        return {"speed": np.full(3, self.t / 10, np.float32), "gear": 1 + self.t % 4}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self._obs(), {}

    def step(self, action):
        self.t += 1
        return self._obs(), 1.0, self.t == 5, False, {}

    def close(self):
        if self.fault == "close_raises":
            raise RuntimeError("closed twice")
        if self.fault == "close_hangs" and self.t == 0:
            time.sleep(1000)

gymnasium.register("Sim-v0", Sim, max_episode_steps=20)
'''
TINY = {"rollout-steps": 8, "batch-size": 32, "n-epochs": 1, "steps": 128, "eval-episodes": 1, "workers": 2}


@pytest.fixture
def simulator(tmp_path: Path) -> Path:
    """A folder with the module `mysim`, which is on nobody's path."""
    folder = tmp_path / "simulator"
    folder.mkdir()
    (folder / "mysim.py").write_text(SIMULATOR)
    return folder


def with_path(folder: Path) -> tuple[str, str]:
    """Words before a command whose process finds the modules of a folder."""
    return "env", f"PYTHONPATH={folder}{os.pathsep}{ROOT}"


def train(
    env: str, folder: Path, path: Path | None = None, settings: Mapping[str, object] = {}, within_s: float = 90.0
) -> subprocess.CompletedProcess[str]:
    """`millrace train` in an empty folder."""
    command = [sys.executable, "-m", "millrace", "train", env]
    for name, value in {**TINY, "run-dir": folder / "runs", **settings}.items():
        command += [f"--{name}", *str(value).split("|")]
    found = os.pathsep.join(map(str, filter(None, [path, ROOT])))
    return preloaded.run(command, cwd=folder, env={**os.environ, "PYTHONPATH": found}, timeout=within_s * crowding())


# ------------------------------------------------------------------------------------------- without the simulator


def test_a_learner_without_the_simulator_trains_with_workers_that_have_it(stage: Stage, simulator: Path) -> None:
    alone = [sys.executable, "-c", "import mysim"]
    missing = subprocess.run(alone, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert "No module named 'mysim'" in missing.stderr
    keys, token = stage.keys()
    address = f"tcp://127.0.0.1:{free_port()}"
    settings = {"keys": keys, "env-kwargs": "", "record": "", "rollout-steps": 16}
    learner = stage.learner(address, settings, env="mysim:Sim-v0")
    learner.is_open()
    bare = stage.worker(address, "bare", "--token", str(token))
    assert bare.ends(START_S) == 2
    assert "environment mysim:Sim-v0: no module named mysim; is it installed, or its folder on PYTHONPATH?" in bare.said()
    learner.hears("worker bare was refused: environment mysim:Sim-v0: no module named mysim")
    workers = [stage.worker(address, f"w{n}", "--token", str(token), before=with_path(simulator)) for n in range(2)]
    row = learner.trains(3)
    assert row["time/total_timesteps"] > 0
    learner.signal(signal.SIGTERM)
    assert learner.ends() == 130, learner.said()
    for worker in workers:
        assert worker.ends() == 0, worker.said()
    card = (learner.folder / "policy.json").read_text()
    assert '"path": "gear"' in card
    assert "0.1" in card


def test_a_resumed_learner_does_not_train_with_workers_that_have_another_environment(
    stage: Stage, simulator: Path, tmp_path: Path
) -> None:
    """One that lacks it, and one whose version has other spaces, are refused; the run goes on with one that has it."""
    address = f"tcp://127.0.0.1:{free_port()}"
    learner = stage.learner(address, {"env-kwargs": ""}, env="mysim:Sim-v0")
    learner.is_open()
    worker = stage.worker(address, "w0", before=with_path(simulator))
    learner.trains(2)
    learner.signal(signal.SIGTERM)
    assert learner.ends() == 130
    assert worker.ends() == 0
    before = content(learner.folder)
    newer = tmp_path / "newer"
    newer.mkdir()
    (newer / "mysim.py").write_text(SIMULATOR.replace("(3,)", "(4,)").replace("np.full(3,", "np.full(4,"))

    again = stage.learner(address, resume=learner.folder)
    again.is_open()
    bare = stage.worker(address, "bare")
    changed = stage.worker(address, "changed", before=with_path(newer))
    says = f"run {learner.folder}: the environment's observations have changed: expected .*, got .*; install the version"
    for refused, why in ((bare, "no module named mysim"), (changed, says)):
        assert refused.ends(START_S) == 2
        refused.hears(why)
        again.hears(f"worker {refused.said_in.name.partition('-')[0]} was refused: .*{why}")
    after = {name: made for name, made in content(learner.folder).items() if name in before}
    assert after.pop("log.jsonl").startswith(before.pop("log.jsonl"))  # it says why, too
    assert after == before
    worker = stage.worker(address, "w1", before=with_path(simulator))
    again.trains(2)
    finish(again, [worker])


# ------------------------------------------------------------------------------------------- faults


def test_an_unknown_id_is_one_line_and_leaves_no_folder(tmp_path: Path) -> None:
    done = train("NoSuchEnv-v3", tmp_path)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("millrace: environment NoSuchEnv-v3 is not registered")
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("fault", ["close_raises", pytest.param("close_hangs", marks=pytest.mark.soak)])
def test_a_copy_whose_close_fails_does_not_hurt_the_run(stage: Stage, simulator: Path, fault: str) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    # The copy of evaluations is described first, and closed before that of training is made.
    settings = {"env-kwargs": f"fault {fault}", "eval-env-kwargs": "seconds 0.1"}
    learner = stage.learner(address, settings, env="mysim:Sim-v0")
    host = stage.worker(address, "host", "--processes", "2", before=with_path(simulator))
    learner.trains(3)
    if fault == "close_hangs":
        host.hears(r"close\(\) of its environment took longer than", 30.0)  # the process that hung; it is restarted
    else:
        assert "close() of its environment" not in host.said()


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        (
            "sys.exit",
            "environment mysim:Sim-v0 cannot be made: SystemExit: 0; failure 1 in a row; max_env_failures allows 0",
        ),
        (
            "raises",
            "environment mysim:Sim-v0 cannot be made: OSError: no display; failure 1 in a row; max_env_failures allows 0",
        ),
        ("os._exit", "failure 1 in a row; max_env_failures allows 0"),
    ],
)
def test_an_environment_that_fails_in_its_constructor_ends_the_start_and_is_named(
    tmp_path: Path, simulator: Path, fault: str, says: str
) -> None:
    settings = {"env-kwargs": f"fault|{fault}", "max-env-failures": 0}
    done = train("mysim:Sim-v0", tmp_path, simulator, settings)
    assert done.returncode == 1
    assert says in done.stderr
    assert "internal error" not in done.stderr
    assert not (tmp_path / "runs").exists()


def test_a_constructor_that_takes_longer_than_the_worker_timeout_is_waited_for(tmp_path: Path, simulator: Path) -> None:
    slow = f"seconds|4|once|{tmp_path / 'once'}"
    settings = {"env-kwargs": slow, "worker-timeout-s": 1.5, "workers": 1}
    done = train("mysim:Sim-v0", tmp_path, simulator, settings)
    assert "silent for" not in done.stderr
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("number", [pytest.param(signal.SIGINT, marks=pytest.mark.soak), signal.SIGTERM])
def test_a_start_is_interrupted_within_2_s(stage: Stage, simulator: Path, number: int) -> None:
    folder = stage.tmp_path / "mine"
    command = [sys.executable, "-m", "millrace", "train", "mysim:Sim-v0", "--run-dir", str(folder)]
    running = stage.start([*with_path(simulator), *command, "--env-kwargs", "seconds", "60"], "train")
    wait_for(lambda: list(folder.glob("*/workers/w0.log")), START_S, "the start of a worker")
    time.sleep(4.0 * crowding())  # PyTorch is imported, and the workers are in the constructor
    began_s = time.monotonic()
    running.signal(number)
    assert running.ends() == 130, running.said()
    assert time.monotonic() - began_s < 2.0 * crowding()
    assert running.said().splitlines()[-1] == "millrace: interrupted"
    assert not folder.exists()


def test_a_description_that_exceeds_the_bounds_is_refused_and_the_next_is_used(stage: Stage) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    learner = stage.learner(address)
    learner.is_open()
    before_mb = learner.memory_mb()
    link = WorkerLink(address, "huge")
    try:
        link.send(encode(example(Hello, worker="huge", host="here", software="test")))
        order = wait_for(lambda: [m for m in link.receive() if isinstance(m, Describe)], START_S, "an order")[0]
        bounds = np.zeros(()), np.ones(())
        huge = BoxSpace((MAX_ELEMENTS, 4096), "float64", *bounds)
        nothing = np.frombuffer(pack({}), np.uint8)
        description = EnvDescription(huge, DiscreteSpace(2, 0, "int64"), nothing, "", 0, "")
        link.send(encode(Described(order.session, order.ticket, description)))
        refusal = wait_for(lambda: [m for m in link.receive() if isinstance(m, Refuse)], 10.0, "a refusal")[0]
    finally:
        link.close()
    assert f"observation space: expected at most {MAX_ELEMENTS} elements" in refusal.reason
    stage.worker(address, "w0")
    learner.trains(2)
    assert learner.memory_mb() < before_mb + 2000


# ------------------------------------------------------------------------------------------- vector environments


class Told(Countdown):
    """Tells where it was made."""

    def __init__(self, pids: str) -> None:
        super().__init__()
        with Path(pids).open("a") as file:
            file.write(f"{os.getpid()}\n")


def test_a_vector_environment_makes_no_copy_here(tmp_path: Path) -> None:
    pids = tmp_path / "pids"
    with millrace.make_vec(Told, 4, workers=2, pids=str(pids)) as envs:
        envs.reset(seed=1)
        assert str(os.getpid()) not in pids.read_text().split()
        assert len(set(pids.read_text().split())) == 2


class SlowToMake(Countdown):
    """Takes seconds to make, and longer in the process that begins second. `first`: a file that the first one creates."""

    def __init__(self, first: str) -> None:
        super().__init__()
        self.pid = os.getpid()
        try:
            Path(first).touch(exist_ok=False)
            time.sleep(2.0)
        except FileExistsError:
            time.sleep(3.5)


def test_a_vector_environment_waits_for_a_worker_that_is_still_describing_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The lanes of a vector environment don't move, so a worker that came too late would never get one."""
    monkeypatch.setattr(long_wait, "FIRST_S", 0.0)  # so that both workers are asked to describe it
    monkeypatch.setattr(step_hub, "PATIENCE_S", 0.0)
    with millrace.make_vec(SlowToMake, 2, workers=2, first=str(tmp_path / "first")) as envs:
        envs.reset(seed=1)
        assert len(set(envs.get_attr("pid"))) == 2


def test_the_spec_and_metadata_of_a_vector_environment_are_as_described() -> None:
    with millrace.make_vec("CartPole-v1", 2, workers=1, render_mode="rgb_array") as envs:
        copy: Any = gymnasium.make("CartPole-v1", render_mode="rgb_array")
        assert envs.get_attr("spec") == (envs.spec, envs.spec)
        assert envs.spec is not None
        assert (envs.spec.id, envs.spec.max_episode_steps) == (copy.spec.id, 500)
        assert envs.render_mode == "rgb_array"
        assert envs.metadata["render_fps"] == copy.metadata["render_fps"]
        assert envs.single_observation_space == copy.observation_space


class Broken(Countdown):
    """Cannot be made."""

    def __init__(self) -> None:
        raise OSError("no display")


def test_a_vector_environment_that_cannot_be_made_raises_with_the_worker_s_traceback() -> None:
    with pytest.raises(EnvironmentFailed, match="Broken cannot be made: OSError: no display") as caught:
        millrace.make_vec(Broken, 2, workers=1)
    assert "raise OSError" in caught.value.detail
    assert "raise OSError" in "".join(traceback.format_exception(caught.value))
    assert repr(caught.value.__cause__) == "OSError('no display')"
