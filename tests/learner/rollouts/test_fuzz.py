"""Hostile messages against the codec: one kind of error, and memory stays flat."""

from __future__ import annotations

from itertools import islice

import psutil
import pytest

from millrace.protocol.errors import BadMessage
from millrace.protocol.wire.codec import decode_to_learner
from tests.support.conversation.hostile_messages import Frames, hostile, real

ROOM = 100_000
GROWTH_MB = 20  # of 100,000 messages


def _refusal(frames: Frames) -> str | None:
    """What is said of these frames; None if they are a message. Whatever else is raised fails the test."""
    try:
        decode_to_learner(frames, ROOM)
    except BadMessage as error:
        return str(error)
    return None


@pytest.mark.parametrize("messages", [25_000, pytest.param(100_000, marks=pytest.mark.soak)])
def test_hostile_messages_raise_one_error_and_leave_no_memory_behind(messages: int) -> None:
    process = psutil.Process()
    refused = understood = 0
    before_mb = 0.0
    for number, frames in enumerate(islice(hostile(1, real(7)), messages)):
        if number == messages // 10:  # what is used once is there
            before_mb = process.memory_info().rss / 2**20
        says = _refusal(frames)
        assert says is None or ("\n" not in says and len(says) < 1_000)
        refused += says is not None
        understood += says is None
    assert refused > 0.6 * messages
    assert understood > 0.05 * messages  # those of other sessions: the coordinator's to judge
    assert process.memory_info().rss / 2**20 - before_mb < GROWTH_MB * messages / 100_000
