"""When a run evaluates its policy, and which policy it keeps as the best: also after a resume with other settings."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from millrace.learner.algorithms import Algorithm
from millrace.learner.between_updates.evaluations import Evaluations
from millrace.learner.between_updates.run_parts import RunParts
from millrace.learner.between_updates.tally import Tally
from millrace.learner.config.config import Config
from millrace.learner.rollouts.evaluation_dealer import EvaluationPlan, PlayedEpisode, evaluation_of
from millrace.learner.rollouts.hub import Hub
from millrace.learner.run_folder.atomic_write import Writes
from millrace.learner.run_folder.progress import Row
from millrace.learner.run_folder.results import EvaluatedPolicy
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.learner.run_state import RunState, SavedRun
from millrace.play_flags import EvaluateFlags
from millrace.protocol.bounds import LARGEST
from millrace.protocol.rollout import Episode, stack_rollouts
from tests.support.conversation.fake_ends import fake_rollout, run_spec


class Fakes:
    """An algorithm whose weights are the number of evaluations so far, a hub that finds `returns` in turn, a folder."""

    def __init__(self, *returns: float) -> None:
        self.returns: Iterator[float] = iter(returns)
        self.evaluated = 0
        self.published: list[int] = []
        """The versions of weights that were published for an evaluation."""
        self.attributes: list[list[int] | None] = []
        """The attributes of environments that they had."""
        self.seeds: list[tuple[int, ...]] = []
        """The seeds of each evaluation."""
        self.time_limits: list[int | None] = []
        """The time limit of each evaluation's episodes."""
        self.writes = Writes()
        self.written: list[float] = []
        """The weights of each policy that was written as the best."""

    def weights(self) -> Any:
        return np.array([self.evaluated], np.float32), np.zeros(0, np.float32)

    def begin_evaluation(self, plan: EvaluationPlan, *, beside: bool = False) -> None:
        self.evaluated += 1
        self.seeds.append(plan.seeds)
        self.time_limits.append(plan.time_limit)

    def end_evaluation(self, watch: Callable[[int, int], None]) -> list[PlayedEpisode]:
        return [PlayedEpisode(Episode(next(self.returns), 1, 0.0), cut=False)] * len(self.seeds[-1])

    def publish(self, version: int, *weights: Any, deal: bool, env_attributes: Any = None) -> None:
        self.published.append(version)
        self.attributes.append(None if env_attributes is None else env_attributes.tolist())

    def confirm_lock(self) -> None:
        pass

    def write_policy(self, run: Any, parameters: Any, *rest: Any) -> None:
        self.written.append(float(parameters[0]))

    def evaluations(
        self, every: int, state: RunState, seed: int = 1, ended_by: Any = lambda: None, **settings: Any
    ) -> tuple[Tally, Evaluations]:
        """`episodes` among the settings are the newest episodes of the run that is resumed."""
        saved = SavedRun(state=state, episodes=settings.pop("episodes", []))
        config = Config(eval_every=every, eval_episodes=10, seed=seed, **settings)
        folder, algorithm, hub = cast(RunFolder, self), cast(Algorithm, self), cast(Hub, self)
        self.tally = Tally(config, run_spec(), saved, ended_by)
        return self.tally, Evaluations(RunParts(config, run_spec(), folder, algorithm, hub, self.tally), 50)


def due(parts: tuple[Tally, Evaluations], *env_steps: int) -> list[int]:
    """Those of these numbers of env steps after which an evaluation is due. They are made."""
    made = []
    tally, evaluations = parts
    for tally.state.version, tally.state.env_steps in enumerate(env_steps, 1):
        if tally.evaluation_is_due():
            evaluate(evaluations)
            made.append(tally.state.env_steps)
    return made


def evaluate(evaluations: Evaluations) -> Row | None:
    """Make the evaluation that is due, as `train` does. Returns the metrics that it reports."""
    before = evaluations.end_pending(lambda: None)
    return evaluations.evaluate_when_due(lambda: None) or before


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
    state = RunState(version=9, env_steps=4_000, best=(5.0, 100), best_policy=policy)
    _, evaluations = fakes.evaluations(0, state)
    assert evaluations.conclude(lambda: None)
    best = evaluations.confirmed
    assert best is not None
    assert (best.chosen_by, best.env_steps, best.evaluation.return_mean) == (7.0, 4_000, 7.5)
    assert fakes.written == [-1.0, 1.0]


# ---------------------------------------------------------------- beside training

TARGET = "target return 5 reached"


