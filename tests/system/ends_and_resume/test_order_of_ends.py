"""No worker outlives the folder that it writes to, or the lock of its run, however a start or a run ends."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, Literal

import psutil
import pytest

import millrace
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.learner.run_folder.run_lock import RunLock
from millrace.protocol.errors import MillraceError
from tests.system.stage.preloaded import command_line

SMALL: dict[str, Any] = {"steps": 64, "envs": 2, "lanes": 2, "rollout_steps": 16, "workers": 2, "eval_episodes": 1}


@pytest.fixture
def alive(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many worker processes were alive when a lock was released, or a folder removed."""
    found: list[int] = []

    def note_before(kind: type, name: str) -> None:
        ends = getattr(kind, name)

        def noted(*arguments: Any) -> Any:
            running = [child for child in psutil.Process().children() if child.status() != psutil.STATUS_ZOMBIE]
            found.append(sum("--parent" in command_line(child) for child in running))
            return ends(*arguments)

        monkeypatch.setattr(kind, name, noted)

    note_before(RunFolder, "remove")
    note_before(RunLock, "__exit__")
    note_before(tempfile.TemporaryDirectory, "cleanup")
    return found


@pytest.mark.parametrize("inference", ["workers", "learner"])
def test_workers_end_before_what_they_write_to(
    tmp_path: Path, alive: list[int], inference: Literal["workers", "learner"]
) -> None:
    def train(env: str, **settings: Any) -> millrace.Run:
        folder = str(tmp_path)
        return millrace.train(env, run_dir=folder, inference=inference, progress=False, **{**SMALL, **settings})

    with pytest.raises(MillraceError):
        train("Nope-v0")
    with pytest.raises(MillraceError):
        train("CartPole-v1", algo="sac")  # which is known once PyTorch is imported
    run = train("CartPole-v1")
    run.evaluate(episodes=2, inference=inference)
    assert len(alive) >= 6
    assert set(alive) == {0}
