"""Helpers for a run with a fault: start it, measure the time until training goes on, and end it.

Rule: at the end of the run every ticket and every transition is accounted for, whatever the fault was.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from tests.system.stage.network import Host, Network
from tests.system.stage.processes import START_S, TOY, WORKER_TIMEOUT_S, Learner, Running, Stage, Worker, crowding, free_port

LANES, ROWS = 4, 16 * 2  # rows of a rollout: T steps of N copies
IN_ROLLOUT = {"env-kwargs": "seconds 0.005"}  # a rollout takes 0.3 s, so that a fault happens during one
NOTICED_S = WORKER_TIMEOUT_S + 1  # a worker is silent, and new tickets are dealt in place of its tickets


def play(
    stage: Stage,
    settings: Mapping[str, object] = {},
    *,
    env: str = TOY,
    workers: int = 2,
    before: Sequence[str] = (),
) -> tuple[Learner, list[Worker]]:
    """Start a learner and workers on loopback, and wait until they train. `before`: words before the learner's command."""
    address = f"tcp://127.0.0.1:{free_port()}"
    learner = stage.learner(address, {"min-workers": workers, **settings}, env=env, before=before)
    started = [stage.worker(address, f"w{number}") for number in range(workers)]
    learner.trains(2)
    return learner, started


def far_apart(
    stage: Stage, network: Network, settings: Mapping[str, object] = {}
) -> tuple[Learner, list[Worker], list[Host], tuple[str, ...]]:
    """Start a learner and two workers, each on its own host (the learner on the first), and wait until they train.

    Returns also the hosts, and the flags with the token.
    """
    hosts = [network.host(number) for number in (1, 2, 3)]
    address = f"tcp://{hosts[0].address}:5555"
    keys, token = stage.keys()
    flags = ("--token", str(token))
    learner = stage.learner(address, {"min-workers": 2, "keys": keys, **settings}, before=hosts[0].before)
    workers = [stage.worker(address, f"w{number}", *flags, before=host.before) for number, host in enumerate(hosts[1:])]
    learner.trains(2)
    return learner, workers, hosts, flags


def within(row: str, seconds: float, bound_s: float) -> None:
    """Print how long it took until training went on. Fails if it took too long; a busy machine may take longer."""
    sys.stdout.write(f"\n{row}: {seconds:.2f} s (bound {bound_s:.1f} s, crowding {crowding():.1f})\n")
    assert seconds <= bound_s * crowding(), f"{row}: training went on after {seconds:.2f} s, expected {bound_s:.1f} s"


def dealt_again(learner: Learner) -> float:
    """Seconds until an update after tickets were lost and new ones were dealt in their place."""
    before = learner.ledger()["lost"]
    return learner.until(lambda row: row["ledger/lost"] > before, START_S, "an update with tickets dealt again")


def finish(learner: Learner, workers: Sequence[Running], **shape: int) -> dict[str, int]:
    """Send SIGTERM to the learner. It saves, its workers leave, and everything is accounted for. Returns the ledger."""
    learner.signal(signal.SIGTERM)
    assert learner.ends() == 130, learner.said()
    for worker in workers:
        assert worker.ends() == 0, worker.said()
    return accounted(learner.summary(), **shape)


def balanced(summary: dict[str, Any]) -> dict[str, int]:
    """Check that the ledger is a whole: tickets and transitions have each one end. Returns it."""
    ledger: dict[str, int] = summary["ledger"]
    assert ledger["issued"] == ledger["used"] + ledger["outstanding"] + ledger["lost"]
    named = sum(ledger[f"transitions_{why}"] for why in ("used", "waiting", "duplicate", "late", "invalid"))
    assert ledger["transitions_received"] == named
    assert all(count >= 0 for count in ledger.values()), ledger
    return ledger


def accounted(summary: dict[str, Any], lanes: int = LANES, rows: int = ROWS, max_lag: int = 0) -> dict[str, int]:
    """Check that every ticket and every transition is accounted for. Returns the ledger. `rows`: T · N of a rollout."""
    ledger = balanced(summary)
    assert ledger["used"] == lanes * summary["updates"], "an update was not made of one rollout of each lane"
    assert ledger["transitions_used"] == summary["env_steps"], "a transition was learned from and not counted"
    assert ledger["outstanding"] <= lanes * (1 + max_lag)
    assert ledger["transitions_waiting"] <= rows * ledger["outstanding"], "more waits than was asked for"
    return ledger
