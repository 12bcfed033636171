"""The shell round a session, over a link that is not real: which runs it takes part in, and how it packs what it sends."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from typing import cast

import msgspec
import numpy as np
import pytest

from protocol.codec import Buffer, decode_to_learner, encode
from protocol.link import WorkerLink
from protocol.messages import (
    Collect,
    Drain,
    Goodbye,
    Inquire,
    Permit,
    Received,
    Rollout,
    ToLearner,
    ToWorker,
    Weights,
    Welcome,
)
from protocol.packing import Packing
from protocol.policy import buffer_size, layout, size
from protocol.rollout import rollout_bytes
from protocol.specs import RunSpec
from tests.collecting import run_of
from workers.session import Leave, Session
from workers.worker import Worker, identity

RUN = msgspec.structs.replace(run_of("CartPole-v1", T=40, N=8), learner_timeout_s=1e9)


class FakeLink:
    """Says one message each time it is asked, and keeps what is answered."""

    address, trouble = "fake", None

    def __init__(self, messages: Sequence[ToWorker], stack: bool = False) -> None:
        self.packing = Packing(stack=stack)
        self.messages = list(messages)
        self.sent: list[list[Buffer]] = []

    def poll(self, timeout_s: float) -> bool:
        return bool(self.messages)

    def receive(self) -> Iterator[ToWorker]:
        yield self.messages.pop(0)

    def send(self, frames: list[Buffer]) -> None:
        self.sent.append(frames)

    def close(self) -> None:
        pass

    def heard(self, room: int = 0) -> list[ToLearner | Inquire]:
        return [decode_to_learner(frames, room) for frames in self.sent]


def work(link: FakeLink) -> Leave:
    return Worker(cast(WorkerLink, link), Session(identity("w0"), 0.0), clock=lambda: 0.0).run()


def said_to_a_worker(run: RunSpec) -> list[ToWorker]:
    """To join, collect one rollout and leave."""
    parameters = np.random.default_rng(0).normal(0, 0.1, size(layout(run.policy)[0])).astype(np.float32)
    weights = Weights(0, parameters, np.ones(buffer_size(run.policy), np.float32))
    return [Welcome(1, 1, run), weights, Collect(1, 0, (Permit(0, 0, 0),), (Received(0, 0, 0),)), Drain("done")]


def test_a_worker_compresses_when_the_run_says_so() -> None:
    rollouts, bytes_sent = [], []
    for compress in ("none", "zstd"):
        link = FakeLink(said_to_a_worker(msgspec.structs.replace(RUN, compress=compress)))
        assert work(link).exit_code == 0
        (rollout,) = (message for message in link.heard(rollout_bytes(RUN)) if isinstance(message, Rollout))
        rollouts.append([bytes(frame) for frame in encode(rollout)[1:]])
        bytes_sent += [sum(map(len, frames)) for frames in link.sent if len(frames) > 1]
    assert rollouts[0] == rollouts[1]
    assert bytes_sent[1] < 0.75 * bytes_sent[0]


def test_a_worker_that_cannot_compress_leaves_at_once_and_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zstandard", None)
    link = FakeLink(said_to_a_worker(msgspec.structs.replace(RUN, compress="zstd")))
    why = "compress zstd needs the package zstandard, which is an extra; pip install 'millrace[compress]'"
    assert work(link) == Leave(2, why)
    assert link.heard()[-1] == Goodbye(1, why, ())
