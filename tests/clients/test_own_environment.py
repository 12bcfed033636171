"""An environment that only a client has: no Python package registers Corridor-v0, or Nim-v0, which has two agents."""

from __future__ import annotations

import re
import signal
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from msgspec.structs import replace

import millrace as millrace_package
from millrace.protocol.arrays import Array
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.seats import SeatedEnv, seated
from millrace.protocol.messages import Goodbye, Welcome
from millrace.protocol.policy.called_policy import Acted, CalledPolicy
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec, RunSpec, StepSpec
from millrace.protocol.wire.codec import encode
from millrace.workers.collect.collector import Collector
from millrace.workers.copies.seated_copies import SeatedCopies
from tests.clients.messages_to_clients import OBSERVATION, POLICY, STEP
from tests.clients.programs import (
    IN_LEARNER,
    Clients,
    FalseLearner,
    ends_well,
    last_line,
    learner,
    loopback,
    millrace,
    resumed,
)
from tests.support.in_process.collectors import collect
from tests.support.users_code.client_games import Nim, Tag
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
        client.hears("joining again", START_S, times=kill)
    runs.trains(2)
    runs.signal(signal.SIGINT)
    assert runs.ends(60) == 130
    ends_well(client)
    ledger = runs.ledger()
    assert ledger["issued"] == sum(ledger[kind] for kind in ("used", "lost", "outstanding"))


# ------------------------------------------------------------------------------------------------------- several agents


def test_its_agents_are_trained_evaluated_and_resumed(stage: Stage, clients: Clients) -> None:
    nim, address = clients["cpp nim"], loopback()
    runs = learner(stage, address, env="Nim-v0", steps=6_000)
    client = nim.start(address)
    assert "greedy return 0.0 ± 0.0 over 2 episodes, return_first " in ends_well(runs), "what one wins the other loses"
    ends_well(client)
    before = runs.summary()["env_steps"]
    for steps in (before, 9_000):
        if steps > before:
            again = resumed(stage, runs, address, "--steps", steps)
            client = nim.start(address)
            ends_well(again)
            ends_well(client)
        summary = runs.summary()
        for facts in (summary["facts_100"], summary["evaluation"]["facts"]):
            first, second = (facts[f"return_{agent}"]["mean"] for agent in ("first", "second"))
            assert first == pytest.approx(-second)
            assert -1 <= first <= 1
        assert summary["ledger"]["transitions_invalid"] == summary["ledger"]["messages_bad"] == 0
    player = millrace(stage, "player", "evaluate", runs.folder, "--episodes", 5, "--bind", address)
    client = nim.start(address)
    assert last_line(player, 0).startswith("return 0.0 ± 0.0 over 5 episodes, return_first ")
    ends_well(client)


class Replayed(CalledPolicy):
    """Does what was done in these rows, in their order."""

    def __init__(self, action: Array, log_prob: Array) -> None:
        self._rows = iter(zip(action, log_prob, strict=True))

    def act(self, leaves: Any, state: Any, rng: np.random.Generator, **keywords: Any) -> Acted:
        action, log_prob = next(self._rows)
        return Acted(action, state, (log_prob,))


@pytest.mark.parametrize("game", [Tag, Nim])
def test_the_rows_of_its_agents_are_a_python_workers_to_the_bit(game: type[Tag | Nim], clients: Clients) -> None:
    """Given the first observations of episodes, and what was done with which log-probability."""
    name, address, A = game.__name__, loopback(), len(game.possible_agents)
    client = clients[f"cpp {name.lower()}"].start(address)
    settings: dict[str, Any] = {"envs": 3, "lanes": 1, "bind": address}
    with millrace_package.RolloutService(f"{name}-v0", rollout_steps=25, **settings) as service:
        run, batches = service.run, list[Any]()
        while len(batches) < 8:
            service.publish(service.policy.initial(seed=len(batches)))
            batches.append(service.gather())
    ends_well(client)

    action, log_prob, resets, after = (
        np.concatenate(rows)
        for rows in zip(*((each.action, each.log_prob, each.resets[:-1], each.obs[1:]) for each in batches), strict=True)
    )

    def made(n: int) -> SeatedEnv:
        return seated(game(iter([batches[0].obs[0, n * A], *after[resets[:, n], n * A]])), name)

    makes = [partial(made, n) for n in range(3)]
    twin = Collector(run, Replayed(action, log_prob), lambda run, lane, pulse: SeatedCopies(makes, pulse, run.seats))
    ends = 0
    for k, batch in enumerate(batches):
        (expected,) = collect(twin, run, k)
        assert batch.obs.tobytes() == expected.obs[0].tobytes()
        for each in ("action", "log_prob", "reward", "terminated", "truncated", "valid", "resets"):
            assert getattr(batch, each).tobytes() == getattr(expected, each).tobytes(), each
        episodes = [[(one.reward, one.length, one.facts) for one in rows.episodes] for rows in (batch, expected)]
        assert episodes[0] == episodes[1]
        ends += len(episodes[0])
    assert ends > 20


