"""Simulated workers without environments: they have real sockets and the real `millrace.workers.conversation`, and answer
every ticket with the same canned rollout.

Many of them share a process, so that a thousand fit on a machine. They answer as fast as they can.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")  # before numpy

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import zmq

from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.messages import ToLearner
from millrace.protocol.rollout import Rollout
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec, RunSpec
from millrace.protocol.wire.codec import decode_to_worker, encode
from millrace.workers.conversation.session import Leave, RolloutTask, SendMessage, Session, WorkerEffect, WorkerIdentity

POLICY = PolicySpec((Leaf("", "box", (4,), "float32"),), ActionSpec("discrete", (), "int64", (2,), (0,)))
STEPS = 32  # with 8 copies, a rollout has 9 KB
COPIES = 8
VERSIONS = 100_000  # number of rows in the table of arrivals; more than a run has versions
Arrivals = npt.NDArray[np.float64]


def run_spec(workers: int) -> RunSpec:
    """A run with one lane for each worker."""
    return RunSpec(EnvSpec("canned"), POLICY, rollout_steps=STEPS, copies=COPIES, lanes=workers, seed=1)


def canned(run: RunSpec) -> Rollout:
    """A rollout with the run's shapes, in which no episode ends."""
    rng = np.random.default_rng(0)
    shape = (run.rollout_steps, run.copies)
    nothing = np.zeros(shape, bool)
    return Rollout(
        session=0,
        lane=0,
        ticket=0,
        version=0,
        sequence=0,
        obs=tuple(
            rng.integers(0, 255, (shape[0] + 1, shape[1], *leaf.shape)).astype(leaf.dtype) for leaf in run.policy.observation
        ),
        action=rng.integers(0, 2, shape),
        log_prob=np.full(shape, -0.693, np.float32),
        reward=np.ones(shape, np.float32),
        terminated=nothing,
        truncated=nothing,
        valid=np.ones(shape, bool),
        state=np.zeros((shape[1], 0), np.float32),
    )


def table(folder: Path, workers: int, mode: Any = "r") -> Arrivals:
    """The table of arrivals [version, worker]: when weights arrived, by the monotonic clock in seconds; 0 if they didn't.

    It is a sparse file that all processes map.
    """
    return np.memmap(folder / "arrivals", np.float64, mode, shape=(VERSIONS, workers))


class Simulated:
    """A simulated worker."""

    def __init__(self, number: int, address: str, context: zmq.Context[zmq.Socket[bytes]], arrivals: Arrivals) -> None:
        self._number = number
        self._arrivals = arrivals
        self.socket = context.socket(zmq.DEALER)
        name = f"w{number}"
        self.socket.routing_id = name.encode()
        self.socket.connect(address)
        self._session = Session(WorkerIdentity(name, "simulated", os.getpid(), number, "0"), time.monotonic())
        self._canned: Rollout | None = None
        self.left = False

    def tick(self, now: float) -> None:
        """Do what is due at this time, such as sending a heartbeat."""
        self._do(self._session.tick(now))

    def listen(self) -> None:
        """Read all messages that have arrived, and answer every ticket."""
        now = time.monotonic()
        try:
            while True:
                frames = self.socket.recv_multipart(zmq.NOBLOCK)
                self._do(self._session.handle(decode_to_worker(frames), now))
        except zmq.Again:
            pass
        while (task := self._session.next_work()) is not None:
            assert isinstance(task, RolloutTask)
            if self._arrivals[task.weights.version, self._number] == 0.0:
                self._arrivals[task.weights.version, self._number] = now
            self._do(self._session.work_ended(self._rollouts(task)))
        self.tick(now)

    def _rollouts(self, task: RolloutTask) -> list[Rollout]:
        if self._canned is None:
            assert isinstance(self._session.run, RunSpec)
            self._canned = canned(self._session.run)
        one = self._canned
        return [
            Rollout(
                session=task.session,
                lane=each.lane,
                ticket=each.ticket,
                version=task.weights.version,
                sequence=each.sequence,
                obs=one.obs,
                action=one.action,
                log_prob=one.log_prob,
                reward=one.reward,
                terminated=one.terminated,
                truncated=one.truncated,
                valid=one.valid,
                state=one.state,
            )
            for each in task.permits
        ]

    def _do(self, effects: Sequence[WorkerEffect]) -> None:
        for effect in effects:
            if isinstance(effect, SendMessage):
                self._say(effect.message)
            elif isinstance(effect, Leave):
                self.left = True

    def _say(self, message: ToLearner) -> None:
        self.socket.send_multipart(encode(message), copy=True)


def simulate(address: str, numbers: range, workers: int, folder: Path) -> None:
    """Run some of the workers in this process, until the learner has told all of them to leave."""
    os.nice(5)  # give way to the learner, which is measured
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    arrivals = table(folder, workers, "r+")
    all_of_them = [Simulated(number, address, context, arrivals) for number in numbers]
    here = {each.socket: each for each in all_of_them}
    poller = zmq.Poller()
    for socket in here:
        poller.register(socket, zmq.POLLIN)
    due_s = 0.0
    while here:
        for socket, _ in poller.poll(100):
            here[socket].listen()
        now = time.monotonic()
        if now >= due_s:
            due_s = now + 0.1
            for each in here.values():
                each.tick(now)
        for each in [each for each in here.values() if each.left]:
            poller.unregister(each.socket)
            del here[each.socket]
            each.socket.close(linger=2000)
    context.term()
