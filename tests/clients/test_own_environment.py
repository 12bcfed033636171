"""An environment that only a client has: no Python package registers Corridor-v0."""

from __future__ import annotations

import signal

import gymnasium
import pytest

import millrace as millrace_package
from tests.clients.programs import IN_LEARNER, Clients, ends_well, last_line, learner, loopback, millrace, resumed
from tests.system.stage.processes import START_S, Stage

pytestmark = [pytest.mark.clients, pytest.mark.timeout(600)]

OF_CORRIDOR = ("--eval-every", 2_000, "--learning-rate", 0.003)
NOT_REGISTERED = "environment Corridor-v0 is not registered"
HOW = "one of a client in another language needs the client (--bind)"


def greedy_return(policy: millrace_package.LoadedPolicy) -> float:
    """Of an episode in the corridor: five steps to the right end it, or 50 in all."""
    at, steps = 0, 0
    while at != 5 and steps < 50:
        at, steps = at + (1 if policy([at]) == 1 else -1), steps + 1
    return 1 - 0.01 * (steps - 1) if at == 5 else -0.01 * steps


@pytest.mark.parametrize(("language", "inference"), [("js", IN_LEARNER), ("cpp", IN_LEARNER), ("cpp", ())])
def test_it_is_trained_evaluated_and_resumed(
    stage: Stage, clients: Clients, language: str, inference: tuple[str, ...]
) -> None:
    assert "Corridor-v0" not in gymnasium.registry
    corridor, address = clients[f"{language} corridor"], loopback()
    runs = learner(stage, address, *inference, *OF_CORRIDOR, env="Corridor-v0", steps=6_000)
    client = corridor.start(address)
    assert "greedy return 1.0 ± 0.0 over 2 episodes" in ends_well(runs), "five steps to the right: 1 - 4 · 0.01"
    ends_well(client)
    folder, before = runs.folder, runs.summary()["env_steps"]

    again = resumed(stage, runs, address, "--steps", 9_000)
    client = corridor.start(address)
    ends_well(again)
    ends_well(client)
    assert before < runs.summary()["env_steps"] <= 9_000
    reached = runs.summary()["evaluation"]["return_mean"]  # a later policy may be worse, on one processor and not on another

    player = millrace(stage, "player", "evaluate", folder, "--episodes", 5, "--bind", address, *inference)
    client = corridor.start(address)
    assert last_line(player, 0) == f"return {reached:.1f} ± 0.0 over 5 episodes"
    ends_well(client)

    assert greedy_return(millrace_package.load(folder)) == pytest.approx(reached)
    assert last_line(millrace(stage, "status", "status", folder), 0).startswith("greedy return ")
    for command in ("report", "plot"):
        ends_well(millrace(stage, command, command, folder))


def test_commands_that_start_python_workers_say_what_to_do(stage: Stage, clients: Clients) -> None:
    """In one line: `train`, and `evaluate` and `record` of a run folder."""
    pytest.importorskip("minari")
    corridor, address = clients["cpp corridor"], loopback()
    runs = learner(stage, address, env="Corridor-v0", steps=1_200)
    client = corridor.start(address)
    ends_well(runs)
    ends_well(client)
    last = last_line(millrace(stage, "train", "train", "Corridor-v0", "--run-dir", stage.tmp_path / "none"), 2)
    assert NOT_REGISTERED in last
    assert HOW in last
    assert not (stage.tmp_path / "none").exists()
    out = ("--out", "corri/dor-v0", "--steps", 10)
    for words, code in ((("evaluate", runs.folder), 1), (("record", runs.folder, *out), 2)):
        last = last_line(millrace(stage, str(words[0]), *words), code)
        assert NOT_REGISTERED in last
        assert HOW in last


def test_the_learner_takes_the_spaces_from_the_client_and_compares_other_workers_with_them(
    stage: Stage, clients: Clients
) -> None:
    """A Python worker, and a client with another environment, are refused by name. The run goes on without them."""
    corridor, cartpole, address = clients["js corridor"], clients["cpp cartpole"], loopback()
    runs = learner(stage, address, *IN_LEARNER, env="Corridor-v0", steps=1_000_000)
    python, other = stage.worker(address, "python"), cartpole.start(address, "other")
    assert python.ends(START_S) == 2
    assert other.ends(START_S) == 2
    assert "this client has the environment CartPole-v1, the learner asks for Corridor-v0" in other.said()
    runs.hears("worker python was refused: environment Corridor-v0 is not registered", START_S)
    runs.hears("worker other was refused: this client has the environment CartPole-v1", START_S)
    client = corridor.start(address)
    runs.trains(2)
    late = cartpole.start(address, "late")
    assert late.ends(START_S) == 2
    runs.trains(2)
    runs.signal(signal.SIGINT)
    assert runs.ends(60) == 130
    ends_well(client)


def test_a_client_joins_a_learner_that_is_killed_and_resumed_twice(stage: Stage, clients: Clients) -> None:
    """One JavaScript client serves three learner processes of a run, and leaves with the last."""
    cartpole, address = clients["js cartpole"], loopback()
    flags = ("--checkpoint-every-s", 0, "--worker-timeout-s", 2, *IN_LEARNER)
    runs = learner(stage, address, *flags, steps=1_000_000)
    client = cartpole.start(address)
    for kill in (1, 2):
        runs.trains(2)
        runs.kill()
        runs = resumed(stage, runs, address)
        client.hears("joining again", START_S, times=1 + kill)  # once after it has described the environment
    runs.trains(2)
    runs.signal(signal.SIGINT)
    assert runs.ends(60) == 130
    ends_well(client)
    ledger = runs.ledger()
    assert ledger["issued"] == sum(ledger[kind] for kind in ("used", "lost", "outstanding"))
