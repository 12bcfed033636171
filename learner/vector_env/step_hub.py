"""The shell round the lock-step: link + lock-step + shared memory + clock. `hear` is the only place that waits.

The law: every wait has a deadline; when it passes, whoever has not answered is given up (and killed, if it is a child of
ours), so that a wait ends with every lane answered or lost, and nobody under way. Nobody is silent whom nobody listens to:
the caller may think as long as it likes between two waits.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from learner.members.events import Broke, Left, Turned, describe
from learner.members.membership import Out
from learner.members.peer_log import Doorkeeper, Lid
from learner.rollouts.status import stepping_status
from learner.vector_env.step_roster import Lockstep, Make
from protocol.address import worker_name
from protocol.errors import BadMessage, EnvironmentFailed, NoWorkers
from protocol.messages import Answer, Inquire
from protocol.specs import StepSpec
from protocol.wire.codec import encode
from protocol.wire.learner_link import LearnerLink
from protocol.wire.shared_memory import SharedMemory
from protocol.wire.wake_up import SpinWait, WakePipe, WakeReason

log = logging.getLogger("millrace.learner")

POLL_S = 0.05  # between two looks at whether a child has ended
LISTEN_EVERY_S = 0.5  # heartbeats are answered so often while steps go through shared memory
AWAY_S = 1.0  # a caller that has not listened for longer was busy: what was said meanwhile may still be on its way
PATIENCE_S = 10.0  # a lost lane waits so long for its worker's successor, and no longer than half its time: then it moves in
# with another lane
BUSY_S = 1.0  # of closing, for a step under way: it may hang, and nobody waits for what it gives
LAST_WORDS_S = 0.1  # what a process said before it ended may still be on its way


class Staff(Protocol):
    """Worker processes of our own."""

    def poll(self) -> Iterable[tuple[str, str]]:
        """Those that have ended since the last call, and why; those that are due are started again."""
        ...

    def kill(self, name: str) -> bool:
        """End one at once; False if it is none of ours."""
        ...

    @property
    def count(self) -> int:
        """How many are here, or will come back."""
        ...

    def stop(self, timeout_s: float) -> None:
        """End all."""
        ...


class Nobody:
    """Staff of a learner whose workers are all started elsewhere."""

    def poll(self) -> Iterable[tuple[str, str]]:
        """None ended."""
        return ()

    def kill(self, name: str) -> bool:
        """None of ours."""
        return False

    @property
    def count(self) -> int:
        """Nobody is."""
        return 0

    def stop(self, timeout_s: float) -> None:
        """Nothing to do."""


@dataclass(frozen=True)
class Shared:
    """Shared memory and the bells of each worker that was handed it."""

    memory: SharedMemory
    bells: Mapping[str, tuple[WakePipe, WakePipe]]
    """by name: rung for the worker, and by it"""

    def close(self) -> None:
        """Let go of all descriptors."""
        self.memory.close()
        for bell in (bell for pair in self.bells.values() for bell in pair):
            bell.close()


class LockstepHub:
    """Everything the vector environment knows of workers."""

    def __init__(
        self,
        link: LearnerLink,
        spec: StepSpec,
        *,
        first_session: int,
        staff: Staff | None = None,
        shared: Shared | None = None,
        spin_s: float = 0.0,
        worker_timeout_s: float = math.inf,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`spin_s`: how long to wait awake for a step through shared memory before sleeping. `worker_timeout_s`: whoever is
        silent for so long while it is listened to is given up; never, where the end of a process is known otherwise.
        """
        self.link, self.spec = link, spec
        self.lockstep = Lockstep(spec, first_session, worker_timeout_s)
        self.staff: Staff = staff or Nobody()
        self._shared, self._spin_s, self._clock = shared, spin_s, clock
        self._awake = SpinWait()
        self._wanted: dict[int, Make] = {}  # lane -> an order that is said as soon as the lane is placed
        self._wanted_since_s = 0.0
        self._patience_s = PATIENCE_S
        self.watch: Callable[[], None] = lambda: None
        """called while waiting; what it raises ends the wait"""
        self.stepped: set[int] = set()
        """lanes whose last step, through shared memory, is done"""
        self._under_way: dict[int, int] = {}  # lane -> number of its order through shared memory
        self._waits: dict[int, tuple[WakePipe, WakePipe] | None] = {}  # lane -> its worker's bells, if it may use them
        self._listen_due_s = 0.0
        self._closing = False
        self._turned_away = ""  # what became of the last one that did not stay
        self._lid = Lid(link, clock)
        self._doorkeeper = Doorkeeper(link)
        self._listened_s = self._listening_since_s = clock()

    @property
    def address(self) -> str:
        """The address that workers connect to."""
        return self.link.address

    @property
    def worker_count(self) -> int:
        """Number of workers that have joined."""
        return len(self.lockstep.members)

    def incarnation(self, lane: int) -> int:
        """How many times the lane has been given new env copies."""
        return self.lockstep.seats[lane].incarnation

    # ---------------------------------------------------------------- saying

    def say(self, makes: Mapping[int, Make]) -> None:
        """Orders, one for each of these lanes; what has not been placed is placed while `hear` waits."""
        self.lockstep.begin()
        self.stepped.clear()
        self._wanted = dict(makes)
        self._wanted_since_s = self._clock()
        self._say_wanted()

    def shares(self, lane: int) -> bool:
        """Whether a step of this lane may go through shared memory: its copies live with a child that was handed it."""
        if lane not in self._waits:
            member = self.lockstep.owner(lane)
            if member is None or not self.lockstep.seats[lane].living or self._shared is None:
                return False
            self._waits[lane] = self._shared.bells.get(member.hello.worker)
        return self._waits[lane] is not None

    def step_shared(self, lanes: Sequence[int]) -> None:
        """The actions are laid in shared memory: step these lanes."""
        self.lockstep.begin()
        self.stepped.clear()
        assert self._shared is not None
        memory = self._shared.memory
        for lane in lanes:
            self._under_way[lane] = self.lockstep.in_memory[lane] = number = memory.ordered(lane) + 1
            memory.order(lane, number)
        for lane in lanes:
            bells = self._waits[lane]
            assert bells is not None
            bells[0].wake()

    # ---------------------------------------------------------------- waiting

    def hear(self, timeout_s: float) -> dict[int, Answer]:
        """Wait until every order is answered or its lane is lost; the answers that came as messages, by lane.

        Raises `EnvironmentFailed` if an environment raised, `NoWorkers` if there was nobody to take a lane in time.
        """
        deadline_s = self._clock() + timeout_s
        self._patience_s = min(PATIENCE_S, timeout_s / 2)
        for lane in list(self._under_way):
            if lane in self._under_way:  # not lost while another was waited for
                self._hear_shared(lane, deadline_s)
        while self._wanted or self.lockstep.orders:
            self._turn(POLL_S)
            if self._clock() > deadline_s:
                self._give_up(timeout_s)
        if self._clock() > self._listen_due_s:
            self._turn(0.0)
        if self.lockstep.broke:
            self._raise_broken()
        return dict(self.lockstep.answers)

    def infos(self, lane: int, timeout_s: float) -> bytes:
        """The packed infos of a lane that was stepped through shared memory."""
        assert self._shared is not None
        packed = self._shared.memory.infos(lane)
        if packed is not None:
            return packed
        deadline_s = self._clock() + timeout_s
        while True:
            if (said := self.lockstep.infos.get(lane)) is not None:
                return said
            if lane not in self.lockstep.in_memory:
                return b""  # its worker is gone, and that is told
            if self._clock() > deadline_s:
                self._give_up_lane(lane, "did not send its infos in time")
            else:
                self._turn(POLL_S)

    def distrust(self, lane: int, why: str) -> None:
        """What this lane's worker sent cannot be used: it is refused."""
        if (member := self.lockstep.owner(lane)) is not None:
            log.warning("worker %s: %s", member.hello.worker, why)
            self._send(self.lockstep.reject(member.peer, why))
            self._after()

    def lost(self) -> dict[int, str]:
        """Lanes whose copies are gone since this was last asked, and why."""
        lost, self.lockstep.lost = self.lockstep.lost, {}
        return lost

    def lives(self, lane: int) -> bool:
        """Whether its copies are with a worker."""
        return self.lockstep.seats[lane].living

    def renew(self) -> None:
        """Every lane is about to begin anew: even out."""
        self._turn(0.0)
        self._waits.clear()
        self._send(self.lockstep.rebalance())

    def wait_for(self, workers: int, timeout_s: float) -> None:
        """Wait until so many workers have joined."""
        deadline_s = self._clock() + timeout_s
        while len(self.lockstep.members) < workers:
            if self._clock() > deadline_s:
                raise self._nobody(timeout_s, workers)
            self._turn(POLL_S)

    def close(self, timeout_s: float) -> None:
        """Ask everybody to leave, wait a moment for their Goodbye, and end those that are ours."""
        self._closing = True
        busy = bool(self._under_way or self.lockstep.orders)
        deadline_s = self._clock() + (min(BUSY_S, timeout_s) if busy else timeout_s)
        self._send(self.lockstep.membership.drain("the vector environment was closed"))
        for bell, _ in self._shared.bells.values() if self._shared is not None else ():
            bell.wake(WakeReason.MESSAGE)
        while self.lockstep.members and self._clock() < deadline_s:
            self._receive(POLL_S)
            for name, why in self.staff.poll():
                self.lockstep.gone(name, why)
        self.staff.stop(max(0.0, deadline_s - self._clock()))

    # ---------------------------------------------------------------- inside

    def _hear_shared(self, lane: int, deadline_s: float) -> None:
        """Wait for one lane's step: awake for a moment, then asleep; it is done when the number is."""
        assert self._shared is not None
        memory, number, bells = self._shared.memory, self._under_way[lane], self._waits[lane]
        assert bells is not None
        self._awake.wait(lambda: memory.answered(lane) == number, self._spin_s)
        while memory.answered(lane) != number and lane in self._under_way:
            if not bells[1].wait(POLL_S):
                self._turn(0.0)
                if self._clock() > deadline_s:
                    self._give_up_lane(lane, "did not answer in time")
            elif self._clock() > self._listen_due_s:
                self._turn(0.0)
        self._take(lane)

    def _take(self, lane: int) -> None:
        """Its step is done, or it is lost."""
        number = self._under_way.pop(lane, None)
        if number is not None and self._shared is not None and self._shared.memory.answered(lane) == number:
            self.stepped.add(lane)

    def _turn(self, timeout_s: float) -> None:
        """Listen; see who has ended; say what can be said."""
        self._listen_due_s = self._clock() + LISTEN_EVERY_S
        self.watch()
        now = self._clock()
        if now - self._listened_s > AWAY_S:
            self._listening_since_s = now
        self._receive(timeout_s)
        self._shut_out()
        self._listened_s = self._clock()
        self.lockstep.tick(self._listened_s, self._listening_since_s)
        self._after()
        for name, why in self.staff.poll():
            self._receive(LAST_WORDS_S)
            self.lockstep.gone(name, why)
            self._after()
        self._say_wanted()

    def _receive(self, timeout_s: float) -> None:
        if self.link.poll(timeout_s):
            for peer, message in self.link.receive():
                match message:
                    case BadMessage():
                        self._lid.complain(peer, f"message from {worker_name(peer)[:40]!r}: {message}")
                        self._send(self.lockstep.reject(peer, str(message)))
                    case Inquire():
                        self.link.send(peer, encode(stepping_status(self.lockstep, self._clock())))
                    case _:
                        self._send(self.lockstep.receive(peer, message, self._clock()))
        self._after()

    def _shut_out(self) -> None:
        for peer, why in self._doorkeeper.shut_out(self.lockstep.members):
            self._send(self.lockstep.revoke(peer, why))
            self._after()

    def _after(self) -> None:
        """Tell what has happened, and let go of what is lost."""
        for event in self.lockstep.events():
            match event:
                case Turned(_, why):
                    self._turned_away = f"was refused: {why}"
                    self._lid.tell(logging.WARNING, event, describe(event))
                case Left(_, why, _, on_purpose):
                    if on_purpose and not self._closing:
                        self._turned_away = why
                    expected = on_purpose and self._closing
                    self._lid.tell(logging.INFO if expected else logging.WARNING, event, describe(event))
                case Broke(worker, host, _, error, _):  # it is raised, with its traceback
                    self._lid.tell(logging.INFO, event, f"worker {worker} ({host}): {error}")
                case _:
                    self._lid.tell(logging.INFO, event, describe(event))
        for lane in [lane for lane in self._waits if self.lockstep.owner(lane) is None]:
            del self._waits[lane]
            self._take(lane)

    def _say_wanted(self) -> None:
        awaited = len(self.lockstep.membership.active()) < self.staff.count  # somebody of ours has yet to join
        patient = awaited and self._clock() - self._wanted_since_s < self._patience_s
        for lane, make in list(self._wanted.items()):
            if self.lockstep.place(lane, patient):
                del self._wanted[lane]
                self._send(self.lockstep.order(lane, make))

    def _send(self, outs: Sequence[Out]) -> None:
        for peer, message in outs:
            if not self.link.send(peer, encode(message)):
                continue  # it is gone, or does not read: its silence will tell
            if self._shared is not None and (bells := self._shared.bells.get(worker_name(peer).decode(errors="replace"))):
                bells[0].wake(WakeReason.MESSAGE)  # it may be asleep beside its shared memory

    def _give_up(self, timeout_s: float) -> None:
        """The deadline has passed: whoever holds an order has had it."""
        if self._wanted and not self.lockstep.orders:
            self._wanted.clear()
            raise self._nobody(timeout_s, 1)
        for order in list(self.lockstep.orders.values()):
            self._give_up_lane(order.lane, f"did not answer within {timeout_s:g} s")

    def _give_up_lane(self, lane: int, why: str) -> None:
        member = self.lockstep.owner(lane)
        if member is not None:
            killed = self.staff.kill(member.hello.worker)
            self.lockstep.gone(member.hello.worker, f"{why}, and was killed" if killed else why)
        self._after()

    def _raise_broken(self) -> None:
        broke, self.lockstep.broke = self.lockstep.broke[0], []
        error = EnvironmentFailed(f"worker {broke.worker} ({broke.host}): {broke.error}", broke.traceback)
        error.add_note(broke.traceback)
        raise error

    def _nobody(self, timeout_s: float, workers: int) -> NoWorkers:
        because = f" ({self.link.refused} were not let in; the log says why)" if self.link.refused else ""
        if self._turned_away:
            because = f" (the last one {self._turned_away})"
        token = "" if self.link.keyring is None else " --token FILE"
        return NoWorkers(
            f"waited {timeout_s:g} s for {workers} workers at {self.link.address}, {len(self.lockstep.members)} are there"
            f"{because}; start one: python -m workers {self.link.address}{token}"
        )
