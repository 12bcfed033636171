"""Calls of a trace are made again, of a new object of the same class: each must have the same result, bit for bit.

Rule: a coordinator and a session depend on nothing but their calls. After each call of a learner, the rules of the model
hold (`tests/model/learner_part.py`), and those of evaluations.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from millrace.learner.members.describe_coordinator import DescribeCoordinator
from millrace.learner.rollouts.lag_rule import Rounds
from millrace.learner.rollouts.lane_history import LaneHistories
from millrace.learner.rollouts.rollout_dealer import AcceptedRollout, RolloutDealer
from millrace.learner.rollouts.ticket_coordinator import TicketCoordinator
from millrace.protocol.errors import BadRollout
from millrace.protocol.lane_past import LanePast
from millrace.protocol.rollout import Rollout
from millrace.protocol.specs import RunSpec
from millrace.workers.conversation.session import Session
from tests.model import learner_part
from tests.model.traces.record import Digests, Record, SaidDealer, SaidMember, SaidRollout, SaidWaiting, message_of
from tests.support.conversation.rules import waiting_rollouts

CLASSES: dict[str, Any] = {each.__name__: each for each in (DescribeCoordinator, TicketCoordinator, Session)}
PARTS_OF_THE_COORDINATOR = {"Membership": "membership", "RolloutDealer": "rollouts", "EvaluationDealer": "evaluation"}


class NotAccepted(AssertionError):
    """The trace is not one of the model. The text says which call, and what was expected."""


class ReplayedLearner(learner_part.Learner):
    """A learner whose versions need not follow one another: an update may fail, and the best policy comes last."""

    def __init__(self, settings: Any, coordinator: TicketCoordinator) -> None:
        super().__init__(settings, coordinator)
        self.begun: dict[int, int] = {}
        """of each update of this learner, the version that was the newest when it began"""
        self._first = coordinator.rollouts.rounds.next
        self._restored = dict(coordinator.rollouts.rounds.versions)

    def acts(self, number: int) -> int:
        if number in self._restored:
            return self._restored[number]
        return self.begun[max(self._first, number - self.settings.max_lag)]


class Rules:
    """The rules of the model, for one learner."""

    def __init__(self, coordinator: TicketCoordinator, used: set[int]) -> None:
        """`used`: tickets whose rollouts were used before the checkpoint from which it started."""
        self.used = used
        self._coordinator = coordinator
        settings: Any = SimpleNamespace(
            lanes=coordinator.run.lanes, max_lag=coordinator.rollouts.rounds.max_lag, opponents=0
        )
        self._learner = ReplayedLearner(settings, coordinator)

    def begun(self) -> None:
        """The next update begins, unless it has."""
        learner = self._learner
        learner.begun.setdefault(self._coordinator.rollouts.rounds.next, self._coordinator.version)

    def published(self) -> None:
        """The newest weights were set."""
        self._learner.updating = False

    def taken(self, taken: Sequence[AcceptedRollout]) -> None:
        """The rollouts of an update."""
        lanes = [arrived.rollout.lane for arrived in taken]
        assert lanes == list(range(self._coordinator.run.lanes)), "an update has not one rollout of each lane"
        self._learner.updating = True
        version = self._learner.acts(self._coordinator.rollouts.rounds.next - 1)
        for rollout in (arrived.rollout for arrived in taken):
            assert rollout.ticket not in self.used, "a ticket was used twice"
            self.used.add(rollout.ticket)
            assert rollout.version == version, f"version {rollout.version} acted, instead of {version}"

    def check(self, accepted: Sequence[AcceptedRollout]) -> None:
        """Those that hold after every call. `accepted`: by this call."""
        for arrived in accepted:
            self._learner._accept(arrived)
        self._learner.check()


class Replay:
    """One process, call by call."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.calls = 0
        self.parts: dict[str, Any] = {}
        """what was called, by class"""
        self._digests = Digests()
        self._wrong_rows: dict[bytes, str] = {}  # by digest of a rollout, what was wrong with its rows
        self._rules: Rules | None = None
        self._taken: list[AcceptedRollout] = []

    def play(self, record: Record, used: set[int] | None = None) -> Any:
        """Make a call again. Returns its arguments. `used`: for a new learner, the tickets that the run had used."""
        self.calls += 1
        to_learner = record.part != "Session" or record.method == "work_ended"
        given = [self._made(each, to_learner=to_learner) for each in record.arguments]
        named = {name: self._made(value, to_learner=to_learner) for name, value in record.keywords.items()}
        try:
            if record.method == "__init__":
                self._begin(record.part, given, named, used or set())
            else:
                self._call(record, given, named)
        except Exception as error:
            where = f"{self.name}: call {self.calls}, at {record.at_s:.3f} s, {record.part}.{record.method}"
            raise NotAccepted(f"{where}{record.arguments}: {error}") from error
        return given

    @property
    def used(self) -> set[int]:
        """The tickets that the run has used by now."""
        return self._rules.used if self._rules is not None else set()

    # ---------------------------------------------------------------- inside

    def _made(self, said: Any, *, to_learner: bool) -> Any:
        if isinstance(said, SaidWaiting):
            return self.parts["DescribeCoordinator"].membership
        if isinstance(said, SaidDealer):
            rounds = Rounds(said.max_lag, said.next_round, said.versions)
            histories = LaneHistories(pasts=[LanePast.unknown(lane, 1) for lane in said.continued])
            return RolloutDealer(said.lanes, rounds, said.ledger, said.incarnations, said.opponents, histories)
        if isinstance(said, SaidRollout) and said.wrong:
            self._wrong_rows[said.digest] = said.wrong
        if isinstance(said, list):
            return [self._made(each, to_learner=to_learner) for each in said]
        return message_of(said, self._digests, to_learner=to_learner)

    def _begin(self, part: str, given: list[Any], named: dict[str, Any], used: set[int]) -> None:
        if part == "TicketCoordinator":
            named["check_rows"] = self._check_rows
        made = self.parts[part] = CLASSES[part](*given, **named)
        if part == "TicketCoordinator":
            self._rules = Rules(made, {each for each in used if each < made.rollouts.ledger.issued})

    def _check_rows(self, rollout: Rollout, run: RunSpec, most_steps: int) -> None:
        """As the learner found them."""
        if why := self._wrong_rows.get(self._digests.of(rollout)):
            raise BadRollout(why)

    def _call(self, record: Record, given: list[Any], named: dict[str, Any]) -> None:
        coordinator: Any = self.parts.get("TicketCoordinator", self.parts.get("DescribeCoordinator"))
        name = PARTS_OF_THE_COORDINATOR.get(record.part)
        called = self.parts[record.part] if name is None else getattr(coordinator, name)
        given = [_member(each, coordinator) for each in given]
        waiting = waiting_rollouts(coordinator) if self._rules is not None else []
        match record.method:
            case "publish":
                version, digest = given
                self._digests.published(version, digest)
                given = [version, np.zeros(1, np.float32), np.zeros(0, np.float32)]
            case "not_used":
                given = [self._taken]
        result = getattr(called, record.method)(*given, **named)
        found = self._digests.result(result)
        if record.method == "incarnations":
            found = tuple(result), coordinator.rollouts.ledger.issued, coordinator.rollouts.ledger.used
        assert found == record.result, f"expected {record.result}, got {found}"
        if coordinator is not None:
            coordinator.membership.events.clear()
        if self._rules is not None:
            self._follow(record.method, result, waiting)

    def _follow(self, method: str, result: Any, waiting: Sequence[AcceptedRollout]) -> None:
        """See to it that the rules hold. `waiting`: rollouts that had come before this call."""
        assert self._rules is not None
        if method == "begin_update":
            self._rules.begun()
        if method == "publish":
            self._rules.published()
        if method == "take":
            self._taken = result or []
            if result is not None:
                self._rules.taken(result)
        if method == "not_used":
            self._rules.used -= {arrived.rollout.ticket for arrived in self._taken}
            waiting = [*waiting, *self._taken]
        before = {arrived.rollout.ticket for arrived in waiting}
        now = waiting_rollouts(self.parts["TicketCoordinator"])
        self._rules.check([arrived for arrived in now if arrived.rollout.ticket not in before])


def _member(said: Any, coordinator: Any) -> Any:
    """The member of this routing id, if an argument is one."""
    if isinstance(said, SaidMember):
        return coordinator.membership.members[said.peer]
    return said
