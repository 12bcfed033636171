"""The learner processes of a run, connected by torch.distributed: gloo between CPUs, NCCL between GPUs. A thin shell.

Rules: rank 0's messages determine the number of collective operations, and each of these transfers one tensor of a fixed
size. If a process is gone, or takes longer than the timeout, all processes end with `LearnerLost`, so that the program that
started them can restart them. torch.distributed authenticates nobody, so it listens on loopback unless the settings say
otherwise.
"""

from __future__ import annotations

import logging
import math
import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, distributed
from torch.distributed import (  # type: ignore[attr-defined]
    DistNetworkError,
    DistStoreError,
    PrefixStore,
    Store,
    TCPStore,
)

from millrace.learner.shards.division import Division
from millrace.learner.shards.messages import HEAD, End, FromRankZero, StillThere, encode
from millrace.learner.shards.place import Place
from millrace.learner.shards.reports import Report
from millrace.protocol.arrays import Array
from millrace.protocol.errors import LearnerLost, UsageError, first_line
from millrace.protocol.logs.notices import log_notice

log = logging.getLogger("millrace.learner")

POLL_S = 0.1
TELL_EVERY_S = 30.0
TELL_BEFORE = 0.1  # a sign of life is sent after this fraction of the time that the others wait for a message
PATIENCE_S = 3.0  # timeout of one attempt to connect
JOINED = "millrace/rank/"


class Timeouts(NamedTuple):
    """How many seconds a process waits for the other processes."""

    join_s: float
    """until all processes have connected"""
    reply_s: float
    """in a collective operation, or for the next message from rank 0"""


class Learners:
    """The learner processes of a run, as one of them sees them. A single process needs no process group."""

    def __init__(self, division: Division, *, reply_s: float = math.inf) -> None:
        """`reply_s` is the number of seconds for which the others wait for a message."""
        self.division = division
        self.others_wait = True
        """Whether the others wait for a message. False during an update or a send, and after either was interrupted."""
        self._tell_every_s = reply_s * TELL_BEFORE
        self._told_s = time.monotonic()

    @property
    def leads(self) -> bool:
        """Whether this process is rank 0, which has the workers and the run folder."""
        return self.division.rank == 0

    @property
    def others(self) -> range:
        """The ranks that follow rank 0."""
        return range(1, self.division.processes)

    def gather(self, own: Tensor) -> Tensor:
        """Gather the tensors [own shards, ...] of all processes into one tensor [S, ...] of all shards.

        Every process must call this, with the same shape. Different shapes would end processes with SIGABRT, because gloo
        checks sizes in a thread of its own.
        """
        if self.division.processes == 1:
            return own
        every = own.new_empty(self.division.processes, *own.shape)
        with _lost():
            distributed.all_gather([*every], own)
        return every.flatten(0, 1)

    def agree(self, error: str = "") -> None:
        """Raise `UsageError` in all processes if one of them has an error. Every process must call this."""
        reports = [Report.of(each) for each in self.gather(Report(0, error=error).encoded()[None])]
        if errors := [report.error for report in reports if report.error]:
            raise UsageError(errors[0])

    def still_waits(self) -> None:
        """Tell the others, if it is time to, that rank 0 is alive and waits for rollouts. You may call this at any time."""
        if self.others_wait and time.monotonic() - self._told_s > self._tell_every_s:
            self.tell_all(StillThere())

    def end(self, reason: str, *, failed: bool = False) -> None:
        """Tell the others that the run has ended. If they expect no message, they find out when the connection is lost."""
        if self.leads and self.others_wait:
            self.tell_all(End(reason, failed))
            self.others_wait = False

    def tell_all(self, message: FromRankZero) -> None:
        """Send a message to all other processes. After a failure, no further message can be sent."""
        self.others_wait = False
        for rank in self.others:
            self.tell(rank, message)
        self.others_wait = True

    def tell(self, rank: int, message: FromRankZero) -> None:
        """Send a message to another process."""
        self._told_s = time.monotonic()
        head, arrays = encode(message)
        with _lost():
            distributed.send(torch.tensor([len(head)]), rank)
            for array in (np.frombuffer(bytearray(head), np.uint8), *arrays):
                if array.size:
                    distributed.send(_bytes_of(array), rank)

    def hear(self) -> FromRankZero:
        """Wait for the next message from rank 0."""
        with _lost():
            size = torch.zeros(1, dtype=torch.int64)
            distributed.recv(size, 0)
            head = np.empty(int(size), np.uint8)
            distributed.recv(_bytes_of(head), 0)
            message: FromRankZero = HEAD.decode(head.data)
            for array in encode(message)[1]:  # in the order in which they are sent
                if array.size:
                    distributed.recv(_bytes_of(array), 0)
        return message


