"""The learner that a check plays. Pure: events and `now` in, effects out; the check decides what is said and what is lost.

It keeps the books that every check needs: the client's newest Hello, the session, the watch over its messages. Unless the
check says otherwise, it answers each Heartbeat, and a repeated Hello by the same Welcome again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

from millrace.conformance import rules
from millrace.conformance.rules import Rule
from millrace.conformance.script import (
    AskToStop,
    Broken,
    CutConnection,
    Effect,
    EndClient,
    Ended,
    Event,
    Heard,
    Listen,
    Script,
    Send,
    StartClient,
    Wait,
    brief,
)
from millrace.conformance.watch import Watch
from protocol.env_spec import EnvSpec
from protocol.errors import BadMessage
from protocol.messages import (
    PROTOCOL_VERSION,
    Alive,
    Call,
    Collect,
    Described,
    Failure,
    Goodbye,
    Heartbeat,
    HeartbeatReply,
    Hello,
    Inquire,
    Received,
    Rejoin,
    Reset,
    Step,
    ToLearner,
    ToWorker,
    Welcome,
)
from protocol.specs import DescribeSpec, RunSpec, StepSpec
from protocol.wire.codec import Buffer, encode

M = TypeVar("M")


@dataclass(frozen=True)
class Settings:
    """How the client is checked."""

    env: EnvSpec
    copies: int = 2
    """N, env copies in a lane"""
    patience_s: float = 5.0
    """how long an answer may take"""
    start_s: float = 20.0
    """how long the client may take from its start to its first Hello"""
    heartbeat_s: float = 0.25
    """what sessions ask for"""


class Learner:
    """The learner's half of one conversation."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.now = 0.0
        self.effects: list[Effect] = []
        self.runs = False
        """whether the client's process runs"""
        self.is_mute = False
        """whether the client was started and has never said Hello"""
        self.peer = b""
        self.hello: Hello | None = None
        """the newest, of the process that runs; what comes before it was said by the process before"""
        self.watch: Watch | None = None
        """of the current session; None while there is none"""
        self.hears = True
        """False: what the client says is lost"""
        self.answers_heartbeats = True
        self.allows_hello = False
        """whether the client may start to join by itself"""
        self.allows_another_process = False
        """whether the client's process may have left, and another have started under its name, by its supervisor"""
        self.description: Described | None = None
        """what the client has described, in this whole run of the test"""
        self.long_steps = 0
        """T of a rollout that takes so long that the test can act before its end; 0: it was not measured yet"""
        self.long_s = 0.0
        """how long the client takes for that rollout"""
        self.received: dict[int, Received] | None = None
        """by lane: what HeartbeatReply and Collect say has arrived; None: all that has"""
        self.unlisted: set[int] = set()
        """lanes that they do not list"""
        self._lanes: dict[int, int] = {}  # lane -> incarnation, in this session
        self._numbers = 0x5EED_0000
        self._tickets = 100
        self._steps = 0  # env steps that the process has reported
        self._welcome: Welcome | None = None

    # --------------------------------------------------------------------------------------------------------- sending

    def send(self, message: ToWorker) -> None:
        """Send a message to the client."""
        if self.watch is not None:
            self.watch.sent(message)
            match message:
                case Collect() if message.session == self.session:
                    for permit in message.permits:
                        self._lanes[permit.lane] = max(permit.incarnation, self._lanes.get(permit.lane, 0))
                case Reset() | Step() | Call() if message.session == self.session:
                    self._lanes[message.lane] = max(message.incarnation, self._lanes.get(message.lane, 0))
        self.send_frames(encode(message))

    def send_frames(self, frames: list[Buffer]) -> None:
        """Send these frames, whatever they are."""
        self.effects.append(Send(self.peer, frames))

    def send_unreadable(self, ticket: int, *messages: list[Buffer]) -> None:
        """Send frames that cannot be read, some of them with this ticket, which the client must not answer."""
        assert self.watch is not None
        self.watch.unreadable(ticket)
        for frames in messages:
            self.send_frames(frames)

    def reply(self) -> None:
        """Send the next HeartbeatReply."""
        assert self.watch is not None
        self.send(HeartbeatReply(self.session, self.watch.replies + 1, self.of_lanes()))

    def of_lanes(self) -> tuple[Received, ...]:
        """One entry for each lane of the client."""
        assert self.watch is not None
        entries = []
        for lane, incarnation in sorted(self._lanes.items()):
            if lane in self.unlisted:
                continue
            if self.received is not None:
                entries.append(self.received.get(lane, Received(lane, incarnation, 0)))
                continue
            arrived = [
                rollout.sequence
                for ticket, rollout in self.watch.rollouts.items()
                if (self.watch.permits[ticket].permit.lane, self.watch.permits[ticket].permit.incarnation)
                == (lane, incarnation)
            ]
            entries.append(Received(lane, incarnation, max(arrived, default=-1) + 1))
        return tuple(entries)

    def ticket(self) -> int:
        """The next ticket."""
        self._tickets += 1
        return self._tickets

    @property
    def session(self) -> int:
        """The current session."""
        assert self.watch is not None, "the check has welcomed the client"
        return self.watch.session

    def described_as(self) -> Described:
        """What the client has described."""
        assert self.description is not None
        return self.description

    def release(self, lane: int) -> None:
        """The lane is not the client's any more, as far as the learner's books say."""
        self._lanes.pop(lane, None)

    # --------------------------------------------------------------------------------------------------------- hearing

    def take(self, event: Event, wanted: Callable[[Event], bool]) -> bool:
        """Do the books for an event; whether the check waits for it. Raises `Broken`."""
        match event:
            case Ended(code, line):
                self.runs, self.watch, self.hello = False, None, None
                if not wanted(event):
                    said = f"; it printed: {line}" if line else ""
                    raise Broken(rules.STAYS, "the client to go on", f"its end with exit code {code}{said}")
                return True
            case Heard(_, Alive() | Inquire()):
                return False
            case Heard(_, BadMessage() as error):
                if self.runs and self.hears:
                    raise Broken(_rule_of_unreadable(str(error)), "a message that can be read", str(error))
                return False
            case Heard(peer, Hello() as hello):
                return self._take_hello(peer, hello, event, wanted)
            case Heard(peer, message) if peer == self.peer and self.hello is not None and self.hears:
                return self._take_message(message, event, wanted)
        return False

    def _take_hello(self, peer: bytes, hello: Hello, event: Event, wanted: Callable[[Event], bool]) -> bool:
        if not self.runs:
            return False  # of a client that was ended
        before = self.hello
        if before is not None and peer != self.peer:
            return False  # of a second worker of the same command
        is_another = before is not None and hello.process_nonce != before.process_nonce
        if is_another and not self.allows_another_process:
            raise Broken(rules.STAYS, "the same process, or the client's end", "the Hello of a new process under its name")
        self.peer, self.hello, self.is_mute = peer, hello, False
        if not self.hears:
            return False
        is_later = before is None or hello.attempt != before.attempt
        if self.watch is not None and is_later and not (self.allows_hello or wanted(event)):
            raise Broken(rules.SILENT, "the client to stay in its session while the learner answers", brief(hello))
        if self.watch is not None and is_later:
            self.watch = None
        if not is_later and self.watch is not None and self._welcome is not None:
            self.send(self._welcome)
        return wanted(event)

    def _take_message(
        self, message: ToLearner | Inquire | BadMessage, event: Event, wanted: Callable[[Event], bool]
    ) -> bool:
        of_session = getattr(message, "session", None)
        if self.watch is None and wanted(event):
            return True
        if self.watch is None or of_session != self.watch.session:
            current = "none: the client is joining" if self.watch is None else str(self.watch.session)
            raise Broken(rules.SESSION, f"session {current}", brief(message))
        assert not isinstance(message, Inquire | BadMessage), "they have no session"
        self.watch.see(message, self.now)
        self._steps = self.watch.steps
        is_wanted = wanted(event)
        match message:
            case Heartbeat() if self.answers_heartbeats:
                self.reply()
            case Failure(_, error):
                if not is_wanted:
                    raise Broken(rules.STAYS, "the client to go on", f"Failure: {error}")
            case Goodbye(_, reason):
                if not is_wanted and not (self.watch.answers or self.watch.rollouts):
                    part = f"a client that takes part in a session with a {type(self.watch.run).__name__}"
                    raise Broken(rules.DECLINED, part, f"Goodbye: {reason}")
                if not is_wanted:
                    raise Broken(rules.STAYS, "the client to go on", f"Goodbye: {reason}")
            case _:
                pass
        return is_wanted

    def check_heartbeats(self) -> None:
        """Raise `Broken` if a Heartbeat is overdue. None is due from a client that may leave the session by itself."""
        if self.watch is not None and self.runs and self.hears and not (self.allows_hello or self.watch.said_goodbye):
            self.watch.late(self.now)

    # ----------------------------------------------------------------------------------------------- parts of any check

    def start(self) -> None:
        """Start the client's process."""
        self.effects.append(StartClient())
        self._steps = 0
        self.is_mute |= not self.peer
        self.runs, self.hello, self.watch = True, None, None

    def end(self) -> None:
        """End the client's process, whatever it does."""
        self.effects.append(EndClient())
        self.runs, self.hello, self.watch = False, None, None

    def stop(self) -> None:
        """Send SIGTERM to the client."""
        self.effects.append(AskToStop())

    def cut(self, *, listen: bool = True) -> None:
        """Close every connection; `listen`: and take new ones at once."""
        self.effects.append(CutConnection())
        if listen:
            self.effects.append(Listen())
        if self.watch is not None:
            self.watch.heard_heartbeat_s = self.now + self.settings.patience_s

    def listen(self) -> None:
        """Take connections again."""
        self.effects.append(Listen())

    def expect(self, kind: type[M], rule: Rule, expected: str, *, within_s: float = 0.0, **fields: Any) -> Script[M]:
        """The next message of this kind whose fields have these values, within `within_s` (or the patience). Or `Broken`."""

        def is_it(event: Event) -> bool:
            if kind is Goodbye and isinstance(event, Ended):
                return True
            if not (isinstance(event, Heard) and isinstance(event.message, kind)):
                return False
            return all(getattr(event.message, name) == value for name, value in fields.items())

        within_s = within_s or self.settings.patience_s
        found = yield Wait(within_s, is_it)
        if found is None:
            raise Broken(rule, expected, f"none within {within_s:g} s")
        if isinstance(found, Ended):
            raise Broken(rule, expected, f"the client's end with exit code {found.code}, without Goodbye")
        message: M = found.message  # type: ignore[assignment]
        return message

    def quiet(self, kinds: type | tuple[type, ...], for_s: float, rule: Rule, expected: str) -> Script[None]:
        """Nothing of these kinds arrives for so long. Or `Broken`."""
        found = yield Wait(for_s, lambda event: isinstance(event, Heard) and isinstance(event.message, kinds))
        if found is not None:
            assert isinstance(found, Heard)
            raise Broken(rule, expected, brief(found.message))

    def let_pass(self, for_s: float) -> Script[None]:
        """Let time pass."""
        yield Wait(for_s)

    def joining(self) -> Script[Hello]:
        """A client that has said Hello and is not welcomed. It is started, or told to join again."""
        if self.runs and self.watch is not None:
            return (yield from self.rejoin())
        if self.runs and self.hello is not None:
            return self.hello
        return (yield from self.newly_started())

    def newly_started(self) -> Script[Hello]:
        """A client that has just been started, and has said its first Hello."""
        if self.runs:
            self.end()
        self.start()
        started = self.settings.start_s
        hello = yield from self.expect(
            Hello, rules.HELLO, f"Hello after the start (--start-s {started:g})", within_s=started
        )
        if hello.protocol != PROTOCOL_VERSION:
            raise Broken(rules.PROTOCOL, f"protocol {PROTOCOL_VERSION}", f"protocol {hello.protocol}")
        return hello

    def rejoin(self) -> Script[Hello]:
        """The client is told to join again, and does so."""
        before = self.hello
        assert before is not None
        self.send(Rejoin(self.session))
        self.allows_hello = True  # so that no Heartbeat is due
        hello = yield from self.expect(Hello, rules.REJOIN, "Hello with a later attempt after Rejoin")
        if hello.attempt <= before.attempt:
            raise Broken(rules.REJOIN, f"an attempt later than {before.attempt}", f"attempt {hello.attempt}")
        return hello

    def welcome(self, run: DescribeSpec | RunSpec | StepSpec) -> None:
        """Answer the newest Hello: a new session begins."""
        assert self.hello is not None
        self._numbers += 1
        self._lanes, self.received, self.unlisted = {}, None, set()
        self.answers_heartbeats, self.hears, self.allows_hello, self.allows_another_process = True, True, False, False
        self.watch = Watch(self._numbers, run, self.now, self._steps)
        self._welcome = Welcome(self._numbers, self.hello.attempt, run)
        self.send(self._welcome)

    def left(self, rule: Rule, codes: int | tuple[int, ...], after: str) -> Script[None]:
        """The client's process ends with this exit code, or one of these. Or `Broken`."""
        within_s = self.settings.patience_s
        allowed = (codes,) if isinstance(codes, int) else codes
        found = yield Wait(within_s, lambda event: isinstance(event, Ended))
        if found is None:
            raise Broken(rule, f"the client's end after {after}", f"a client that still runs {within_s:g} s later")
        assert isinstance(found, Ended)
        if found.code not in allowed:
            raise Broken(rule, f"exit code {' or '.join(map(str, allowed))} after {after}", f"exit code {found.code}")


def _rule_of_unreadable(error: str) -> Rule:
    return rules.LIMITS if any(words in error for words in ("at most", "1 to", "length <=")) else rules.FRAMES
