"""Fakes: a run as plain data, rollouts without an environment, and a hostile network between the two pure halves.

The network keeps the order of what one worker says to the learner and of what the learner says to it (as a TCP connection
does), loses, repeats and delays, and knows nothing of what it carries. Time is simulated: a case takes milliseconds.
"""

from __future__ import annotations

import heapq
import itertools
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache

import msgspec
import numpy as np

from millrace.learner.members.coordinator import Coordinator
from millrace.learner.members.membership import Outgoing
from millrace.learner.rollouts.evaluation_dealer import EvaluationPlan
from millrace.learner.rollouts.lag_rule import Rounds
from millrace.learner.rollouts.lane_history import LaneHistories, LaneHistory
from millrace.learner.rollouts.ledger import Ledger
from millrace.learner.rollouts.past_rollouts import PastRollouts
from millrace.learner.rollouts.rollout_dealer import RolloutDealer
from millrace.learner.rollouts.ticket_coordinator import TicketCoordinator
from millrace.protocol.arrays import Array
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.lane_past import EpisodeBegin, LanePast
from millrace.protocol.messages import (
    Alive,
    EpisodeRows,
    Evaluated,
    HeartbeatReply,
    Rollout,
    ToLearner,
    ToWorker,
    Weights,
    WorkerActivity,
    WorkerExit,
)
from millrace.protocol.rollout import Episode
from millrace.protocol.rules import Rule
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec, RunSpec
from millrace.workers.conversation.session import (
    CloseLanes,
    EvaluationTask,
    Leave,
    RolloutTask,
    SendMessage,
    Session,
    StartSession,
    WorkerEffect,
    WorkerIdentity,
)
from millrace.workers.shared_weights import is_of_learner
from tests.support.conversation.example_messages import example
from tests.support.conversation.rules import check_tickets, pending_evaluation

PARAMETERS = np.zeros(1, np.float32)
BUFFERS = np.zeros(0, np.float32)
SUPERVISOR = b"supervisor"


def run_spec(lanes: int = 4, **changes: object) -> RunSpec:
    """A run of one copy and one step a lane: the smallest there is."""
    policy = PolicySpec((Leaf("", "box", (1,), "float32"),), ActionSpec("discrete", (), "int64", (2,), (0,)))
    spec = RunSpec(EnvSpec("Fake-v0"), policy, rollout_steps=1, copies=1, lanes=lanes, seed=0, learner_timeout_s=6.0)
    return msgspec.structs.replace(spec, **changes)


def fake_rollout(session: int, lane: int, ticket: int, version: int, sequence: int, place: int = 0) -> Rollout:
    """One valid transition. `place`: how many rollouts its env copies have made since the run began, this one included."""
    return example(
        Rollout,
        session=session,
        lane=lane,
        ticket=ticket,
        version=version,
        sequence=sequence,
        obs=(np.zeros((2, 1, 1), np.float32),),
        action=np.zeros((1, 1), np.int64),
        log_prob=np.zeros((1, 1), np.float32),
        reward=np.zeros((1, 1), np.float32),
        terminated=np.zeros((1, 1), bool),
        truncated=np.zeros((1, 1), bool),
        valid=np.ones((1, 1), bool),
        state=np.zeros((1, 0), np.float32),
        begun=(EpisodeBegin(0, 0, b""),),
        memory=fake_memory(place),
    )


def fake_memory(place: int) -> tuple[Array]:
    """What a worker remembers of fake env copies, which have made so many rollouts."""
    return (np.array([place]),)


def place_of(memory: Sequence[Array]) -> int:
    """How many rollouts the fake env copies have made."""
    return int(memory[0][0]) if memory else 0


@cache
def fake_past(lane: int, place: int) -> LanePast:
    """The past of a lane whose fake env copies have made so many rollouts."""
    history = LaneHistory.of_nothing(1, most_steps=1)
    history.add(fake_rollout(0, lane, 0, 0, 0, place), b"")
    return history.past(lane)


