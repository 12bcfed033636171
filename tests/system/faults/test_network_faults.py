"""Runs whose network is bad or cut, or is used by strangers.

Hosts are network namespaces (root, `ip`, `nft`). Tests that do not need them use a proxy on loopback.
"""

from __future__ import annotations

import os
import sys
import time

import pytest

from millrace.protocol.messages import PROTOCOL_VERSION
from millrace.workers.worker import CONNECT_AGAIN_S
from tests.system.faults.rubbish import talk_rubbish
from tests.system.stage.network import Network
from tests.system.stage.processes import START_S, Stage, free_port, wait_for
from tests.system.stage.proxy import Proxy
from tests.system.stage.runs import NOTICED_S, dealt_again, far_apart, finish, play, within

LEARNER_TIMEOUT_S = 30.0  # after so long a worker says Hello again
AGAIN_S = 5.0  # after a cut: at most 2 s until a connection attempt fails, 2 s until the next attempt, and a Hello

# ---------------------------------------------------------------- cut, and healed


@pytest.mark.parametrize("cut_s", [4, pytest.param(30, marks=pytest.mark.soak)])
def test_a_worker_joins_again_after_its_network_was_cut(stage: Stage, network: Network, cut_s: float) -> None:
    learner, workers, (_, far, _), _ = far_apart(stage, network)
    far.cut()
    began_s = time.monotonic()
    within("a worker's network cut", dealt_again(learner), NOTICED_S)
    learner.hears("worker w0 silent for 2 s")
    time.sleep(cut_s - (time.monotonic() - began_s))  # long enough that TCP waits long between two attempts
    far.heal()
    began_s = time.monotonic()
    learner.hears(r"worker w0 \(.*\) joined", times=2)
    within(f"healed after {cut_s} s, joined again", time.monotonic() - began_s, AGAIN_S)
    learner.trains()
    finish(learner, workers)


@pytest.mark.soak
def test_workers_join_again_after_the_learners_network_was_cut(stage: Stage, network: Network) -> None:
    learner, workers, (here, *_), _ = far_apart(stage, network)
    here.cut()
    learner.hears("worker w[01] silent for 2 s", times=2)
    time.sleep(4)
    here.heal()
    began_s = time.monotonic()
    learner.trains(1)
    within("the learner's network cut for 6 s and healed", time.monotonic() - began_s, AGAIN_S)
    learner.trains()
    finish(learner, workers)


def test_a_worker_on_a_vanished_host_joins_again_under_its_name(stage: Stage, network: Network) -> None:
    """The learner's connection to the host is half-open. A new worker of the same name is not locked out."""
    learner, (gone, other), (here, far, _), token = far_apart(stage, network, {"worker-timeout-s": 20})
    far.cut()
    gone.kill()
    far.vanish()
    far = network.host(2)
    began_s = time.monotonic()
    back = stage.worker(f"tcp://{here.address}:5555", "w0", *token, before=far.before)
    dealt_again(learner)
    within("its host vanished, the same name came back", time.monotonic() - began_s, 4.0)
    learner.hears(r"worker w0 replaced by process \d+; \d of its tickets are dealt again")
    learner.trains()
    finish(learner, [back, other])


@pytest.mark.soak
def test_the_connection_to_a_vanished_host_is_closed(stage: Stage, network: Network) -> None:
    """The worker sends no Goodbye, and the learner sends nothing to it. The learner still closes the connection."""
    learner, (gone, other), (_, far, _), _ = far_apart(stage, network)
    far.cut()
    gone.kill()
    far.vanish()
    within("its host vanished for good", dealt_again(learner), NOTICED_S)
    before = learner.descriptors()
    began_s = time.monotonic()
    wait_for(lambda: learner.descriptors() < before, 60, "the end of its connection")
    within("its connection closed", time.monotonic() - began_s, 30.0)
    finish(learner, [other])


@pytest.mark.soak
def test_workers_join_a_learner_whose_host_vanished_and_came_back(stage: Stage, network: Network) -> None:
    """The workers' connections are half-open, and the workers are not notified."""
    learner, workers, (here, *_), _ = far_apart(stage, network, {"checkpoint-every-s": 0.3})
    wait_for(lambda: len(learner.checkpoints()) >= 2, START_S, "the second checkpoint")
    here.cut()
    learner.kill()
    here.vanish()
    seen = learner.rows()[-1]["time/total_timesteps"]  # its last rows may be newer than its last checkpoint
    time.sleep(3)
    here = network.host(1)
    again = stage.learner(f"tcp://{here.address}:5555", resume=learner.folder, before=here.before)
    again.is_open()
    seconds = again.until(
        lambda row: row["time/total_timesteps"] > seen, START_S, "an update after those of the first learner"
    )
    within("the learner's host vanished, resumed at its address", seconds, AGAIN_S)
    finish(again, workers)


# ---------------------------------------------------------------- bad


@pytest.mark.parametrize(
    ("percent", "bound_s"),
    [(1, 4.0), pytest.param(10, 15.0, marks=pytest.mark.soak), pytest.param(30, 60.0, marks=pytest.mark.soak)],
)
def test_training_goes_on_while_packets_are_lost(stage: Stage, network: Network, percent: int, bound_s: float) -> None:
    learner, workers, (_, *far), _ = far_apart(stage, network)
    for host in far:
        host.lose(percent)
    began_s = time.monotonic()
    learner.trains(10)
    within(f"ten updates while {percent} % of packets are lost, each way", time.monotonic() - began_s, bound_s)
    for host in far:
        host.lose(0)
    learner.trains()
    finish(learner, workers)


