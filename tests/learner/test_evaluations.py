"""When a run evaluates its policy, and which policy it keeps as the best: also after a resume with other settings."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from learner.algorithms import Algorithm
from learner.between_updates.evaluations import Evaluations
from learner.between_updates.run_parts import RunParts
from learner.between_updates.tally import Tally
from learner.config.config import Config
from learner.rollouts.evaluation_dealer import EvaluationPlan, PlayedEpisode
from learner.rollouts.hub import Hub
from learner.run_folder.atomic_write import Writes
from learner.run_folder.run_folder import RunFolder
from learner.run_state import RunState
from millrace.cli.flags import EvaluateFlags
from protocol.bounds import LARGEST
from protocol.rollout import Episode
from tests.support.conversation.fake_ends import run_spec


class Fakes:
    """An algorithm whose weights are the number of evaluations so far, a hub that finds `returns` in turn, a folder."""

    def __init__(self, *returns: float) -> None:
        self.returns: Iterator[float] = iter(returns)
        self.evaluated = 0
        self.seeds: list[tuple[int, ...]] = []
        """The seeds of each evaluation."""
        self.writes = Writes()
        self.written: list[float] = []
        """The weights of each policy that was written as the best."""

    def weights(self) -> Any:
        return np.array([self.evaluated], np.float32), np.zeros(0, np.float32)

    def begin_evaluation(self, plan: EvaluationPlan, *, beside: bool = False) -> None:
        self.evaluated += 1
        self.seeds.append(plan.seeds)

    def end_evaluation(self, watch: Callable[[int, int], None]) -> list[PlayedEpisode]:
        return [PlayedEpisode(Episode(next(self.returns), 1, 0.0), cut=False)] * len(self.seeds[-1])

    def publish(self, version: int, *weights: Any, deal: bool) -> None:
        pass

    def write_policy(self, policy: Any, env: Any, parameters: Any, *rest: Any) -> None:
        self.written.append(float(parameters[0]))

    def evaluations(self, every: int, state: RunState, seed: int = 1) -> tuple[Tally, Evaluations]:
        config = Config(eval_every=every, eval_episodes=10, seed=seed)
        folder, algorithm, hub = cast(RunFolder, self), cast(Algorithm, self), cast(Hub, self)
        tally = Tally(config, run_spec(), state)
        return tally, Evaluations(RunParts(config, run_spec(), folder, algorithm, hub, tally), None)


def due(parts: tuple[Tally, Evaluations], *env_steps: int) -> list[int]:
    """Those of these numbers of env steps after which an evaluation is due. They are made."""
    made = []
    tally, evaluations = parts
    for tally.state.version, tally.state.env_steps in enumerate(env_steps, 1):
        if tally.evaluation_is_due():
            evaluations.evaluate_when_due(lambda: None)
            made.append(tally.state.env_steps)
    return made


def test_one_evaluation_follows_each_multiple_of_eval_every() -> None:
    evaluations = Fakes(*range(9)).evaluations(100, RunState())
    assert due(evaluations, 60, 120, 180, 240, 300, 360) == [120, 240, 300]


def test_updates_that_are_larger_than_eval_every_are_each_evaluated_once() -> None:
    evaluations = Fakes(*range(9)).evaluations(100, RunState())
    assert due(evaluations, 250, 280, 290, 310, 550, 560) == [250, 310, 550]


def test_evaluations_do_not_come_in_bursts_after_a_resume_with_another_eval_every() -> None:
    """The run had none between 1,000 and 4,000 env steps. One is made at once, and the next ones when they are due."""
    evaluations = Fakes(*range(9)).evaluations(500, RunState(version=9, env_steps=4_000, next_evaluation=1_000))
    assert due(evaluations, 4_000, 4_010, 4_020, 4_510) == [4_000, 4_510]


def test_the_final_policy_can_be_the_best_after_a_resume_without_evaluations() -> None:
    fakes = Fakes(7.0, 7.5)
    policy = np.array([-1], np.float32), np.zeros(0, np.float32)
    state = RunState(version=9, env_steps=4_000, best=[5.0, 100.0], best_policy=policy)
    _, evaluations = fakes.evaluations(0, state)
    assert evaluations.conclude(lambda: None)
    best = evaluations.confirmed
    assert best is not None
    assert (best.chosen_by, best.env_steps, best.evaluation.return_mean) == (7.0, 4_000, 7.5)
    assert fakes.written == [-1.0, 1.0]


@pytest.mark.parametrize("seed", [0, 1])
def test_no_policy_is_chosen_by_the_episodes_that_evaluate_plays(seed: int) -> None:
    fakes = Fakes(1.0, 2.0, 3.0)
    evaluations = fakes.evaluations(100, RunState(), seed)
    assert due(evaluations, 100) == [100]
    tally, concluded = evaluations
    tally.state.version, tally.state.env_steps = 2, 200
    concluded.conclude(lambda: None)
    chosen, final, confirmed = fakes.seeds
    assert chosen == final
    by_command = EvaluationPlan.of(10, EvaluateFlags(run=Path()).seed, 4, 1000).seeds
    assert len({chosen, confirmed, by_command}) == 3


def test_a_share_of_steps_fits_the_message() -> None:
    assert [EvaluationPlan.of(2, 1, 4, steps).most_steps for steps in (1, 7, 10**20)] == [1, 3, LARGEST]
