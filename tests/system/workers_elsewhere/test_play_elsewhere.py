"""`millrace evaluate` and `millrace record` with workers that are started elsewhere: over TCP with a token, and over ipc.

Rule: the result is that of local workers, the workers leave with exit code 0 when all is played, and nothing is left.
"""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import pytest

import millrace
from millrace.launch.policy_workers import PlayingWorkers, policy_player
from millrace.launch.training import train
from millrace.learner.config.layers import resolve
from millrace.learner.policy_player import saved_policy
from millrace.learner.rollouts.evaluation_dealer import EvaluationPlan
from millrace.protocol.errors import UsageError
from tests.system.stage.local_runs import worker_processes
from tests.system.stage.processes import START_S, Running, Stage, crowding, free_port

ANY_PORT = "tcp://127.0.0.1:*"
MILLRACE = (sys.executable, "-m", "millrace")


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The folder of a short run."""
    settings: dict[str, Any] = {"steps": 1_024, "rollout_steps": 64, "n_epochs": 1, "eval_episodes": 1, "net": (8,)}
    config = resolve("CartPole-v1", transport="inproc", workers=1, run_dir=str(tmp_path / "trained"), **settings)
    return train(config, None, lambda progress: None)


def play(stage: Stage, name: str, arguments: Sequence[object], **variables: object) -> Running:
    """Start `millrace evaluate` or `millrace record`, without keys of the user's own."""
    environment = [
        "env",
        "-u",
        "MILLRACE_TOKEN",
        "-u",
        "MILLRACE_KEYS",
        *(f"{key}={text}" for key, text in variables.items()),
    ]
    return stage.start([*environment, *MILLRACE, *map(str, arguments)], name)


def worker_for(player: Running) -> list[str]:
    """The command that the line for people names."""
    return player.hears("start one with: ", START_S).partition("start one with: ")[2].split()


def join(stage: Stage, player: Running, name: str) -> Running:
    """Start a worker with the command that the line for people names."""
    command, *arguments = worker_for(player)
    assert command == "millrace"
    return stage.start(["env", "-u", "MILLRACE_TOKEN", *MILLRACE, *arguments, "--name", name], name)


def result(player: Running) -> str:
    """What it printed at its end, without the lines for people."""
    assert player.ends(START_S) == 0, player.said()
    return [line for line in player.said().splitlines() if "waiting for" not in line][-1]


@pytest.mark.parametrize(
    ("bind", "inference"),
    [("tcp with keys", "workers"), ("tcp", "workers"), ("ipc", "workers"), ("tcp with keys", "learner")],
)
def test_an_evaluation_by_workers_from_elsewhere_is_that_of_local_ones(
    stage: Stage, run: Path, bind: str, inference: str
) -> None:
    evaluate = ["evaluate", run, "--episodes", 10, "--inference", inference]
    local = result(play(stage, "local", ["evaluate", run, "--episodes", 10, "--workers", 1]))
    keys, _ = stage.keys()
    variables = {"MILLRACE_KEYS": keys} if bind == "tcp with keys" else {}
    address = f"ipc://{stage.tmp_path}/socket" if bind == "ipc" else ANY_PORT
    player = play(stage, "evaluate", [*evaluate, "--bind", address], **variables)
    assert ("--token" in worker_for(player)) == (bind == "tcp with keys")
    worker = join(stage, player, "w0")
    assert result(player) == local
    assert "return" in local
    assert worker.ends() == 0, worker.said()


def test_a_worker_without_a_token_is_not_let_in_and_one_with_it_plays(stage: Stage, run: Path) -> None:
    keys, _ = stage.keys()
    player = play(stage, "evaluate", ["evaluate", run, "--episodes", 2, "--bind", ANY_PORT], MILLRACE_KEYS=keys)
    address = worker_for(player)[2]
    stranger = stage.worker(address, "stranger")
    stranger.hears("perhaps it asks for a key: give this worker --token FILE", START_S)
    assert player.alive()
    stranger.signal(signal.SIGTERM)
    stranger.ends()
    worker = join(stage, player, "w0")
    assert "return" in result(player)
    assert worker.ends() == 0, worker.said()


