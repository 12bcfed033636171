"""Asks each learner whose run has an open page for its status twice a second, and keeps the last minutes' answers.

Rule: a learner is asked just as `millrace status` asks it, with the same rights, and only while a page of its run is open.
The memory for a run is bounded, and freed when no page is open. An open page calls `look` once a second (`page.js`).
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

from millrace.cli.status import observer_name, whom_to_ask
from millrace.protocol.bounds import one_line
from millrace.protocol.errors import UserFacingError
from millrace.protocol.keys.keys import Token
from millrace.protocol.messages import Inquire, Status, WorkerStatus
from millrace.protocol.wire.codec import encode
from millrace.protocol.wire.worker_link import OF_OBSERVER, WorkerLink

ASK_EVERY_S = 0.5
LOOKED_AT_S = 10.0  # a page counts as open for this long after its last request; an open page sends one every second
FORGOTTEN_S = 300.0  # after this time without an open page, the answers are freed
SILENT_S = 5.0  # after this time without an answer, the connection is closed
PAUSE_S = 10.0  # pause before the next connection; an endless message can fill memory only while a connection is open
SAMPLES = 400  # number of answers to keep
MOST_LANES = 64  # largest number of lanes shown
ANSWER_WITHIN_S = 0.5
MOST_ANSWERS = 4  # largest number of answers to read at a time, because a learner may send more than requested

LEARNER: dict[str, str] = {
    "gathering": "waiting",
    "learning": "updating",
    "evaluating": "evaluating",
    "starting": "starting",
}
"""The word in the picture "Who waits for whom" for what a learner is doing, by the phase of its progress"""
WORKER = {
    "stepping": "collecting",
    "repeating": "resetting",
    "resetting": "resetting",
    "making": "resetting",
    "preparing": "starting",
    "acting": "collecting",
    "describing": "resetting",
    "evaluating": "evaluating",
    "starting": "starting",
    "closing": "resetting",
    "waiting": "waiting",
}
"""The word in that picture for what a lane is doing, by the activity of its worker"""


class LaneSample(NamedTuple):
    """What the learner and all lanes were doing at one moment."""

    at_s: float
    learner: str
    lanes: dict[int, str]


class Seen(NamedTuple):
    """What is known about a running learner."""

    status: Status | None = None
    """the newest answer"""
    samples: tuple[LaneSample, ...] = ()
    problem: str = ""
    """why there is no answer"""


@dataclass
class _Watched:
    """A run whose page is open, or was open a short while ago."""

    looked_s: float
    link: WorkerLink | None = None
    whom: tuple[str, Token | None] | None = None
    status: Status | None = None
    answered_s: float = 0.0
    silent_since_s: float = 0.0
    """the time of the newest answer, or of the connection if there was no answer since"""
    ask_again_s: float = 0.0
    problem: str = ""
    samples: deque[LaneSample] = field(default_factory=lambda: deque(maxlen=SAMPLES))


def sample(status: Status, now: float) -> LaneSample:
    """What the learner and each lane were doing, from an answer."""
    lanes = {lane: _doing(worker) for worker in status.workers for lane in worker.lanes}
    shown = {lane: lanes.get(lane, "no worker") for lane in range(min(status.workers_wanted, MOST_LANES))}
    return LaneSample(now, LEARNER.get(status.progress.phase, ""), shown)


def _doing(worker: WorkerStatus) -> str:
    if not worker.doing:  # a worker without a supervisor doesn't report its activity
        return "collecting" if worker.tickets else "waiting"
    return WORKER.get(worker.doing, "")


class Lookout:
    """A context manager that watches runs in a thread."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._watched: dict[Path, _Watched] = {}
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="dashboard-lookout", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._stop.set()
        self._thread.join()

    def look(self, run: Path) -> Seen:
        """What is known about the learner of this run. From now on, the learner is asked repeatedly while a page of the run
        is open.
        """
        with self._lock:
            watched = self._watched.setdefault(run, _Watched(self._clock()))
            watched.looked_s = self._clock()
            return Seen(watched.status, tuple(watched.samples), watched.problem)

    def _run(self) -> None:
        while not self._stop.wait(ASK_EVERY_S):
            now = self._clock()
            with self._lock:
                asked = {run: each for run, each in self._watched.items() if now - each.looked_s < LOOKED_AT_S}
                gone = {run: each for run, each in self._watched.items() if now - each.looked_s >= FORGOTTEN_S}
                for run in gone:
                    del self._watched[run]
            for each in gone.values():
                _close(each)
            for run, watched in asked.items():
                self._ask(run, watched)
            deadline_s = self._clock() + ANSWER_WITHIN_S
            for watched in asked.values():
                self._listen(watched, max(0.0, deadline_s - self._clock()))
        for watched in self._watched.values():
            _close(watched)

    def _ask(self, run: Path, watched: _Watched) -> None:
        if self._clock() < watched.ask_again_s:
            return
        try:
            whom = whom_to_ask(str(run), None, insecure=False)
            if watched.link is None or whom != watched.whom:
                _close(watched)
                watched.whom = whom
                watched.link = WorkerLink(whom[0], observer_name(), token=whom[1], limits=OF_OBSERVER)
                watched.silent_since_s = self._clock()
            watched.link.send(encode(Inquire()))
        except UserFacingError as error:
            _close(watched)
            with self._lock:
                watched.status = None
                watched.problem = one_line(str(error))

    def _listen(self, watched: _Watched, timeout_s: float) -> None:
        if watched.link is None:
            return
        watched.link.poll(timeout_s)
        newest = None
        for message in islice(watched.link.answers(), MOST_ANSWERS):
            newest = message if isinstance(message, Status) else newest
        now = self._clock()
        with self._lock:
            if newest is not None:
                watched.status = newest
                watched.answered_s = now
                watched.problem = ""
                watched.silent_since_s = now
                watched.samples.append(sample(newest, now))
            elif now - watched.answered_s > LOOKED_AT_S:
                watched.status = None
                problem = watched.link.problem
                watched.problem = one_line(problem.line) if problem else "its learner does not answer"
        if now - watched.silent_since_s > SILENT_S:
            _close(watched)
            watched.ask_again_s = now + PAUSE_S


def _close(watched: _Watched) -> None:
    if watched.link is not None:
        watched.link.close(linger_s=0)
    watched.link = watched.whom = None
