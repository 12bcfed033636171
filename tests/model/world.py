"""The model: the learner, the workers and the messages between them, and what can happen next.

Rule: a state is a tuple of small numbers: of the learner, of a seat for each worker (the worker and its messages under way),
and of the faults left. What an event makes of the learner or of a worker is computed once, by the program's own code, and
remembered; so a state costs a few look-ups. A connection keeps the order of messages; only a copy of a message that has
arrived can arrive again at any time. (A fault repeats a message.)

So that there are few states:
 - Time passes only when nothing else is under way. If it passes earlier, a fault has delayed what is under way.
 - States that differ only in the numbers of the workers, or in names (`names.py`), are one state.
 - Without faults left the learner does not restart, so its checkpoints are forgotten.
 - Without faults left, a worker that has a message to handle moves at once: see `moves`.
 - A worker that is gone for ever goes when time is about to pass: see `ends_of_faults`.
`reduced=False` explores without the last three.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

from tests.model.conversation import Content, Conversation, Event
from tests.model.names import Name, renaming
from tests.model.parts import Parts, Seat

State = tuple[int, ...]
"""Number of the learner, number of the seat of each worker, faults that can still happen."""

BROKEN = "broken"
FOR_EVER = -1  # instead of the number of faults left: one worker or its link is gone for ever, and nothing else goes wrong


class Action(NamedTuple):
    """What happens."""

    what: str
    """one of `story.SENTENCES`"""
    number: int = 0
    """of the worker or the version"""
    message: int | None = None


Move = tuple[Action, State]
"""What can happen, and the state after it, which is not in canonical form."""


WorkerMove = tuple[str, int | None, int]
"""What can happen to a worker alone, with which message, and its seat after it."""


GONE: Content = ("gone",)
"""in place of a worker that is gone for ever, or whose link is"""


def broken(error: Exception) -> Content:
    """In place of a learner or worker: a rule does not hold, or the program raised."""
    return BROKEN, f"{type(error).__name__}: {error}"


class World:
    """All parts that were met, and what can happen."""

    def __init__(self, conversation: Conversation, *, reduced: bool = True) -> None:
        self.conversation, self.reduced = conversation, reduced
        self.parts = Parts()
        self._renamings: dict[Any, dict[Name, Name | None]] = {}
        # What follows is computed once for each argument. (A decorator would keep all worlds alive.)
        self.facts = cache(lambda part: conversation.facts(self.parts[part]))
        self.worker = cache(lambda seat: self.facts(self.parts[seat].worker))
        self._learner_event = cache(self._compute_learner_event)
        self._worker_event = cache(self._compute_worker_event)
        self._worker_moves = cache(self._compute_worker_moves)
        self._worker_faults = cache(self._compute_worker_faults)
        self._arrived = cache(self._compute_arrived)
        self._sent = cache(self._compute_sent)
        self._alone = cache(self.parts.alone)
        self._without_checkpoints = cache(self._compute_without_checkpoints)

    def start(self) -> State:
        """The learner has started, and no worker has."""
        learner, workers = self.conversation.start()
        seats = [self.parts.number(Seat(self.parts.number(worker))) for worker in workers]
        return self.canonical(self._at_most(self.conversation.faults, self.parts.number(learner), *seats))

    def why_broken(self, state: State) -> str:
        """Which rule does not hold in this state; empty: none."""
        workers = [self.parts[seat].worker for seat in state[1:-1]]
        return next((self.parts[part][1] for part in (state[0], *workers) if self.parts[part][0] == BROKEN), "")

    def reached(self, state: State) -> bool:
        """Whether the run has reached its target."""
        return self.facts(state[0]).reached

    # ---------------------------------------------------------------- what can happen

    def moves(self, state: State) -> list[Move]:
        """Enough of what can happen without a fault to show every broken rule.

        Without faults left, only the moves of one worker that has a message to handle. Why: every rule is about the learner
        or about one worker. Nothing that happens elsewhere changes what this worker can do or what that leads to, and no
        time passes before it has moved. So what happens elsewhere leads to the same states if it happens after the move. A
        worker handles finitely many messages without the others, so nothing is put off for ever. (Whether a worker moves
        before it is gone for ever makes no difference.)
        """
        if state[-1] <= 0 and self.reduced:
            for number, seat in enumerate(state[1:-1]):
                if self.worker(seat).awake and self.parts[seat].down:
                    return self._moves_of(state, number, self._worker_moves(number, seat))
        return self.all_moves(state)

    def all_moves(self, state: State) -> list[Move]:
        """All that can happen without a fault. Time comes last."""
        learner, *seats, _ = state
        moves: list[Move] = []
        under_way = updating = self.facts(learner).updating
        for number, seat in enumerate(seats):
            moves += self._moves_of(state, number, self._worker_moves(number, seat))
            up, late_up = self.parts[seat].up, self.parts[seat].late_up
            arrivals = *[("up", each) for each in up[:1]], *[("late up", each) for each in dict.fromkeys(late_up)]
            moves += [(Action(what, number, each), self._receive(state, number, what, each)) for what, each in arrivals]
            under_way = under_way or self._under_way(seat)
        if updating:
            moves.append((Action("publish"), self._after_learner(state, ("publish",))))
        if not under_way:
            moves.append((Action("time"), self._after_time(state)))
        return moves

    def faults(self, state: State) -> list[Move]:
        """All faults that can happen."""
        learner, *seats, faults = state
        if faults <= 0:
            return []
        moves: list[Move] = []
        for number, seat in enumerate(seats):
            worker, up, down, _, late_down = self.parts[seat]
            moves += self._moves_of(state, number, self._worker_faults(number, seat))
            if up:
                moves.append((Action("repeat up", number, up[0]), self._receive(state, number, "repeat up", up[0])))
            if self.worker(seat).alive:
                dead = _with(state, number, self._after_worker(number, seat, ("end",)))
                event = "ended", number, self.worker(seat).nonce
                moves.append((Action("kill, reported", number), self._after_learner(dead, event)))
            if number in self.facts(learner).members and not self.worker(seat).shut_out:
                unheard = self.parts.number(Seat(worker, (), down, (), late_down))
                shut_out = _with(state, number, self._after_worker(number, unheard, ("shut out",)))
                moves.append((Action("revoke", number), self._after_learner(shut_out, ("revoke", number))))
        if self.facts(learner).updating or any(self._under_way(seat) for seat in seats):
            moves.append((Action("delay"), self._after_time(state)))
        for version in range(self.facts(learner).checkpoints):
            silent = [self.parts.number(Seat(self.parts[seat].worker)) for seat in seats]
            after = self._after_learner((learner, *silent, faults), ("restart", version))
            moves.append((Action("restart", version), after))
        only = self.conversation.only
        return [
            (action, self._at_most(faults - 1, *after[:-1])) for action, after in moves if not only or action.what in only
        ]

    def ends_of_faults(self, state: State) -> list[Move]:
        """Nothing goes wrong any more; then, at any time, one worker or its link is gone for ever."""
        learner, *seats, faults = state
        if faults > 0:
            return [(Action("calm"), self._at_most(0, learner, *seats))]
        if faults == FOR_EVER:
            return []
        moves: list[Move] = []
        gone = self.parts.number(GONE)
        for number, seat in enumerate(seats):
            # Until time passes, a worker that is gone does not differ from one whose turn does not come. So it goes when
            # only what it does or has said keeps time from passing. (If what it said did arrive, it goes after that.)
            needed = self.conversation.is_needed(self.parts[self.parts[seat].worker])
            if not needed and not (self.reduced and self._others_under_way(state, number)):
                nothing = self.parts.number(Seat(gone, late_up=self.parts[seat].late_up))
                moves.append((Action("gone for ever", number), (*_with(state, number, nothing)[:-1], FOR_EVER)))
        return moves

    def _others_under_way(self, state: State, number: int) -> bool:
        """Whether anything but this worker, or what it said, is under way."""
        others = (each for each in state[1 : number + 1] + state[number + 2 : -1])
        return self.facts(state[0]).updating or any(self._under_way(each) for each in others)

    def gave_up(self, before: State, after: State) -> bool:
        """Whether the learner has fewer members, or a worker says Hello anew."""
        lost = len(self.facts(after[0]).members) < len(self.facts(before[0]).members)
        return lost or any(self.worker(seat).rejoins for seat in after[1:-1])

    @staticmethod
    def _moves_of(state: State, number: int, moves: list[WorkerMove]) -> list[Move]:
        return [(Action(what, number, message), _with(state, number, after)) for what, message, after in moves]

    def _compute_worker_moves(self, number: int, at: int) -> list[WorkerMove]:
        """What the worker of this number, in this seat, can do without the learner."""
        seat, facts = self.parts[at], self.worker(at)
        happens = {
            "start": not facts.alive and self.parts[seat.worker] != GONE,
            "thaw": facts.frozen,
            "told": facts.awake and facts.shut_out,
            "finish": facts.awake and facts.working,
        }
        moves: list[WorkerMove] = [
            (what, None, self._after_worker(number, at, (what,))) for what in happens if happens[what]
        ]
        if facts.awake:
            moves += [self._handle(number, at, "down", each) for each in seat.down[:1]]
            moves += [self._handle(number, at, "late down", each) for each in dict.fromkeys(seat.late_down)]
        return moves

    def _handle(self, number: int, seat: int, what: str, message: int) -> WorkerMove:
        rest = self._arrived(seat, what, message)
        return what, message, self._after_worker(number, rest, ("handle", message))

    def _compute_worker_faults(self, number: int, at: int) -> list[WorkerMove]:
        """What can go wrong with this worker and its messages without the learner."""
        seat, facts = self.parts[at], self.worker(at)
        faults: list[WorkerMove] = [("drop up", each, self._arrived(at, "up", each)) for each in seat.up[:1]]
        faults += [("drop down", each, self._arrived(at, "down", each)) for each in seat.down[:1]]
        if facts.awake:
            faults += [self._handle(number, at, "repeat down", each) for each in seat.down[:1]]
            faults.append(("freeze", None, self._after_worker(number, at, ("freeze",))))
        if facts.alive:
            faults.append(("kill", None, self._after_worker(number, at, ("end",))))
        return faults

    def _under_way(self, seat: int) -> bool:
        facts, messages = self.worker(seat), self.parts[seat]
        return bool(messages.up or (facts.awake and (messages.down or facts.working)))

    # ---------------------------------------------------------------- what an event leads to

    def _at_most(self, faults: int, learner: int, *seats: int) -> State:
        """The state with so many faults left. Without any the learner will not restart, so its checkpoints do not matter."""
        return (learner if faults > 0 or not self.reduced else self._without_checkpoints(learner), *seats, faults)

    def _compute_without_checkpoints(self, learner: int) -> int:
        content = self.parts[learner]
        return learner if content[0] == BROKEN else self.parts.number(self.conversation.without_checkpoints(content))

    def _after_time(self, state: State) -> State:
        learner, *seats, faults = self._after_learner(state, ("time",))
        return (learner, *[self._after_worker(number, seat, ("time",)) for number, seat in enumerate(seats)], faults)

    def _receive(self, state: State, number: int, what: str, message: int) -> State:
        seat = self._arrived(state[number + 1], what, message)
        return self._after_learner(_with(state, number, seat), ("receive", number, message))

    def _compute_arrived(self, number: int, what: str, message: int) -> int:
        """The seat without this message, or with a copy of it that arrives later: `what` begins with "repeat"."""
        seat = self.parts[number]
        *how, way = what.split()
        late = f"late_{way}"
        channel = late if how == ["late"] else way
        rest = list(getattr(seat, channel))
        rest.remove(message)
        seat = seat._replace(**{channel: tuple(rest)})
        if how == ["repeat"]:
            seat = seat._replace(**{late: tuple(sorted((*getattr(seat, late), message)))})
        return self.parts.number(seat)

    def _after_learner(self, state: State, event: Event) -> State:
        before, *seats, faults = state
        learner, out = self._learner_event(before, event)
        for number, message in out:
            seats[number] = self._sent(seats[number], message)
        return self._at_most(faults, learner, *seats)

    def _compute_sent(self, number: int, message: int) -> int:
        """The seat after the learner has sent this message. It is lost if no process is there."""
        seat = self.parts[number]
        return self.parts.number(seat._replace(down=(*seat.down, message))) if self.worker(number).alive else number

    def _compute_learner_event(self, learner: int, event: Event) -> tuple[int, tuple[tuple[int, int], ...]]:
        message = self.parts[event[2]] if event[0] == "receive" else None
        try:
            after, sent = self.conversation.learner(self.parts[learner], event, message)
        except Exception as error:
            return self.parts.number(broken(error)), ()
        return self.parts.number(after), tuple([(worker, self.parts.number(told)) for worker, told in sent])

    def _after_worker(self, number: int, seat: int, event: Event) -> int:
        """The seat of the worker of this number, after this event."""
        before, up, down, late_up, late_down = self.parts[seat]
        worker, sent = self._worker_event(number, before, event)
        facts = self.facts(worker)
        if not facts.shut_out:
            up += sent
        if not facts.alive:
            down = late_down = ()
        return self.parts.number(Seat(worker, up, down, late_up, late_down))

    def _compute_worker_event(self, number: int, worker: int, event: Event) -> tuple[int, tuple[int, ...]]:
        if self.parts[worker] == GONE:
            return worker, ()  # time passes
        message = self.parts[event[1]] if event[0] == "handle" else None
        try:
            after, sent = self.conversation.worker(self.parts[worker], number, event, message)
        except Exception as error:
            return self.parts.number(broken(error)), ()
        return self.parts.number(after), tuple([self.parts.number(said) for said in sent])

    # ---------------------------------------------------------------- canonical form

    def canonical(self, state: State) -> State:
        """The same state, with its names and its workers numbered anew."""
        learner, *seats, faults = state
        order = self._order(learner, seats)
        key = order, *[self.parts.names[each] for each in state[:-1]]
        new = self._renamings.get(key)
        if new is None:
            names = frozenset().union(*key[1:])
            new = self._renamings[key] = renaming(names, {old: number for number, old in enumerate(order)})
        if not new:
            return state
        return (self.parts.renamed(learner, new), *[self.parts.renamed(seats[old], new) for old in order], faults)

    def _order(self, learner: int, seats: list[int]) -> tuple[int, ...]:
        """The workers in an order that does not depend on their numbers: members first, as they joined."""
        members = self.facts(learner).members
        if len(members) == len(seats):
            return members
        others = [number for number in range(len(seats)) if number not in members]
        return (*members, *sorted(others, key=lambda number: self._alone(seats[number])))


def _with(state: State, number: int, seat: int) -> State:
    return (*state[: number + 1], seat, *state[number + 2 :])
