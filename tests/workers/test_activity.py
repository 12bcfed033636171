"""The page that a worker shares with its supervisor."""

from __future__ import annotations

import math
from time import perf_counter
from typing import Any

import gymnasium
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from millrace.extras.envs.vector_copies import VectorCopies
from millrace.protocol.call_timeouts import CallTimeouts
from millrace.protocol.wire.plain_values import pack
from millrace.workers.activity import (
    DOING,
    ENV_CALLS,
    SINCE_S,
    START_TIMEOUT_S,
    STEP_TIMEOUT_S,
    Activity,
    ActivityReader,
    activity,
    share_activity,
)
from millrace.workers.copies.env_copies import LoopedCopies
from millrace.workers.copies.env_errors import CopyFailed
from millrace.workers.copies.env_loop import EnvLoop
from tests.support.envs.toy import Countdown


class Watched(Countdown):
    """Notes what the page says while each of its methods runs."""

    seen: list[str]

    def _note(self) -> None:
        Watched.seen.append(ActivityReader(activity()).read(perf_counter()).doing)

    def __init__(self) -> None:
        self._note()
        super().__init__(k=2)

    def reset(self, **keywords: object) -> tuple[object, dict[str, object]]:  # type: ignore[override]
        self._note()
        return super().reset()

    def step(self, action: object) -> tuple[object, float, bool, bool, dict[str, object]]:  # type: ignore[override]
        self._note()
        return super().step(action)

    def close(self) -> None:
        self._note()


def test_the_page_says_what_a_loop_does_at_each_moment() -> None:
    Watched.seen = []
    page = Activity()
    share_activity(page)
    reader = ActivityReader(page)
    loop = EnvLoop([Watched] * 2, lambda: Watched.seen.append(reader.read(perf_counter()).doing))
    assert Watched.seen == ["starting", "making", "waiting", "making"]
    Watched.seen = []
    loop.reset(range(2), [1, 2], [None, None], lambda: None)
    for _ in range(3):  # the third resets
        loop.step([0, 0], [None, None], lambda: None)
    assert Watched.seen == ["resetting"] * 2 + ["stepping"] * 4 + ["resetting"] * 2
    assert reader.read(perf_counter()).doing == "waiting"
    assert reader.read(perf_counter()).env_calls >= 2 + 2 + 6
    Watched.seen = []
    loop.close()
    assert Watched.seen == ["closing"] * 2


class Attributes(Countdown):
    """Its attributes are properties, as those of an environment on another machine may be."""

    @property
    def observation_space(self) -> gymnasium.Space[Any]:
        Watched.seen.append(ActivityReader(activity()).read(perf_counter()).doing)
        return self._space

    @observation_space.setter
    def observation_space(self, space: gymnasium.Space[Any]) -> None:
        self._space = space

    @property
    def wind(self) -> float:
        return 0.0

    @wind.setter
    def wind(self, value: float) -> None:
        Watched.seen.append(ActivityReader(activity()).read(perf_counter()).doing)


def test_the_page_names_what_the_environment_does_when_its_attributes_are_read_or_set() -> None:
    Watched.seen = []
    share_activity(page := Activity())
    loop = LoopedCopies([Attributes], lambda: None)
    loop.assign("wind", pack(2.0), lambda: None)
    lane = VectorCopies(SyncVectorEnv([Attributes], autoreset_mode=AutoresetMode.NEXT_STEP))
    made = len(Watched.seen)  # gymnasium's class reads them, too
    lane.assign("wind", pack(2.0), lambda: None)
    assert Watched.seen[:2] == ["making", "stepping"]
    assert Watched.seen[made:] == ["stepping"]
    assert ActivityReader(page).read(perf_counter()).doing == "waiting"


class Exits(Countdown):
    """Calls `sys.exit` in `step`."""

    def step(self, action: object) -> tuple[object, float, bool, bool, dict[str, object]]:  # type: ignore[override]
        raise SystemExit(0)


@pytest.mark.parametrize("kind", [SystemExit, KeyboardInterrupt])
def test_an_exit_in_environment_code_is_caught(kind: type[BaseException]) -> None:
    def make() -> gymnasium.Env[object, object]:
        raise kind(0)

    with pytest.raises(CopyFailed):
        EnvLoop([make], lambda: None)
    loop = EnvLoop([Exits], lambda: None)
    loop.reset([0], [1], [None], lambda: None)
    with pytest.raises(CopyFailed):
        loop.step([0], [None], lambda: None)


def test_whatever_environment_code_writes_to_the_page_fits_the_message() -> None:
    page = Activity()
    reader = ActivityReader(page)
    for code in (-1, 99, -(2**63)):
        page.numbers[DOING] = page.numbers[ENV_CALLS] = code
        page.seconds[SINCE_S] = math.nan
        read = reader.read(1.0)
        assert (read.doing, read.for_s) == ("waiting", 0.0)
        assert 0 <= read.env_calls <= 2**53
    for limit_s in (-1.0, math.nan, math.inf, -math.inf):
        page.seconds[START_TIMEOUT_S] = page.seconds[STEP_TIMEOUT_S] = limit_s
        assert reader.read(1.0).timeouts == CallTimeouts(0.0, 0.0)


def test_calls_have_no_limit_until_a_run_says_one_and_then_that_of_the_last_run() -> None:
    page = Activity()
    reader = ActivityReader(page)
    assert reader.read(1.0).timeouts == CallTimeouts(0.0, 0.0)
    for timeouts in (CallTimeouts(2.0, 3.0), CallTimeouts(0.0, 0.5)):
        page.limit(timeouts)
        assert reader.read(1.0).timeouts == timeouts


def test_only_a_worker_that_says_so_leaves_on_purpose() -> None:
    page = Activity()
    reader = ActivityReader(page)
    assert reader.read(1.0).exit_code is None
    page.leave(0)
    assert reader.read(1.0).exit_code == 0


def test_each_call_has_its_own_timeout_and_zero_is_never() -> None:
    timeouts = CallTimeouts(start_s=2.0, step_s=0.0)
    limits = [timeouts.limit_s(doing) for doing in ("making", "resetting", "stepping", "waiting")]
    assert limits == [2, 2, math.inf, math.inf]
    assert CallTimeouts(start_s=2.0, step_s=1.0).limit_s("preparing") == 2
    assert CallTimeouts(start_s=2.0, step_s=1.0).limit_s("acting") == 1
    assert CallTimeouts(2.0, 1.0).reason("acting").endswith("a call of the policy took longer than 1 s (--step-timeout-s)")
    assert "a reset of its environment took longer than 2 s (--start-timeout-s)" in timeouts.reason("resetting")
    assert CallTimeouts(start_s=2.0, step_s=1.0).longest_s() == 2
    assert timeouts.longest_s() == math.inf
