"""Whether the traces of a run of real processes are accepted by the model.

They are if all of this holds:

 1. Every call of each learner's coordinators and of each worker's session, made again of a fresh object with the recorded
    arguments and times, has the same result, bit for bit (`replay.py`). So the two halves are what the model explores: they
    depend on nothing but their messages and the time.
 2. The rules of safety of the model hold after every call of a learner: the ledger balances, each ticket is used at most
    once in the whole run, also after restarts, no rollout exceeds the lag, a lane has one owner, an incarnation of a lane
    belongs to one session, and each ticket of an evaluation is in one place. No message of a recorded worker is rejected.
 3. The network did only what that of the model can. Each message that a learner heard from a worker was said before by a
    process of this worker, in the session that the message names. Each message that a worker's session handled was said to
    this worker before by a learner. In each direction, between a process of a worker and the learners, which follow one
    another, messages arrive in the order in which they were said; some are lost. What arrives twice is counted (the model's
    fault "repeat"), and so is what arrives out of order (the model has that only for copies).
 4. Each learner but the first begins with the tickets and the incarnations of a moment at which an earlier one could have
    made a checkpoint (the model's fault "restart").

Strangers are only counted: whoever joins under a name or key of no recorded worker, or sends what cannot be read. To the
learner they are workers like any other; 1 and 2 hold with them. When a worker connects again before its old connection has
ended, libzmq gives the old one a routing id of its own: a zero byte and a number. What still arrives from there is a
stranger's, because the learner cannot know better.

`python -m tests.model.traces.accept FOLDER` checks the traces in a folder.
"""

from __future__ import annotations

import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from millrace.learner.rollouts.ledger import Ledger
from millrace.protocol.messages import Alive, Hello
from millrace.workers.conversation.session import Session
from tests.model.traces.record import SUFFIX, Record, Said, SaidRollout, SaidWeights, read
from tests.model.traces.replay import NotAccepted, Replay

OLD_CONNECTION = b"\0"  # the routing ids of workers begin with their name


class Moment(NamedTuple):
    """A message was said, or heard."""

    at_s: float
    kind: str
    digest: bytes


@dataclass
class WorkerTrace:
    """What a process of a worker said and heard."""

    name: str
    nonce: int
    said: list[Moment] = field(default_factory=list)
    heard: list[Moment] = field(default_factory=list)
    sessions: set[int] = field(default_factory=set)


@dataclass
class LearnerTrace:
    """What a learner heard, by worker, and what it said."""

    heard: list[tuple[bytes, int | None, Moment]] = field(default_factory=list)
    """sender, session or (of a Hello) nonce, and the message"""
    said: list[tuple[bytes, Moment]] = field(default_factory=list)


@dataclass
class Acceptance:
    """What was accepted."""

    counts: Counter[str] = field(default_factory=Counter)
    seconds: float = 0.0

    def __str__(self) -> str:
        return (
            "accepted: " + ", ".join(f"{count:,} {what}" for what, count in self.counts.items()) + f"; {self.seconds:.0f} s"
        )


def accept(folder: Path) -> Acceptance:
    """Check all traces in this folder. Raises `NotAccepted`."""
    began_s = time.monotonic()
    accepted = Acceptance()
    workers = [_worker(path, accepted) for path in sorted(folder.glob(f"worker-*{SUFFIX}"))]
    learners = _learners(folder, accepted)
    honest = processes_by_sender(workers, learners)
    _check_up(workers, learners, honest, accepted)
    _check_down(workers, learners, honest, accepted)
    accepted.seconds = time.monotonic() - began_s
    return accepted


# -------------------------------------------------------------------- replays


def _worker(path: Path, accepted: Acceptance) -> WorkerTrace:
    replay = Replay(path.stem)
    found: WorkerTrace | None = None
    for record in read(path):
        given = replay.play(record)
        if found is None:
            found = WorkerTrace(given[0].worker, given[0].process_nonce)
        session: Session = replay.parts["Session"]
        if session.run is not None:
            found.sessions.add(session.session)
        if record.method == "handle":
            found.heard.append(_moment(record.at_s, record.arguments[0]))
        for kind, digest in _sent_by_session(record.result):
            found.said.append(Moment(record.at_s, kind, digest))
    accepted.counts["calls of workers"] += replay.calls
    accepted.counts["processes of workers"] += 1
    return found or WorkerTrace(path.stem, 0)


def _learners(folder: Path, accepted: Acceptance) -> list[LearnerTrace]:
    """The learners, one after the other."""
    found, used, moments = [], set[int](), list[tuple[Any, ...]]()
    traces = [(list(read(path)), path) for path in folder.glob(f"learner-*{SUFFIX}")]
    for records, path in sorted(((r, p) for r, p in traces if r), key=lambda each: each[0][0].at_s):
        replay, learner = Replay(path.stem), LearnerTrace()
        for record in records:
            given = replay.play(record, used)
            if record.method == "__init__" and record.part == "TicketCoordinator" and moments:
                _check_checkpoint(path.stem, replay.parts["TicketCoordinator"], moments)
            if record.method == "incarnations":
                moments.append(record.result)
            _follow(record, given, learner, accepted)
        used = replay.used or used
        found.append(learner)
        accepted.counts["calls of learners"] += replay.calls
        accepted.counts["learners"] += 1
    accepted.counts["tickets used"] = len(used)
    return found


