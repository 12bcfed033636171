"""Weights in a file that a supervisor writes and its workers read."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator

import pytest

from millrace.protocol.alive import SHARED_VERSIONS
from millrace.workers.shared_weights import SESSIONS, SharedWeights, SharedWeightsReader

FIRST = 5_000  # session of the learner


@pytest.fixture
def shared() -> Iterator[SharedWeights]:
    made = SharedWeights()
    yield made
    made.close()


def reader(shared: SharedWeights, worker: str = "w0") -> SharedWeightsReader:
    return SharedWeightsReader(*shared.descriptors(worker))


def message(version: int) -> list[bytes]:
    """Four frames, one of them empty."""
    return [b"head", bytes([version]) * 10_000, b"", b"attributes"]


def test_a_worker_finds_the_versions_that_it_asks_for(shared: SharedWeights) -> None:
    worker = reader(shared)
    assert list(worker.find(FIRST, {0, 1})) == []
    for version in range(SHARED_VERSIONS):
        shared.write(FIRST, version, message(version))
    assert list(worker.find(FIRST + 7, {0, 2, 9})) == [message(0), message(2)]
    assert list(worker.find(FIRST, ())) == []


def test_a_worker_takes_no_weights_of_another_learner(shared: SharedWeights) -> None:
    """Whether it was there before or came after: versions begin at 0 in each run."""
    worker = reader(shared)
    shared.write(FIRST, 0, message(0))
    for session in (FIRST - 1, FIRST + SESSIONS, 0, 2**48):
        assert list(worker.find(session, {0})) == []
    shared.write(2**40, 0, message(1))
    assert list(worker.find(FIRST, {0})) == [message(0)]
    assert list(worker.find(2**40, {0})) == [message(1)]


def test_an_empty_place_holds_no_weights(shared: SharedWeights) -> None:
    """It is all zeros: so are the first version, and the first session of one learner among many."""
    assert list(reader(shared).find(0, {0})) == []


def test_only_the_newest_are_kept_whatever_their_lengths(shared: SharedWeights) -> None:
    worker = reader(shared)
    for version in range(2 * SHARED_VERSIONS + 1):
        shared.write(FIRST, version, [b"x" * (1_000 * version)])
    found = [len(frames[0]) for frames in worker.find(FIRST, range(100))]
    assert sorted(found) == [1_000 * version for version in range(SHARED_VERSIONS + 1, 2 * SHARED_VERSIONS + 1)]


@pytest.mark.parametrize("when", ["while the table is read", "while a frame is read"])
def test_what_is_overwritten_while_it_is_read_is_not_found(
    shared: SharedWeights, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    worker, reads, read = reader(shared), 0, os.pread
    shared.write(FIRST, 0, message(0))

    def pread(fd: int, length: int, at: int) -> bytes:
        nonlocal reads
        reads += 1
        found = read(fd, length, at)
        if reads == (1 if when == "while the table is read" else 3):
            for version in range(SHARED_VERSIONS):
                shared.write(FIRST, 10 + version, message(10 + version))
        return found

    monkeypatch.setattr("os.pread", pread)
    assert list(worker.find(FIRST, {0})) == []


def test_what_is_half_written_is_not_found(shared: SharedWeights, monkeypatch: pytest.MonkeyPatch) -> None:
    """The old entry of the place is cleared before the first frame is written."""
    worker = reader(shared)
    for version in range(SHARED_VERSIONS):
        shared.write(FIRST, version, message(version))
    write = os.pwrite
    with pytest.raises(OSError, match="no memory"), monkeypatch.context() as patch:
        patch.setattr("os.pwrite", lambda fd, data, at: write(fd, data, at) if len(data) < 100 else 7)
        shared.write(FIRST, SHARED_VERSIONS, message(SHARED_VERSIONS))
    assert [frames[1][0] for frames in worker.find(FIRST, range(100))] == [1, 2, 3]


def test_every_worker_is_woken_once_and_a_new_process_of_a_name_has_the_same_pipe(shared: SharedWeights) -> None:
    workers = [reader(shared, name) for name in ("w0", "w1", "w0")]
    assert workers[0].wake_fd == workers[2].wake_fd != workers[1].wake_fd
    shared.write(FIRST, 0, message(0))
    for worker in workers[:2]:
        assert os.read(worker.wake_fd, 100)
        with pytest.raises(BlockingIOError):
            os.read(worker.wake_fd, 100)
    shared.write(FIRST, 1, message(1))
    list(workers[1].find(FIRST, ()))
    with pytest.raises(BlockingIOError):
        os.read(workers[1].wake_fd, 100)


@pytest.mark.parametrize("said", [(-1, 0, [b""]), (0, -1, [b""]), (0, 2**64, [b""]), (0, 0, [b""] * 5)])
def test_what_is_no_message_of_weights_is_refused(shared: SharedWeights, said: tuple[int, int, list[bytes]]) -> None:
    with pytest.raises(struct.error):
        shared.write(*said)
    assert list(reader(shared).find(0, {0})) == []
