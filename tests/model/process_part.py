"""A worker's process in the model, whatever its work is: a real `Session`, and what happened to the process.

Rule: a session is taken apart into plain tuples and put together again, as the learner is. What happens to a process is the
same in every conversation; what it does after each event is its own.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, TypeVar

from millrace.protocol.messages import ToLearner, ToWorker
from millrace.workers.conversation.session import Session, WorkerEffect, WorkerIdentity
from millrace.workers.conversation.worker_states import WorkerState
from tests.model.conversation import Content, Event, Facts
from tests.model.message_content import session
from tests.model.names import ATTEMPTS, MASK, Kind, name
from tests.model.settings import FOR_EVER_S, TIMEOUT_S

PAUSE_S = 0.5  # between two Hellos: one in every tick


@dataclass
class Process(ABC):
    """One state of a worker, which an event changes."""

    settings: Any
    number: int
    nonce: int
    """of its process; a later process has a larger one"""
    session: Session | None = None
    """None: its process has ended"""
    frozen: bool = False
    shut_out: bool = False
    """whether its key was revoked: the learner hears nothing of it"""
    evaluates: bool = False
    """whether it only plays evaluations: so does the next process of this worker"""

    def event(self, event: Event, message: ToWorker | None, now: float) -> list[ToLearner]:
        """What the worker says after this event. `message`: what it handles, if anything."""
        current = self.session
        match event:
            case "handle", _:
                assert message is not None
                return self.handle(message, now)
            case ("start",):  # a new process, under the same name
                self.nonce += ATTEMPTS
                self.shut_out = False
                self.session = self.new_session(now)
                return self.turn([], now)
            case ("finish",):
                return self.finish(now)
            case ("time",):
                return [] if current is None or self.frozen else self.turn([], now)
            case ("told",):
                assert current is not None
                return self.turn(current.refused("its key was revoked"), now)
            case ("end",):
                self.end()
            case ("shut out",):
                self.shut_out = True
            case ("freeze",) | ("thaw",):
                self.frozen = event == ("freeze",)
        return []

    def new_session(self, now: float) -> Session:
        """A process of this worker has started."""
        who = WorkerIdentity(f"w{self.number}", "host", 1, self.nonce, "model", self.evaluates)
        return Session(who, now, join_timeout_s=FOR_EVER_S, rejoin_timeout_s=FOR_EVER_S)

    def handle(self, message: ToWorker, now: float) -> list[ToLearner]:
        """A message has come."""
        assert self.session is not None
        return self.turn(self.session.handle(message, now), now)

    def end(self) -> None:
        """The process is killed, or leaves."""
        self.session, self.frozen = None, False

    @abstractmethod
    def finish(self, now: float) -> list[ToLearner]:
        """Its work is done."""

    @abstractmethod
    def turn(self, effects: list[WorkerEffect], now: float) -> list[ToLearner]:
        """Do what the program does after each event."""


# -------------------------------------------------------------------- to tuples and back


def saved(process: Process, now: float, more: Content, work: Content | None) -> Content:
    """The process, its session, what it holds of its work (`more`), and the work in progress."""
    nonce = name(Kind.NONCE, process.nonce, process.number)
    flags = process.frozen, process.shut_out, process.evaluates
    current = process.session
    if current is None:
        return nonce, flags, None, None
    held = current._current
    fields = (
        current.state,
        None if current.run is None else session(current.session),
        name(Kind.ATTEMPT, current._attempt, process.number),
        max(current._unanswered_s - now, -TIMEOUT_S - 1.0),
        max(current.due_s - now, 0.0),
        held.in_progress,
        None if current.run is None else name(Kind.REPLIES, held.replies, current.session),
    )
    return nonce, flags, (*fields, *more), work


P = TypeVar("P", bound=Process)


def loaded(kind: type[P], content: Content, number: int, settings: Any) -> tuple[P, Content]:
    """A process at the time 0 with this content, and what it held of its work."""
    nonce, (frozen, shut_out, evaluates), fields, _ = content
    process = kind(settings, number, nonce.value, frozen=frozen, shut_out=shut_out, evaluates=evaluates)
    if fields is None:
        return process, ()
    state, of_session, attempt, heard, due, in_progress, replies, *more = fields
    current = process.session = process.new_session(0.0)
    current.session = MASK  # before its first session: not that of any message
    current.state, current._attempt = WorkerState(state), attempt.value
    current._unanswered_s, current.due_s, current._backoff_s = heard, due, PAUSE_S
    current._current.in_progress = in_progress
    if of_session is not None:
        current.run, current.session, current._current.replies = settings.run, of_session.value, replies.value
    return process, tuple(more)


def facts(content: Content) -> Facts:
    """The facts of a worker."""
    nonce, (frozen, shut_out, _), fields, work = content
    return Facts(
        nonce=nonce.value,
        alive=fields is not None,
        frozen=frozen,
        shut_out=shut_out,
        working=work is not None,
        rejoins=fields is not None and fields[0] is WorkerState.JOINING and fields[1] is not None,
    )