def spoiled(rollout: Rollout) -> Rollout:
    """The rollout, with rows that break the row format."""
    return msgspec.structs.replace(rollout, reward=np.full(rollout.reward.shape, np.nan, np.float32))


def any_rows(rollout: Rollout, run: RunSpec, most_steps: int) -> None:
    """Every rollout passes: for runs whose fake rollouts have no rows of the run."""


SEATS = ("black", "white")


def seated_rollout(session: int) -> Rollout:
    """One step of a copy with these seats: the first acted, and the second waits."""
    return msgspec.structs.replace(
        fake_rollout(session, 0, 0, 0, 0),
        obs=(np.zeros((2, 2, 1), np.float32),),
        action=np.zeros((1, 2), np.int64),
        log_prob=np.zeros((1, 2), np.float32),
        reward=np.zeros((1, 2), np.float32),
        terminated=np.zeros((1, 2), bool),
        truncated=np.zeros((1, 2), bool),
        valid=np.array([[True, False]]),
        state=np.zeros((2, 0), np.float32),
        resets=np.zeros((2, 1), bool),
    )


def process_ends(coordinator: Coordinator, worker: str, why: str = "killed", nonce: int = -1) -> list[Outgoing]:
    """The learner hears that the process of this worker has ended. `nonce`: of one that is no member any more."""
    nonces = [each.hello.process_nonce for each in coordinator.members.values() if each.hello.worker == worker]
    return coordinator.process_ended(WorkerExit(worker, nonces[0] if nonces else nonce, why, failed=False))


def fake_rollouts(task: RolloutTask) -> list[Rollout]:
    """What a collector would have made of this task."""
    return [fake_rollout(task.session, each.lane, each.ticket, task.weights.version, each.sequence) for each in task.permits]


def held_count(session: Session) -> int:
    """Number of tickets and rollouts that a worker holds."""
    return sum(len(lane.asked) + len(lane.answered) for lane in session._current.rollouts._lanes.values())


def fake_evaluated(task: EvaluationTask) -> Evaluated:
    """Result of an evaluator: episodes of two steps whose return names the seed and the version."""
    order = task.order
    episodes = tuple(Episode(seed + task.weights.version / 1000, 2, 0.0) for seed in order.seeds)
    return example(Evaluated, session=order.session, ticket=order.ticket, episodes=episodes, cut=(False,) * len(episodes))


def fake_rows(session: int, ticket: int, episode: int, step: int) -> EpisodeRows:
    """One row of an episode of two steps."""
    return example(
        EpisodeRows,
        session=session,
        ticket=ticket,
        episode=episode,
        first_step=step,
        obs=(np.zeros((2, 1), np.float32),),
        action=np.zeros(1, np.int64),
        reward=np.zeros(1),
        terminated=np.array([step == 1]),
        truncated=np.zeros(1, bool),
    )


@dataclass
class Faults:
    """What the network and fate do, until `until_s`; after that only `loss` goes on."""

    loss: float = 0.0
    repeat: float = 0.0
    delay_s: float = 0.05
    spoiled: float = 0.0  # rollouts that break the row format
    deaths: int = 0
    freezes: int = 0
    late_joiners: int = 0
    leaves: int = 0
    learner_restarts: int = 0
    evaluations: float = 0.0  # how many of the updates are evaluated
    shares: float = 0.0  # how often, while the learner waits for one, a second worker is to play its oldest ticket
    places: int = 0  # in which a supervisor of all workers shares weights; 0: none does
    until_s: float = 30.0


EVALUATOR = b"e"  # the name of a worker that only evaluates begins so


@dataclass
class FakeSupervisor:
    """What the supervisor of all workers has got of the learner."""

    first_session: int = 0
    replies: int = 0
    shared: list[tuple[int, Weights]] = field(default_factory=list)