@pytest.mark.parametrize(
    ("eval_workers", "returns", "evaluated", "reason", "best"),
    [
        (0, [3.0, 6.0, 1.0], [100, 200], TARGET, (6.0, 200)),
        (1, [3.0, 6.0, 1.0], [100, 200], f"{TARGET} by the policy of 200 env steps", (6.0, 200)),
        (1, [6.0, 1.0], [100], f"{TARGET} by the policy of 100 env steps", (6.0, 100)),
        (0, [3.0, 1.0, 2.0, 6.0], [100, 200, 300, 400], TARGET, (6.0, 400)),
        (1, [3.0, 1.0, 2.0, 6.0], [100, 200, 300], "all steps done", (6.0, 400)),
        (1, [3.0, 3.0, 2.0, 1.0], [100, 200, 300], "all steps done", (3.0, 200)),
        (0, [0.0, 0.0, 0.0, 0.0], [100, 200, 300, 400], "all steps done", (0.0, 400)),
    ],
)
def test_when_a_run_stops_and_which_policy_it_keeps(
    eval_workers: int, returns: list[float], evaluated: list[int], reason: str, best: tuple[float, int]
) -> None:
    """`evaluated`: env steps of the policies whose results came before the run stopped, at 430 env steps at the latest."""
    fakes, state = Fakes(*returns, *returns), RunState()
    tally, evaluations = fakes.evaluations(100, state, eval_workers=eval_workers, target_return=5.0, steps=433, envs=4)
    found = []
    for state.version, state.env_steps in enumerate(range(30, 431, 10), 1):
        if tally.evaluation_is_due() and evaluate(evaluations) is not None:
            found.append(state.evaluated.env_steps)
        if (stop := tally.stop_reason()) is not None:
            break
    assert (found, stop) == (evaluated, reason)
    evaluations.end_pending(lambda: None)
    assert state.best == best
    number = best[1] // 100 - 1  # what `Fakes.weights` were when this policy was to be evaluated
    assert fakes.written[-1] == number + (eval_workers == 0)


def concluded(fakes: Fakes, returns_to_stop: int, **settings: Any) -> tuple[Evaluations, RunState, list[tuple[int, ...]]]:
    """A run with so many evaluations, which ends after the last of them. Also the seeds of the evaluations that follow."""
    state = RunState()
    tally, evaluations = fakes.evaluations(100, state, steps=1_000_000, **settings)
    assert due((tally, evaluations), *range(100, 100 * returns_to_stop + 1, 100)) == [
        *range(100, 100 * returns_to_stop + 1, 100)
    ]
    before = len(fakes.seeds)
    assert tally.stop_reason() is not None
    evaluations.conclude(lambda: None)
    return evaluations, state, fakes.seeds[before:]


def test_the_return_that_reached_the_target_is_not_the_one_that_is_reported() -> None:
    """The best policy is the final one: a single evaluation on other episodes reports both."""
    fakes = Fakes(3.0, 6.0, 4.5)
    evaluations, state, again = concluded(fakes, 2, target_return=5.0)
    assert fakes.time_limits == [50] * 3, "that of the environment"
    assert fakes.tally.note == "200 env steps: greedy return 4.5 ± 0.0 over 10 episodes, on other episodes"
    assert evaluations.final is not None
    assert evaluations.confirmed is not None
    assert (evaluations.final.return_mean, evaluations.ended_by) == (4.5, 6.0)
    assert evaluations.to_report() is evaluations.final is evaluations.confirmed.evaluation
    assert evaluations.confirmed.chosen_by == 6.0
    (others,) = again
    assert not {*others} & {*fakes.seeds[0]}
    assert state.newest_evaluation is not None
    assert state.newest_evaluation.return_mean == 6.0


def test_nor_is_it_where_an_earlier_policy_was_better() -> None:
    """The target was set when the run was resumed."""
    fakes = Fakes(8.0, 6.0, 4.5, 7.0)
    policy = np.array([-1], np.float32), np.zeros(0, np.float32)
    state = RunState(best=(8.0, 50), best_policy=policy)
    tally, evaluations = fakes.evaluations(100, state, steps=1_000_000, target_return=5.0)
    next(fakes.returns)
    assert due((tally, evaluations), 100) == [100]
    assert (evaluations.to_report(), tally.stop_reason()) == (None, TARGET)
    evaluations.conclude(lambda: None)
    assert evaluations.final is not None
    assert evaluations.confirmed is not None
    assert evaluations.final.return_mean == 4.5
    assert (evaluations.confirmed.env_steps, evaluations.confirmed.evaluation.return_mean) == (50, 7.0)


def test_nor_one_that_a_callback_saw_before_it_ended_the_run() -> None:
    fakes, ended = Fakes(6.0, 4.5), ["sweep: pruned"]
    evaluations, _, _ = concluded(fakes, 1, ended_by=lambda: ended[0] if fakes.evaluated else None)
    assert evaluations.final is not None
    assert evaluations.final.return_mean == 4.5


