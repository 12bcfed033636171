"""One agent is the case A = 1 of several: whole rollouts of it are counted at once, and have the rows of a single seat."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest
from pettingzoo import ParallelEnv

from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.messages import EpisodeRows, Evaluate
from millrace.protocol.rollout import Episode
from millrace.workers.evaluate.evaluator import Evaluator
from tests.support.conversation.example_messages import example
from tests.support.in_process.collectors import collect, no_pulse, random_collector, random_policy, run_of


class OneSeat(ParallelEnv):  # type: ignore[misc]
    """CartPole with one agent, in PettingZoo's form."""

    possible_agents = ["only"]
    metadata: dict[str, Any] = {"name": "one_seat"}

    def __init__(self) -> None:
        self._env = gymnasium.make("CartPole-v1")
        self.agents: list[str] = []

    def observation_space(self, agent: str) -> Any:
        return self._env.observation_space

    def action_space(self, agent: str) -> Any:
        return self._env.action_space

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.agents = ["only"]
        seen, info = self._env.reset(seed=seed)
        return {"only": seen}, {"only": info}

    def step(self, actions: dict[str, Any]) -> Any:
        seen, reward, terminated, truncated, info = self._env.step(actions["only"])
        self.agents = [] if terminated or truncated else ["only"]
        return tuple({"only": each} for each in (seen, reward, terminated, truncated, info))


def figures(episodes: Iterable[Episode]) -> list[tuple[float, int]]:
    return [(each.reward, each.length) for each in episodes]


ALONE = run_of("CartPole-v1", T=23, N=3, core="lstm", core_size=5)
SEATED = msgspec.structs.replace(ALONE, env=EnvSpec(f"{__name__}:OneSeat"), seats=("only",))


def test_a_seat_that_is_alone_has_the_rows_of_one_agent() -> None:
    alone, seated = random_collector(ALONE), random_collector(SEATED)
    ended = 0
    for k in range(6):
        one, other = (collect(collector, run, k)[0] for collector, run in ((alone, ALONE), (seated, SEATED)))
        for name in ("reward", "terminated", "truncated", "valid", "state"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), name)
        np.testing.assert_array_equal(one.obs[0], other.obs[0])
        for name in ("action", "log_prob"):
            np.testing.assert_array_equal(getattr(one, name)[one.valid], getattr(other, name)[one.valid], name)
        assert [(each.reward, each.length) for each in one.episodes] == [
            (each.reward, each.length) for each in other.episodes
        ]
        assert one.env_steps == other.env_steps
        ended += len(one.episodes)
    assert ended > 6


@pytest.mark.parametrize("most_steps", [4, 200])
def test_an_evaluation_plays_it_alike(most_steps: int) -> None:
    played = []
    for run in (ALONE, SEATED):
        rows: list[EpisodeRows] = []
        order = example(Evaluate, session=1, ticket=1, seeds=(3, 4, 5), most_steps=most_steps, send_rows=True)
        answer = Evaluator(run, random_policy(run.policy)).play(order, rows.append, no_pulse)
        told = [(each.episode, each.reward.tolist(), each.obs[0].ravel().tolist(), each.truncated.tolist()) for each in rows]
        played.append((figures(answer.episodes), answer.cut, told))
    assert played[0] == played[1]
