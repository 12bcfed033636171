"""The shell round the roster: link + roster + clock. `gather` is the only place where the learner waits.

The law: the inbox is emptied before silence is judged, and a learner that was away itself listens for a while first, so a
long update, or a stop, never kills a healthy worker; every wait has a deadline and says what it waits for.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from learner.members.events import Broke, Joined, Left, Stale, Told, Turned, describe
from learner.members.membership import Out
from learner.members.peer_log import Doorkeeper, Lid
from learner.members.states import Standing
from learner.members.worker_processes import WorkerProcesses
from learner.rollouts.arrived_rollout import ArrivedRollout
from learner.rollouts.ledger import Ledger
from learner.rollouts.roster import CollectingMember, Roster
from learner.rollouts.status import status
from learner.rollouts.weight_age import Freshness
from learner.run_folder.progress import Progress
from protocol.address import worker_name
from protocol.errors import BadMessage, BadRollout, EnvironmentFailed, NoWorkers, Stalled
from protocol.messages import Array, Inquire, Rollout, ToWorker, Weights
from protocol.rollout import rollout_bytes, validate
from protocol.wire.codec import Buffer, encode
from protocol.wire.learner_link import LearnerLink
from protocol.wire.weight_dtypes import WeightsDtype, to_wire_dtype

log = logging.getLogger("millrace.learner")

POLL_S = 0.1
PULSE_S = 0.003  # a minibatch may take a tenth of it, and listening as long as a minibatch
SAY_WAITING_EVERY_S = 10.0
AWAY_S = 0.5  # a learner that has not listened for longer was busy, or stopped


@dataclass(frozen=True)
class HubSettings:
    """The settings of a run that the hub needs, named as in `Config`."""

    no_workers_timeout_s: float
    stall_timeout_s: float
    max_env_failures: int
    weights_dtype: WeightsDtype = "float32"
    """dtype in which parameters travel"""


@dataclass(frozen=True)
class HubSnapshot:
    """What the hub knows at one moment, for metrics, checkpoints and status. Cheap to make."""

    progress: Progress
    """as of the last update"""
    version: int
    """of the newest weights; -1 before any"""
    ledger: Ledger
    """a copy"""
    incarnations: list[int]
    """the next incarnation of each lane"""
    lags: list[int]
    """of each rollout of the last `gather`"""
    lag_counts: Mapping[int, int]
    """how many rollouts were used, by lag, since this learner started"""
    wait_s: float
    """seconds spent waiting for rollouts since this learner started"""
    members: tuple[CollectingMember, ...]
    received: tuple[int, int]
    """messages, bytes"""
    sent: tuple[int, int]
    """messages, bytes"""
    refused_messages: int
    """messages under keys that were revoked"""
    refused_handshakes: int

    def worker_stages(self) -> dict[int, Mapping[str, float]]:
        """Seconds in each stage, by session, as the workers' last heartbeats said."""
        return {member.session: member.heartbeat.stages for member in self.members if member.heartbeat is not None}

    def worker_states(self) -> Counter[str]:
        """How many workers are active, draining, or spare: active without a lane."""
        return Counter(_state(member) for member in self.members)


def _state(member: CollectingMember) -> str:
    if member.standing is Standing.DRAINING:
        return "draining"
    return "active" if member.lanes else "spare"


HubObserver = Callable[["Hub"], None]
"""Called with the hub each time that it has listened to the workers."""


