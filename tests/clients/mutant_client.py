"""A client that breaks one rule on purpose: our own worker, with one mistake between it and its socket.

    python -m tests.clients.mutant_client MUTANT ADDRESS

Rule: a mutant is a small mistake that an author of a client makes. `none` is the worker without a mistake.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from typing import Any

import msgpack
import msgspec
import numpy as np

from millrace.protocol.arrays import Array, Floats
from millrace.protocol.env_spec import AllowedCode
from millrace.protocol.errors import BadMessage
from millrace.protocol.messages import (
    Collect,
    Described,
    Drain,
    EpisodeRows,
    Evaluate,
    Evaluated,
    Goodbye,
    Heartbeat,
    HeartbeatReply,
    Hello,
    Received,
    Refuse,
    Rejoin,
    Release,
    Reset,
    Returned,
    Rollout,
    Step,
    Stepped,
    ToLearner,
    ToWorker,
    Weights,
    Welcome,
)
from millrace.protocol.policy.distributions import Categorical
from millrace.protocol.specs import RunSpec, StepSpec
from millrace.protocol.wire.codec import Buffer, decode_to_learner, encode
from millrace.protocol.wire.plain_values import pack
from millrace.protocol.wire.worker_link import WorkerLink
from millrace.workers.conversation.held import Held, HeldEvaluations
from millrace.workers.conversation.session import Session
from millrace.workers.lanes import lane
from millrace.workers.worker import Worker, WorkerOptions, identity
from tests.support.conversation.example_messages import example

replace = msgspec.structs.replace
FLAT = np.zeros(0, np.uint8)
NO_OPTIONS = np.frombuffer(pack(None), np.uint8)


class Mutant(WorkerLink):
    """The socket, with a mistake."""

    def __init__(self, mutant: str, address: str) -> None:
        super().__init__(address, f"mutant-{os.getpid()}")
        self.mutant = mutant
        self.session = self.first_session = self.beats = self.attempt = self.newest = 0
        self.said_hello = self.described = self.begins_again = False
        self.versions = set[int]()  # of the weights that came
        self.arrived = 0  # permits
        self.copies = 0  # of a lane that is stepped
        self.incarnation = 0  # the highest one
        self.asked: dict[int, int] = {}  # the learner's ticket, by the one that the worker was given
        self.tickets = set[int]()  # of orders and permits that came
        self.answered = set[int]()  # tickets
        self.late_drain: Drain | None = None
        self.kept: list[ToLearner] = []
        self.drains, self.lost_session = False, 0

    # ---------------------------------------------------------------- what it says

    def send(self, frames: Sequence[Buffer]) -> None:
        """Send the messages that the mutant makes of this one."""
        message = decode_to_learner([bytes(frame) for frame in frames], 1 << 30)
        match self.mutant, message:
            case "oversized frame", Goodbye(session):
                return super().send([msgpack.packb(["Goodbye", session, "x" * (2 << 20), []])])
            case "wrong order", Heartbeat():
                name, session, replies, versions, *more = msgpack.unpackb(bytes(frames[0]))
                return super().send([msgpack.packb([name, session, versions, replies, *more])])
        for said in self.said(message):
            super().send(encode(said))
        return None

    def said(self, message: Any) -> list[Any]:
        """What the mutant says in place of this message."""
        match self.mutant, message:
            case "stale session", Heartbeat() | Stepped() | Rollout() | Described():
                self.first_session = self.first_session or message.session
                return [replace(message, session=self.first_session)]
            case "forgotten heartbeat", Heartbeat():
                self.beats += 1
                return [message] if self.beats <= 3 else []
            case "steps counted by session", Heartbeat():
                self.first_session = self.first_session or message.session
                return [replace(message, steps=message.steps if message.session == self.first_session else 0)]
            case "lists every ticket that came", Heartbeat():
                return [replace(message, tickets=tuple(sorted(self.tickets)))]
            case "leaves without Goodbye", Goodbye():
                return []
            case "speaks another protocol", Hello():
                return [replace(message, protocol=message.protocol + 1)]
            case "two results for one copy", Returned():
                return [replace(message, results=np.frombuffer(pack([1, 2]), np.uint8), error="")]
            case "goes on after Goodbye", Goodbye():
                return [message, message]
            case "observes what is no number", Stepped():
                return [replace(message, obs=tuple(np.full_like(leaf, np.nan) for leaf in message.obs))]
            case "rewards a reset", Stepped():
                return [replace(message, reward=np.ones_like(message.reward))]
            case "wrong ticket", Rollout():
                return [replace(message, ticket=message.ticket + 1000)]
            case "wrong ticket", Stepped():
                return [replace(message, ticket=message.ticket - 1)]
            case "wrong incarnation", Stepped():
                return [replace(message, incarnation=0)]
            case "executes every order", Stepped():
                return [replace(message, ticket=self.asked[message.ticket])]
            case "rows in another order", Stepped():
                return [replace(message, obs=tuple(leaf[::-1].copy() for leaf in message.obs))]
            case "wrong dtype", Stepped():
                return [replace(message, reward=message.reward.astype(np.float32))]
            case "lane not owned", Stepped() | Rollout():
                return [replace(message, lane=message.lane ^ 1)]
            case "wrong shape", Stepped():
                return [replace(message, obs=tuple(array[..., None] for array in message.obs))]
            case "missing truncated", Stepped():
                return [replace(message, truncated=np.zeros_like(message.truncated))]
            case "missing truncated in rollouts", Rollout():
                return [replace(message, truncated=np.zeros_like(message.truncated), episodes=())]
            case "repeated rollout", Rollout():
                return [message, message]
            case "wrong episode return", Rollout():
                return [replace(message, episodes=tuple(replace(each, reward=each.reward + 1) for each in message.episodes))]
            case "wrong log-probabilities", Rollout():
                return [replace(message, log_prob=message.log_prob * np.float32(0.9))]
            case "wrong episode length", Rollout():
                return [replace(message, episodes=tuple(replace(each, length=each.length + 1) for each in message.episodes))]
            case "forgets the last observation of a rollout", Rollout() if message.sequence:
                return [replace(message, obs=tuple(_with_first_row(leaf, 0) for leaf in message.obs))]
            case "forgets who ended in the last row", Rollout():
                return [replace(message, valid=_with_first_row(message.valid, True))]
            case "forgets who is reset first", Rollout(resets=np.ndarray() as resets):
                return [replace(message, resets=_with_first_row(resets, False))]
            case "resets a copy in the step that ends its episode", Rollout():
                ends = (message.terminated | message.truncated)[:-1]
                return [replace(message, obs=tuple(_with_first_of_the_next(leaf, ends) for leaf in message.obs))]
            case "sends no rollout again", Rollout():
                was_sent = message.ticket in self.answered
                self.answered.add(message.ticket)
                return [] if was_sent else [message]
            case "every row valid", Rollout():
                return [replace(message, valid=np.ones_like(message.valid))]
            case "wrong sequence", Rollout():
                return [replace(message, sequence=message.sequence + 1)]
            case "acts under the newest weights", Rollout():
                return [replace(message, version=max(self.versions))]
            case "lists the newest weights only", Heartbeat():
                return [replace(message, versions=message.versions[-1:])]
            case "lists all weights that came", Heartbeat():
                return [replace(message, versions=tuple(sorted(self.versions)))]
            case "Goodbye without tickets", Goodbye():
                return [replace(message, tickets=())]
            case "same attempt after Rejoin", Hello():
                self.attempt = self.attempt or message.attempt
                return [replace(message, attempt=self.attempt)]
            case "one Hello only", Hello():
                was_said, self.said_hello = self.said_hello, True
                return [] if was_said else [message]
            case "described once", Described():
                was_said, self.described = self.described, True
                return [] if was_said else [message]
            case "describes another order", Described():
                return [replace(message, ticket=message.ticket - 1)]
            case "does not say that it waits", Heartbeat():
                return [replace(message, waits=False)]
            case "counts replies anew when the run begins", Heartbeat() if not message.waits:
                return [replace(message, replies=0)]
            case "no new Hello in silence", Hello():
                was_said, self.said_hello = self.said_hello, True
                return [] if was_said else [message]
            case "lists no tickets", Heartbeat():
                return [replace(message, tickets=())]
            case "no heartbeat while it drains", Heartbeat() if self.drains:
                return []
            case "episodes in another order", Rollout():
                return [replace(message, episodes=message.episodes[::-1])]
            case "rows after their Evaluated", EpisodeRows():
                self.kept.append(message)
                return []
            case "rows after their Evaluated", Evaluated():
                return [message, *self.kept]
            case "rows in float32", EpisodeRows():
                return [replace(message, reward=message.reward.astype(np.float32))]
            case "rows without an end", EpisodeRows():
                return [replace(message, truncated=np.zeros_like(message.truncated))]
            case "an episode more", Evaluated():
                return [replace(message, episodes=(*message.episodes, message.episodes[-1]))]
            case "evaluates again", Evaluated() if message.ticket in self.answered:
                return [replace(message, episodes=tuple(replace(each, reward=each.reward - 1) for each in message.episodes))]
            case "evaluates again", Evaluated():
                self.answered.add(message.ticket)
            case "cuts nothing", Evaluated():
                return [replace(message, cut=(False,) * len(message.cut))]
            case "replies counted wrongly", Heartbeat():
                return [replace(message, replies=message.replies + (message.replies > 0))]
        return [message]

    # ---------------------------------------------------------------- what it hears

    def receive(self) -> Iterator[ToWorker | BadMessage]:
        """The messages that the mutant hears."""
        for message in super().receive():
            if self.mutant == "ends on what it cannot read" and isinstance(message, BadMessage):
                raise SystemExit(3)
            if not isinstance(message, BadMessage):
                yield from self.heard(message)

    def heard(self, message: Any) -> list[Any]:
        """What the mutant hears in place of this message."""
        match self.mutant, message:
            case "answers before reset", Welcome(session, _, StepSpec() as run):
                N = run.lanes[0]
                obs = tuple(np.zeros((N, *leaf.shape), leaf.dtype) for leaf in run.observation)
                flags = np.zeros(N, bool)
                self.say(
                    example(
                        Stepped,
                        session=session,
                        ticket=1,
                        obs=obs,
                        reward=np.zeros(N),
                        terminated=flags,
                        truncated=flags,
                        infos=FLAT,
                    )
                )
            case "never begins", Welcome() if message.session == self.session:
                return []
            case "begins again at a repeated Welcome", Welcome() if message.session == self.session:
                self.begins_again = True
                return []
            case "begins again at a repeated Welcome", Step() if self.begins_again:
                self.begins_again = False
                copies = len(message.actions[0])
                order = (message.session, message.ticket, message.lane, message.incarnation)
                return [Reset(*order, tuple(range(copies)), (1,) * copies, NO_OPTIONS)]
            case "lists every ticket that came", Reset() | Step():
                self.tickets.add(message.ticket)
            case "lists every ticket that came", Collect():
                self.tickets |= {permit.ticket for permit in message.permits}
            case "takes a run of any agents", Welcome(_, _, RunSpec() as run):
                return [replace(message, run=replace(run, seats=(), takes_turns=False))]
            case "takes a run of any agents", Weights():
                return []
            case "resets all copies", Welcome(_, _, StepSpec() as run):
                self.copies = run.lanes[0]
            case "resets all copies", Reset():
                seeds = (message.seeds * self.copies)[: self.copies]
                return [replace(message, copies=tuple(range(self.copies)), seeds=seeds)]
            case "one seed for all copies of a lane", Reset():
                return [replace(message, seeds=message.seeds[:1] * len(message.seeds))]
            case "one action for all copies", Step():
                return [replace(message, actions=tuple(np.repeat(leaf[:1], len(leaf), 0) for leaf in message.actions))]
            case "obeys a lower incarnation", Reset() | Step():
                self.incarnation = max(self.incarnation, message.incarnation)
                return [replace(message, incarnation=self.incarnation)]
            case "obeys a lower incarnation", Collect():
                self.incarnation = max(self.incarnation, *(permit.incarnation for permit in message.permits))
                permits = [replace(permit, incarnation=self.incarnation) for permit in message.permits]
                return [replace(message, permits=tuple(permits))]
            case "ignores the past of a lane", Collect():
                return [replace(message, permits=tuple(replace(permit, past=None) for permit in message.permits))]
            case "continues with other random numbers", Collect():
                permits = [replace(each, round=each.round + (each.past is not None)) for each in message.permits]
                return [replace(message, permits=tuple(permits))]
            case "does not wait for weights", Collect(version=version) if self.versions and version not in self.versions:
                return [replace(message, version=max(self.versions))]
            case "evaluates without end", Evaluate():
                return [replace(message, most_steps=10_000)]
            case "any Welcome", Welcome():
                return [replace(message, attempt=self.attempt)]
            case "one autoreset mode", Welcome(_, _, StepSpec() as run):
                return [replace(message, run=replace(run, autoreset="NextStep"))]
            case "one activation", Welcome(_, _, RunSpec() as run):
                return [replace(message, run=replace(run, policy=replace(run.policy, activation="tanh")))]
            case "does not normalize", Weights(_, _, buffers) if buffers.size:
                return [replace(message, buffers=np.repeat(np.array([0, 1], np.float32), buffers.size // 2))]
            case "sets no attributes", Weights():
                return [replace(message, env_attributes=None)]
            case "reads bfloat16 as numbers", Weights(_, parameters) if parameters.dtype == np.uint16:
                return [replace(message, parameters=parameters.astype(np.float32))]
            case "evaluates the newest weights", Evaluate() if self.versions:
                return [replace(message, version=max(self.versions))]
            case "never greedy", Evaluate():
                return [replace(message, greedy=False)]
            case "always greedy", Evaluate():
                return [replace(message, greedy=True)]
            case "evaluates by other seeds", Evaluate(seeds=seeds):
                return [replace(message, seeds=tuple(range(7, 7 + len(seeds))))]
            case "resets without options", Reset():
                return [replace(message, options=NO_OPTIONS)]
            case "answers no order again", Reset() | Step():
                was_said, self.newest = message.ticket == self.newest, message.ticket
                return [] if was_said else [message]
            case "keeps what a session had", Welcome(session) if self.session:
                self.lost_session = session
            case "keeps what a session had", Collect(session) if session == self.lost_session:
                return []
            case "keeps unlisted lanes", HeartbeatReply():
                return [replace(message, received=tuple(Received(lane, 0, 0) for lane in (0, 1)))]
            case "last words after Refuse", Refuse(reason):
                self.say(Goodbye(self.session, reason, ()))
            case "no heartbeat while it drains", Drain():
                self.drains = True
            case "no autoreset", Welcome(_, _, StepSpec() as run):
                return [replace(message, run=replace(run, autoreset="SameStep"))]
            case "ignores Drain while it joins", Drain() if not self.session:
                return []
            case "no drain", Drain():
                return []
            case "drains after the next Collect", Drain():
                self.late_drain = message
                return []
            case "drains after the next Collect", Collect() if self.late_drain is not None:
                return [message, self.late_drain]
            case "joins again while it drains", Drain():
                return []
            case "ignores revoke", Release() | HeartbeatReply():
                return []
            case "ignores Rejoin", Rejoin():
                return []
            case "refusal is no error", Refuse(reason):
                return [Drain(reason)]
            case "ignores seeds", Reset():
                return [replace(message, seeds=(None,) * len(message.seeds))]
            case "ignores older weights", Weights(version) if version < max(self.versions, default=-1):
                return []
            case "acts under the newest weights", Weights(version):
                self.versions.add(version)
                return [replace(message, version=each) for each in range(1, 1 + version)]
            case _, Weights(version):
                self.versions.add(version)
            case "keeps only what its tickets name", Collect():
                return [replace(message, keep=())]
            case "order of arrival", Collect():
                begin, self.arrived = self.arrived, self.arrived + len(message.permits)
                permits = [replace(each, sequence=n) for n, each in enumerate(message.permits, begin)]
                return [replace(message, permits=tuple(permits))]
            case "executes every order", Reset() | Step():
                self.newest += 1
                self.asked[self.newest] = message.ticket
                return [replace(message, ticket=self.newest)]
            case "any session", _ if hasattr(message, "session") and not isinstance(message, Welcome):
                return [replace(message, session=self.session)]
            case _, Welcome():
                self.session = message.session
        return [message]

    def say(self, message: ToLearner) -> None:
        """Send a message that nobody asked for."""
        super().send(encode(message))


def _with_first_row(rows: Array, value: float) -> Array:
    """The rows [T, …], with this value in all of the first one."""
    return np.concatenate([np.full_like(rows[:1], value), rows[1:]])


def _with_first_of_the_next(obs: Array, ends: Array) -> Array:
    """The observations [T+1, N, …], with the first one of an episode also in place of the last one before.

    `ends` [T-1, N]: the rows that end an episode, but for the last row.
    """
    changed = obs.copy()
    t, n = np.nonzero(ends)
    changed[t + 1, n] = obs[t + 2, n]
    return changed


def _one_for_all(self: Categorical, generator: np.random.Generator, shape: tuple[int, ...]) -> Floats:
    return np.broadcast_to(_noise(self, generator, shape)[..., :1, :], (*shape, self.params_size)).copy()


_noise = Categorical.noise


def main(mutant: str, address: str) -> int:
    """Run the mutant until it leaves."""
    if mutant == "one seed for all copies":
        vars(lane)["copy_seed"] = lambda seed, lane, start, copy: 1
    if mutant == "goes on with an evaluation that is over":
        HeldEvaluations.take = Held.take  # type: ignore[method-assign]
    if mutant == "one random number for all copies":
        Categorical.noise = _one_for_all  # type: ignore[method-assign]
    signals: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, frame: signals.append(number))
    link = Mutant(mutant, address)
    nonce = 7 if mutant == "one process_nonce for every process" else None
    who = identity(f"mutant-{os.getpid()}", nonce)
    link.attempt = who.process_nonce + 1 if mutant == "any Welcome" else 0
    session = Session(who, time.monotonic(), join_timeout_s=30.0)
    options = WorkerOptions(code=AllowedCode.CALLABLES, stop_requests=lambda: len(signals))
    left = Worker(link, session, options).run()
    return 1 if mutant == "drained is an error" else left.exit_code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2]))
