"""A hostile worker with a valid key and without a lane, at a live learner that shows its run in every way that it can.

Rule: what it says, in any field and however often, leaves the learner's weights the same bits, its memory within 20 MB and
its log within 1 MB of the run without it; and nothing that is shown holds control characters or markup of it.
"""

from __future__ import annotations

import fcntl
import itertools
import json
import os
import pty
import re
import struct
import sys
import termios
import threading
import urllib.request
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import get_args

import pytest

from millrace.cli.status import as_table, ask, in_json, observer_name
from millrace.extras.monitoring.report.page import write_page
from millrace.protocol.bounds import Stage as WorkerStage
from millrace.protocol.keys.key_folder import KeyFolder
from millrace.protocol.keys.worker_token import read_token
from millrace.protocol.wire.worker_link import WorkerLink
from tests.support.conversation.extreme_messages import MARK
from tests.system.faults.hostile_worker import FLOODS, NAME, Hostile, sayings
from tests.system.stage.preloaded import start
from tests.system.stage.processes import ROOT, SMALL, START_S, TOY, Learner, Stage, free_port, wait_for
from tests.system.stage.run_folders import policy_of
from tests.system.stage.runs import accounted

LANES = 2
SETTINGS: dict[str, object] = {"envs": LANES, "lanes": LANES, "min-workers": LANES, "seed": 3, "batch-size": 16}
MEMORY_MB, LOG_BYTES = 20, 1_000_000
END_S = 400.0  # of a run with a hostile worker, on a crowded machine
EVENTS = (
    "joined",
    "left",
    "refused",
    "nameless_hello",
    "environment_raised",
    "policy_raised",
    "asked_to_rejoin",
    "progress",
    "said",
)  # of `--log-json`
BLOCK = re.compile(rb"[^\w]* \d+% |(env steps|return|workers|time|lost|run)  | {11}|\s*$")
FORGED = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]")


class OnTerminal(Learner):
    """`millrace learner` on a terminal of its own. What it shows goes to a file."""

    def __init__(self, command: Sequence[str], said: Path, runs: Path) -> None:
        self._runs, self.said_in = runs, said
        said.touch()
        master, slave = pty.openpty()
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 50, 200, 0, 0))
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "TERM": "xterm-256color"}
        self.process = start(command, stdin=slave, stdout=slave, stderr=slave, cwd=ROOT, env=environment)
        os.close(slave)
        self.pid = self.process.pid
        self._reader = threading.Thread(target=self._read, args=(master,), daemon=True)
        self._reader.start()

    def _read(self, master: int) -> None:
        with self.said_in.open("wb", buffering=0) as file:
            try:
                while shown := os.read(master, 65536):
                    file.write(shown)
            except OSError:  # Linux's way to say that nobody has the terminal open any more
                pass
        os.close(master)

    def all_said(self) -> bytes:
        """Everything, after its end."""
        self._reader.join(10.0)
        return self.said_in.read_bytes()


@dataclass
class Seen:
    """What is left of a run, and what it showed on the way."""

    policy: bytes = b""
    memory_mb: float = 0.0
    said: bytes = b""
    log: str = ""
    texts: dict[str, str] = field(default_factory=dict)
    hostile: Hostile | None = None


def learn(folder: Path, settings: Mapping[str, object], attack: Callable[[Hostile], None] | None, live: bool) -> Seen:
    """Learn with two honest workers, and perhaps a hostile one that joins when every lane has its owner."""
    seen = Seen()
    with closing(Stage(folder)) as stage, ExitStack() as stack:
        keys, token = stage.keys()
        mallory = KeyFolder(keys).new("mallory", datetime.now(UTC).replace(microsecond=0))
        address, metrics = f"tcp://127.0.0.1:{free_port()}", f"127.0.0.1:{free_port()}"
        flags = {**SMALL, **SETTINGS, "keys": keys, "metrics-bind": metrics, **settings}
        arguments = [TOY, "--bind", address, "--run-dir", str(stage.runs), "--tensorboard"]
        for name, value in flags.items():
            arguments += [f"--{name}", *str(value).split()]
        if live:
            learner: Learner = OnTerminal(
                [sys.executable, "-m", "millrace", "learner", *arguments], folder / "tty", stage.runs
            )
            stage.started.append(learner)
        else:
            learner = Learner([sys.executable, "-m", "millrace", "learner", *arguments], folder / "learner.log", stage.runs)
            stage.started.append(learner)
        learner.hears("waiting for workers", START_S)
        for number in range(LANES):
            stage.worker(address, f"w{number}", "--token", str(token))
        learner.trains(1)
        if attack is not None:
            seen.hostile = Hostile(address, mallory, stack)
            attack(seen.hostile)
        asks = WorkerLink(address, observer_name(), token=read_token(str(token)))
        status = ask(asks, START_S)
        asks.close(0.0)
        seen.texts |= {"status": as_table(status), "json": in_json(status)}
        with urllib.request.urlopen(f"http://{metrics}/metrics", timeout=10) as answer:
            seen.texts["metrics"] = answer.read().decode()
        steps = int(str(settings["steps"]))
        sizes: list[float] = []

        def far() -> bool:
            sizes.append(learner.memory_mb())
            return bool(learner.rows()[-1]["time/total_timesteps"] > 0.8 * steps)

        assert learner.rows()[-1]["time/total_timesteps"] < 0.8 * steps, "the run was over before the hostile worker was"
        wait_for(far, END_S, "the end of training", every_s=0.1)
        seen.memory_mb = median(sizes[-5:])
        assert learner.ends(END_S) == 0, learner.said()[-5_000:]
        seen.policy = policy_of(learner.folder)
        if isinstance(learner, OnTerminal):
            seen.said = learner.all_said()
        else:
            seen.log = learner.said_in.read_text(errors="replace")
        write_page([learner.folder], learner.folder / "report.html")
        accounted(learner.summary(), lanes=LANES, rows=16)
        for file in learner.folder.rglob("*"):
            if file.is_file() and file.suffix not in (".pt", ".safetensors"):
                seen.texts[str(file.relative_to(learner.folder))] = file.read_bytes().decode(errors="replace")
    return seen