def test_a_return_that_decided_nothing_is_reported_as_it_was_found() -> None:
    fakes = Fakes(3.0, 4.0, 3.5)
    tally, evaluations = fakes.evaluations(100, state := RunState(), steps=200)
    assert due((tally, evaluations), 100, 200) == [100, 200]
    assert tally.stop_reason() == "all steps done"
    assert not evaluations.conclude(lambda: None)
    assert evaluations.final is state.newest_evaluation
    assert evaluations.ended_by is None
    assert evaluations.confirmed is not None
    assert evaluations.confirmed.evaluation.return_mean == 3.5


def test_the_last_policy_is_not_evaluated_twice() -> None:
    fakes, state = Fakes(3.0, 4.0, 3.5), RunState(version=1, env_steps=100)
    _, evaluations = fakes.evaluations(100, state, eval_workers=1)
    assert evaluate(evaluations) is None
    assert evaluations.end_pending(lambda: None) is not None
    assert not evaluations.conclude(lambda: None)
    assert evaluations.confirmed is not None
    assert (state.newest_evaluation is not None, fakes.evaluated) == (True, 2), "once, and once as the best"


def ended(fakes: Fakes, state: RunState, **settings: Any) -> tuple[Tally, Evaluations]:
    """A run that ends as `train` ends it, with the evaluations that are due after 100, 200, … env steps."""
    tally, evaluations = fakes.evaluations(100, state, **settings)
    if tally.evaluation_is_due():
        evaluate(evaluations)
    while tally.stop_reason() is None:
        state.version, state.env_steps = state.version + 1, state.env_steps + 100
        if tally.evaluation_is_due():
            evaluate(evaluations)
    tally.training_ended()
    evaluations.end_pending(lambda: None)
    evaluations.conclude(lambda: None)
    return tally, evaluations


BESIDE = f"{TARGET} by the policy of 100 env steps"
MEAN_REACHED = "mean return 2 of the last episodes reached"
WINDOW = [Episode(2.0, 1, 0.0)] * 100


@pytest.mark.parametrize(
    ("settings", "returns", "reason", "ended_by", "reported"),
    [
        ({"eval_workers": 1, "target_return": 5.0}, [6.0, 1.0, 5.5], BESIDE, 6.0, 1.0),
        ({"eval_workers": 1, "target_return": 5.0}, [6.0, 7.0, 5.5], BESIDE, 6.0, 7.0),
        ({"eval_workers": 1, "target_return": 5.0, "steps": 200}, [1.0, 6.0, 5.5], "all steps done", None, 6.0),
        ({"target_mean_return": 2.0}, [6.0, 4.5], MEAN_REACHED, None, 6.0),
        ({"target_mean_return": 2.0, "target_return": 7.0}, [6.0, 4.5], MEAN_REACHED, None, 6.0),
        ({"target_mean_return": 2.0, "target_return": 5.0, "eval_workers": 1}, [6.0, 4.5], MEAN_REACHED, None, 6.0),
        ({"target_return": 5.0}, [6.0, 4.5], TARGET, 6.0, 4.5),
    ],
)
def test_evaluations_after_training_do_not_change_why_a_run_ended(
    settings: dict[str, Any], returns: list[float], reason: str, ended_by: float | None, reported: float
) -> None:
    """Nor does a resume: whether the run was interrupted before its second evaluations, or has finished."""
    mean_reached = "target_mean_return" in settings
    state = RunState(version=1, env_steps=100, next_evaluation=100)
    settings = {"steps": 1_000_000, "episodes": WINDOW if mean_reached else [], **settings}
    fakes = Fakes(*returns)
    tally, evaluations = ended(fakes, state, **settings)
    assert (tally.stop_reason(), evaluations.ended_by) == (reason, ended_by)
    assert evaluations.final is not None
    assert evaluations.final.return_mean == reported
    before = state.env_steps
    again, others = ended(Fakes(*returns[-1:] * 2), state, **settings)
    assert (again.stop_reason(), others.ended_by, state.env_steps) == (reason, ended_by, before)
    assert others.final is not None
    assert others.final.return_mean == reported


