"""Which workers the host starts again, and when. Time and processes are faked."""

from __future__ import annotations

import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import pytest

from millrace.protocol.alive import StartFailed, WorkerActivity, WorkerExit
from millrace.protocol.call_timeouts import Doing
from millrace.workers.exit_codes import EXIT_NO_LEARNER, EXIT_UNSUITABLE
from millrace.workers.supervise.how_it_ended import Ending
from millrace.workers.supervise.supervisor import (
    BACKOFF_FIRST_S,
    BACKOFF_MOST_S,
    ENFORCE_EVERY_S,
    FINISH_ROLLOUT_WITHIN_S,
    GIVEN_UP,
    HANGS_AFTER_S,
    HEALTHY_S,
    MOST_FAILED_STARTS,
    POLL_S,
    Supervisor,
)

NONCE = 7


@dataclass
class FakeRunning:
    name: str
    end: Ending | None = None
    requests: list[str] = field(default_factory=list)
    process_nonce: int = NONCE
    session: int | None = None
    doing: Doing = "waiting"
    since_s: float = 0.0
    enforced: list[float] = field(default_factory=list)
    wrote: str = ""

    def last_line(self) -> str:
        return self.wrote

    def ended(self) -> Ending | None:
        return self.end

    def activity(self, now: float) -> WorkerActivity | None:
        return WorkerActivity(self.name, NONCE, self.doing, now - self.since_s, 0) if self.end is None else None

    def end_if_hung(self, now: float) -> None:
        self.enforced.append(now)

    def lower_priority(self) -> None:
        self.requests.append("lower_priority")

    def stop(self) -> None:
        self.requests.append("stop")

    def wait(self, timeout_s: float) -> None:
        self.requests.append("wait")

    def kill(self) -> None:
        self.requests.append("kill")


class Machine:
    """Starts fake workers and has a clock."""

    def __init__(self, workers: int = 1, *, stay: bool = False) -> None:
        self.now = 0.0
        self.started: list[tuple[str, FakeRunning]] = []
        self.host = Supervisor(self.start, workers, lambda: self.now, stay=stay)

    def start(self, name: str) -> FakeRunning:
        self.started.append((name, FakeRunning(name)))
        return self.started[-1][1]

    def die(
        self,
        code: int,
        after_s: float = 0.0,
        *,
        on_purpose: bool = False,
        worked: bool = False,
        last_lines: str | None = None,
    ) -> list[WorkerExit | StartFailed]:
        self.now += after_s
        failed = not on_purpose and last_lines is None
        self.started[-1][1].end = Ending(code, "why", on_purpose, failed, worked=worked, last_lines=last_lines)
        return self.host.poll()

    def pause_s(self) -> float:
        """Seconds until the worker is started again, to a tenth of a second."""
        before, died_s = len(self.started), self.now
        while len(self.started) == before:
            self.now += 0.1
            assert self.now - died_s < 2 * BACKOFF_MOST_S, "it is not started again"
            assert self.host.poll() == []
        return self.now - died_s


def test_a_worker_that_died_is_restarted_under_its_name_with_backoff() -> None:
    machine = Machine()
    pauses = []
    for _ in range(9):
        assert machine.die(1) == [WorkerExit("w0", NONCE, "why", True)]
        pauses.append(machine.pause_s())
    assert {name for name, _ in machine.started} == {"w0"}
    expected = [min(BACKOFF_FIRST_S * 2**n, BACKOFF_MOST_S) for n in range(9)]
    assert pauses == pytest.approx(expected, abs=0.11)


def test_a_worker_that_cannot_be_started_again_now_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = Machine(workers=2)
    starts = iter([OSError("no memory"), OSError("no memory"), None])

    def start(name: str) -> FakeRunning:
        if (error := next(starts)) is not None:
            raise error
        return machine.start(name)

    monkeypatch.setattr(machine.host, "_start", start)
    machine.die(1)
    assert machine.pause_s() == pytest.approx(BACKOFF_FIRST_S * (1 + 2 + 4), abs=0.31)
    assert machine.host.count == 2


