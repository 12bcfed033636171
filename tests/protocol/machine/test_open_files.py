"""A learner that listens for workers of other machines may open as many files as the system allows."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from millrace.learner.members.bound import listen
from millrace.learner.members.who_may_connect import BindSettings
from millrace.protocol.machine.open_files import MOST


@pytest.fixture
def limits() -> Iterator[tuple[int, int]]:
    """The limits of this process, which are restored at the end."""
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    yield before
    resource.setrlimit(resource.RLIMIT_NOFILE, before)


@pytest.mark.parametrize("below", [True, False])
def test_a_learner_raises_its_limit_and_never_lowers_it(limits: tuple[int, int], below: bool) -> None:
    hard = limits[1]
    highest = MOST if hard == resource.RLIM_INFINITY else min(hard, MOST)
    before = 512 if below else limits[0]
    resource.setrlimit(resource.RLIMIT_NOFILE, (before, hard))
    with ExitStack() as resources:
        listen(BindSettings(bind="tcp://127.0.0.1:*"), resources)
    after = resource.getrlimit(resource.RLIMIT_NOFILE)
    assert after == (max(before, highest), hard)