def test_with_a_higher_target_a_resumed_run_trains_on() -> None:
    state = RunState()
    settings: dict[str, Any] = {"eval_workers": 1, "steps": 1_000_000}
    ended(Fakes(6.0, 1.0, 5.5), state, target_return=5.0, **settings)
    assert Fakes().evaluations(100, state, target_return=6.0, **settings)[0].stop_reason() == BESIDE.replace("5", "6", 1)
    tally, _ = Fakes().evaluations(100, state, target_return=6.5, **settings)
    assert tally.stop_reason() is None
    tally.count(stack_rollouts([fake_rollout(1, 0, 0, 0, 0)]))
    assert state.ended_with is None
    tally, _ = Fakes().evaluations(100, state, target_return=0.5, **settings)
    assert tally.stop_reason() == "target return 0.5 reached by the policy of 200 env steps", "the final one"


def test_with_a_target_that_only_the_evaluation_after_training_reached_a_resumed_run_ends() -> None:
    state = RunState()
    settings: dict[str, Any] = {"eval_workers": 1, "steps": 1_000_000}
    ended(Fakes(6.0, 7.0, 5.5), state, target_return=5.0, **settings)
    tally, _ = Fakes().evaluations(100, state, target_return=6.5, **settings)
    assert tally.stop_reason() == "target return 6.5 reached"
    tally.training_ended()
    assert state.ended_with is not None
    assert state.ended_with.evaluation == 7.0


@pytest.mark.parametrize(("pending", "expected"), [(5, [1, 2]), (3, None)])
def test_weights_that_are_evaluated_again_have_the_attributes_of_their_version(pending: int, expected: Any) -> None:
    """Workers take weights of one version once: those that training publishes after it are the same."""
    policy = np.array([7], np.float32), np.zeros(0, np.float32)
    state = RunState(version=5, env_steps=150, pending=EvaluatedPolicy(pending, 100), pending_policy=policy)
    fakes = Fakes(3.0)
    _, evaluations = fakes.evaluations(100, state, eval_workers=1)
    evaluations.begin_again(np.array([1, 2], np.uint8), lambda: None)
    assert fakes.attributes == [expected]


@pytest.mark.parametrize("eval_workers", [0, 1])
def test_an_evaluation_begins_again_when_the_run_is_resumed(eval_workers: int) -> None:
    policy = np.array([7], np.float32), np.zeros(0, np.float32)
    state = RunState(version=5, env_steps=150, next_evaluation=200, pending=EvaluatedPolicy(3, 100), pending_policy=policy)
    fakes = Fakes(3.0, 4.0)
    tally, evaluations = fakes.evaluations(100, state, eval_workers=eval_workers)
    metrics = evaluations.begin_again(None, lambda: None)
    assert fakes.published == [3]
    assert (metrics is None) == bool(eval_workers), "without workers that only evaluate, it is awaited at once"
    if metrics is None:
        state.version, state.env_steps = 6, 210
        assert tally.evaluation_is_due()
        metrics = evaluate(evaluations)
    assert metrics is not None
    assert (metrics["eval/mean_reward"], metrics["eval/env_steps"]) == (3.0, 100)
    assert (state.evaluated.version, state.best, fakes.written) == (3, (3.0, 100), [7.0])
    assert (state.pending is None) == (not eval_workers)


def test_a_result_that_ended_the_run_stays_after_a_resume_without_eval_workers() -> None:
    """The run was interrupted before the result, when the next evaluation was already due."""
    policy = np.array([7], np.float32), np.zeros(0, np.float32)
    state = RunState(version=6, env_steps=210, next_evaluation=200, pending=EvaluatedPolicy(3, 100), pending_policy=policy)
    fakes = Fakes(6.0, 3.0)
    tally, evaluations = fakes.evaluations(100, state, target_return=5.0)
    evaluations.begin_again(None, lambda: None)
    assert tally.evaluation_is_due()
    assert evaluate(evaluations) is None
    assert (tally.stop_reason(), state.best) == (f"{TARGET} by the policy of 100 env steps", (6.0, 100))


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


def test_a_number_of_the_environment_may_be_called_score() -> None:
    played = [PlayedEpisode(Episode(1.0, 1, 0.0, (300.0 + n,)), cut=False) for n in range(3)]
    found = evaluation_of(played, ("score",))
    assert found.score_interval is None
    assert str(found).endswith("over 3 episodes, score 301")


def test_the_interval_of_a_score_is_wilsons() -> None:
    """Of none of one, the upper limit is z² / (1 + z²)."""
    played = [PlayedEpisode(Episode(1.0, 1, 0.0, (float(n < 8),), opponent=3), cut=False) for n in range(10)]
    assert evaluation_of(played, ("score",)).score_interval == pytest.approx((0.4901625, 0.9433178), abs=1e-6)
    none = [PlayedEpisode(Episode(1.0, 1, 0.0, (0.0,), opponent=3), cut=False)]
    assert evaluation_of(none, ("score",)).score_interval == pytest.approx((0.0, 0.7934506), abs=1e-6)