@contextmanager
def connected(place: Place, shards: int, device: str, timeouts: Timeouts, poll: Callable[[], None]) -> Iterator[Learners]:
    """Connect the processes of a run, and disconnect them at the end.

    `poll` is called now and then while this process waits for others; the log names the processes that are missing. Raises
    `UsageError` if `shards` can't be divided among them, and `LearnerLost` if not all of them connect in time.
    """
    division = place.division(shards)
    if place.processes == 1:
        yield Learners(division)
        return
    if distributed.is_initialized():  # by the program that started this process, such as Ray Train
        with _told_of_the_end(Learners(division, reply_s=timeouts.reply_s)) as learners:
            yield learners
        return
    store = _store(place, timeouts, poll)

    def missing() -> list[int]:
        with _lost():
            return [rank for rank in range(place.processes) if not store.check([f"{JOINED}{rank}"])]

    with _lost():
        store.set(f"{JOINED}{place.rank}", socket.gethostname())
    # Every process waits for all others here, because nothing can interrupt the wait in `init_process_group`.
    _wait(missing, place, timeouts.join_s, poll)
    if device == "cuda":
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", 0)))
    with _lost():
        distributed.init_process_group(
            "cpu:gloo,cuda:nccl" if device == "cuda" else "gloo",
            store=store,
            rank=place.rank,
            world_size=place.processes,
            timeout=timedelta(seconds=timeouts.reply_s),
        )
    try:
        with _told_of_the_end(Learners(division, reply_s=timeouts.reply_s)) as learners:
            yield learners
    finally:
        distributed.destroy_process_group()


@contextmanager
def _told_of_the_end(learners: Learners) -> Iterator[Learners]:
    """At the end of the context, rank 0 tells the others that the run has ended, and why."""
    try:
        yield learners
        learners.end("the run has ended")
    except LearnerLost:
        raise
    except BaseException as error:
        with suppress(LearnerLost):
            why = first_line(error, type(error).__name__)
            learners.end(f"rank 0 has ended: {why}", failed=not isinstance(error, KeyboardInterrupt))
        raise


def _store(place: Place, timeouts: Timeouts, poll: Callable[[], None]) -> Store:
    """The key-value store through which the processes find each other. Rank 0 opens it, unless torchrun already has."""
    patience = timedelta(seconds=PATIENCE_S)
    found: list[Store] = []

    def missing() -> list[int]:
        # PyTorch prints a stack trace for each failed attempt to connect, so first check that somebody listens there.
        with suppress(OSError, DistNetworkError, DistStoreError):
            socket.create_connection((place.host, place.port), PATIENCE_S).close()
            found.append(TCPStore(place.host, place.port, is_master=False, wait_for_workers=False, timeout=patience))
        return [] if found else [0]

    if place.rank == 0 and os.environ.get("TORCHELASTIC_USE_AGENT_STORE") != "True":
        listens = listening(place).detach()
        with _lost():
            store = TCPStore(
                place.host, place.port, is_master=True, wait_for_workers=False, timeout=patience, master_listen_fd=listens
            )
        found.append(store)
    else:
        _wait(missing, place, timeouts.join_s, poll)
    # After a restart, torchrun's store still holds the keys of the earlier processes, so each restart gets its own prefix.
    return PrefixStore(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"), found[0])


def listening(place: Place) -> socket.socket:
    """A listening socket for the store. PyTorch's own socket would listen at all addresses, even for localhost."""
    try:
        if place.is_local:
            family = socket.getaddrinfo(place.host, place.port, type=socket.SOCK_STREAM)[0][0]
            return socket.create_server((place.host, place.port), family=family)
        if socket.has_dualstack_ipv6():
            return socket.create_server(("", place.port), family=socket.AF_INET6, dualstack_ipv6=True)
        return socket.create_server(("", place.port))
    except OSError as error:
        raise UsageError(
            f"MASTER_PORT {place.port}: expected a free port of this machine, to listen at {place.host}, got: "
            f"{first_line(error)}; set another one for all ranks"
        ) from None


def _wait(missing: Callable[[], list[int]], place: Place, seconds: float, poll: Callable[[], None]) -> None:
    """Wait until no rank is missing. Raises `LearnerLost` after this many seconds."""
    end_s = time.monotonic() + seconds
    tell_s = time.monotonic() + POLL_S * 10
    while ranks := missing():
        who = f"rank {', '.join(map(str, ranks))} of {place.processes}"
        now_s = time.monotonic()
        if now_s > end_s:
            raise LearnerLost(
                f"learner: rank {place.rank}: expected {who} at {place.host}:{place.port} within {seconds:.0f} s, got none; "
                "start all of them"
            )
        if now_s > tell_s:
            tell_s = now_s + TELL_EVERY_S
            log_notice(log, f"rank {place.rank} waits for {who}, which must come to {place.host}:{place.port}")
        poll()
        time.sleep(POLL_S)


def _bytes_of(array: Array) -> Tensor:
    """The memory of an array, or of a contiguous copy if it is not contiguous, as a tensor of bytes."""
    return torch.from_numpy(np.ascontiguousarray(array).reshape(-1).view(np.uint8))


@contextmanager
def _lost() -> Iterator[None]:
    """Turn errors of torch.distributed into `LearnerLost`, with a one-line message."""
    try:
        yield
    except (RuntimeError, ValueError) as error:  # distributed.DistError is a RuntimeError
        raise LearnerLost(
            f"learner: another learner process is lost, or too slow ({_cause(error)}); start all of them again, with "
            "--resume auto"
        ) from error


def _cause(error: Exception) -> str:
    """The message of gloo, without the source location before it and the general advice after it."""
    return first_line(error).partition(". This is")[0].rpartition(".cc:")[2].partition("] ")[2] or first_line(error)