def test_an_end_is_told_by_the_name_that_the_learner_knows() -> None:
    """`millrace worker --name x` has a worker x, whatever its number here."""
    named = FakeRunning("x")
    host = Supervisor(lambda number: named, 1, lambda: 0.0)
    named.end = Ending(-9, "why", failed=True)
    assert host.poll() == [WorkerExit("x", NONCE, "why", True)]


def test_one_that_ends_again_and_again_before_it_has_joined_is_given_up() -> None:
    machine = Machine()
    for _ in range(MOST_FAILED_STARTS - 1):
        assert machine.die(1, last_lines="no licence") == [StartFailed("w0", "why", "no licence")]
        assert machine.host.names == ["w0"]
        machine.pause_s()
    assert machine.die(1, last_lines="") == [StartFailed("w0", f"why{GIVEN_UP}", "")]
    assert machine.host.names == []
    assert machine.host.exit_code == 1


@pytest.mark.parametrize("stay", [False, True])
def test_one_that_has_joined_or_waited_for_long_or_stays_is_started_again_however_often_it_cannot_start(stay: bool) -> None:
    machine = Machine(stay=stay)
    if not stay:
        machine.die(1)  # it had joined
        machine.pause_s()
    for _ in range(2 * MOST_FAILED_STARTS):
        machine.die(1, last_lines="no memory")
        machine.pause_s()
    patient = Machine()
    for _ in range(2 * MOST_FAILED_STARTS):
        patient.die(-9, after_s=HEALTHY_S + 1, last_lines="")
        patient.pause_s()


def test_if_a_worker_cannot_be_started_at_first_none_is_left_behind() -> None:
    started: list[FakeRunning] = []

    def start(name: str) -> FakeRunning:
        if started:
            raise OSError("no memory")
        started.append(FakeRunning(name))
        return started[0]

    with pytest.raises(OSError, match="no memory"):
        Supervisor(start, 3)
    assert started[0].requests == ["stop", "wait"]


def test_the_backoff_of_a_worker_that_was_healthy_is_reset() -> None:
    machine = Machine()
    for _ in range(4):
        machine.die(-9)
        machine.pause_s()
    machine.die(-9, after_s=HEALTHY_S + 1)
    assert machine.pause_s() == pytest.approx(BACKOFF_FIRST_S, abs=0.11)


def test_a_worker_whose_environment_worked_is_soon_there_again_however_often_it_dies() -> None:
    machine = Machine()
    for _ in range(9):
        machine.die(-9, after_s=1.0, worked=True)
        assert machine.pause_s() == pytest.approx(BACKOFF_FIRST_S, abs=0.11)


@pytest.mark.parametrize("code", [0, 2, EXIT_NO_LEARNER, EXIT_UNSUITABLE])
def test_a_worker_that_left_on_purpose_or_was_refused_is_not_restarted(code: int) -> None:
    machine = Machine()
    assert machine.die(code, on_purpose=True) == [WorkerExit("w0", NONCE, "why", False)]
    machine.now += 10 * BACKOFF_MOST_S
    assert machine.host.poll() == []
    assert len(machine.started) == 1


@pytest.mark.parametrize("code", [0, EXIT_NO_LEARNER, EXIT_UNSUITABLE])
def test_one_that_stays_is_followed_by_another_whatever_the_others_do(code: int) -> None:
    """Of two workers, one is still to be started again when the other leaves with the end of the run."""
    machine = Machine(workers=2, stay=True)
    machine.started[0][1].end = Ending(1, "failed")
    machine.die(code, on_purpose=True)
    machine.pause_s()
    assert sorted(name for name, _ in machine.started) == ["w0", "w0", "w1", "w1"]


def test_one_that_stays_is_followed_by_another_soon_after_each_of_many_short_runs() -> None:
    machine = Machine(stay=True)
    for _ in range(9):
        machine.die(0, on_purpose=True)
        assert machine.pause_s() == pytest.approx(BACKOFF_FIRST_S, abs=0.11)