def _check_checkpoint(name: str, coordinator: Any, moments: list[tuple[Any, ...]]) -> None:
    ledger: Ledger = coordinator.rollouts.ledger
    began = tuple(coordinator.rollouts.incarnations()), ledger.issued, ledger.used
    if began not in moments:
        raise NotAccepted(
            f"{name}: begins with incarnations, tickets issued and used {began}, of which there is no checkpoint"
        )


def _follow(record: Record, given: list[Any], learner: LearnerTrace, accepted: Acceptance) -> None:
    """Note what the learner heard and said in this call."""
    match record.method:
        case "receive":
            peer, message = given[0], given[1]
            said = record.arguments[1]
            if isinstance(said, SaidRollout) and said.wrong:
                learner.heard.append((peer, None, Moment(record.at_s, "a rollout that is rejected", b"")))
            elif isinstance(message, Alive):
                accepted.counts["messages of supervisors"] += 1
            else:
                which = message.process_nonce if isinstance(message, Hello) else message.session
                learner.heard.append((peer, which, _moment(record.at_s, said)))
        case "reject_message":
            learner.heard.append((given[0], None, Moment(record.at_s, "what cannot be read", b"")))
    for peer, (kind, digest) in _sent_by_coordinator(record.result):
        learner.said.append((peer, Moment(record.at_s, kind, digest)))


def _moment(at_s: float, said: Said | SaidRollout | SaidWeights) -> Moment:
    return Moment(at_s, said.kind, said.digest)


def _sent_by_session(result: Any) -> Iterator[tuple[str, bytes]]:
    for effect in result if isinstance(result, tuple) else ():
        if isinstance(effect, tuple) and len(effect) == 2 and isinstance(effect[1], bytes):
            yield effect[0], effect[1]


def _sent_by_coordinator(result: Any) -> Iterator[tuple[bytes, tuple[str, bytes]]]:
    for each in result if isinstance(result, tuple) else ():
        if isinstance(each, tuple) and len(each) == 2 and isinstance(each[0], bytes):
            yield each


# -------------------------------------------------------------------- the network


def processes_by_sender(workers: list[WorkerTrace], learners: list[LearnerTrace]) -> dict[bytes, list[WorkerTrace]]:
    """The processes of each sender that is a recorded worker: it said Hello with the secret nonce of one."""
    of_nonce = {worker.nonce: worker for worker in workers}
    found: dict[bytes, list[WorkerTrace]] = defaultdict(list)
    for learner in learners:
        for peer, which, moment in learner.heard:
            if peer.startswith(OLD_CONNECTION):
                continue
            if moment.kind == "Hello" and which in of_nonce and of_nonce[which] not in found[peer]:
                found[peer].append(of_nonce[which])
    return {peer: processes for peer, processes in found.items() if processes}


def _check_up(
    workers: list[WorkerTrace], learners: list[LearnerTrace], honest: dict[bytes, list[WorkerTrace]], accepted: Acceptance
) -> None:
    heard: dict[int, list[Moment]] = defaultdict(list)  # by nonce
    for learner in learners:
        for peer, which, moment in learner.heard:
            if peer not in honest:
                accepted.counts["messages of strangers"] += 1
                continue
            who = f"worker {honest[peer][0].name}, at {moment.at_s:.3f} s: {moment.kind}"
            if not moment.digest:
                raise NotAccepted(f"{who}: a recorded worker sent it")
            of_hello = moment.kind == "Hello"
            processes = [one for one in honest[peer] if (which == one.nonce if of_hello else which in one.sessions)]
            if len(processes) != 1:
                raise NotAccepted(f"{who}: no process of this worker was in session {which}")
            heard[processes[0].nonce].append(moment)
    for worker in workers:
        where = f"the learners heard of a process of {worker.name}"
        check_order(where, worker.said, heard[worker.nonce], accepted, "from workers")


def _check_down(
    workers: list[WorkerTrace], learners: list[LearnerTrace], honest: dict[bytes, list[WorkerTrace]], accepted: Acceptance
) -> None:
    peers = {worker.nonce: peer for peer, processes in honest.items() for worker in processes}
    said: dict[bytes, list[Moment]] = defaultdict(list)
    for learner in learners:
        for peer, moment in learner.said:
            said[peer].append(moment)
    for worker in workers:
        where = f"a process of {worker.name} heard"
        check_order(where, said[peers.get(worker.nonce, b"")], worker.heard, accepted, "to workers")


def check_order(where: str, said: list[Moment], heard: Iterable[Moment], accepted: Acceptance, direction: str) -> None:
    """All that was heard was said before; count what came twice, or out of order."""
    places: dict[tuple[str, bytes], list[int]] = defaultdict(list)
    for number, moment in enumerate(said):
        places[moment.kind, moment.digest].append(number)
    following, taken = 0, set[int]()
    for moment in heard:
        every = [number for number in places[moment.kind, moment.digest] if said[number].at_s <= moment.at_s]
        if not every:
            raise NotAccepted(f"{where} {moment.kind} at {moment.at_s:.3f} s, which nobody had said")
        accepted.counts[f"messages {direction}"] += 1
        in_order = next((number for number in every if number >= following), None)
        if in_order is not None:
            following = in_order + 1
            taken.add(in_order)
        elif set(every) <= taken:
            accepted.counts[f"messages {direction} that came twice"] += 1
        else:
            accepted.counts[f"messages {direction} that came out of order"] += 1
    accepted.counts[f"messages {direction} that were lost"] += len(said) - len(taken)


if __name__ == "__main__":
    try:
        sys.stdout.write(f"{accept(Path(sys.argv[1]))}\n")
    except NotAccepted as error:
        sys.stdout.write(f"not accepted: {error}\n")
        sys.exit(1)
