"""What the disk of a run refuses: warnings while it trains, and more tries at its end."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from millrace.learner.run_folder.atomic_write import SAY_AGAIN_S, TRY_FOR_S, Writes
from millrace.protocol.errors import RunError


class Disk:
    """A disk that is full until a time, by its own clock, and notes what is written to it."""

    def __init__(self, full_until_s: float) -> None:
        self.now, self.full_until_s = 0.0, full_until_s
        self.written: list[str] = []
        self.writes = Writes(lambda: self.now, self.sleep)

    def sleep(self, seconds: float) -> None:
        self.now += seconds

    def write(self, name: str, reason: str = "No space left on device") -> Callable[[], None]:
        def write() -> None:
            if self.now < self.full_until_s:
                raise RunError(f"{name} not written: {reason}")
            self.written.append(name)

        return write


def test_what_is_written_needs_no_second_try(caplog: pytest.LogCaptureFixture) -> None:
    disk = Disk(0.0)
    disk.writes.write("state", disk.write("state"))
    disk.writes.confirm()
    assert (disk.written, disk.now, caplog.messages) == (["state"], 0.0, [])


def test_a_refusal_is_said_again_after_a_while_or_for_another_reason(caplog: pytest.LogCaptureFixture) -> None:
    disk = Disk(1e9)
    for reason in ("No space left on device", "Input/output error"):
        for _ in range(3):
            disk.writes.write("metrics", disk.write("metrics.jsonl", reason))
    assert caplog.messages == [
        f"metrics.jsonl not written: {why}" for why in ("No space left on device", "Input/output error")
    ]
    disk.now += SAY_AGAIN_S
    disk.writes.write("metrics", disk.write("metrics.jsonl", reason))
    assert len(caplog.messages) == 3


def test_the_last_save_waits_for_space_and_writes_all_that_is_missing() -> None:
    disk = Disk(TRY_FOR_S - 1)
    disk.writes.write("state", disk.write("a checkpoint of then"))
    disk.writes.write("best", disk.write("best"))
    disk.writes.write("state", disk.write("checkpoint"))
    disk.writes.confirm()
    assert disk.written == ["checkpoint", "best"]
    assert TRY_FOR_S - 1 <= disk.now < TRY_FOR_S


@pytest.mark.parametrize("left_s", [100.0, 3.0])
def test_the_last_save_gives_up_with_all_reasons(left_s: float) -> None:
    disk = Disk(1e9)
    disk.writes.at_most = lambda seconds: min(seconds, left_s)
    for name in ("metrics", "checkpoint"):
        disk.writes.write(name, disk.write(name))
    reason = "No space left on device"
    with pytest.raises(RunError, match=f"^metrics not written: {reason}; checkpoint not written: {reason}$"):
        disk.writes.confirm()
    assert disk.now == min(TRY_FOR_S, left_s)


def test_ctrl_c_ends_the_tries_of_the_last_save() -> None:
    disk = Disk(1e9)

    def interrupted(seconds: float) -> None:
        raise KeyboardInterrupt

    writes = Writes(lambda: disk.now, interrupted)
    writes.write("checkpoint", disk.write("checkpoint"))
    with pytest.raises(RunError, match="checkpoint not written"):
        writes.confirm()
