"""`millrace launch ray` on a real Ray cluster of two nodes: an actor is killed, Ray restarts it, the run goes on."""

from __future__ import annotations

import importlib.util
import shutil
import signal
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from tests.system.stage.processes import SMALL, START_S, TOY, Learner, Running, Stage, free_port, wait_for
from tests.system.stage.runs import accounted

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(600)]
CORES = {"head": 1, "second": 2}
ACTORS = sum(CORES.values())
ENDS_S = 90.0  # a node first waits for its actors, for up to 30 s


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    made = Stage(tmp_path)
    try:
        yield made
    finally:
        made.close()


class Ray:
    """A Ray cluster of a head and a second node, both on loopback, with all files in one folder."""

    def __init__(self, stage: Stage, folder: Path) -> None:
        self.address = f"127.0.0.1:{free_port()}"
        self._nodes: list[Running] = []
        self._stage = stage
        self._start(
            "head",
            "--head",
            "--port",
            self.address.rpartition(":")[2],
            "--temp-dir",
            str(folder),
            "--include-dashboard=false",
        )
        self._start("second", "--address", self.address)

    def _start(self, name: str, *flags: str) -> None:
        """Run `ray start`, which stays in the foreground until SIGTERM ends the node."""
        command = [str(Path(sys.executable).with_name("ray")), "start", "--block", "--disable-usage-stats", *flags]
        command += ["--node-ip-address", "127.0.0.1", "--num-cpus", str(CORES[name])]
        self._nodes.append(self._stage.start(command, f"ray-{name}"))
        self._nodes[-1].hears("block forever", START_S)

    def actors(self) -> set[int]:
        """Process ids of the actors that run the worker program."""
        found = set()
        for process in self._processes():
            with suppress(psutil.NoSuchProcess):
                if process.cmdline()[:1] == ["ray::WorkerHost.run"]:
                    found.add(process.pid)
        return found

    def kill(self, actor: int) -> None:
        """Send SIGKILL to an actor and its worker, as if their host failed. They are stopped before: a worker says Goodbye
        if its actor alone is dead.
        """
        both = [psutil.Process(actor), *psutil.Process(actor).children(recursive=True)]
        for process in both:
            process.suspend()
        for process in both:
            process.kill()

    def close(self) -> None:
        """End both nodes; fail if one of their processes remains."""
        theirs = self._processes()
        try:
            for node in reversed(self._nodes):
                node.signal(signal.SIGTERM)
            for node in self._nodes:
                node.ends(ENDS_S)
        finally:
            _, left = psutil.wait_procs(theirs, timeout=30)
            for process in left:
                process.kill()
        assert not left, f"processes were left behind: {left}"

    def _processes(self) -> list[psutil.Process]:
        return [process for node in self._nodes for process in psutil.Process(node.pid).children(recursive=True)]


@pytest.fixture
def ray(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> Iterator[Ray]:
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")  # a token in the home directory would be that of another cluster
    if importlib.util.find_spec("ray") is None:
        pytest.skip("Ray is not installed: pip install '.[ray]'")
    folder = Path(tempfile.mkdtemp(prefix="ray-", dir="/tmp"))  # the path of a socket must be short
    made = None
    try:
        made = Ray(stage, folder)
        yield made
    finally:
        try:
            if made is not None:
                made.close()
        finally:
            shutil.rmtree(folder)


def launched(stage: Stage, ray: Ray, **settings: object) -> Learner:
    """A run on the cluster."""
    stage.runs.mkdir(exist_ok=True)
    given = SMALL | {"min-workers": ACTORS, "run-dir": stage.runs, "keys": stage.tmp_path / "keys"} | settings
    flags = [word for name, value in given.items() for word in (f"--{name}", *str(value).split())]
    command = [sys.executable, "-m", "millrace", "launch", "ray", TOY, "--workers", str(ACTORS), "--address", ray.address]
    learner = Learner([*command, "--port", str(free_port()), "--", *flags], stage.tmp_path / "learner.log", stage.runs)
    stage.started.append(learner)
    return learner


def test_an_actor_that_is_killed_comes_back_and_the_run_goes_on(ray: Ray, stage: Stage) -> None:
    learner = launched(stage, ray)
    learner.trains(3)
    before = wait_for(lambda: len(found := ray.actors()) == ACTORS and found, START_S, "an actor for each core")
    assert before
    ray.kill(min(before))
    after = wait_for(lambda: len(found := ray.actors()) == ACTORS and found != before and found, 60, "another in its place")
    assert after
    assert before - after == {min(before)}
    learner.until(lambda row: row["ledger/lost"] > 0, START_S, "what it held to be dealt again")
    learner.trains(3)

    learner.signal(signal.SIGTERM)
    assert learner.ends() == 130, learner.said()
    saved = learner.summary()
    accounted(saved)
    wait_for(lambda: not ray.actors(), 30, "the end of the actors")

    again = launched(stage, ray)  # --resume auto
    again.until(lambda row: row["time/iterations"] > saved["updates"], START_S, "the run to go on")
    again.signal(signal.SIGTERM)
    assert again.ends() == 130, again.said()
    accounted(again.summary())


def test_a_run_ends_by_itself_and_leaves_no_actor(ray: Ray, stage: Stage) -> None:
    learner = launched(stage, ray, steps=2000)
    assert learner.ends(START_S) == 0, learner.said()
    assert learner.summary()["stop_reason"] == "all steps done"
    wait_for(lambda: not ray.actors(), 30, "the end of the actors")


def test_without_a_cluster_one_line_says_so(stage: Stage) -> None:
    if importlib.util.find_spec("ray") is None:
        pytest.skip("Ray is not installed: pip install '.[ray]'")
    if any(process.name() == "raylet" for process in psutil.process_iter()):
        pytest.skip("a Ray cluster of somebody else runs here")
    asked = stage.start([sys.executable, "-m", "millrace", "launch", "ray", TOY], "asks")
    assert asked.ends(START_S) == 2, asked.said()
    assert "millrace: no Ray cluster at auto" in asked.said()
    assert asked.said().count("\n") == 1
