"""A short run of real processes with faults is one of the model, and a trace that was tampered with is not."""

from __future__ import annotations

import inspect
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from millrace.learner.members.describe_coordinator import DescribeCoordinator
from millrace.learner.rollouts.ticket_coordinator import TicketCoordinator
from millrace.workers.conversation.session import Session
from tests.model.traces.accept import Acceptance, LearnerTrace, Moment, WorkerTrace, accept, check_order, processes_by_sender
from tests.model.traces.record import Record, SaidRollout, read
from tests.model.traces.recorder import FOLDER, METHODS, NOT_RECORDED
from tests.model.traces.replay import NotAccepted
from tests.system.stage.processes import ROOT, SMALL, TOY, Stage, free_port

ADDRESS = "tcp://127.0.0.1:{}"
UPDATES = 4


@pytest.fixture(scope="module")
def traces(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The traces of a run with a killed worker, a stopped worker, a killed learner and evaluations."""
    folder = tmp_path_factory.mktemp("traced")
    stage = Stage(folder / "stage", folder / "traces")
    address = ADDRESS.format(free_port())
    settings = {**SMALL, "eval-every": 128, "eval-episodes": 4, "checkpoint-every-s": 0.01}
    try:
        learner = stage.learner(address, settings, env=TOY)
        first, second = (stage.worker(address, f"w{number}") for number in range(2))
        learner.trains(UPDATES)
        first.kill()
        first = stage.worker(address, "w0")
        learner.trains(UPDATES)
        second.pause()
        learner.hears("silent")
        second.go_on()
        learner.trains(UPDATES)
        learner.kill()
        learner = stage.learner(address, resume=learner.folder)
        learner.trains(UPDATES)
    finally:
        stage.close()
    return folder / "traces"


@pytest.fixture(scope="module")
def accepted(traces: Path) -> Acceptance:
    return accept(traces)


@pytest.mark.parametrize("part", [TicketCoordinator, DescribeCoordinator, Session])
def test_every_method_that_a_shell_may_call_is_recorded_or_left_out_on_purpose(part: type) -> None:
    public = {name for name, _ in inspect.getmembers(part, inspect.isfunction) if not name.startswith("_")}
    assert public == {*METHODS[part.__name__], *NOT_RECORDED.get(part.__name__, ())}


@pytest.mark.model
def test_the_run_is_one_of_the_model(accepted: Acceptance) -> None:
    counts = accepted.counts
    assert counts["learners"] == 2
    assert counts["processes of workers"] >= 3
    assert counts["tickets used"] > 0
    assert counts["messages from workers"] > 100
    assert counts["messages to workers"] > 100
    assert counts["messages of strangers"] == 0


def test_what_arrives_from_an_old_connection_is_a_strangers() -> None:
    """In every process libzmq numbers old connections from the same number, so two workers can have had the same one."""
    worker, hello = WorkerTrace("w0", nonce=7), Moment(1.0, "Hello", b"digest")
    learner = LearnerTrace(heard=[(b"\0k\x8bEg\0key", 7, hello), (b"w0\0key", 7, hello)])
    assert processes_by_sender([worker], [learner]) == {b"w0\0key": [worker]}


@pytest.mark.parametrize(
    ("heard", "lost", "twice", "out_of_order"), [("abc", 0, 0, 0), ("ac", 1, 0, 0), ("abbc", 0, 1, 0), ("acb", 1, 0, 1)]
)
def test_what_the_network_did_is_counted(heard: str, lost: int, twice: int, out_of_order: int) -> None:
    accepted = Acceptance()
    said = [Moment(at_s, kind, b"") for at_s, kind in enumerate("abc")]
    check_order("w0 heard", said, [Moment(9.0, kind, b"") for kind in heard], accepted, "to workers")
    found = [
        accepted.counts[f"messages to workers that {what}"] for what in ("were lost", "came twice", "came out of order")
    ]
    assert found == [lost, twice, out_of_order]
    for nobody_said in (Moment(9.0, "d", b""), Moment(9.0, "a", b"other"), Moment(1.5, "c", b"")):
        with pytest.raises(NotAccepted, match="which nobody had said"):
            check_order("w0 heard", said, [nobody_said], accepted, "to workers")


# ---------------------------------------------------------------- traces that were tampered with


@pytest.fixture
def copy(traces: Path, tmp_path: Path, accepted: Acceptance) -> Path:
    """A copy of the traces, which are accepted."""
    return Path(shutil.copytree(traces, tmp_path / "copy"))


def change(path: Path, how: Callable[[list[Record]], list[Record]]) -> None:
    """Write the trace anew."""
    path.write_bytes(b"".join(pickle.dumps(tuple(record)) for record in how(list(read(path)))))


def learners(folder: Path) -> list[Path]:
    """The traces of the learners, the first first."""
    return sorted(folder.glob("learner-*"), key=lambda path: next(read(path)).at_s)


@pytest.mark.model
def test_a_call_that_is_left_out_shows(copy: Path) -> None:
    def without_a_rollout(records: list[Record]) -> list[Record]:
        place = next(n for n, each in enumerate(records) if any(isinstance(one, SaidRollout) for one in each.arguments))
        return records[:place] + records[place + 1 :]

    change(learners(copy)[0], without_a_rollout)
    with pytest.raises(NotAccepted, match=r"learner-.* expected .*, got "):
        accept(copy)


@pytest.mark.model
def test_a_message_that_nobody_said_shows(copy: Path) -> None:
    """A worker's process ended before it said what the learner heard."""
    path = max(copy.glob("worker-*"), key=lambda path: path.stat().st_size)
    change(path, lambda records: records[: 3 * len(records) // 4])
    with pytest.raises(NotAccepted, match=r"w\d.*(which nobody had said|no process of this worker was in session)"):
        accept(copy)


@pytest.mark.model
def test_a_message_that_is_heard_before_it_is_said_shows(copy: Path) -> None:
    path = max(copy.glob("worker-*"), key=lambda path: path.stat().st_size)
    change(path, lambda records: [each._replace(at_s=each.at_s - 1000) for each in records])
    with pytest.raises(NotAccepted, match=r"a process of w\d heard .*, which nobody had said"):
        accept(copy)


@pytest.mark.model
def test_a_message_may_come_twice(copy: Path, accepted: Acceptance) -> None:
    """The network of the model repeats messages. A repeat of weights changes nothing in a worker."""

    def with_weights_twice(records: list[Record]) -> list[Record]:
        place = next(n for n, each in enumerate(records) if each.method == "handle" and each.arguments[0].kind == "Weights")
        return [*records[: place + 1], *records[place:]]

    change(next(copy.glob("worker-*")), with_weights_twice)
    assert accept(copy).counts["messages to workers"] == accepted.counts["messages to workers"] + 1


@pytest.mark.model
def test_a_learner_that_begins_where_no_checkpoint_was_shows(copy: Path) -> None:
    def without_snapshots(records: list[Record]) -> list[Record]:
        return [each for each in records if each.method != "incarnations"]

    def with_another_snapshot(records: list[Record]) -> list[Record]:
        kept = without_snapshots(records)
        first = next(each for each in records if each.method == "incarnations")
        place = records.index(first)
        return [*kept[:place], first, *kept[place:]]

    change(learners(copy)[0], with_another_snapshot)
    with pytest.raises(NotAccepted, match="of which there is no checkpoint"):
        accept(copy)


@pytest.mark.model
def test_a_trace_that_is_cut_in_a_record_is_read_up_to_there(copy: Path) -> None:
    """So ends the trace of a process that was killed while it wrote."""
    path = learners(copy)[-1]
    whole = len(list(read(path)))
    path.write_bytes(path.read_bytes()[:-3])
    assert len(list(read(path))) == whole - 1


def test_without_a_wish_for_traces_the_program_is_what_it_always_is() -> None:
    """The hook alone imports nothing; the classes are the program's own."""
    code = "import sys, millrace.learner.rollouts.ticket_coordinator as t, millrace.workers.conversation.session as s; "
    code += "print(t.TicketCoordinator.__module__ == t.__name__, s.Session.__module__ == s.__name__, "
    code += "'sitecustomize' in sys.modules, any('traces' in name for name in sys.modules))"
    path = os.pathsep.join(map(str, (ROOT / "tests/model/traces/hook", ROOT)))
    environment = {**os.environ, "PYTHONPATH": path}
    environment.pop(FOLDER, None)
    said = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True).stdout
    assert said.split() == ["True", "True", "True", "False"]
