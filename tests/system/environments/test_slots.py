"""Simulators on port 5000 + slot, on two hosts, through deaths of everything: no port is ever taken twice at once."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

import psutil
import pytest

from millrace.workers.machine_slots import FILE_VARIABLE, Slots
from tests.system.stage.network import Host, Network
from tests.system.stage.preloaded import workers_of
from tests.system.stage.processes import START_S, Stage, Worker, wait_for
from tests.system.stage.runs import accounted

ENV = "tests.system.environments.slot_env:SlotEnv"
LANES, COPIES, T, UPDATES = 4, 4, 16, 40
RUN_S = 300.0  # until a run has ended by itself; workers that die are started again with a growing pause


@contextmanager
def looking_at(file: Path) -> Iterator[Slots]:
    """The slots of a host, as a process on it sees them."""
    fd = os.open(file, os.O_RDWR)
    try:
        yield Slots(fd)
    finally:
        os.close(fd)


def free_below(file: Path, count: int) -> set[int]:
    """Which of the first slots of a host nobody holds."""
    with looking_at(file) as slots:
        return {slot for slot in (slots.take() for _ in range(count)) if slot < count}


@pytest.fixture
def hosts(stage: Stage, network: Network) -> Iterator[list[Host]]:
    """Three hosts. What still runs on them after the test, also in no one's family any more, is ended."""
    made = [network.host(number) for number in (1, 2, 3)]
    yield made
    for pid in [pid for host in made for pid in host.processes()]:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


@pytest.mark.soak
def test_no_port_is_taken_twice_whoever_dies(stage: Stage, hosts: list[Host]) -> None:
    here, *there = hosts
    address = f"tcp://{here.address}:5555"
    keys, token = stage.keys()
    folder = {host: stage.tmp_path / f"simulators-{number}" for number, host in enumerate(there)}
    slots = {host: stage.tmp_path / f"slots-{number}" for number, host in enumerate(there)}
    for made in folder.values():
        made.mkdir()

    def worker(host: Host, name: str) -> Worker:
        env = ("env", f"{FILE_VARIABLE}={slots[host]}", f"SIMULATORS={folder[host]}")
        return stage.worker(address, name, "--token", str(token), before=[*env, *host.before])

    settings = {
        "min-workers": 4,
        "keys": keys,
        "lanes": LANES,
        "envs": LANES * COPIES,
        "env-kwargs": "port {5000+slot}",
        "rollout-steps": T,
        "steps": LANES * COPIES * T * UPDATES,
        "eval-every": LANES * COPIES * T * 5,
        "eval-episodes": 8,
        "eval-copies": 2,
        "max-env-failures": 100_000,
        "checkpoint-every-s": 1,
    }
    learner = stage.learner(address, settings, env=ENV, before=here.before)
    a, b = there
    workers = [worker(a, "a0"), worker(a, "a1"), worker(b, "b0"), worker(b, "b1")]
    learner.trains(2)

    # A supervisor is killed, and another one is started at once.
    psutil.Process(workers[2].pid).kill()
    workers[2] = worker(b, "b2")
    learner.hears(r"worker b2 \(.*\) joined", START_S)
    learner.trains(2)

    # A host is cut off. Its workers live, and so do their copies: they keep their slots.
    wait_for(lambda: alive_simulators(b) >= 2 * COPIES, START_S)
    silent = len(re.findall("worker b[12] silent", learner.said()))
    b.cut()
    learner.hears("worker b[12] silent", START_S, times=silent + 1)  # the other one may be starting
    kept = alive_simulators(b)
    assert kept >= COPIES
    assert not free_below(slots[b], kept)

    # Then a worker is killed while its supervisor cannot act: its simulators live, and its neighbour gets all lanes.
    (killed,) = wait_for(lambda: [each for each in workers_of(workers[0].pid) if each.children()])
    psutil.Process(workers[0].pid).suspend()
    killed.kill()
    learner.hears("worker a0 silent", START_S)
    wait_for(lambda: alive_simulators(a) > LANES * COPIES, START_S, "all lanes beside the simulators of the killed worker")
    learner.trains(2)
    psutil.Process(workers[0].pid).resume()
    learner.trains(2)
    b.heal()
    learner.trains(2)

    learner.kill()
    learner = stage.learner(address, {}, before=here.before, resume=learner.folder)
    assert learner.ends(RUN_S) == 0, learner.said()
    for each in workers:
        assert each.ends(RUN_S) in (0, 1), each.said()  # 1: it was to start a worker again, which then found no learner
    accounted(learner.summary(), lanes=LANES, rows=T * COPIES)
    assert learner.summary()["updates"] >= UPDATES
    for host in there:
        assert not (folder[host] / "taken").exists(), (folder[host] / "taken").read_text()
        assert len((folder[host] / "started").read_text().split()) > 16, "simulators died and were started again"
        wait_for(partial(nothing_lives, host), what="the end of all simulators")
        assert free_below(slots[host], 16) == set(range(16))


def nothing_lives(host: Host) -> bool:
    """Whether no simulator is left on a host."""
    return not alive_simulators(host)


def alive_simulators(host: Host) -> int:
    """Number of simulators on a host that hold their port."""
    found = 0
    for pid in host.processes():
        with suppress(psutil.NoSuchProcess, psutil.ZombieProcess):
            found += "slot_env.py" in " ".join(psutil.Process(pid).cmdline())
    return found
