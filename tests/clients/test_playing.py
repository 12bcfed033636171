"""Evaluations and recordings whose episodes clients play: in a run between its rollouts, and of a run folder."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from millrace.launch.training import train
from millrace.learner.config.layers import resolve
from tests.clients.programs import IN_LEARNER, Clients, ends_well, last_line, learner, loopback, millrace
from tests.system.stage.processes import START_S, Learner, Stage

pytestmark = [pytest.mark.clients, pytest.mark.timeout(600)]

ROBOT = ("--hz", 1_000, "--deadline-ms", 1e6)
"""of control_50hz: faster than a robot, and no action is late"""
SHORT = ("--rollout-steps", 64)
ONE_COPY = ("--lanes", 1, "--envs", 1, *SHORT)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The folder of a short run."""
    settings: dict[str, Any] = {"steps": 1_024, "rollout_steps": 64, "n_epochs": 1, "eval_episodes": 1, "net": (8,)}
    config = resolve("CartPole-v1", transport="inproc", workers=1, run_dir=str(tmp_path / "trained"), **settings)
    return train(config, None, lambda progress: None)


def evaluations(runs: Learner, every: int) -> list[float]:
    """The mean returns of the evaluations of a run, oldest first: after each update that reaches a multiple of `every`."""
    found, before = [], 0
    for row in runs.rows():
        is_due = row["time/total_timesteps"] // every > before // every
        assert ("eval/mean_reward" in row) is is_due, row
        found += [row["eval/mean_reward"]] if is_due else []
        before = row["time/total_timesteps"]
    return found


def wrong_steps(observations: Any) -> int:
    """How many steps of an episode of CartPole are not what its equations say: the position moves by 0.02 of the speed."""
    x, speed = np.asarray(observations, np.float64)[:, :2].T
    return int(np.count_nonzero(np.abs(x[1:] - x[:-1] - 0.02 * speed[:-1]) > 1e-5))


@pytest.fixture
def datasets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Minari datasets, for the test and for the processes that it starts."""
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))


def whole_episodes(dataset: str) -> list[int]:
    """The lengths of the episodes of a dataset. Fails if one is not a whole episode of CartPole."""
    minari = pytest.importorskip("minari")
    observations = [episode.observations for episode in minari.load_dataset(dataset).iterate_episodes()]
    for seen in observations:
        assert np.abs(seen[0]).max() <= 0.05, "it does not begin with a reset"
        assert wrong_steps(seen) == 0
    return [len(seen) - 1 for seen in observations]


# ---------------------------------------------------------------- in a run


@pytest.mark.parametrize(
    ("program", "flags", "of_client"),
    [
        ("cpp cartpole", SHORT, ()),
        ("cpp cartpole", (*SHORT, *IN_LEARNER), ()),
        ("js cartpole", (*SHORT, *IN_LEARNER), ()),
        ("cpp cartpole", ONE_COPY, ()),
        ("cpp control_50hz", ONE_COPY, ROBOT),
        ("cpp control_50hz", (*ONE_COPY, "--max-lag", 1), ROBOT),
    ],
)
def test_a_run_evaluates_on_its_clients_between_rollouts(
    stage: Stage,
    clients: Clients,
    datasets: None,
    program: str,
    flags: tuple[object, ...],
    of_client: tuple[object, ...],
) -> None:
    """At each multiple of --eval-every and at the end; also on a single environment, whose owner drives it.

    With --record, whole episodes of training are recorded, without a hole.
    """
    owner = clients[program]
    address, steps = loopback(), 2_000 if "--envs" in flags else 4_000
    runs = learner(stage, address, "--eval-every", steps // 4, "--record", "cart/pole-v0", *flags, steps=steps)
    client = owner.start(address, "client", *of_client)
    ends_well(runs)
    ends_well(client)
    found = evaluations(runs, steps // 4)
    assert len(found) >= 3
    assert all(1 <= each <= 500 for each in found)
    ledger = runs.summary()["ledger"]
    assert ledger["transitions_invalid"] == ledger["messages_bad"] == ledger["late_actions"] == 0
    assert steps // 2 < ledger["transitions_used"] <= steps
    lengths = whole_episodes("cart/pole-v0")
    assert lengths
    assert sum(lengths) <= ledger["transitions_used"]


# ---------------------------------------------------------------- of a run folder


def test_a_client_that_only_steps_plays_what_a_python_worker_plays(
    stage: Stage, clients: Clients, datasets: None, run: Path
) -> None:
    """Bit for bit: the C++ CartPole has gymnasium's dynamics and random numbers."""
    cartpole = clients["cpp cartpole"]
    evaluate, record = ("evaluate", run, "--episodes", 10), ("record", run, "--steps", 300)
    local, address = last_line(millrace(stage, "local", *evaluate), 0), loopback()
    player = millrace(stage, "player", *evaluate, "--bind", address, *IN_LEARNER)
    client = cartpole.start(address)
    assert last_line(player, 0) == local
    ends_well(client)
    rows = {name: stage.tmp_path / f"{name}.npy" for name in ("local", "client")}
    ends_well(millrace(stage, "record", *record, "--out", "cart/local-v0", "--npy", rows["local"]))
    words = ("--out", "cart/client-v0", "--npy", rows["client"], "--bind", address, *IN_LEARNER)
    player = millrace(stage, "recorder", *record, *words)
    client = cartpole.start(address)
    ends_well(player)
    ends_well(client)
    assert rows["client"].read_bytes() == rows["local"].read_bytes()


@pytest.mark.parametrize(
    ("program", "of_client"), [("cpp cartpole", ()), ("cpp control_50hz", ROBOT)], ids=["library drives", "program drives"]
)
def test_a_client_that_acts_is_evaluated(
    stage: Stage, clients: Clients, run: Path, program: str, of_client: tuple[object, ...]
) -> None:
    plays, address = clients[program], loopback()
    player = millrace(stage, "player", "evaluate", run, "--episodes", 6, "--bind", address)
    client = plays.start(address, "client", *of_client)
    assert " over 6 episodes" in last_line(player, 0)
    ends_well(client)


@pytest.mark.parametrize(
    ("program", "command", "why"),
    [
        ("cpp cartpole", "record", "the C++ client does not record episodes by itself; add --inference learner"),
        ("cpp control_50hz", "record", "a program that owns its loop does not record episodes; train with --record"),
        ("js cartpole", "record", "this client does not act: it needs --inference learner, or millrace.make_vec"),
        ("js cartpole", "evaluate", "this client does not act: it needs --inference learner, or millrace.make_vec"),
    ],
)
def test_a_client_says_in_one_line_what_it_cannot_play(
    stage: Stage, clients: Clients, datasets: None, run: Path, program: str, command: str, why: str
) -> None:
    """It leaves with exit code 2, and the player says so too, and waits for another."""
    declines, address = clients[program], loopback()
    out = ("--out", "cart/pole-v0", "--steps", 100) if command == "record" else ()
    player = millrace(stage, "player", command, run, *out, "--bind", address)
    client = declines.start(address)
    assert client.ends(START_S) == 2
    assert why in client.said()
    player.hears(re.escape(f"left: {why}"))
    assert player.alive()


def test_no_client_is_filmed(stage: Stage, clients: Clients, run: Path) -> None:
    pytest.importorskip("moviepy")
    cartpole, address = clients["cpp cartpole"], loopback()
    player = millrace(stage, "player", "evaluate", run, "--video", "--bind", address)
    cartpole.start(address)
    assert "CartPole-v1 cannot be filmed: expected it to render rgb_array" in last_line(player, 2)
