"""What is freed stays: a buffer that is needed again costs no page faults."""

from __future__ import annotations

import resource

import numpy as np
import pytest

from millrace.protocol.policy.malloc import keep_freed_memory
from millrace.protocol.policy.networks import ActorCriticNetwork
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec


def faults(megabytes: int, rounds: int) -> int:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(rounds):
        buffers = [np.empty(megabytes << 20, np.uint8) for _ in range(3)]
        for buffer in buffers:
            buffer.fill(1)
        del buffer, buffers
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def test_freed_memory_is_used_again() -> None:
    if not keep_freed_memory():
        pytest.skip("the C library is not glibc")
    faults(8, 3)
    pages_a_round = 3 * 8 * 256
    assert faults(8, 20) < pages_a_round


def test_networks_that_look_at_images_keep_it_and_others_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    kept: list[bool] = []
    monkeypatch.setattr("millrace.protocol.policy.networks.keep_freed_memory", lambda: kept.append(True))
    action = ActionSpec("discrete", (), "int64", (4,), (0,))
    ActorCriticNetwork(PolicySpec((Leaf("", "box", (4,), "float32"),), action))
    assert kept == []
    ActorCriticNetwork(PolicySpec((Leaf("", "box", (36, 36, 1), "uint8", divisor=255),), action))
    assert kept == [True]
