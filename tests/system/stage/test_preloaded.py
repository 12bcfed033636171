"""A process that the preloaded parent forks is what an executed one is: the tests of learners may use either."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import psutil
import pytest

from millrace.workers.supervise import worker_process
from tests.system.stage.network import Network
from tests.system.stage.preloaded import (
    ENVIRONMENT,
    ForkedProcess,
    ForkedWorker,
    command_line,
    may_be_forked,
    start_worker,
    without_words_before,
    workers_of,
)
from tests.system.stage.processes import ROOT, Stage, wait_for
from tests.system.stage.run_folders import policy_of

WITHIN_S = 60.0
PIPES = (subprocess.DEVNULL, subprocess.PIPE, subprocess.PIPE)
PROBE = """
import faulthandler, json, os, random, resource, signal, sys, tempfile, threading, time

def stream(name):
    one = getattr(sys, name)
    found = [one.name, one.encoding, one.errors, one.line_buffering, one.isatty()]
    return [*found, one.write_through, type(one.buffer).__name__, one is getattr(sys, f"__{name}__")]

match sys.argv[1:]:
    case ["raise"]:
        raise ValueError("mine")
    case ["exit", code]:
        sys.exit(int(code))
    case ["exit at the end"]:
        import atexit
        atexit.register(lambda: print("at exit", flush=True))
    case ["wait"]:
        print("waits", flush=True)
        time.sleep(60)
    case _:
        main = sys.modules["__main__"]
        print(json.dumps({
            "argv": sys.argv, "orig_argv": sys.orig_argv[1:], "path": sys.path, "folder": os.getcwd(),
            "environment": dict(os.environ), "main": [main.__name__, main.__file__, main.__spec__.name, main.__package__],
            "streams": [stream(name) for name in ("stdin", "stdout", "stderr")],
            "signals": {number: str(signal.getsignal(number)) for number in signal.valid_signals()},
            "blocked": sorted(signal.pthread_sigmask(signal.SIG_BLOCK, [])), "threads": threading.active_count(),
            "tasks": len(os.listdir("/proc/self/task")), "group": os.getpgid(0), "session": os.getsid(0),
            "files": [number for number in range(256) if os.path.exists(f"/proc/self/fd/{number}")],
            "limits": resource.getrlimit(resource.RLIMIT_NOFILE), "temporary": tempfile.gettempdir(),
            "faulthandler": faulthandler.is_enabled(), "cpus": sorted(os.sched_getaffinity(0)), "nice": os.nice(0),
            "umask": os.umask(0), "network": os.readlink("/proc/self/ns/net"),
        }))