@dataclass
class FakeWorker:
    """A worker process: dies, freezes, comes back under the same name, and pid."""

    name: bytes
    session: Session
    task: RolloutTask | EvaluationTask | None = None
    frozen: bool = False
    inbox: list[ToWorker] = field(default_factory=list)
    places: dict[int, tuple[int, int]] = field(default_factory=dict)
    """of the lanes that are open: the incarnation, and how many rollouts their env copies have made"""

    def open_lanes(self, task: RolloutTask) -> None:
        """The env copies of these lanes are here in their incarnation, or they are made, and continue its past."""
        for each in task.permits:
            if self.places.get(each.lane, (-1, 0))[0] != each.incarnation:
                self.places[each.lane] = each.incarnation, 0 if each.past is None else place_of(each.past.memory)

    def collected(self, task: RolloutTask) -> list[Rollout]:
        """What it has collected. The env copies of each lane have made one rollout more."""
        found = []
        for each in task.permits:
            incarnation, place = self.places[each.lane]
            self.places[each.lane] = incarnation, place + 1
            version = task.weights.version
            found.append(fake_rollout(task.session, each.lane, each.ticket, version, each.sequence, place + 1))
        return found


class World:
    """One learner, some workers, simulated time; checks every rule after every event."""

    def __init__(
        self, seed: int, faults: Faults, *, workers: int, lanes: int, max_lag: int, evaluators: int | None = None
    ) -> None:
        """`evaluators`: how many more workers only evaluate, beside training; None: all evaluate, and training waits."""
        self.beside = evaluators is not None
        self.due = False  # whether the newest version is to be evaluated
        self.random = random.Random(seed)
        self.faults = faults
        self.run = run_spec(lanes)
        self.max_lag = max_lag
        self.now = 0.0
        self.lives = itertools.count(1)
        self.order = itertools.count()
        self.queue: list[tuple[float, int, Callable[[], None]]] = []
        self.arrival: dict[tuple[bytes, str], float] = {}  # a stream's last delivery: order is kept within it
        self.workers: dict[bytes, FakeWorker] = {}
        self.supervisor = FakeSupervisor()
        self.parameters: dict[int, Array] = {}  # of each learner, by its first session
        self.evaluations = 0
        self.shared = 0
        self.plan: EvaluationPlan | None = None  # of the evaluation that is pending
        self.issued_at_barrier = 0
        self.rows: list[tuple[int, int]] = []  # episode and step, as they came
        self.used: set[int] = set()
        self.updates = 0
        self.epoch = 0
        self.checkpoint = PastRollouts(Ledger(), [0] * lanes)
        self.coordinator = self._learner()
        names = [f"w{number}".encode() for number in range(workers)]
        names += [EVALUATOR + b"%d" % number for number in range(evaluators or 0)]
        for name in names:
            self.spawn(name)
        self._schedule_faults(names)
        self.every(0.5, self._tick)
        if faults.places:
            self.every(1.0, self._speak_for_workers)

    # ------------------------------------------------------------ time

    def at(self, delay_s: float, action: Callable[[], None]) -> None:
        heapq.heappush(self.queue, (self.now + delay_s, next(self.order), action))

    def every(self, interval_s: float, action: Callable[[], None]) -> None:
        def again() -> None:
            action()
            self.at(interval_s, again)

        self.at(interval_s, again)

    def play(self, updates: int, limit_s: float = 400.0) -> None:
        """Run until so many updates were made. A deadlock shows as the time limit."""
        while self.updates < updates or self.now < self.faults.until_s:
            assert self.queue
            self.now, _, action = heapq.heappop(self.queue)
            assert self.now < limit_s, f"only {self.updates} of {updates} updates after {limit_s} s: deadlock"
            action()
            self.check()

    # ------------------------------------------------------------ network

    def carry(self, key: tuple[bytes, str], deliver: Callable[[], None]) -> None:
        epoch = self.epoch
        faulty = self.now < self.faults.until_s
        if self.random.random() < self.faults.loss:
            return
        copies = 2 if faulty and self.random.random() < self.faults.repeat else 1
        for _ in range(copies):
            delay = self.random.uniform(0.001, self.faults.delay_s if faulty else 0.01)
            arrival = max(self.now + delay, self.arrival.get(key, 0.0))
            self.arrival[key] = arrival
            self.at(arrival - self.now, lambda: deliver() if epoch == self.epoch else None)

    def to_workers(self, outs: list[Outgoing]) -> None:
        for peer, message in outs:
            self.carry((peer, "down"), lambda peer=peer, message=message: self._arrives(peer, message))  # type: ignore[misc]

    def _arrives(self, peer: bytes, message: ToWorker) -> None:
        if peer == SUPERVISOR:
            self._share(message)
        worker = self.workers.get(peer)
        if worker is None:
            return
        worker.inbox.append(message)
        self._serve(worker)

    def say(self, worker: FakeWorker, effects: list[WorkerEffect]) -> None:
        for effect in effects:
            match effect:
                case SendMessage(message):
                    self.carry((worker.name, "up"), lambda m=message: self._hears(worker.name, m))  # type: ignore[misc]
                case StartSession():
                    worker.places.clear()
                case CloseLanes(closed):
                    for lane in closed:
                        worker.places.pop(lane.lane, None)
                case Leave():
                    self.workers.pop(worker.name, None)

    def _hears(self, peer: bytes, message: ToLearner) -> None:
        faulty = self.now < self.faults.until_s and self.random.random() < self.faults.spoiled
        if faulty and isinstance(message, Rollout):
            message = spoiled(message)
        self.to_workers(self.coordinator.receive(peer, message, self.now))
        self.check()
        self._learn()

    # ------------------------------------------------------------ supervisor

    def _speak_for_workers(self) -> None:
        running = [
            WorkerActivity(name.decode(), worker.session.identity.process_nonce, "waiting", 0.0, 0)
            for name, worker in self.workers.items()
        ]
        said = Alive(tuple(running), (), self.supervisor.replies)
        self.carry((SUPERVISOR, "up"), lambda: self._hears(SUPERVISOR, said))

    def _share(self, message: ToWorker) -> None:
        supervisor = self.supervisor
        match message:
            case HeartbeatReply(first_session, number):
                supervisor.first_session, supervisor.replies = first_session, number
            case Weights():
                shared = [*supervisor.shared, (supervisor.first_session, message)]
                supervisor.shared = shared[-self.faults.places :]
                for worker in list(self.workers.values()):
                    self._serve(worker)

    # ------------------------------------------------------------ worker

    def spawn(self, name: bytes) -> None:
        evaluates = name.startswith(EVALUATOR)
        who = WorkerIdentity(name.decode(), "host", 1, next(self.lives), "fake", evaluates)  # in a container every pid is 1
        worker = FakeWorker(name, Session(who, self.now, join_timeout_s=1e9, rejoin_timeout_s=1e9))
        self.workers[name] = worker

        def tick() -> None:
            if self.workers.get(name) is worker:
                if not worker.frozen:
                    self._serve(worker)
                self.at(0.25, tick)

        self.at(0.0, tick)

    def _serve(self, worker: FakeWorker) -> None:
        if worker.frozen:
            return
        session = worker.session
        while worker.inbox:
            self.say(worker, session.handle(worker.inbox.pop(0), self.now))
        for first_session, weights in self.supervisor.shared:
            if weights.version in session.missing_versions() and is_of_learner(session.session, first_session):
                self.say(worker, session.handle(weights, self.now))
        if worker.task is not None and session.is_unwanted(worker.task):
            for each in worker.task.permits if isinstance(worker.task, RolloutTask) else ():
                worker.places.pop(each.lane, None)  # as a collector closes lanes whose rollout is abandoned
            worker.task = None
            self.say(worker, session.work_ended([]))
        if worker.task is None and (task := session.next_work()) is not None:
            assert isinstance(task, RolloutTask | EvaluationTask)
            worker.task = task
            if isinstance(task, RolloutTask):
                worker.open_lanes(task)
            self.at(self.random.uniform(0.01, 0.4), lambda: self._finish(worker, task))
        self.say(worker, session.tick(self.now))

    def _finish(self, worker: FakeWorker, task: RolloutTask | EvaluationTask) -> None:
        if worker.task is not task or self.workers.get(worker.name) is not worker:
            return
        if worker.frozen:
            self.at(0.5, lambda: self._finish(worker, task))
            return
        worker.task = None
        (own,) = (each for first, each in self.parameters.items() if 0 <= task.session - first < 2**20)
        assert task.weights.parameters is own, "acted under the weights of another learner"
        if isinstance(task, RolloutTask):
            self.say(worker, worker.session.work_ended(worker.collected(task)))
        else:
            order = task.order
            assert task.weights.version == order.version, "evaluated under other weights than those of the order"
            for n, step in itertools.product(range(len(order.seeds)), range(2)) if order.send_rows else ():
                self.say(worker, [SendMessage(fake_rows(order.session, order.ticket, n, step))])
            self.say(worker, worker.session.work_ended([fake_evaluated(task)]))
        self._serve(worker)

    # ------------------------------------------------------------ learner

    def _learner(self) -> TicketCoordinator:
        past = self.checkpoint
        rounds = Rounds(self.max_lag, past.rounds.next, past.rounds.versions)
        version = rounds.next
        ledger = past.ledger.copy()
        ledger.lost += ledger.outstanding  # of the learner that died
        ledger.transitions_late += ledger.transitions_waiting
        self.used = {ticket for ticket in self.used if ticket < ledger.issued}
        self.updates = version
        self.updating = self.due = False
        self.plan = None
        coordinator = TicketCoordinator(
            self.run,
            RolloutDealer(
                self.run.lanes,
                rounds,
                ledger=ledger,
                incarnations=past.incarnations,
                histories=LaneHistories(copies=1, most_steps=1, pasts=past.lanes),
            ),
            worker_timeout_s=3.0,
            first_session=self.random.getrandbits(48),
        )
        self.coordinator = coordinator
        parameters = self.parameters[coordinator.membership._first_session] = PARAMETERS.copy()
        for weights in past.acting:
            coordinator.keep(msgspec.structs.replace(weights, parameters=parameters))
        coordinator.publish(version, parameters, BUFFERS)
        self.to_workers(coordinator.begin_update())
        return coordinator

    def restart_learner(self) -> None:
        self.epoch += 1  # whatever was under way is lost with its connections
        self._learner()

    def _tick(self) -> None:
        self.to_workers(self.coordinator.remove_silent(self.now))
        self._learn()

    def _learn(self) -> None:
        """Take a batch if there is one; publish new weights a little later."""
        if self.updating or self._evaluating():
            return
        self.to_workers(self.coordinator.begin_update())
        taken = self.coordinator.rollouts.take()
        if taken is None:
            return
        rollouts = [arrived.rollout for arrived in taken]
        assert [rollout.lane for rollout in rollouts] == list(range(self.run.lanes))
        for rollout in rollouts:
            assert rollout.ticket not in self.used, "a ticket was used twice"
            self.used.add(rollout.ticket)
            assert rollout.version == max(0, self.coordinator.version - self.max_lag)
            place = place_of(rollout.memory)
            number = self.coordinator.rollouts.rounds.next  # rounds count from 0, and this one is taken
            assert place == number or (self.faults.spoiled and place > number), (
                f"{Rule.PAST}: lane {rollout.lane} has made {place} rollouts in round {number - 1}"
            )
        self.updating = True
        coordinator = self.coordinator
        parameters = self.parameters[coordinator.membership._first_session]

        def publish() -> None:
            if self.coordinator is not coordinator:
                return
            self.updates += 1
            self.updating = False
            self.due = self.random.random() < self.faults.evaluations
            coordinator.publish(self.updates, parameters, BUFFERS)
            if self.due and self.plan is None:
                self._begin_evaluation()
            if self.random.random() < 0.3:
                self.checkpoint = coordinator.past(self.updates)
            self._learn()

        self.at(self.random.uniform(0.0, 0.3), publish)

    def _begin_evaluation(self) -> None:
        draw, coordinator = self.random, self.coordinator
        seeds = tuple(draw.sample(range(1000), draw.randint(1, 9)))
        self.plan = EvaluationPlan(seeds, draw.randint(1, 3), most_steps=2, send_rows=draw.random() < 0.5)
        self.rows, self.issued_at_barrier = [], coordinator.rollouts.ledger.issued
        on_rows = self._take_rows if self.plan.send_rows else None
        self.due, self.evaluated = False, coordinator.version
        self.to_workers(coordinator.begin_evaluation(self.plan, on_rows, beside=self.beside))

    def _take_rows(self, episode: int, rows: EpisodeRows) -> None:
        self.rows.append((episode, rows.first_step))

    def _evaluating(self) -> bool:
        """Whether the learner waits for an evaluation. Ends one that is done, and checks its result."""
        if self.plan is None:
            return False
        evaluation = pending_evaluation(self.coordinator)
        if not evaluation.done:
            if evaluation.beside and self.due:
                self.to_workers(self.coordinator.await_evaluation())
                self.issued_at_barrier = self.coordinator.rollouts.ledger.issued
            if self.faults.shares and (self.due or not evaluation.beside) and self.random.random() < self.faults.shares:
                self.to_workers(self.coordinator.share_evaluation())
                self.shared += sum(len(members) > 1 for members in evaluation.playing.values())
            return self.due or not evaluation.beside
        plan, self.plan = self.plan, None
        played = self.coordinator.evaluation.end()
        expected = [seed + self.evaluated / 1000 for seed in plan.seeds]
        assert [one.episode.reward for one in played] == expected, "the episodes are not those of the seeds"
        if plan.send_rows:
            assert sorted(self.rows) == list(itertools.product(range(len(plan.seeds)), range(2)))
        self.evaluations += 1
        if self.due:
            self._begin_evaluation()
        return False

    # ------------------------------------------------------------ fate

    def _schedule_faults(self, names: Sequence[bytes]) -> None:
        faults = self.faults

        def when() -> float:
            return self.random.uniform(0.0, faults.until_s)

        for _ in range(faults.deaths):
            self.at(when(), self._kill_one)
        for _ in range(faults.freezes):
            self.at(when(), self._freeze_one)
        for _ in range(faults.leaves):
            self.at(when(), self._leave_one)
        for number in range(faults.late_joiners):
            self.at(when(), lambda number=number: self.spawn(f"late{number}".encode()))  # type: ignore[misc]
        for _ in range(faults.learner_restarts):
            self.at(when(), self.restart_learner)
        self.at(faults.until_s, lambda: self._revive(names))

    def _revive(self, names: Sequence[bytes]) -> None:
        for name in names:
            if name not in self.workers:
                self.spawn(name)

    def _kill_one(self) -> None:
        if self.workers:
            name = self.random.choice(sorted(self.workers))
            del self.workers[name]
            if self.random.random() < 0.5:  # the host sees it at once; else only silence tells
                self.to_workers(process_ends(self.coordinator, name.decode(), "killed"))
            self.at(self.random.uniform(0.1, 8.0), lambda: self.spawn(name) if name not in self.workers else None)

    def _freeze_one(self) -> None:
        if self.workers:
            worker = self.workers[self.random.choice(sorted(self.workers))]
            worker.frozen = True

            def thaw() -> None:
                worker.frozen = False

            self.at(self.random.uniform(0.5, 8.0), thaw)

    def _leave_one(self) -> None:
        running = [worker for name, worker in self.workers.items() if not worker.frozen and not name.startswith(EVALUATOR)]
        if len(running) > 1:
            worker = self.random.choice(sorted(running, key=lambda worker: worker.name))
            self.say(worker, worker.session.stop())

    # ------------------------------------------------------------ the rules

    def check(self) -> None:
        check_tickets(self.coordinator, self.max_lag, shares=self.faults.shares > 0.0)
        if self.plan is not None and not pending_evaluation(self.coordinator).beside:
            issued = self.coordinator.rollouts.ledger.issued
            assert issued == self.issued_at_barrier, "a ticket for a rollout was dealt during an evaluation"
        if self.epoch == 0:
            for worker in self.workers.values():
                holds = held_count(worker.session)
                assert holds <= self.run.lanes * (1 + self.max_lag), f"{worker.name!r} holds {holds} rollouts"