@pytest.mark.soak
def test_training_goes_on_over_a_slow_line(stage: Stage, network: Network) -> None:
    """Sending weights or a rollout takes longer than the interval between heartbeats."""
    learner, workers, (_, *far), _ = far_apart(stage, network)
    for host in far:
        host.slow(32)
    began_s = time.monotonic()
    learner.trains(10)
    seconds = time.monotonic() - began_s
    within("ten updates over 32 kbit/s", seconds, 15.0)
    assert seconds > 1.0, "the line is not thin"
    for host in far:
        host.slow(0)
    learner.trains()
    finish(learner, workers)


def test_training_goes_on_with_latency_and_small_pieces(stage: Stage) -> None:
    port = free_port()
    learner = stage.learner(f"tcp://127.0.0.1:{port}", {"min-workers": 2})
    with Proxy(port) as far:
        workers = [stage.worker(far.address, f"w{number}") for number in range(2)]
        learner.trains(2)
        far.latency_s, far.slice_bytes = 0.2, 100
        learner.trains(2)
        began_s = time.monotonic()
        learner.trains(2)
        within("two updates over 200 ms each way, in pieces of 100 bytes", time.monotonic() - began_s, 2.0)
        assert learner.ledger()["lost"] == 0
        assert "silent" not in learner.said()
        far.latency_s, far.slice_bytes = 0.0, 0
        finish(learner, workers)


def test_no_worker_is_lost_when_connections_are_reset(stage: Stage) -> None:
    """Messages on their way are lost, and heartbeats repair this. No worker is removed, and no ticket is lost."""
    port = free_port()
    learner = stage.learner(f"tcp://127.0.0.1:{port}", {"min-workers": 2})
    with Proxy(port) as way:
        workers = [stage.worker(way.address, f"w{number}") for number in range(2)]
        learner.trains(2)
        worst_s = 0.0
        for _ in range(3):
            way.reset()
            began_s = time.monotonic()
            learner.trains(2)
            worst_s = max(worst_s, time.monotonic() - began_s)
        within("all connections reset, two updates, the worst of three", worst_s, 2.0)
        assert way.connections >= 8
        assert learner.ledger()["lost"] == 0, "a cut connection cost a ticket"
        finish(learner, workers)


@pytest.mark.soak
def test_a_worker_joins_again_after_its_connection_forwarded_nothing(stage: Stage) -> None:
    """Connections stay open and nothing arrives. The learner removes the worker, and later tells it to rejoin."""
    port = free_port()
    learner = stage.learner(f"tcp://127.0.0.1:{port}", {"min-workers": 2})
    with Proxy(port) as way:
        near, far = stage.worker(f"tcp://127.0.0.1:{port}", "near"), stage.worker(way.address, "far")
        learner.trains(2)
        way.swallow()
        within("a connection swallows everything", dealt_again(learner), NOTICED_S)
        learner.hears("worker far silent for 2 s")
        way.flow()
        began_s = time.monotonic()
        learner.hears(r"worker far \(.*\) joined", times=2)
        within("it flows again, joined again", time.monotonic() - began_s, 2.0)
        learner.trains()
        finish(learner, [near, far])


@pytest.mark.soak
def test_a_worker_whose_connection_is_dead_but_looks_open_makes_another(stage: Stage) -> None:
    """A proxy on the way keeps its connections open and forwards nothing more. New connections work."""
    port = free_port()
    learner = stage.learner(f"tcp://127.0.0.1:{port}", {"min-workers": 2})
    with Proxy(port) as way:
        near, far = stage.worker(f"tcp://127.0.0.1:{port}", "near"), stage.worker(way.address, "far")
        learner.trains(2)
        way.freeze()
        began_s = time.monotonic()
        learner.hears(r"worker far \(.*\) joined", 60.0, times=2)
        bound_s = LEARNER_TIMEOUT_S + CONNECT_AGAIN_S + 5  # a Hello may be answered over the old connection, and is not
        within("a connection is dead but looks open, joined again", time.monotonic() - began_s, bound_s)
        far.hears("no answer over the connection to .* for 20 s; connecting again")
        learner.trains()
        finish(learner, [near, far])


# ---------------------------------------------------------------- strangers


def test_training_goes_on_while_peers_send_invalid_data(stage: Stage) -> None:
    learner, workers = play(stage)
    before_mb = learner.memory_mb()
    port = int(learner.hears("waiting for workers").rpartition(":")[2])
    bad = learner.ledger()["messages_bad"]
    assert talk_rubbish("127.0.0.1", port, seed=1), "it was not answered"
    learner.until(lambda row: row["ledger/messages_bad"] >= bad + 301, START_S, "301 bad messages")
    learner.hears("message from .*: ")
    assert learner.said().count("message from") < 40, "strangers fill the log"
    began_s = time.monotonic()
    learner.trains(1)
    within("rubbish from a hundred peers", time.monotonic() - began_s, 1.0)
    assert learner.memory_mb() - before_mb < 30
    assert learner.ledger()["lost"] == 0
    finish(learner, workers)


def test_a_worker_of_another_protocol_version_is_refused(stage: Stage) -> None:
    learner, workers = play(stage)
    address = learner.hears("waiting for workers").split()[-1]
    imports = "import sys, millrace.workers.conversation.session as s, millrace.workers.__main__ as m"
    newer = f"{imports}; s.PROTOCOL_VERSION = 999; sys.exit(m.main())"
    as_worker = ["--name", "newer", "--parent", str(os.getpid())]  # its supervisor would start one of this version
    stranger = stage.start([sys.executable, "-c", newer, address, *as_worker], "newer")
    assert stranger.ends() == 2
    assert "got 999; install the learner's version of millrace" in stranger.said()
    learner.hears(f"worker newer was refused: protocol: expected {PROTOCOL_VERSION}, got 999")
    learner.trains()
    finish(learner, workers)