def test_one_that_stays_and_was_refused_is_not_restarted() -> None:
    machine = Machine(stay=True)
    machine.die(2, on_purpose=True)
    assert (machine.host.count, machine.host.exit_code) == (0, 2)


def test_a_worker_that_sigterm_ends_before_it_can_listen_has_left_as_asked() -> None:
    machine = Machine(workers=2)
    machine.host.ask_to_leave()
    machine.started[0][1].end = Ending(0, "left", on_purpose=True)
    machine.die(-signal.SIGTERM)
    assert (machine.host.count, machine.host.exit_code) == (0, 0)


@pytest.mark.parametrize("code", [0, 2, EXIT_NO_LEARNER])
def test_a_worker_that_ended_with_such_a_code_and_not_on_purpose_is_restarted(code: int) -> None:
    """The environment called `sys.exit` or `os._exit`."""
    machine = Machine()
    assert machine.die(code) == [WorkerExit("w0", NONCE, "why", True)]
    assert machine.pause_s() == pytest.approx(BACKOFF_FIRST_S, abs=0.11)


def test_a_worker_that_failed_on_purpose_is_restarted() -> None:
    """Its environment raised, which it reported to the learner itself."""
    machine = Machine()
    assert machine.die(1, on_purpose=True) == [WorkerExit("w0", NONCE, "why", False)]
    assert machine.pause_s() == pytest.approx(BACKOFF_FIRST_S, abs=0.11)


def test_timeouts_are_enforced_a_few_times_a_second() -> None:
    """The learner polls thousands of times a second."""
    machine = Machine()
    for _ in range(100):
        machine.now += 0.01
        machine.host.poll()
    assert 1.0 / ENFORCE_EVERY_S - 1 <= len(machine.started[0][1].enforced) <= 1.0 / ENFORCE_EVERY_S + 1


def test_activities_are_those_of_running_workers() -> None:
    machine = Machine(workers=2)
    machine.die(1)
    assert machine.host.activities() == [WorkerActivity("w0", NONCE, "waiting", 0.0, 0)]


def test_a_lower_priority_is_also_that_of_workers_that_are_started_again() -> None:
    machine = Machine()
    machine.host.lower_priority()
    machine.die(1)
    machine.pause_s()
    assert [worker.requests for _, worker in machine.started] == [["lower_priority"], ["lower_priority"]]


def test_the_end_of_a_worker_in_a_call_of_the_policy_is_told_as_such() -> None:
    machine = Machine()
    machine.started[-1][1].end = Ending(-9, "why", failed=True, of_policy=True)
    assert machine.host.poll() == [WorkerExit("w0", NONCE, "why", failed=True, of_policy=True)]


def test_each_end_is_reported_once() -> None:
    machine = Machine(workers=2)
    assert machine.die(1) == [WorkerExit("w1", NONCE, "why", True)]
    assert machine.host.poll() == []


def test_stop_asks_all_waits_for_all_and_restarts_none() -> None:
    machine = Machine(workers=2)
    machine.die(1)
    machine.host.stop()
    machine.now += 10
    assert machine.host.poll() == []
    assert [running.requests for _, running in machine.started] == [["stop", "wait"], []]


@pytest.mark.parametrize(
    ("codes", "expected"),
    [
        ([0, 0], 0),
        ([0, EXIT_NO_LEARNER], 1),
        ([2, EXIT_NO_LEARNER], 2),
        ([EXIT_UNSUITABLE, 0], 2),
        ([0, 2], 2),
        ([EXIT_NO_LEARNER, EXIT_NO_LEARNER], 1),
    ],
)
def test_a_host_without_workers_returns_the_exit_code_and_reports_each_end(codes: list[int], expected: int) -> None:
    machine = Machine(workers=2)
    for (_, running), code in zip(machine.started, codes, strict=True):
        running.end = Ending(code, f"ended with {code}", on_purpose=True)
    reports: list[str] = []
    assert machine.host.run(lambda: 0, reports.append) == expected
    assert reports == [f"w0 ended with {codes[0]}", f"w1 ended with {codes[1]}"]