@pytest.mark.parametrize(
    ("bind", "inference"),
    [("tcp with keys", "workers"), ("tcp", "learner"), pytest.param("ipc", "workers", marks=pytest.mark.soak)],
)
def test_a_dataset_of_workers_from_elsewhere_is_that_of_local_ones(
    stage: Stage, run: Path, bind: str, inference: str
) -> None:
    pytest.importorskip("minari")
    keys, _ = stage.keys()
    variables: dict[str, object] = {"MINARI_DATASETS_PATH": stage.tmp_path / "datasets"}
    rows = {name: stage.tmp_path / f"{name}.npy" for name in ("local", "elsewhere")}

    def record(name: str, *more: object, **keys: object) -> Running:
        flags = ["--steps", 300, "--npy", rows[name], *more]
        arguments = ["record", run, "--out", f"{name}/box-v0", *flags]
        return play(stage, name, arguments, **variables, **keys)

    assert record("local", "--workers", 1).ends(START_S) == 0
    address = f"ipc://{stage.tmp_path}/socket" if bind == "ipc" else ANY_PORT
    player = record(
        "elsewhere",
        "--bind",
        address,
        "--inference",
        inference,
        **({"MILLRACE_KEYS": keys} if bind == "tcp with keys" else {}),
    )
    worker = join(stage, player, "w0")
    assert player.ends(START_S) == 0, player.said()
    assert rows["elsewhere"].read_bytes() == rows["local"].read_bytes()
    assert (stage.tmp_path / "datasets" / "elsewhere" / "box-v0").is_dir()
    assert worker.ends() == 0, worker.said()


@pytest.mark.parametrize("inference", ["workers", "learner"])
def test_the_policy_may_act_here(run: Path, inference: Literal["workers", "learner"]) -> None:
    """With two processes over ipc, the result is that of one worker in this process. No worker is left."""
    alone = millrace.evaluate(run, 6, transport="inproc", progress=False)
    assert millrace.evaluate(run, 6, inference=inference, workers=2, progress=False) == alone
    assert not worker_processes()


def test_a_lost_worker_costs_its_episodes_only(stage: Stage, run: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The policy acts here, and the worker that steps is killed: the next worker plays its episodes from their seeds."""
    address, plan = f"tcp://127.0.0.1:{free_port()}", EvaluationPlan.of(40, 1, 4, 100_000)
    workers = [stage.worker(address, "first")]

    def watch(text: str) -> None:
        if len(workers) == 1 and not text.startswith("0 of"):
            workers[0].kill()
            workers.append(stage.worker(address, "second"))

    played = []
    for which in (PlayingWorkers(bind=address, inference="learner", copies=4), PlayingWorkers(1, "inproc")):
        with policy_player(saved_policy(run), which, watch) as player:
            played.append([(one.episode.reward, one.episode.length, one.cut) for one in player.play(plan)])
    assert played[0] == played[1]
    assert "worker first silent" in caplog.text
    assert workers[1].ends() == 0


def test_only_a_worker_that_acts_films(run: Path) -> None:
    with pytest.raises(UsageError, match="video: expected inference workers, got learner"):
        millrace.evaluate(run, 1, inference="learner", video=True)


@pytest.mark.parametrize("command", ["evaluate", "record"])
def test_a_signal_while_it_waits_for_workers_ends_it_at_once(stage: Stage, run: Path, command: str) -> None:
    if command == "record":
        pytest.importorskip("minari")
    more = ["--out", "never/box-v0"] if command == "record" else []
    datasets = stage.tmp_path / "datasets"
    player = play(stage, command, [command, run, *more, "--bind", ANY_PORT], MINARI_DATASETS_PATH=datasets)
    worker_for(player)
    time.sleep(1.0)
    began_s = time.monotonic()
    player.signal(signal.SIGINT)
    assert player.ends() == 130, player.said()
    assert time.monotonic() - began_s < 2.0 * crowding()
    assert player.said().splitlines()[-1] == "millrace: interrupted"
    assert not list(datasets.rglob("*.hdf5"))
