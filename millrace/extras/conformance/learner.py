"""The learner that a check plays for the client. Pure: events and `now` in, effects out.

Each check decides which messages the learner sends and which of them are lost. The learner keeps the state that every check
needs: the client's newest Hello, the session, and the watch over its messages. Unless a check turns this off, the learner
answers each Heartbeat, and answers a repeated Hello with the same Welcome.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from typing import Any, TypeVar

from msgspec.structs import replace

from millrace.extras.conformance.script import (
    Broken,
    ClientEvent,
    CutConnection,
    EndClient,
    Ended,
    Heard,
    LearnerEffect,
    Script,
    SendFrames,
    Skipped,
    StartClient,
    Wait,
    brief,
)
from millrace.extras.conformance.watch import WatchedSession
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.description import DescribedEnv
from millrace.protocol.errors import BadMessage
from millrace.protocol.keys.keys import Token
from millrace.protocol.messages import (
    PROTOCOL_VERSION,
    Alive,
    Failure,
    Goodbye,
    Heartbeat,
    Hello,
    Inquire,
    Rejoin,
    ToLearner,
    ToWorker,
    Welcome,
)
from millrace.protocol.rules import Rule
from millrace.protocol.specs import RunSpec, StepSpec, WaitSpec
from millrace.protocol.wire.codec import Buffer, encode

M = TypeVar("M")
QUIET_S = 0.7  # how long `Learner.quiet` waits by default


@dataclass(frozen=True)
class Settings:
    """Settings of the whole test."""

    env: EnvSpec
    copies: int = 2
    """N, the number of env copies in a lane"""
    patience_s: float = 5.0
    """how long the client may take to answer"""
    start_s: float = 20.0
    """how long the client may take from its start to its first Hello"""
    heartbeat_s: float = 0.25
    """the interval of Heartbeats that sessions ask for"""
    token: Token | None = None
    """the client's token, if the connection is encrypted"""