def logged(seen: Seen) -> bytes:
    """What the learner logged. On a terminal: without the block, which is drawn again below each line of the log."""
    lines = re.sub(rb"\x1b\[[0-9;?]*[A-Za-z]|\r", b"", seen.said).splitlines()
    return seen.log.encode() + b"\n".join(line for line in lines if not BLOCK.match(line))


def names(seen: Seen) -> set[str]:
    """Names of the metrics, which are also TensorBoard's tags."""
    return {name for line in seen.texts["metrics.jsonl"].splitlines() for name in json.loads(line)}


def compare(tmp_path: Path, settings: Mapping[str, object], attack: Callable[[Hostile], None], live: bool) -> Seen:
    """Run with and without the hostile worker, side by side, and compare. The run with it."""
    with ThreadPoolExecutor() as threads:
        runs = [
            threads.submit(learn, tmp_path / "quiet", settings, None, live),
            threads.submit(learn, tmp_path / "loud", settings, attack, live),
        ]
        quiet, loud = (run.result() for run in runs)
    assert loud.hostile is not None
    figures = (
        f"said {loud.hostile.said} messages in {loud.hostile.sessions} sessions; memory {quiet.memory_mb:.0f} MB quiet, "
    )
    figures += f"{loud.memory_mb:.0f} MB loud; bytes logged {len(logged(quiet))} quiet, {len(logged(loud))} loud"
    sys.stdout.write(f"\n{figures}\n")
    assert loud.policy == quiet.policy, "the weights differ"
    assert loud.memory_mb - quiet.memory_mb < MEMORY_MB, figures
    assert len(logged(loud)) - len(logged(quiet)) < LOG_BYTES, figures
    assert MARK.encode() not in loud.said, "the hostile worker controls the terminal"
    assert "\x9b31m".encode() not in loud.said
    assert "led to an error in the learner" not in loud.said.decode(errors="replace") + loud.log
    for name, text in loud.texts.items():
        assert MARK not in text, name
        if "tfevents" not in name:
            assert not FORGED.search(text), name
    json.loads(loud.texts["json"])
    assert "<script>alert" not in loud.texts["report.html"]
    mine = {f"stage/worker_{stage}" for stage in get_args(WorkerStage)}
    assert names(loud) | mine == names(quiet) | mine
    return loud


def test_a_hostile_worker_changes_no_bit_of_the_weights(tmp_path: Path) -> None:
    """A twelfth of all that it can say, and a flood of each kind."""

    def attack(hostile: Hostile) -> None:
        hostile.says(itertools.islice(sayings(), 0, None, 12))
        for flood in FLOODS:
            hostile.floods(flood, 0.2, names=4)
        hostile.joins()  # on a busy machine the floods last longer than a silent worker stays, and the status is asked next

    loud = compare(tmp_path, {"steps": 5_000, "env-kwargs": "seconds 0.002"}, attack, live=True)
    assert NAME in loud.texts["status"], "it is named as it named itself"


@pytest.mark.soak
@pytest.mark.timeout(900)
@pytest.mark.parametrize("shown", ["terminal", "json"])
def test_a_hostile_worker_that_says_everything_changes_no_bit_of_the_weights(tmp_path: Path, shown: str) -> None:
    def attack(hostile: Hostile) -> None:
        hostile.says(sayings())
        for flood in FLOODS:
            hostile.floods(flood, 3.0, names=100)

    settings = {"steps": 40_000, "env-kwargs": "seconds 0.002"} | ({"log-json": ""} if shown == "json" else {})
    loud = compare(tmp_path, settings, attack, live=shown == "terminal")
    for line in loud.log.splitlines()[:-3]:  # the last three are the result, for people
        assert json.loads(line)["event"] in EVENTS, line[:200]
