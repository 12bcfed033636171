"""What the learner tells whoever asks, and the log as JSON."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
import zmq

from millrace.cli.status import as_table, ask, in_json, observer_name
from millrace.learner.members.events import LoggedEvent, WorkerLeft, WorkerToldToRejoin, as_extra, describe
from millrace.learner.members.member import MAX_LATE_ACTIONS
from millrace.learner.rollouts.hub import Hub, HubSettings
from millrace.learner.rollouts.run_status import progress_now, status
from millrace.learner.run_folder.json_log import JsonLines, progress_line
from millrace.learner.run_folder.progress import Progress
from millrace.protocol.errors import RunError
from millrace.protocol.messages import Goodbye, Heartbeat, Hello, Inquire, Status
from millrace.protocol.progress import RunProgress
from millrace.protocol.wire.codec import encode
from millrace.protocol.wire.learner_link import LearnerLink
from millrace.protocol.wire.worker_link import WorkerLink
from millrace.terminal import progress_view
from tests.learner.rollouts.test_ticket_coordinator import Learner
from tests.support.conversation.example_messages import example
from tests.support.conversation.fake_ends import process_ends

PROGRESS = Progress(env_steps=1_000, total_steps=10_000, steps_per_s=50.0, return_mean=12.5, lag_mean=0.5, lag_max=2)


def told(learner: Learner, waiting: str = "") -> Status:
    progress = progress_now(learner.coordinator, PROGRESS, waiting, "gathering")
    return status(learner.coordinator, progress, learner.now)


def counts(learner: Learner, peer: bytes, steps: int, resident: int = 0) -> None:
    seen = learner.coordinator.members[peer].replies
    held = tuple(learner.tickets(peer))
    learner.says(
        peer,
        example(
            Heartbeat,
            session=learner.session(peer),
            replies=seen,
            versions=(0,),
            tickets=held,
            steps=steps,
            resident_bytes=resident,
        ),
    )


def test_it_tells_of_the_run_and_of_every_worker_in_the_order_of_joining() -> None:
    learner = Learner(lanes=3)
    learner.joins(b"b", pid=7)
    learner.joins(b"a", host="far")
    learner.deliver_all()
    found = told(learner)
    assert (found.env, found.version) == (learner.coordinator.run.env.id, 0)
    assert found.progress == RunProgress(
        env_steps=1_000,
        total_steps=10_000,
        steps_per_s=50.0,
        return_mean=12.5,
        lag_mean=0.5,
        lag_max=2,
        ledger=learner.coordinator.rollouts.ledger.counts(),
        phase="gathering",
    )
    assert [(w.worker, w.host, w.pid, w.state) for w in found.workers] == [
        ("b", "host", 7, "active"),
        ("a", "far", 1, "active"),
    ]
    assert sorted(lane for worker in found.workers for lane in worker.lanes) == [0, 1, 2]
    learner.coordinator.drain("done")
    assert {worker.state for worker in told(learner).workers} == {"draining"}


def late(learner: Learner, peer: bytes, actions: int) -> None:
    learner.says(peer, example(Heartbeat, session=learner.session(peer), versions=(0,), late_actions=actions))


def test_late_actions_are_counted_once_also_when_a_worker_joins_again() -> None:
    learner = Learner()
    learner.joins(b"a")
    for actions in (0, 3, 3, 5):
        late(learner, b"a", actions)
    assert told(learner).workers[0].late_actions == 5
    assert told(learner).progress.ledger["late_actions"] == 5
    learner.joins(b"a", attempt=2)  # the same process
    late(learner, b"a", 7)
    assert told(learner).progress.ledger["late_actions"] == 5
    late(learner, b"a", 8)
    assert told(learner).progress.ledger["late_actions"] == 6
    learner.joins(b"a", pid=2)
    late(learner, b"a", 2)
    assert told(learner).progress.ledger["late_actions"] == 8


def test_a_number_of_late_actions_that_no_loop_can_reach_is_not_counted() -> None:
    learner = Learner()
    learner.joins(b"a")
    for actions in (2, 2**60, 1, MAX_LATE_ACTIONS + 1):
        late(learner, b"a", actions)
    assert told(learner).progress.ledger["late_actions"] == 2 + MAX_LATE_ACTIONS


def test_late_actions_have_a_column_if_there_are_any() -> None:
    learner = Learner()
    learner.joins(b"a")
    assert "late actions" not in as_table(told(learner))
    late(learner, b"a", 1_234)
    table = as_table(told(learner)).splitlines()
    assert table[2].endswith("late actions")
    assert table[3].endswith("1,234")
    assert table[-1] == "1,234 actions came too late"


def test_silence_is_counted_from_the_last_message() -> None:
    learner = Learner()
    learner.joins(b"a")
    learner.now += 3.0
    assert told(learner).workers[0].silent_s == 3.0
    learner.beats(b"a")
    assert told(learner).workers[0].silent_s == 0.0


def test_speed_is_measured_between_two_accounts_that_are_apart() -> None:
    learner = Learner()
    learner.now = 10.0
    learner.joins(b"a")
    counts(learner, b"a", steps=1_000, resident=5)
    assert told(learner).workers[0].steps_per_s == 0.0  # nobody knows since when
    learner.now += 0.1
    counts(learner, b"a", steps=1_010)  # early
    learner.now += 1.9
    counts(learner, b"a", steps=1_400, resident=6)
    worker = told(learner).workers[0]
    assert (worker.steps_per_s, worker.steps, worker.resident_bytes) == (200.0, 1_400, 6)


def test_speed_is_that_of_the_last_rollout_until_the_next_one_is_overdue() -> None:
    learner = Learner()
    learner.now = 10.0
    learner.joins(b"a")
    counts(learner, b"a", steps=1_000)
    learner.now += 20.0
    counts(learner, b"a", steps=2_000)
    speeds = []
    for seconds in (1.0, 19.0, 5.0, 75.0):
        learner.now += seconds
        counts(learner, b"a", steps=2_000)
        speeds.append(told(learner).workers[0].steps_per_s)
    assert speeds == [50.0, 50.0, 40.0, 10.0]


def test_weights_count_as_held_when_the_worker_says_so() -> None:
    learner = Learner()
    learner.joins(b"a")
    assert told(learner).workers[0].version == -1
    learner.beats(b"a", versions=(0,))
    assert told(learner).workers[0].version == 0


def test_asking_changes_nothing() -> None:
    learner = Learner()
    learner.joins(b"a")
    before = (repr(vars(learner.coordinator)), repr(learner.coordinator.members))
    told(learner)
    assert before == (repr(vars(learner.coordinator)), repr(learner.coordinator.members))


# ------------------------------------------------------------------------------------------------ over a socket


@pytest.fixture
def context() -> Iterator[zmq.Context[zmq.Socket[bytes]]]:
    made: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    yield made
    made.term()


def test_a_learner_answers_one_who_is_no_worker(context: zmq.Context[zmq.Socket[bytes]]) -> None:
    learner = Learner()
    link = LearnerLink("tcp://127.0.0.1:*", context)
    hub = Hub(link, learner.coordinator, HubSettings(no_workers_timeout_s=60, stall_timeout_s=60, max_env_failures=0))
    hub.report_progress(PROGRESS)
    asking = WorkerLink(link.address, observer_name(), context)
    found: list[Status] = []
    thread = threading.Thread(target=lambda: found.append(ask(asking, 10.0)))
    thread.start()
    deadline_s = time.monotonic() + 10.0
    while thread.is_alive() and time.monotonic() < deadline_s:
        if link.poll(0.1):
            hub.pulse()
    thread.join(10.0)
    asking.close(0)
    link.close(0)
    assert found == [status(learner.coordinator, progress_now(learner.coordinator, PROGRESS, "", "starting"), 0.0)]
    assert not learner.coordinator.members


def test_nobody_there_is_said_at_the_deadline(context: zmq.Context[zmq.Socket[bytes]]) -> None:
    link = WorkerLink("tcp://127.0.0.1:9", observer_name(), context)
    with pytest.raises(RunError, match=r"no learner answered within 0\.05 s; is it running, and is this its address\?"):
        ask(link, 0.05)
    link.close(0)


# ------------------------------------------------------------------------------------------------ as it is shown


def test_who_waits_for_whom_stands_below_the_line_of_the_run() -> None:
    learner = Learner(lanes=2)
    assert as_table(told(learner)).splitlines()[1] == ""
    busy = RunProgress(stages={"learner_update": 3.0, "worker_wait": 1.0})
    updating = status(learner.coordinator, busy, learner.now)
    assert as_table(updating).splitlines()[1].startswith("Updates are the slowest part: ")
    waiting = told(learner, "waiting 12 s for lane 3 (worker \x1b[7m on cpu2: in reset for 11 s)")
    assert as_table(waiting).splitlines()[1:3] == [
        "The learner has been waiting 12 s for lane 3 (worker \\x1b[7m on cpu2: in reset for 11 s).",
        "",
    ]
    assert json.loads(in_json(waiting))["progress"]["waiting"] == waiting.progress.waiting


def test_it_is_shown_as_a_table() -> None:
    learner = Learner(lanes=2)
    learner.joins(b"w0")
    counts(learner, b"w0", steps=10, resident=50 * 2**20)
    learner.joins(b"w1")
    for name in (b"w2",):
        learner.joins(name)
    learner.says(b"w1", Goodbye(learner.session(b"w1"), "told to stop", ()))
    text = as_table(told(learner))
    assert "1,000 of 10,000 env steps, 50 steps/s, return 12.5" in text
    assert "50 MB" in text
    assert "w2" in text
    assert "w1" not in text
    assert text.splitlines()[-1] == "nothing was lost or dropped"


@pytest.mark.parametrize("workers", [1, 3])
def test_it_shows_how_many_workers_could_have_a_lane(workers: int) -> None:
    learner = Learner(lanes=2)
    for number in range(workers):
        learner.joins(b"w%d" % number)
    learner.says(b"e", example(Hello, worker="e", process_nonce=77, attempt=78, evaluates=True))
    assert f"workers: {workers} here, 2 wanted (one for each lane)" in as_table(told(learner)).splitlines()


def test_in_json_every_field_has_its_name() -> None:
    learner = Learner(lanes=1)
    learner.joins(b"a")
    found = json.loads(in_json(told(learner)))
    assert list(found) == ["type", *Status.__struct_fields__]
    assert (found["type"], found["progress"]["env_steps"]) == ("Status", 1_000)
    assert (found["workers"][0]["worker"], found["workers"][0]["lanes"]) == ("a", [0])


def test_a_run_without_workers_says_so() -> None:
    text = as_table(told(Learner()))
    assert "no worker is here" in text
    assert "silent" not in text
    assert text.splitlines()[-1] == "nothing was lost or dropped"


# ------------------------------------------------------------------------------------------------ events


def test_one_whose_session_has_ended_is_told_to_join_again_and_that_is_an_event() -> None:
    learner = Learner()
    learner.joins(b"a")
    late = learner.rollout_of(learner.tickets()[0])
    process_ends(learner.coordinator, "a", "was killed")
    learner.coordinator.events.clear()
    learner.says(b"a", late)
    (event,) = learner.coordinator.events
    assert event == WorkerToldToRejoin("a", late.session, 1)
    assert "1 transitions that it sent are counted, not used" in describe(event)


EVENTS: list[tuple[LoggedEvent, dict[str, Any]]] = [
    (WorkerLeft("w0", "was killed", 2, False), {"event": "left", "worker": "w0", "why": "was killed", "tickets": 2}),
    (WorkerToldToRejoin("w0", 7, 640), {"event": "asked_to_rejoin", "worker": "w0", "session": 7, "late": 640}),
]


@pytest.mark.parametrize(("event", "expected"), EVENTS)
def test_an_event_is_one_line_of_json(event: LoggedEvent, expected: dict[str, Any]) -> None:
    record = logging.LogRecord("millrace.learner", logging.WARNING, "", 0, "%s", (describe(event),), None)
    vars(record).update(json.loads(json.dumps(as_extra(event))))
    line = JsonLines().format(record)
    found = json.loads(line)
    assert "\n" not in line
    assert expected.items() <= found.items()
    assert (found["level"], found["message"]) == ("warning", describe(event))
    assert found["time"].endswith("+00:00")


def test_any_other_line_and_the_progress_are_lines_of_json_too() -> None:
    record = logging.LogRecord("millrace.learner", logging.INFO, "", 0, "two\nlines %d", (3,), None)
    assert json.loads(JsonLines().format(record)) | {"time": ""} == {
        "time": "", "level": "info", "event": "said", "message": "two\nlines 3",
    }  # fmt: skip
    record.levelno, record.levelname, record.notice = logging.WARNING, "WARNING", True
    assert json.loads(JsonLines().format(record))["level"] == "info", "a notice is no warning"
    found = json.loads(progress_line(PROGRESS, 0.0))
    assert (found["event"], found["time"], found["env_steps"]) == ("progress", "1970-01-01T00:00:00.000+00:00", 1_000)


def test_a_run_that_is_watched_by_a_machine_says_nothing_but_json(capsys: pytest.CaptureFixture[str]) -> None:
    logger = logging.getLogger("millrace.learner")
    with progress_view(log_json=True) as watch:
        watch(Progress(total_steps=5, note="saved"))
        logger.info("worker w1 joined")
    logger.info("nobody listens any more")
    out, err = capsys.readouterr()
    assert out == ""
    assert [json.loads(line)["event"] for line in err.splitlines()] == ["progress", "said"]


def test_a_question_is_a_message_without_a_session() -> None:
    assert len(encode(Inquire())) == 1


def test_what_is_unusual_about_a_worker_is_shown() -> None:
    learner = Learner(lanes=1)
    for name in (b"w0", b"w1"):
        learner.joins(name)
    learner.coordinator.reject_message(b"w1", "rubbish", learner.now)
    text = as_table(told(learner))
    assert "spare" in text
    assert "w1 (1 strikes)" in text
    assert "none" in text
    learner.coordinator.drain("done")
    assert "draining" in as_table(told(learner))
