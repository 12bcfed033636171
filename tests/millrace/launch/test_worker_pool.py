"""How the workers of a run on this machine are started."""

from __future__ import annotations

import errno
import math
import os
import subprocess
from typing import Any

import pytest

import millrace
from millrace.flags.parse import parse_flags
from millrace.launch import vector
from millrace.launch.crew import Crew
from millrace.launch.worker_pool import open_worker_pool
from millrace.learner.config.rollout_config import RolloutConfig
from millrace.learner.members.who_may_connect import BindSettings
from millrace.learner.open_hub import lobby_settings
from millrace.protocol.wire.shared_memory import SUPPORTED, new_memory
from millrace.protocol.wire.wake_up import WakePipe
from millrace.workers import worker_thread
from millrace.workers.conversation.connection_rules import wait_limits_s
from millrace.workers.conversation.session import Session, WorkerIdentity
from millrace.workers.flags import WorkerFlags
from millrace.workers.supervise import worker_process

WITHIN_S = 60.0


def test_a_worker_process_waits_for_its_learner_as_long_as_that_does_not_listen(monkeypatch: pytest.MonkeyPatch) -> None:
    """The learner may be stopped (Ctrl-Z), or in a callback, before the worker has joined. It ends with the learner."""
    commands: list[list[str]] = []

    def popen(command: list[str], **how: Any) -> subprocess.Popen[bytes]:
        commands.append(command)
        return subprocess.Popen(["sh", "-c", "exit 0"], **how)

    monkeypatch.setattr(worker_process, "popen", popen)
    with open_worker_pool(BindSettings(), "ipc") as pool, pool.start(Crew(2, evaluating=1), lobby_settings(RolloutConfig())):
        pass
    for command, evaluates in zip(commands, (False, True), strict=True):
        flags = parse_flags(WorkerFlags, command[command.index("millrace.workers") + 1 :], "worker")
        assert wait_limits_s(flags.join_timeout_s, stay=flags.stay) == (math.inf, math.inf)
        assert flags.evaluate == evaluates


def test_a_worker_thread_waits_for_its_learner_as_long_as_that_does_not_listen(monkeypatch: pytest.MonkeyPatch) -> None:
    limits: list[tuple[float, float]] = []

    def session(who: WorkerIdentity, now: float, *, join_timeout_s: float, rejoin_timeout_s: float) -> Session:
        limits.append((join_timeout_s, rejoin_timeout_s))
        return Session(who, now, join_timeout_s=join_timeout_s, rejoin_timeout_s=rejoin_timeout_s)

    monkeypatch.setattr(worker_thread, "Session", session)
    with open_worker_pool(BindSettings(), "inproc") as pool, pool.start(Crew(1), lobby_settings(RolloutConfig())):
        pool.stop(WITHIN_S)
        pool.processes.ended()
        assert not pool.processes.left(collecting=False)
    assert limits == [(math.inf, math.inf)]


@pytest.mark.skipif(not SUPPORTED, reason="needs Linux")
@pytest.mark.parametrize("most", range(4))
def test_a_vector_environment_that_may_not_open_enough_files_closes_those_it_has_opened(
    monkeypatch: pytest.MonkeyPatch, most: int
) -> None:
    """It opens a memory, and pipes for two workers and the learner: four things, of which it gets `most`."""
    opened: list[int] = []
    limit = iter(range(most))

    def count() -> None:
        if next(limit, None) is None:
            raise OSError(errno.EMFILE, "Too many open files")

    def memory() -> int:
        count()
        opened.append(new_memory())
        return opened[-1]

    def pipe() -> WakePipe:
        count()
        made = WakePipe()
        opened.extend((made.read_fd, made.write_fd))
        return made

    monkeypatch.setattr(vector, "new_memory", memory)
    monkeypatch.setattr(vector, "WakePipe", pipe)
    with pytest.raises(millrace.UsageError, match="files open here, which is too few"):
        millrace.make_vec("CartPole-v1", 2, workers=2)
    assert len(opened) == (2 * most - 1 if most else 0)
    assert [fd for fd in opened if os.path.exists(f"/proc/self/fd/{fd}")] == []