"""


@pytest.fixture
def probe(tmp_path: Path) -> dict[str, str]:
    """The environment of a process that finds the module `probe`."""
    (tmp_path / "probe").mkdir()
    (tmp_path / "probe" / "__main__.py").write_text(PROBE)
    return {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}", "ONLY_HERE": "ü\udcff"}


def forked(env: dict[str, str], *arguments: str, folder: Path = ROOT) -> ForkedProcess:
    return ForkedProcess([sys.executable, "-m", "probe", *arguments], PIPES, folder, env)


def executed(env: dict[str, str], *arguments: str, folder: Path = ROOT) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "probe", *arguments]
    return subprocess.Popen(command, stdin=PIPES[0], stdout=PIPES[1], stderr=PIPES[2], cwd=folder, env=env)


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_what_a_process_can_tell_of_itself_is_the_same(probe: dict[str, str], tmp_path: Path, unbuffered: str) -> None:
    probe["PYTHONUNBUFFERED"] = unbuffered
    found: list[dict[str, Any]] = []
    for start in (forked, executed):
        process = start(probe, "one", "--two", folder=tmp_path)
        stdout, stderr = process.communicate(timeout=WITHIN_S)
        assert (process.returncode, stderr) == (0, b"")
        found.append(json.loads(stdout))
    for name, value in found[1].items():
        assert found[0][name] == value, name
    assert found[0].keys() == found[1].keys()
    assert found[0]["environment"]["ONLY_HERE"] == "ü\udcff"


@pytest.mark.parametrize("arguments", [["raise"], ["exit", "3"], ["exit at the end"]])
def test_it_ends_the_same(probe: dict[str, str], arguments: list[str]) -> None:
    found = []
    for start in (forked, executed):
        process = start(probe, *arguments)
        stdout, stderr = process.communicate(timeout=WITHIN_S)
        found.append((process.returncode, stdout, stderr.splitlines()[-1:]))
    assert found[0] == found[1]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL, signal.SIGHUP])
def test_a_signal_ends_it_the_same(probe: dict[str, str], number: int) -> None:
    for start in (forked, executed):
        process = start(probe, "wait")
        assert process.stdout is not None
        assert process.stdout.readline() == b"waits\n"
        assert process.poll() is None
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.01)
        process.send_signal(number)
        assert process.wait(WITHIN_S) == -number
        assert process.poll() == process.returncode == -number
        process.send_signal(number)  # to nobody
        process.communicate(timeout=WITHIN_S)


def test_one_that_nobody_waits_for_is_no_process_any_more(probe: dict[str, str]) -> None:
    """The check after each test does not find it, though its parent has not reaped it."""
    process = forked(probe, "wait")
    process.kill()
    wait_for(lambda: Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z", WITHIN_S, "its end")
    for stream in (process.stdout, process.stderr):
        assert stream is not None
        stream.close()


def test_a_worker_can_tell_no_difference_and_is_a_child_of_its_supervisor(probe: dict[str, str], tmp_path: Path) -> None:
    command = [sys.executable, "-P", "-m", "probe", "one", "--two"]
    found: list[dict[str, Any]] = []
    for forks in (True, False):
        reads, writes = os.pipe()
        with (tmp_path / "said").open("wb") as said:
            if forks:
                process: ForkedWorker | subprocess.Popen[bytes] = ForkedWorker(
                    command, (subprocess.DEVNULL, said, said), probe, [writes]
                )
            else:
                process = subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=said,
                    stderr=said,
                    start_new_session=True,
                    env=probe,
                    pass_fds=[writes],
                )
        os.close(writes)
        assert os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT) is not None, "it is not a child of this process"
        assert process.wait() == process.poll() == 0
        assert os.read(reads, 1) == b"", "somebody else holds what was passed"
        os.close(reads)
        found.append(json.loads((tmp_path / "said").read_text()))
        assert found[-1].pop("group") == found[-1].pop("session") == process.pid
        assert found[-1]["files"] == [0, 1, 2, writes]
    assert found[0] == found[1]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL, signal.SIGHUP])
def test_a_signal_ends_a_worker(probe: dict[str, str], tmp_path: Path, number: int) -> None:
    said = tmp_path / "said"
    with said.open("wb") as file:
        worker = ForkedWorker([sys.executable, "-P", "-m", "probe", "wait"], (subprocess.DEVNULL, file, file), probe, [])
    wait_for(lambda: said.read_bytes() == b"waits\n", WITHIN_S, "its start")
    assert worker.poll() is None
    worker.send_signal(number)
    assert worker.wait() == worker.poll() == -number
    worker.terminate()  # nobody


def test_workers_of_a_forked_supervisor_are_its_children_and_end_with_it(stage: Stage) -> None:
    """It has a preloaded parent of its own, which is none of its workers and ends with it too."""
    supervisor = stage.worker(f"ipc://{stage.tmp_path}/nobody", "some", "--processes", "2")
    workers = wait_for(lambda: len(found := workers_of(supervisor.pid)) == 2 and found, WITHIN_S, "two workers")
    assert workers
    assert not any("millrace.workers" in command_line(worker) for worker in workers), "they were executed"
    family = psutil.Process(supervisor.pid).children(recursive=True)
    assert len(family) == 3
    supervisor.process.kill()
    _, alive = psutil.wait_procs(family, timeout=WITHIN_S)
    assert not alive


def test_workers_of_this_process_are_forked() -> None:
    assert worker_process.popen is start_worker


def test_the_words_before_a_command_say_its_environment_and_its_network() -> None:
    command = [sys.executable, "-m", "millrace", "learner", "env", "A=1"]
    rest, environment, namespace = without_words_before(
        ["env", "-u", "LEFT_OUT", "A=1=2", "B=", *command], {"LEFT_OUT": "x", "C": "3"}
    )
    assert (rest, environment, namespace) == (command, {"A": "1=2", "B": "", "C": "3"}, "")
    rest, environment, namespace = without_words_before(["ip", "netns", "exec", "host", "env", "A=1", *command], {})
    assert (rest, environment, namespace) == (command, {"A": "1"}, "host")
    assert without_words_before(["sh", "env"], None) == (["sh", "env"], dict(os.environ), "")


def test_a_process_is_forked_on_another_host(network: Network, probe: dict[str, str]) -> None:
    host = network.host(1)
    found = []
    for before in ((), host.before):
        rest, environment, namespace = without_words_before([*before, sys.executable, "-m", "probe"], probe)
        process = ForkedProcess(rest, PIPES, ROOT, environment, namespace)
        stdout, stderr = process.communicate(timeout=WITHIN_S)
        assert (process.returncode, stderr) == (0, b"")
        found.append(json.loads(stdout)["network"])
    assert found[0] == os.readlink("/proc/self/ns/net") != found[1]


def test_only_commands_of_ours_whose_environment_is_the_parents_are_forked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("TESTS_EXEC", raising=False)
    learner = [sys.executable, "-m", "millrace", "learner", "CartPole-v1"]
    changed = {name for name in {*os.environ, *ENVIRONMENT} if os.environ.get(name) != ENVIRONMENT.get(name)}
    assert may_be_forked(learner), changed
    assert may_be_forked([sys.executable, "-m", "millrace.workers", "x"])
    assert may_be_forked([sys.executable, "-P", "-m", "millrace.workers", "x"])
    assert may_be_forked([sys.executable, "-m", "millrace", "train"], {**os.environ, "PYTHONPATH": "x", "TMPDIR": "/x"})
    for command in ("worker", "status", "keys"):
        assert may_be_forked([sys.executable, "-m", "millrace", command, "x"])
    for other in (
        [sys.executable, "-P", *learner[1:]],
        ["ip", "netns", "exec", "x", *learner],
        [sys.executable, "-m", "millrace", "plot", "x"],
        [sys.executable, "-m", "millrace"],
        [sys.executable],
    ):
        assert not may_be_forked(other), other
    for name in ("LC_ALL", "OMP_NUM_THREADS", "PYTHONHASHSEED", "PYTHONIOENCODING", "ANYTHING"):
        assert not may_be_forked(learner, {**os.environ, name: "7"}), name
    fewer = dict(os.environ)
    del fewer["OMP_NUM_THREADS"]
    assert not may_be_forked(learner, fewer)
    path = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{tmp_path}"}
    assert may_be_forked(learner, path)
    (tmp_path / "sitecustomize.py").touch()
    assert not may_be_forked(learner, path)
    with monkeypatch.context() as outside_a_test:
        outside_a_test.delenv("PYTEST_CURRENT_TEST")
        assert not may_be_forked(learner)
    monkeypatch.setenv("TESTS_EXEC", "1")
    assert not may_be_forked(learner)


def test_a_run_gives_the_same_bits(tmp_path: Path) -> None:
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    found = []
    for name in ("forked", "executed"):
        flags = f"--transport inproc --workers 1 --steps 1024 --rollout-steps 32 --seed 7 --run-dir {tmp_path}/{name}"
        command = [sys.executable, "-m", "millrace", "train", "CartPole-v1", *flags.split()]
        if name == "forked":
            process: ForkedProcess | subprocess.Popen[bytes] = ForkedProcess(command, PIPES, ROOT, env)
        else:
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=ROOT, env=env)
        _, stderr = process.communicate(timeout=WITHIN_S)
        assert process.returncode == 0, stderr
        (folder,) = (tmp_path / name).iterdir()
        found.append(policy_of(folder))
    assert found[0] == found[1]