class Hub:
    """Everything the loop knows of workers."""

    def __init__(
        self,
        link: LearnerLink,
        roster: Roster,
        settings: HubSettings,
        processes: WorkerProcesses | None = None,
        check_interrupt: Callable[[], None] = lambda: None,
        observer: HubObserver = lambda hub: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`check_interrupt` is called while the hub waits: what it raises ends the wait."""
        self.link, self.roster, self.settings = link, roster, settings
        link.packed_bytes_limit = rollout_bytes(roster.run)
        self._processes = processes or WorkerProcesses()
        self._check_interrupt, self._observer, self._clock = check_interrupt, observer, clock
        self._wait_s = 0.0  # seconds spent waiting for rollouts
        self._lags: list[int] = []  # lag of each rollout of the last `gather`
        self._freshness = Freshness()
        self._progress = Progress()
        self._lid = Lid(link, clock)
        self._doorkeeper = Doorkeeper(link)
        self._draining = False
        self._listened_s = self._judge_s = clock()
        self._env_failures = 0
        self._failure: EnvironmentFailed | None = None
        self._refusal = ""
        self._lonely_since_s: float | None = None
        self._encoded: tuple[ToWorker, Sequence[Buffer]] | None = None

    # ---------------------------------------------------------------- what the loop calls

    def wait_for(self, workers: int) -> None:
        """Wait until so many workers have joined. Raises `NoWorkers` after `no_workers_timeout_s`."""
        deadline_s = self._clock() + self.settings.no_workers_timeout_s
        start = f"python -m workers {self.link.address}{'' if self.link.keyring is None else ' --token FILE'}"
        while len(self.roster.members) < workers:
            if self._clock() > deadline_s:
                raise NoWorkers(
                    f"waited {self.settings.no_workers_timeout_s:.0f} s for {workers} workers at {self.link.address}, "
                    f"{len(self.roster.members)} came{self._because()}; start one: {start}"
                )
            self._turn(POLL_S)

    def publish(self, version: int, parameters: Array, buffers: Array) -> None:
        """Broadcast new weights and deal the tickets that they allow. The arrays must not change afterwards.

        Raises `RunError` if a parameter is too large for `weights_dtype`.
        """
        travelling = to_wire_dtype(parameters, self.settings.weights_dtype)
        self._freshness.published(version, self._clock())
        self._send(self.roster.publish(version, travelling, buffers))

    def gather(self) -> list[ArrivedRollout]:
        """The rollouts of the next update. Raises `NoWorkers`, `Stalled` or `EnvironmentFailed`."""
        started_s = said_s = heard_s = self._clock()
        self._turn(0.0)
        while True:
            waiting = len(self.roster.ready)
            taken = self.roster.take()
            self._send(self.roster.deal())
            if taken is not None:
                self._wait_s += self._clock() - started_s
                self._lags = [self.roster.version - arrived.rollout.version for arrived in taken]
                self._freshness.used(self._lags)
                return taken
            self._turn(POLL_S)
            now = self._clock()
            if len(self.roster.ready) > waiting:
                heard_s = now
            if now - heard_s > self.settings.stall_timeout_s:
                raise Stalled(f"no rollout came for {self.settings.stall_timeout_s:.0f} s; {self.waiting_for()}")
            if now - said_s > SAY_WAITING_EVERY_S:
                said_s = now
                log.warning("%s", self.waiting_for())

    def pulse(self) -> None:
        """Empty the inbox, then judge silence, unless that was just done. Called between minibatches.

        Never waits, never ends the run.
        """
        if self._clock() - self._listened_s >= PULSE_S:
            self._listen(0.0)

    def drain(self, reason: str, timeout_s: float = 5.0) -> None:
        """Ask every worker to leave and wait for their Goodbye, at most `timeout_s`; what they still send is counted."""
        self._draining = True
        self._send(self.roster.drain(reason))
        deadline_s = self._clock() + timeout_s
        while self.roster.members and self._clock() < deadline_s:
            self._receive(POLL_S)
            self._shut_out()
            self._gone()
        for member in self.roster.members.values():
            log.warning("worker %s did not say goodbye within %.0f s", member.hello.worker, timeout_s)

    def waiting_for(self) -> str:
        """What the learner waits for, in words."""
        roster = self.roster
        if not roster.members:
            return f"waiting for a worker to join at {self.link.address}{self._because()}"
        late = sorted({roster.members[ticket.peer].hello.worker for ticket in roster.tickets.values()})
        have, need = len(roster.ready), roster.rollouts_per_update
        return f"waiting for rollouts: have {have} of {need}, outstanding with {', '.join(late) or 'nobody'}"

    # ---------------------------------------------------------------- what others ask and tell

    def report_progress(self, progress: Progress) -> None:
        """How far the run is, for whoever asks for its status."""
        self._progress = progress

    def workers_alive(self) -> int:
        """How many processes step the environment."""
        count = self._processes.count
        return len(self.roster.members) if count is None else count()

    def lag_histogram(self) -> dict[str, int]:
        """How many rollouts were used by lag, from the smallest; a JSON object has strings for keys."""
        return self._freshness.histogram()

    def first_use_s(self) -> dict[str, float]:
        """Of each worker, the median of the seconds from publishing weights to its first rollout under them."""
        return self._freshness.first_use_s()

    def snapshot(self) -> HubSnapshot:
        """What the hub knows now."""
        link, roster = self.link, self.roster
        return HubSnapshot(
            progress=self._progress,
            version=roster.version,
            ledger=roster.ledger.copy(),
            incarnations=roster.incarnations(),
            lags=self._lags,
            lag_counts=self._freshness.lags.copy(),
            wait_s=self._wait_s,
            members=tuple(roster.members.values()),
            received=(link.received.messages, link.received.bytes),
            sent=(link.sent.messages, link.sent.bytes),
            refused_messages=link.refused_messages,
            refused_handshakes=link.refused,
        )

    # ---------------------------------------------------------------- inside

    def _turn(self, timeout_s: float) -> None:
        """One turn of waiting: listen, and see whether the run can go on."""
        self._listen(timeout_s)
        self._check_interrupt()
        if self._failure is not None:
            raise self._failure
        self._judge()

    def _listen(self, timeout_s: float) -> None:
        self._receive(timeout_s)
        self._shut_out()
        self._gone()
        now = self._clock()
        if now - self._listened_s > timeout_s + AWAY_S:
            # What was said meanwhile may still lie in the kernel: ZeroMQ's thread was stopped, as we were.
            self._judge_s = now + AWAY_S
        self._listened_s = now
        if now >= self._judge_s:
            self._send(self.roster.tick(now))
        self._observer(self)

    def _receive(self, timeout_s: float) -> None:
        if not self.link.poll(timeout_s):
            return
        for peer, message in self.link.receive():
            now = self._clock()
            match message:
                case BadMessage():
                    self._lid.complain(peer, f"message from {worker_name(peer)[:40]!r}: {message}")
                    self._send(self.roster.reject(peer, None, str(message), now))
                case Rollout():
                    self._rollout(peer, message, now)
                case Inquire():
                    self.link.send(peer, encode(status(self.roster, self._progress, now)))
                case _:
                    self._send(self.roster.receive(peer, message, now))

    def _rollout(self, peer: bytes, rollout: Rollout, now: float) -> None:
        try:
            validate(rollout, self.roster.run)
        except BadRollout as error:
            why = f"worker {worker_name(peer).decode(errors='replace')}: rollout of ticket {rollout.ticket}: {error}"
            self._lid.complain(peer, why)
            self._send(self.roster.reject(peer, rollout, why, now))
        else:
            self._freshness.arrived(worker_name(peer).decode(errors="replace"), rollout.version, now)
            self._send(self.roster.receive(peer, rollout, now))

    def _shut_out(self) -> None:
        for peer, why in self._doorkeeper.shut_out(self.roster.members):
            self._send(self.roster.revoke(peer, why))

    def _gone(self) -> None:
        for worker, why in self._processes.ended():
            self._send(self.roster.gone(worker, why))

    def _send(self, outs: Sequence[Out]) -> None:
        for peer, message in outs:
            self.link.send(peer, self._frames(message))
        self._events()

    def _frames(self, message: ToWorker) -> Sequence[Buffer]:
        """Frames of a message; weights are encoded once, however many workers there are."""
        if not isinstance(message, Weights):
            return encode(message)
        if self._encoded is None or self._encoded[0] is not message:
            self._encoded = (message, encode(message))
        return self._encoded[1]

    def _events(self) -> None:
        for event in self.roster.membership.happened():
            leaving = isinstance(event, Left) and event.on_purpose and self._draining
            expected = leaving or isinstance(event, Joined | Told | Stale)
            self._lid.tell(logging.INFO if expected else logging.WARNING, event, describe(event))
            match event:
                case Turned(_, why):
                    self._refusal = why
                case Broke(worker, host, _, error, traceback):
                    self._env_failures += 1
                    if self._env_failures > self.settings.max_env_failures:
                        counted = (
                            f"that was failure {self._env_failures}, at most {self.settings.max_env_failures} are borne"
                        )
                        self._failure = EnvironmentFailed(f"worker {worker} ({host}): {error}; {counted}", traceback)
                case _:
                    pass

    def _judge(self) -> None:
        """End the run when nobody has been there for too long."""
        if self.roster.members:
            self._lonely_since_s = None
            return
        now = self._clock()
        if self._lonely_since_s is None:
            self._lonely_since_s = now
        timeout_s = self.settings.no_workers_timeout_s
        if now - self._lonely_since_s > timeout_s:
            raise NoWorkers(f"no worker for {timeout_s:.0f} s at {self.link.address}{self._because()}")

    def _because(self) -> str:
        if self._refusal:
            return f" (the last one was refused: {self._refusal})"
        return f" ({self.link.refused} were not let in; the log says why)" if self.link.refused else ""
