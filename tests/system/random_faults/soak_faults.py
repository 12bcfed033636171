"""The faults of the soak: one table, and a small function for each.

Rule: a function does its fault and returns how to undo it, or None. The course of the soak undoes it after a few seconds.
"""

from __future__ import annotations

import random
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from tests.system.faults.rubbish import NAME
from tests.system.stage.network import Host
from tests.system.stage.processes import START_S, Learner, Running, Stage, Worker, wait_for

PORT = 5555
Undo = Callable[[], None] | None


@dataclass
class Scene:
    """A learner on the first host, workers on the other two, one of which is behind a proxy, and what was done to them."""

    stage: Stage
    hosts: list[Host]
    random: random.Random
    learner: Learner
    resume: Callable[[], Learner]
    """Starts the learner again, from its run folder."""
    proxy: Running
    workers: dict[int, Worker]
    """Those that faults happen to, by number."""
    hostile_token: Path
    stopped: set[int] = field(default_factory=set)
    bad_links: set[int] = field(default_factory=set)
    killed: set[int] = field(default_factory=set)
    """pids of workers"""
    updates_when_killed: int = 0
    """Of the run, when the learner was killed last."""
    strangers: list[Running] = field(default_factory=list)
    hostile: list[Running] = field(default_factory=list)

    @property
    def address(self) -> str:
        """Where the learner listens."""
        return f"tcp://{self.hosts[0].address}:{PORT}"


def kill_a_worker(scene: Scene) -> Undo:
    """SIGKILL, also to its supervisor."""
    number = scene.random.choice(sorted(scene.workers.keys() - scene.stopped))
    scene.killed.add(scene.workers[number].pid)
    scene.workers[number].kill()
    return None


def stop_a_worker(scene: Scene) -> Undo:
    """SIGSTOP, also to its supervisor, then SIGCONT."""
    number = scene.random.choice(sorted(scene.workers.keys() - scene.stopped))
    worker = scene.workers[number]
    if not worker.alive():
        return None
    scene.stopped.add(number)
    worker.pause()

    def go_on() -> None:
        scene.stopped.discard(number)
        worker.go_on()

    return go_on


def cut_a_host(scene: Scene) -> Undo:
    """All packets of a host are dropped."""
    return _spoil_a_link(scene, Host.cut, Host.heal)


def lose_a_tenth(scene: Scene) -> Undo:
    """A tenth of the packets of a host are dropped in each direction."""
    return _spoil_a_link(scene, lambda host: host.lose(10), lambda host: host.lose(0))


def _spoil_a_link(scene: Scene, spoil: Callable[[Host], None], mend: Callable[[Host], None]) -> Undo:
    number = scene.random.choice([1, 2])
    if number in scene.bad_links:
        return None
    scene.bad_links.add(number)
    spoil(scene.hosts[number])

    def heal() -> None:
        scene.bad_links.discard(number)
        mend(scene.hosts[number])

    return heal


def delay(scene: Scene) -> Undo:
    """The proxy delays everything."""
    scene.proxy.tell("delay 0.2")
    return lambda: scene.proxy.tell("delay 0")


def reset_connections(scene: Scene) -> Undo:
    """The proxy resets all connections."""
    scene.proxy.tell("reset")
    return None


def freeze_connections(scene: Scene) -> Undo:
    """The proxy keeps its connections open and forwards nothing more over them; new connections work."""
    scene.proxy.tell("freeze")
    return None


def talk_rubbish(scene: Scene) -> Undo:
    """A stranger without a key connects and sends random bytes."""
    host = scene.hosts[scene.random.choice([1, 2])]
    arguments = (scene.hosts[0].address, str(PORT), str(scene.random.getrandbits(32)))
    command = [*host.before, sys.executable, "-m", "tests.system.faults.rubbish", *arguments]
    scene.strangers.append(scene.stage.start(command, NAME.decode()))
    return None


def say_extremes(scene: Scene) -> Undo:
    """A hostile worker with a key of its own joins as a spare; one at a time."""
    if any(running.alive() for running in scene.hostile):
        return None
    host = scene.hosts[scene.random.choice([1, 2])]
    arguments = (scene.address, str(scene.hostile_token), str(scene.random.getrandbits(32)))
    command = [*host.before, sys.executable, "-m", "tests.system.faults.hostile_worker", *arguments]
    scene.hostile.append(scene.stage.start(command, "hostile"))
    return None


def stop_the_learner(scene: Scene) -> Undo:
    """SIGSTOP, then SIGCONT."""
    learner = scene.learner
    learner.pause()
    return learner.go_on


def kill_the_learner(scene: Scene) -> Undo:
    """SIGKILL; then it is resumed at the same address. Only if the run got further since the last time."""
    updates = scene.learner.updates()
    if updates <= scene.updates_when_killed:
        return None
    wait_for(scene.learner.checkpoints, START_S, "a checkpoint")
    scene.learner.kill()
    scene.updates_when_killed = updates
    scene.learner = scene.resume()
    return None


class Fault(NamedTuple):
    """A kind of fault."""

    do: Callable[[Scene], Undo]
    weight: int
    """how often it is chosen, beside the others"""
    at_any_time: bool = True
    """False: only before the second half, in which one learner process lives all the time, and its memory is judged"""

    @property
    def name(self) -> str:
        """For people."""
        return self.do.__name__.replace("_", " ")


FAULTS = (
    Fault(kill_a_worker, 6),
    Fault(stop_a_worker, 6),
    Fault(cut_a_host, 3),
    Fault(lose_a_tenth, 3),
    Fault(delay, 3),
    Fault(reset_connections, 3),
    Fault(freeze_connections, 1),
    Fault(talk_rubbish, 2),
    Fault(say_extremes, 2),
    Fault(stop_the_learner, 2),
    Fault(kill_the_learner, 2, at_any_time=False),
)
KILL_A_WORKER = FAULTS[0]
