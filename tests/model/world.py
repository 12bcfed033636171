"""The model: the learner, the workers and the messages between them, and what can happen next.

Rule: a state is a few numbers of parts: the learner, each worker, each message. What an event makes of a part is computed
once, by the program's own code, and remembered; so a state costs a few look-ups. A connection keeps the order of messages;
only a copy of a message that has arrived can arrive again at any time. (A fault repeats a message.)
Time passes only when nothing else can happen without a fault; if it passes earlier, what is under way is delayed by a fault.
States that differ only in the numbers of the workers, or in names, are one state.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from hashlib import blake2b
from typing import Any, NamedTuple

from tests.model.conversation import Action, Content, Conversation, Facts
from tests.model.names import Kind, Name, name, names_in, renamed, renaming


class Seat(NamedTuple):
    """A worker, and the messages that are on their way, oldest first; all by the number of the part."""

    worker: int
    up: tuple[int, ...]
    down: tuple[int, ...]
    late_up: tuple[int, ...] = ()
    """copies of messages that have arrived; they can arrive at any time"""
    late_down: tuple[int, ...] = ()


class State(NamedTuple):
    learner: int
    seats: tuple[Seat, ...]
    faults: int
    """number of faults that can still happen"""


class Part(NamedTuple):
    content: Content
    names: tuple[Name, ...]
    name_set: frozenset[Name]
    digest: int


class Violation(Exception):
    """A rule was broken by this action in this state."""

    def __init__(self, action: Action, why: BaseException) -> None:
        super().__init__(f"{action}: {why!r}")
        self.why = f"{type(why).__name__}: {why}"


class World:
    """All parts that were met, and the actions."""

    def __init__(self, conversation: Conversation) -> None:
        self.conversation = conversation
        self.parts: list[Part] = []
        self.facts: list[Facts] = []
        self.by_digest: dict[int, int] = {}
        self._numbers: dict[Content, int] = {}
        self._events: dict[Any, Any] = {}
        self._renamed: dict[Any, int] = {}
        self._renamings: dict[Any, dict[Name, Name | None]] = {}

    def start(self) -> State:
        """The learner has started, and no worker has."""
        learner, workers = self.conversation.start()
        seats = tuple(Seat(self.part(worker), (), ()) for worker in workers)
        return self.canonical(State(self.part(learner), seats, self.conversation.faults))

    def reached(self, state: State) -> bool:
        """Whether the run has reached its target."""
        return self.facts[state.learner].reached

    def digests(self, state: State) -> Any:
        """The same state in any process, with a digest for each part."""
        parts = self.parts
        seats = [
            (parts[worker].digest, *[tuple([parts[each].digest for each in messages]) for messages in channels])
            for worker, *channels in state.seats
        ]
        return parts[state.learner].digest, tuple(seats), state.faults

    def key(self, state: State) -> int:
        """A hash of 63 bits, even, the same in any process."""
        return hash(self.digests(state)) >> 2 << 1

    # ---------------------------------------------------------------- what can happen

    def actions(self, state: State) -> Iterator[Action]:
        """All actions that need no fault. The order is that of a fair run without faults."""
        learner = self.facts[state.learner]
        under_way = learner.updating
        for number, (worker, up, down, late_up, late_down) in enumerate(state.seats):
            facts = self.facts[worker]
            awake = facts.alive and not facts.frozen
            if not facts.alive and not facts.cut_off:
                yield "start", number
            if facts.frozen:
                yield "thaw", number
            if awake and facts.shut_out:
                yield "told", number
            if awake and down:
                under_way = True
                yield "down", number
            if up:
                under_way = True
                yield "up", number
            if awake and facts.working:
                under_way = True
                yield "finish", number
            for each in late_up:
                yield "late up", number, each
            for each in late_down if awake else ():
                yield "late down", number, each
        if learner.updating:
            yield ("publish",)
        if not under_way:
            yield ("time",)

    def faults(self, state: State) -> Iterator[Action]:
        """All faults that can happen."""
        if not state.faults:
            return
        learner = self.facts[state.learner]
        under_way = learner.updating
        for number, (worker, up, down, _, _) in enumerate(state.seats):
            facts = self.facts[worker]
            awake = facts.alive and not facts.frozen
            under_way = under_way or bool(up or (awake and (down or facts.working)))
            if up:
                yield "drop up", number
                yield "repeat up", number
            if down:
                yield "drop down", number
                if awake:
                    yield "repeat down", number
            if facts.alive:
                yield "kill", number
                yield "kill, reported", number
                if not facts.frozen:
                    yield "freeze", number
            if number in learner.members and not facts.shut_out:
                yield "revoke", number
        if under_way:
            yield ("delay",)
        for version in range(learner.checkpoints):
            yield "restart", version

    def successors(self, state: State) -> Iterator[tuple[Action, State]]:
        """All that can follow, in canonical form. Raises `Violation`."""
        no_fault_yet = state.faults == self.conversation.faults
        for actions, cost in ((self.actions(state), 0), (self.faults(state), 1)):
            for action in actions:
                after = self.after(state, action, cost)
                if no_fault_yet and not cost and self._gave_up(state, after):
                    raise Violation(action, AssertionError("a worker was given up, or gave up, although nothing went wrong"))
                yield action, self.canonical(after)

    def _gave_up(self, before: State, after: State) -> bool:
        """Whether the learner has fewer members, or a worker says Hello anew."""
        lost = len(self.facts[after.learner].members) < len(self.facts[before.learner].members)
        return lost or any(self.facts[seat.worker].rejoins for seat in after.seats)

    def after(self, state: State, action: Action, cost: int = 0) -> State:
        """The state after this action. Raises `Violation`."""
        try:
            after = self._after(state, action)
        except Exception as error:
            raise Violation(action, error) from error
        return after._replace(faults=state.faults - cost) if cost else after

    def _after(self, state: State, action: Action) -> State:
        match action:
            case "down" | "drop down" | "repeat down" as what, number:
                seat = state.seats[number]
                first, late = seat.down[0], seat.late_down
                late = self._sorted((*late, first)) if what == "repeat down" else late
                state = self._with(state, number, seat._replace(down=seat.down[1:], late_down=late))
                return state if what == "drop down" else self._worker(state, number, ("handle", first))
            case "up" | "drop up" | "repeat up" as what, number:
                seat = state.seats[number]
                first, late = seat.up[0], seat.late_up
                late = self._sorted((*late, first)) if what == "repeat up" else late
                state = self._with(state, number, seat._replace(up=seat.up[1:], late_up=late))
                return state if what == "drop up" else self._learner(state, ("receive", number, first))
            case "late down", number, message:
                seat = state.seats[number]
                rest = _without(seat.late_down, message)
                state = self._with(state, number, seat._replace(late_down=rest))
                return self._worker(state, number, ("handle", message))
            case "late up", number, message:
                seat = state.seats[number]
                state = self._with(state, number, seat._replace(late_up=_without(seat.late_up, message)))
                return self._learner(state, ("receive", number, message))
            case "start" | "finish" | "thaw" | "freeze" | "told" as what, number:
                return self._worker(state, number, (what,))
            case "kill", number:
                return self._worker(state, number, ("end",))
            case "kill, reported", number:
                nonce = self.facts[state.seats[number].worker].nonce
                return self._learner(self._worker(state, number, ("end",)), ("ended", number, nonce))
            case "revoke", number:
                state = self._with(state, number, state.seats[number]._replace(up=(), late_up=()))
                return self._learner(self._worker(state, number, ("shut out",)), ("revoke", number))
            case ("publish",):
                return self._learner(state, ("publish",))
            case ("time",) | ("delay",):
                state = self._learner(state, ("time",))
                for number in range(len(state.seats)):
                    state = self._worker(state, number, ("time",))
                return state
            case "restart", version:
                seats = tuple(Seat(seat.worker, (), ()) for seat in state.seats)
                return self._learner(state._replace(seats=seats), ("restart", version))
            case ("dead for ever", number):
                return self._worker(state, number, ("dead for ever",))
            case ("cut off for ever", number):
                seat = Seat(state.seats[number].worker, (), ())
                return self._worker(self._with(state, number, seat), number, ("cut off for ever",))
        raise AssertionError(action)

    # ---------------------------------------------------------------- events of parts

    def _learner(self, state: State, event: Action) -> State:
        key = state.learner, event
        if key not in self._events:
            self._events[key] = self._compute_learner(state.learner, event)
        learner, out = self._events[key]
        seats = list(state.seats)
        for number, message in out:
            facts = self.facts[seats[number].worker]
            if facts.alive and not facts.cut_off:
                seats[number] = seats[number]._replace(down=(*seats[number].down, message))
        return State(learner, tuple(seats), state.faults)

    def _compute_learner(self, number: int, event: Action) -> tuple[int, tuple[tuple[int, int], ...]]:
        message = self.parts[event[2]].content if event[0] == "receive" else None
        learner, sent = self.conversation.learner(self.parts[number].content, event, message)
        return self.part(learner), tuple([(worker, self.part(told)) for worker, told in sent])

    def _worker(self, state: State, number: int, event: Action) -> State:
        seat = state.seats[number]
        key = seat.worker, number, event
        if key not in self._events:
            self._events[key] = self._compute_worker(seat.worker, number, event)
        worker, sent = self._events[key]
        facts = self.facts[worker]
        up = seat.up if facts.shut_out or facts.cut_off else seat.up + sent
        down, late_down = (seat.down, seat.late_down) if facts.alive else ((), ())
        return self._with(state, number, Seat(worker, up, down, seat.late_up, late_down))

    def _compute_worker(self, part: int, number: int, event: Action) -> tuple[int, tuple[int, ...]]:
        message = self.parts[event[1]].content if event[0] == "handle" else None
        worker, sent = self.conversation.worker(self.parts[part].content, number, event, message)
        return self.part(worker), tuple([self.part(said) for said in sent])

    @staticmethod
    def _with(state: State, number: int, seat: Seat) -> State:
        return State(state.learner, (*state.seats[:number], seat, *state.seats[number + 1 :]), state.faults)

    # ---------------------------------------------------------------- parts and names

    def part(self, content: Content) -> int:
        number = self._numbers.get(content)
        if number is None:
            number = self._numbers[content] = len(self.parts)
            names = tuple(sorted(names_in(content, set())))
            digest = int.from_bytes(blake2b(repr(content).encode(), digest_size=7).digest(), "little")
            self.parts.append(Part(content, names, frozenset(names), digest))
            self.facts.append(self.conversation.facts(content))
            assert digest not in self.by_digest, "two parts have the same digest"
            self.by_digest[digest] = number
        return number

    def canonical(self, state: State) -> State:
        """The same state, with its names and its workers numbered anew."""
        parts, seats = self.parts, state.seats
        numbers = [state.learner]
        for worker, up, down, late_up, late_down in seats:
            numbers += worker, *up, *down, *late_up, *late_down
        names = parts[state.learner].name_set.union(*[parts[number].names for number in numbers])
        order = self._order(state)
        key = names, order
        new = self._renamings.get(key)
        if new is None:
            new = self._renamings[key] = renaming(names, {old: number for number, old in enumerate(order)})
        if not new:
            return state
        rename = self._rename
        moved = []
        for old in order:
            worker, up, down, late_up, late_down = seats[old]
            late_up, late_down = (
                self._sorted([rename(m, new) for m in late_up]),
                self._sorted([rename(m, new) for m in late_down]),
            )
            up, down = tuple([rename(m, new) for m in up]), tuple([rename(m, new) for m in down])
            moved.append(Seat(rename(worker, new), up, down, late_up, late_down))
        return State(rename(state.learner, new), tuple(moved), state.faults)

    def _sorted(self, messages: Sequence[int]) -> tuple[int, ...]:
        """Messages whose order does not matter."""
        return tuple(sorted(messages, key=lambda part: self.parts[part].digest) if len(messages) > 1 else messages)

    def _order(self, state: State) -> tuple[int, ...]:
        """The workers in an order that does not depend on their numbers: members first, as they joined."""
        members = self.facts[state.learner].members
        if len(members) == len(state.seats):
            return members
        others = [number for number in range(len(state.seats)) if number not in members]
        if len(others) > 1:
            others.sort(key=lambda number: self._shape(state.seats[number], number))
        return (*members, *others)

    def _shape(self, seat: Seat, number: int) -> tuple[int, ...]:
        """A sort key of a worker that does not contain its number."""
        parts = [
            self._as_first(part, number) for part in (seat.worker, *seat.up, *seat.down, *seat.late_up, *seat.late_down)
        ]
        return tuple(self.parts[part].digest for part in parts)

    def _as_first(self, part: int, number: int) -> int:
        """The same part, if it belonged to worker 0."""
        new: dict[Name, Name | None] = {
            each: name(each.kind, each.value, 0)
            for each in self.parts[part].names
            if each.kind in (Kind.NONCE, Kind.ATTEMPT) and each.scope == number
        }
        return self._rename(part, new)

    def _rename(self, part: int, new: dict[Name, Name | None]) -> int:
        _, names, name_set, _ = self.parts[part]
        if name_set.isdisjoint(new):
            return part
        to = tuple([new.get(each, each) for each in names])
        key = part, to
        number = self._renamed.get(key)
        if number is None:
            number = self._renamed[key] = self.part(renamed(self.parts[part].content, new))
        return number


def _without(messages: tuple[int, ...], message: int) -> tuple[int, ...]:
    index = messages.index(message)
    return messages[:index] + messages[index + 1 :]
