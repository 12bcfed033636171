"""`millrace evaluate` and `millrace record` with workers that are started elsewhere: over TCP with a token, and over ipc.

Rule: the result is that of local workers, the workers leave with exit code 0 when all is played, and nothing is left.
"""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from learner.config.layers import resolve
from millrace.launch.local_run import train
from tests.system.processes import START_S, Running, Stage, crowding

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


@pytest.mark.parametrize("bind", ["tcp with keys", "tcp", "ipc"])
def test_an_evaluation_by_workers_from_elsewhere_is_that_of_local_ones(stage: Stage, run: Path, bind: str) -> None:
    evaluate = ["evaluate", run, "--episodes", 10]
    local = result(play(stage, "local", [*evaluate, "--workers", 1]))
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


@pytest.mark.parametrize("bind", ["tcp with keys", pytest.param("ipc", marks=pytest.mark.soak)])
def test_a_dataset_of_workers_from_elsewhere_is_that_of_local_ones(stage: Stage, run: Path, bind: str) -> None:
    pytest.importorskip("minari")
    keys, _ = stage.keys()
    variables: dict[str, object] = {"MINARI_DATASETS_PATH": stage.tmp_path / "datasets"}
    rows = {name: stage.tmp_path / f"{name}.npy" for name in ("local", "elsewhere")}

    def record(name: str, *more: object, **keys: object) -> Running:
        arguments = ["record", run, "--out", f"{name}/box-v0", "--steps", 300, "--npy", rows[name], *more]
        return play(stage, name, arguments, **variables, **keys)

    assert record("local", "--workers", 1).ends(START_S) == 0
    address = f"ipc://{stage.tmp_path}/socket" if bind == "ipc" else ANY_PORT
    player = record("elsewhere", "--bind", address, **({"MILLRACE_KEYS": keys} if bind == "tcp with keys" else {}))
    worker = join(stage, player, "w0")
    assert player.ends(START_S) == 0, player.said()
    assert rows["elsewhere"].read_bytes() == rows["local"].read_bytes()
    assert (stage.tmp_path / "datasets" / "elsewhere" / "box-v0").is_dir()
    assert worker.ends() == 0, worker.said()


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