@pytest.mark.parametrize(
    ("mistakes", "says"),
    [
        (("WRONG=returns",), "agent (ann|bob): expected no action after its part of the episode"),
        (("WRONG=nobody",), "reset: expected an agent that acts"),
        (("WRONG=vanishes",), "agent (ann|bob|cid): expected that it acts again, or that its part of the episode ends"),
        (("WRONG=waits", "ALL=1"), "agent (ann|bob|cid): expected that it acts again, or that its part of the episode ends"),
    ],
)
def test_what_an_environment_with_agents_does_wrong_is_said_in_a_line(
    stage: Stage, cpp: Path, mistakes: tuple[str, ...], says: str
) -> None:
    address = loopback()
    runs = learner(stage, address, env="Gathering-v0", steps=100_000)
    client = stage.start(["env", *mistakes, str(cpp / "gathering"), address, "--name", "wrong"], "wrong")
    assert re.search(f"^lane [0-9]+: its environment raised: {says}$", last_line(client, 1))
    runs.hears(f"its environment raised: {says}")


AGENTS = ("black", "white")
NO_AGENTS = "CartPole-v1: expected agents that take turns: black, white, this client has agents: none"
NO_SEATS = "this client has no environment of several agents, the learner asks for black, white"


def run_of(env: str, **fields: Any) -> RunSpec:
    """A run of an environment of the clients."""
    observation = Leaf("", "discrete", (), "int64", (21,), (0,)) if env == "Nim-v0" else OBSERVATION
    action = ActionSpec("discrete", (), "int64", (3,), (1,)) if env == "Nim-v0" else POLICY.action
    return RunSpec(EnvSpec(env), PolicySpec((observation,), action, **fields), 8, 1, 1, 0)


def of_agents(env: str) -> RunSpec:
    return replace(run_of(env), seats=AGENTS, takes_turns=True)


def stepped(env: str) -> StepSpec:
    return replace(STEP, envs=(EnvSpec(env),), seats=AGENTS)


@pytest.mark.parametrize(
    ("client", "run", "says"),
    [
        ("cpp cartpole", of_agents("CartPole-v1"), NO_AGENTS),
        ("cpp cartpole", stepped("CartPole-v1"), "expected agents: black, white, this client has agents: none"),
        ("cpp cartpole", run_of("CartPole-v1", critic=(OBSERVATION,)), "not support observations that only the critic sees"),
        ("cpp nim", of_agents("Nim-v0"), NO_AGENTS[13:].replace("agents: none", "agents that take turns: first, second")),
        ("cpp nim", replace(of_agents("Nim-v0"), teams=((0,), (1,))), "opponents that play some of the agents"),
        ("cpp control_50hz", of_agents("CartPole-v1"), NO_AGENTS),
        ("js cartpole", of_agents("CartPole-v1"), NO_SEATS),
        ("js cartpole", stepped("CartPole-v1"), NO_SEATS),
        ("page", of_agents("GridWorld-v0"), "expected --inference learner, GridWorld-v0; got RunSpec"),
        ("page", stepped("GridWorld-v0"), "GridWorld-v0; got StepSpec, [{'id': 'GridWorld-v0'}], ['black', 'white']"),
    ],
)
def test_what_the_environment_of_a_client_does_not_have_is_declined_in_a_line(
    clients: Clients, client: str, run: RunSpec | StepSpec, says: str
) -> None:
    program = clients[client]
    with FalseLearner() as false:
        started = program.start(false.address)
        peer, hello = false.hello()
        false.socket.send_multipart([peer, *encode(Welcome(5, hello.attempt, run))])
        goodbye = false.heard(Goodbye)
        assert says in goodbye.reason
        assert goodbye.session == 5
        assert started.ends() == 2
        assert says in started.said()
