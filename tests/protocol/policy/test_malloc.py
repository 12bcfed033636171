"""What is freed stays: a buffer that is needed again costs no page faults."""

from __future__ import annotations

import resource
from typing import Any

import numpy as np
import pytest

from millrace.learner.algorithms.bodies.networks import ActorCriticNetwork
from millrace.protocol.policy.acting_network import ActingNetwork
from millrace.protocol.policy.malloc import keep_freed_memory
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


@pytest.mark.parametrize("network", [ActingNetwork, ActorCriticNetwork])
def test_networks_that_look_at_images_keep_it_and_others_do_not(network: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    kept: list[bool] = []
    monkeypatch.setattr(f"{network.__module__}.keep_freed_memory", lambda: kept.append(True))
    action = ActionSpec("discrete", (), "int64", (4,), (0,))
    network(PolicySpec((Leaf("", "box", (4,), "float32"),), action))
    assert kept == []
    network(PolicySpec((Leaf("", "box", (36, 36, 1), "uint8", divisor=255),), action))
    assert kept == [True]
