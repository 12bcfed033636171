"""Every test leaves the machine as it found it: no child process, no thread of ours, no temporary folder."""

from __future__ import annotations

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")  # as the command line does: bits must not depend on the number of cores
os.environ["CUDA_VISIBLE_DEVICES"] = ""  # what is compared bit for bit is computed on the CPU, also where there is a GPU

import gc
import signal
import sys

os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # else hundreds of processes of tests each compile all that they import
sys.dont_write_bytecode = False
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as a background job does, and all that it starts
    signal.signal(signal.SIGINT, signal.default_int_handler)
UNDER_NOHUP = "TESTS_UNDER_NOHUP"  # for the processes of pytest-xdist
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN or UNDER_NOHUP in os.environ:
    # The tests go on when the terminal is gone. What they start must heed the signal, and inherits no function.
    os.environ[UNDER_NOHUP] = "1"
    signal.signal(signal.SIGHUP, lambda number, frame: None)

import tempfile
import threading
import time
from collections.abc import Generator, Iterator
from contextlib import suppress
from pathlib import Path

import hypothesis
import psutil
import pytest

from millrace.workers import copy_slots, machine_slots
from millrace.workers.machine_slots import FILE_VARIABLE
from millrace.workers.supervise import worker_process
from tests.layers import SELECTED, layer_of, may_hold, short_name
from tests.support.examples import ALL, FEW
from tests.system.stage import preloaded
from tests.whole_runs import WHOLE_RUNS

worker_process.popen = preloaded.start_worker  # type: ignore[assignment]

LEAVE_WITHIN_S = 5.0
LONG_IN_CI = ("clients", "cluster", "model")
STARTS_A_PROCESS = {"subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn"}
SOAK_TIMEOUT_S = 1200  # of a test of that mark: it takes minutes, and longer on a busy machine

MAY_BE_SLOW = [hypothesis.HealthCheck.too_slow]  # no limit on time, because other tests share the cores
hypothesis.settings.register_profile("few", max_examples=FEW, deadline=None, suppress_health_check=MAY_BE_SLOW)
hypothesis.settings.register_profile("all", max_examples=ALL, deadline=None, suppress_health_check=MAY_BE_SLOW)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--layer", choices=SELECTED, default="all", help="which part of the tests runs (tests/layers.py)")


def pytest_configure(config: pytest.Config) -> None:
    layer = config.getoption("layer")
    hypothesis.settings.load_profile("few" if layer in ("check", "test") else "all")
    if layer == "check":
        sys.addaudithook(no_process)


def no_process(event: str, arguments: tuple[object, ...]) -> None:
    """What hears the interpreter's events in `make check`."""
    if event in STARTS_A_PROCESS and "PYTEST_CURRENT_TEST" in os.environ:
        raise AssertionError(f"{event}: expected a test that starts no process, or the mark `process`")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    path = collection_path.relative_to(config.rootpath).as_posix()
    return True if path.endswith(".py") and not may_hold(path, config.getoption("layer")) else None


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Garbage collections do not look again and again at what is imported and collected, which stays until the end."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not any("::" in argument for argument in config.args):
        every_whole_run_is_there({short_name(item.nodeid) for item in items})
    layer = config.getoption("layer")
    chosen: list[pytest.Item] = []
    others: list[pytest.Item] = []
    for item in items:
        (chosen if is_in(item, layer) else others).append(item)
    config.hook.pytest_deselected(items=others)
    items[:] = spread(chosen)
    for item in items:
        if item.get_closest_marker("soak") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(SOAK_TIMEOUT_S))


def every_whole_run_is_there(names: set[str]) -> None:
    """Of those whose function was collected. `tests/test_layers.py` looks for the others."""
    functions = {name.partition("[")[0] for name in names}
    gone = [run for run in WHOLE_RUNS - names if run.partition("[")[0] in functions]
    if gone:
        raise pytest.UsageError(f"tests/whole_runs.py names tests that are not there: {', '.join(sorted(gone))}")


def is_in(item: pytest.Item, layer: str) -> bool:
    """Whether a value of `--layer` selects a test."""
    own = layer_of(item.nodeid, {mark.name for mark in item.iter_markers()})
    has_more_examples = hypothesis.is_hypothesis_test(getattr(item, "obj", None))
    return own in SELECTED[layer] or (layer == "rest" and has_more_examples)


def spread(items: list[pytest.Item]) -> list[pytest.Item]:
    """Files of tests/system lie evenly among the others: they wait while those compute, so no core idles at the end."""
    waiting: list[pytest.Item] = []
    computing: list[pytest.Item] = []
    for item in items:
        (waiting if "tests/system/" in item.nodeid else computing).append(item)
    place: dict[Path, float] = {}
    for group in (waiting, computing):
        for number, item in enumerate(group):
            place.setdefault(item.path, number / len(group))
    return sorted(items, key=lambda item: place[item.path])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """In CI, a long test that is skipped has failed: what it needs is missing."""
    report = yield
    if report.skipped and "CI" in os.environ and any(item.get_closest_marker(mark) for mark in LONG_IN_CI):
        report.outcome = "failed"
    return report


def _runs(process: psutil.Process) -> bool:
    with suppress(psutil.NoSuchProcess):
        return bool(process.status() != psutil.STATUS_ZOMBIE)
    return False


def _has_children(process: int) -> bool:
    """Whether a process has a child that is not a preloaded parent, or such a parent has one. True if unknown."""
    found: set[int] = set()
    try:
        for children in Path(f"/proc/{process}/task").glob("*/children"):
            found.update(map(int, children.read_text().split()))
    except OSError:
        return True
    parents = preloaded.parent_pids()
    return not os.path.exists(f"/proc/{process}/task/{process}/children") or any(
        child not in parents or _has_children(child) for child in found
    )


def pytest_unconfigure() -> None:
    preloaded.close_parents()


@pytest.fixture(autouse=True)
def nothing_is_left_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    monkeypatch.setenv("TMPDIR", str(temporary))
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setenv(FILE_VARIABLE, str(tmp_path.with_name(f"{tmp_path.name}-slots")))
    own_slots: dict[int, machine_slots.Slots] = {}
    # Copies that a test does not close hold no slots of another test.
    monkeypatch.setattr(machine_slots, "_of_processes", own_slots)
    monkeypatch.setattr(copy_slots, "_slots", {})
    copy_slots._of_process.cache_clear()
    threads = set(threading.enumerate())
    yield
    for own in own_slots.values():
        os.close(own.fd)
    deadline = time.monotonic() + LEAVE_WITHIN_S
    if _has_children(os.getpid()):  # psutil reads all of /proc
        children = [child for child in psutil.Process().children(recursive=True) if _runs(child)]
        children = [child for child in children if child.pid not in preloaded.parent_pids()]
    else:
        children = []
    _, alive = psutil.wait_procs(children, timeout=LEAVE_WITHIN_S)
    alive = [child for child in alive if _runs(child)]
    for child in alive:
        child.kill()  # so that the next test does not find it too
    assert not alive, f"processes were left behind: {alive}"
    started = [thread for thread in threading.enumerate() if thread not in threads and not thread.daemon]
    for thread in started:
        thread.join(max(0.0, deadline - time.monotonic()))
        assert not thread.is_alive(), f"{thread} was left behind"
    left = [path.name for path in temporary.iterdir() if path.name.startswith("millrace-")]
    assert not left, f"temporary folders were left behind: {left}"