def test_every_request_to_stop_is_passed_on_and_a_worker_that_does_not_leave_is_killed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    machine = Machine(workers=1)
    worker = machine.started[0][1]
    worker.doing = "stepping"
    requests = 0

    def sleeps(seconds: float) -> None:
        """Time passes; the worker is asked twice, and ends only when it is killed."""
        nonlocal requests
        machine.now += seconds
        worker.since_s = machine.now - 0.5  # calls of its environment return
        requests = 2 if machine.now > 5 else 1 if machine.now > 1 else 0
        if "wait" in worker.requests:
            worker.end = Ending(-9, "was killed")

    monkeypatch.setattr("millrace.workers.supervise.supervisor.time.sleep", sleeps)
    assert machine.host.run(lambda: requests, lambda line: None) == 1
    assert worker.requests == ["stop", "stop", "stop", "wait"]
    assert machine.now == pytest.approx(1 + FINISH_ROLLOUT_WITHIN_S, abs=5 * POLL_S)
    assert len(machine.started) == 1


class Notice:
    """The learner, as the supervisor hears it."""

    def __init__(self) -> None:
        self.over = False
        self.passes: Callable[[float], None]
        self.sent: list[tuple[list[WorkerActivity], list[WorkerExit]]] = []

    def send(self, running: Sequence[WorkerActivity], ended: Sequence[WorkerExit], now: float) -> None:
        self.sent.append((list(running), list(ended)))

    def listen(self, for_s: float) -> bool:
        self.passes(for_s)
        return self.over


def test_of_those_that_stay_only_what_hangs_from_before_the_end_of_a_run_is_killed() -> None:
    """One worker hangs; the other has left, and its successor makes its environment for the next run for long."""
    machine, notice = Machine(workers=2, stay=True), Notice()
    hangs, leaves = machine.started[0][1], machine.started[1][1]
    hangs.doing, stop_at_s = "stepping", 10 * HANGS_AFTER_S

    def sleeps(seconds: float) -> None:
        machine.now += seconds
        notice.over = 1 < machine.now < 2
        leaves.end = Ending(0, "left", on_purpose=True) if machine.now > 1 else None
        for _, worker in machine.started[2:]:
            worker.doing, worker.since_s = "making", 2 + BACKOFF_FIRST_S
        for _, worker in machine.started:
            if worker.requests and worker.end is None:
                worker.end = Ending(-9 if worker is hangs else 0, "ended", on_purpose=worker is not hangs)

    notice.passes = sleeps
    assert machine.host.run(lambda: int(machine.now > stop_at_s), lambda line: None, notice) == 0
    assert hangs.requests == ["kill"]
    assert [(name, worker.requests) for name, worker in machine.started[2:]] == [("w1", ["stop"]), ("w0", ["stop"])]


@pytest.mark.parametrize("cause", ["the run is over", "told to leave"])
def test_a_worker_that_hangs_when_it_should_leave_is_killed_soon(cause: str) -> None:
    """One step of its environment does not return."""
    machine, notice = Machine(workers=1), Notice()
    worker = machine.started[0][1]
    worker.doing = "stepping"

    def sleeps(seconds: float) -> None:
        machine.now += seconds
        notice.over = cause == "the run is over" and machine.now > 1
        if worker.requests[-1:] in (["kill"], ["wait"]):
            worker.end = Ending(-9, "was killed")

    notice.passes = sleeps
    stop_requests = lambda: int(cause == "told to leave" and machine.now > 1)  # noqa: E731
    assert machine.host.run(stop_requests, lambda line: None, notice) == 1
    assert machine.now == pytest.approx(1 + HANGS_AFTER_S, abs=5 * POLL_S)
    assert len(machine.started) == 1
    assert notice.sent[0] == ([WorkerActivity("w0", NONCE, "stepping", 0.0, 0)], [])
    assert notice.sent[-1] == ([], [WorkerExit("w0", NONCE, "was killed", False)])
