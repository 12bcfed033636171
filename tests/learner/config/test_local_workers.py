"""How many workers a run starts, and what it says of lanes that don't keep them busy."""

from __future__ import annotations

import math
import re
from typing import Any

import pytest

from millrace.learner.config.layers import resolve
from millrace.learner.config.local_workers import chosen_workers, local_workers, uneven_lanes


@pytest.mark.parametrize("lanes", range(1, 13))
@pytest.mark.parametrize("cores", range(1, 13))
def test_no_fewer_workers_would_do_and_no_more_would_help(lanes: int, cores: int) -> None:
    config = resolve("CartPole-v1", lanes=lanes, envs=lanes)
    chosen = local_workers(config, cores)
    assert chosen <= cores
    largest_share = math.ceil(lanes / min(lanes, cores))
    assert math.ceil(lanes / chosen) == largest_share
    assert chosen == 1 or math.ceil(lanes / (chosen - 1)) > largest_share


def test_a_given_number_of_workers_is_kept() -> None:
    config = resolve("CartPole-v1", workers=7, lanes=4, envs=8)
    assert local_workers(config, 2) == 7
    assert not chosen_workers(config, 2)


@pytest.mark.parametrize(
    ("cores", "says"),
    [
        (1, "1 worker, one for each core"),
        (2, "2 workers, one for each core"),
        (3, "2 workers, because 3 would be no faster with 4 lanes"),
        (4, "4 workers, one for each lane"),
        (7, "4 workers, one for each lane"),
        (16, "4 workers, one for each lane; 16 cores could step --lanes 16 --envs 16 --rollout-steps 64"),
        (
            64,
            "4 workers, one for each lane; 64 cores could step --lanes 64 --envs 64 --rollout-steps 32 (updates of 2,048 "
            "env steps instead of 1,024)",
        ),
    ],
)
def test_what_was_chosen_is_said(cores: int, says: str) -> None:
    assert chosen_workers(resolve("Taxi-v3", envs=8, lanes=4), cores) == says


@pytest.mark.parametrize(
    ("algo", "settings", "flags"),
    [
        ("ppo", {"rollout_steps": 512}, " --rollout-steps 64"),
        ("ppo", {"rollout_steps": 16}, " (updates of 1,024 env steps instead of 128)"),
        ("dqn", {"rollout_steps": 8}, " --rollout-steps 1"),
        ("dqn", {"rollout_steps": 8, "core": "gru"}, " (updates of 512 env steps instead of 64)"),
        ("reinforce", {"rollout_steps": 300}, " (updates of 19,200 env steps instead of 2,400)"),
    ],
)
def test_more_copies_are_suggested_with_rollouts_that_keep_updates_small_and_fit_the_algorithm(
    algo: str, settings: dict[str, Any], flags: str
) -> None:
    config = resolve("Taxi-v3", algo=algo, envs=8, lanes=4, **settings)
    assert chosen_workers(config, 64).endswith(f"--lanes 64 --envs 64{flags}")


@pytest.mark.parametrize(
    ("workers", "says"),
    [
        (4, ""),
        (2, ""),
        (
            6,
            "2 of 6 workers have nothing to collect, because there are 4 lanes; to use all, take --lanes 6 --envs 12 "
            "--rollout-steps 85",
        ),
        (8, "4 of 8 workers have nothing to collect, because there are 4 lanes; to use all, take --lanes 8"),
        (
            3,
            "4 lanes don't divide among 3 workers: some step 2 of them while others wait; --workers 2 is as fast, and "
            "--lanes 6 --envs 12 --rollout-steps 85 keeps all busy",
        ),
    ],
)
def test_lanes_that_keep_not_all_workers_busy_are_named_with_better_ones(workers: int, says: str) -> None:
    config = resolve("Taxi-v3", workers=workers, envs=8, lanes=4)
    assert uneven_lanes(config) == says
    taken: dict[str, Any] = {name: int(number) for name, number in re.findall(r"--(lanes|envs) (\d+)", says)}
    assert not uneven_lanes(resolve("CartPole-v1", workers=workers, **({"envs": 8, "lanes": 4} | taken)))