class Learner:
    """The learner's half of one conversation."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.now = 0.0
        self.effects: list[LearnerEffect] = []
        self.runs = False
        """whether the client's process is running"""
        self.is_mute = False
        """whether the client was started and has never said Hello"""
        self.peer = b""
        self.hello: Hello | None = None
        """the newest Hello of the running process; until its first Hello, messages come from the previous process"""
        self.answers_heartbeats = True
        self.may_leave = False
        """whether the client may leave its session, or a new process take its name; if so, no Heartbeat is due"""
        self.tickets = count(101)
        self.env: DescribedEnv | None = None
        """the environment that the client has described, at any time during the test"""
        self.step_s = 0.0
        """time per env step in a long rollout; 0 if it hasn't been measured yet"""
        self._sessions = count(0x5EED_0001)
        self._had_a_session = False  # whether the running process has had a session
        self._steps = 0  # number of env steps that the running process has reported
        self._watch: WatchedSession | None = None  # the watch over the current session

    @property
    def watch(self) -> WatchedSession:
        """The watch over the current session."""
        assert self._watch is not None, "the check has welcomed the client"
        return self._watch

    @property
    def session(self) -> int:
        """The number of the current session."""
        return self.watch.session

    # --------------------------------------------------------------------------------------------------------- sending

    def send(self, message: ToWorker) -> None:
        """Send a message to the client."""
        if self._watch is not None:
            self._watch.sent(message)
        self.effects.append(SendFrames(self.peer, encode(message)))

    def send_unreadable(self, ticket: int, *messages: list[Buffer]) -> None:
        """Send messages that can't be read. Some of them contain this ticket, which the client must not answer."""
        self.watch.unreadable(ticket)
        self.effects += [SendFrames(self.peer, frames) for frames in messages]

    def welcome(self, run: WaitSpec | RunSpec | StepSpec) -> None:
        """Answer the newest Hello, which begins a new session."""
        assert self.hello is not None
        self.answers_heartbeats = True
        welcome = Welcome(next(self._sessions), self.hello.attempt, run)
        self._watch = WatchedSession(welcome, self.now, self._steps, is_first=not self._had_a_session)
        self._had_a_session = True
        self.send(self._watch.welcome)

    def begin(self, run: RunSpec | StepSpec) -> None:
        """Begin the run in the session in which the client waits for it."""
        self.send(replace(self.watch.welcome, run=run))

    def do(self, *effects: LearnerEffect) -> None:
        """Request these effects on the client's process and its connections."""
        self.effects += effects
        for effect in effects:
            match effect:
                case StartClient():
                    self.runs = True
                    self.is_mute = not self.peer
                case EndClient():
                    self._forget_process()
                case CutConnection() if self._watch is not None:
                    self._watch.loses()
                    self._watch.heard_heartbeat_s = self.now + self.settings.patience_s

    # --------------------------------------------------------------------------------------------------------- hearing

    def take(self, event: ClientEvent, wanted: Callable[[ClientEvent], bool]) -> bool:
        """Update the state for an event. Returns whether the check waits for it. Raises `Broken` if it breaks a rule."""
        match event:
            case Ended():
                self._forget_process()
                if not wanted(event):
                    raise Broken(Rule.STAYS, "the client to go on", str(event))
                return True
            case Heard(_, BadMessage() as error) if self.runs:
                raise Broken(_rule_of_unreadable(str(error)), "a message that can be read", str(error))
            case Heard(peer, Hello() as hello) if self.runs and (self.hello is None or peer == self.peer):
                self._take_hello(hello, is_wanted=wanted(event))
                self.peer = peer
                self.hello = hello
                self.is_mute = False
                return wanted(event)
            case Heard(_, Hello() | Alive() | Inquire() | BadMessage()):
                return False  # from a supervisor, a process that was ended, or a second worker started by this command
            case Heard(peer, message) if peer == self.peer and self.hello is not None:
                return self._take_message(message, event, wanted)
        return False

    def _forget_process(self) -> None:
        self.runs = False
        self.hello = None
        self._watch = None
        self.may_leave = False
        self._had_a_session = False
        self._steps = 0

    def _take_hello(self, hello: Hello, is_wanted: bool) -> None:
        if self.hello is not None and hello.process_nonce != self.hello.process_nonce and not self.may_leave:
            raise Broken(Rule.STAYS, "the same process, or the client's end", "the Hello of a new process under its name")
        if self._watch is None:
            return
        if self.hello is not None and hello.attempt == self.hello.attempt:
            self.send(self._watch.welcome)
        elif self.may_leave or is_wanted:
            self._watch = None
            self.may_leave = False
        else:
            raise Broken(Rule.SILENT, "the client to stay in its session while the learner answers", brief(hello))

    def _take_message(
        self, message: ToLearner | Inquire | BadMessage, event: ClientEvent, wanted: Callable[[ClientEvent], bool]
    ) -> bool:
        watch = self._watch
        if watch is None and wanted(event):
            return True
        if watch is None or getattr(message, "session", None) != watch.session:
            current = "none: the client is joining" if watch is None else str(watch.session)
            raise Broken(Rule.SESSION, f"session {current}", brief(message))
        assert not isinstance(message, Inquire | BadMessage), "they have no session"
        watch.see(message, self.now)
        self._steps = watch.steps
        if isinstance(message, Heartbeat) and self.answers_heartbeats:
            self.send(watch.reply(watch.replies + 1))
        if wanted(event):
            return True
        match message:
            case Failure(_, error):
                raise Broken(Rule.STAYS, "the client to go on", f"Failure: {error}")
            case Goodbye(_, reason) if watch.answers:
                raise Broken(Rule.STAYS, "the client to go on", f"Goodbye: {reason}")
            case Goodbye(_, reason):
                part = f"a client that takes part in a session with a {type(watch.run).__name__}"
                raise Broken(Rule.DECLINED, part, f"Goodbye: {reason}")
        return False

    def check_heartbeats(self) -> None:
        """Raise `Broken` if a Heartbeat is overdue. While the client may leave its session, no Heartbeat is due."""
        if self._watch is not None and not (self.may_leave or self._watch.said_goodbye):
            self._watch.late(self.now)

    # ----------------------------------------------------------------------------------------------- parts of any check

    def expect(
        self, kinds: type[M] | tuple[type[M], ...], rule: Rule, expected: str, *, within_s: float = 0.0, **fields: Any
    ) -> Script[M]:
        """Wait for a message of these kinds whose fields have these values, for `within_s` (by default, `patience_s`).

        Raises `Broken` with this rule and this expectation if none arrives.
        """
        may_end = Goodbye in (kinds if isinstance(kinds, tuple) else (kinds,))

        def is_it(event: ClientEvent) -> bool:
            if isinstance(event, Ended):
                return may_end
            message = event.message
            return isinstance(message, kinds) and all(getattr(message, name) == value for name, value in fields.items())

        within_s = within_s or self.settings.patience_s
        heard = yield Wait(within_s, is_it)
        if not isinstance(heard, Heard):
            raise Broken(rule, expected, f"none within {within_s:g} s" if heard is None else f"{heard}, without Goodbye")
        message: M = heard.message  # type: ignore[assignment]
        return message

    def takes_part(self, kind: type[M], rule: Rule, expected: str, *, within_s: float = 0.0) -> Script[M]:
        """Wait for a message of this kind. If the client declines with Goodbye instead, skip the check."""
        message = yield from self.expect((kind, Goodbye), rule, expected, within_s=within_s)
        if isinstance(message, Goodbye):
            yield from self.left(Rule.DECLINED, "Goodbye", (2,))
            raise Skipped(f"it declines: {message.reason}")
        assert isinstance(message, kind)
        return message

    def quiet(self, kind: type, rule: Rule, expected: str, *, for_s: float = QUIET_S) -> Script[None]:
        """Raise `Broken` if anything of this kind arrives within this many seconds."""
        heard = yield Wait(for_s, lambda event: isinstance(event, Heard) and isinstance(event.message, kind))
        if isinstance(heard, Heard):
            raise Broken(rule, expected, brief(heard.message))

    def left(self, rule: Rule, after: str, codes: tuple[int, ...] = (0,)) -> Script[None]:
        """Wait until the client's process ends. Raises `Broken` unless it has one of these exit codes."""
        within_s = self.settings.patience_s
        ended = yield Wait(within_s, lambda event: isinstance(event, Ended))
        if not isinstance(ended, Ended):
            raise Broken(rule, f"the client's end after {after}", f"a client that still runs {within_s:g} s later")
        if ended.code not in codes:
            raise Broken(rule, f"exit code {' or '.join(map(str, codes))} after {after}", f"exit code {ended.code}")

    def joining(self) -> Script[Hello]:
        """Start the client or tell it to join again, so that it has said Hello and waits for a Welcome."""
        if self._watch is not None:
            return (yield from self.rejoin())
        if self.hello is not None:
            return self.hello
        return (yield from self.newly_started())

    def newly_started(self) -> Script[Hello]:
        """Start the client as a new process, and wait for its first Hello."""
        if self.runs:
            self.do(EndClient())
        self.do(StartClient())
        within_s = self.settings.start_s
        hello = yield from self.expect(
            Hello, Rule.HELLO, f"Hello after the start (--start-s {within_s:g})", within_s=within_s
        )
        if hello.protocol != PROTOCOL_VERSION:
            raise Broken(Rule.PROTOCOL, f"protocol {PROTOCOL_VERSION}", f"protocol {hello.protocol}")
        return hello

    def rejoin(self) -> Script[Hello]:
        """Tell the client to join again, and wait for its Hello."""
        self.send(Rejoin(self.session))
        return (yield from self.later_hello(Rule.REJOIN, "Hello with a later attempt after Rejoin"))

    def later_hello(self, rule: Rule, expected: str, *, within_s: float = 0.0) -> Script[Hello]:
        """Wait until the client leaves its session and says Hello again, in the same process and with a later attempt."""
        before = self.hello
        assert before is not None
        self.may_leave = True
        hello = yield from self.expect(Hello, rule, expected, within_s=within_s)
        if hello.process_nonce != before.process_nonce or hello.attempt <= before.attempt:
            expected = f"an attempt later than {before.attempt}, under process_nonce {before.process_nonce}"
            raise Broken(rule, expected, f"attempt {hello.attempt}, under process_nonce {hello.process_nonce}")
        return hello


def _rule_of_unreadable(error: str) -> Rule:
    return Rule.LIMITS if any(words in error for words in ("at most", "1 to", "length <=")) else Rule.FRAMES
