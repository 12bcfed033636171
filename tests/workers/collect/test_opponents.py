"""Rows with opponents: in each copy the policy plays one team, and one opponent all others, for whole episodes."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from millrace.learner.algorithms.minibatches import log_probs
from millrace.learner.algorithms.ppo import PPO
from millrace.learner.config.hyperparameters import PPOConfig
from millrace.learner.rollouts.opponent_pool import teams_of
from millrace.protocol.arrays import Array, Floats
from millrace.protocol.errors import PolicyFailed, UsageError
from millrace.protocol.messages import Evaluate, Permit, Weights
from millrace.protocol.policy.layout import acting_size
from millrace.protocol.policy.policy import make_policy
from millrace.protocol.rollout import Episode, Rollout, stack_rollouts
from millrace.protocol.rows.rollout_checks import validate, wrong_facts
from millrace.protocol.specs import PolicySpec, RunSpec
from millrace.workers.collect.collector import Collector
from millrace.workers.evaluate.evaluator import Evaluator
from millrace.workers.opponents import KnownOpponents, Match, Opponent, OtherTeams
from tests.support.conversation.example_messages import example
from tests.support.in_process.collectors import no_pulse, random_policy
from tests.support.users_code.seat_envs import AGENTS
from tests.workers.collect.test_seat_rows import FORMS, seated_run

A = len(AGENTS)
SCRIPTED = f"{__name__}:always_two"


def with_teams(run: RunSpec, patterns: Sequence[str] = (), **changes: Any) -> RunSpec:
    return msgspec.structs.replace(run, teams=teams_of(run.seats, patterns), **changes)


def always(action: int, version: int, spec: PolicySpec) -> Weights:
    """Weights of a policy without hidden layers that always takes this action."""
    parameters = np.zeros(acting_size(spec), np.float32)
    parameters[-3 + action] = 1e4  # the last are the biases of the three actions
    return Weights(version, parameters, np.zeros(0, np.float32))


def always_two() -> Any:
    def act(obs: Array, state: Floats, rng: np.random.Generator) -> Any:
        return np.full(len(obs), 2), state, {}

    return SimpleNamespace(act=act)


def collector_of(run: RunSpec, action: int = 0) -> Collector:
    """A collector whose policy always takes this action."""
    policy, weights = make_policy(run.policy), always(action, 0, run.policy)
    policy.load(weights.parameters, weights.buffers)
    return Collector(run, policy)


def collect(collector: Collector, run: RunSpec, opponents: Sequence[int | None], lane: int = 0) -> list[Rollout]:
    """A rollout for each of these opponents; version v always takes action v."""
    held = {number: always(number, number, run.policy) for number in opponents if number is not None and number >= 0}
    found = []
    for sequence, opponent in enumerate(opponents):
        found += collector.collect([Permit(sequence, lane, 0, sequence, sequence, opponent)], 0, 1, no_pulse, held)
        validate(found[-1], run)
    return found


def told(collector: Collector, lane: int = 0) -> list[list[dict[str, Any]]]:
    """What the agents of each copy lived through, episode by episode."""
    return [env.env.told for env in collector.lanes[lane].copies.envs]  # type: ignore[attr-defined]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("second", [2, -1])
def test_one_opponent_plays_the_other_seats_for_a_whole_episode(form: str, second: int) -> None:
    run = with_teams(seated_run(form, T=7, N=4, net=()), scripted=(SCRIPTED,))
    collector = collector_of(run)
    order = [1, second] * 10
    rollouts = collect(collector, run, order, lane=1)
    met = set()
    ended = [[e.opponent for e in rollout.episodes] for rollout in rollouts]
    for n, episodes in enumerate(told(collector, 1)):
        mine = AGENTS[(4 + n) % A]
        for episode in episodes:
            assert set(episode[mine].did) <= {0}
            others = {action for agent in AGENTS if agent != mine for action in episode[agent].did}
            assert len(others) <= 1
            met |= others
    assert met == {1, 2}
    assert {number for of_rollout in ended for number in of_rollout} == {1, second}


def test_another_opponent_comes_where_the_copy_is_reset() -> None:
    run = with_teams(seated_run("together", T=5, N=1, net=()))
    collector = collector_of(run)
    order = [1, 2, 2, 1, 1, 2, 1, 2, 2, 1, 2, 1, 1, 1, 2, 2]
    rollouts = collect(collector, run, order)
    resets = np.concatenate([rollout.resets[:-1, 0] for rollout in rollouts if rollout.resets is not None])
    began = [order[0], *(order[t // run.rollout_steps] for t in np.flatnonzero(resets))]
    played = [episode.opponent for rollout in rollouts for episode in rollout.episodes]
    assert played == began[: len(played)]
    assert len(played) > 6


def test_teams_are_of_one_size_and_every_agent_is_in_one() -> None:
    assert teams_of(("r1", "b1", "r2", "b2"), ("r*", "b*")) == ((0, 2), (1, 3))
    assert teams_of(AGENTS) == ((0,), (1,), (2,))
    for patterns, says in (
        (("[ab]", "c"), r"expected two teams or more, with as many agents in each; got 2 in \[ab\], 1 in c"),
        (("*",), r"expected two teams or more, with as many agents in each; got 3 in \*"),
        (("a", "b"), "expected each agent in one team, got c in 0: a b"),
        (("*", "c"), r"expected each agent in one team, got c in 2: \* c"),
        (("a", "b", "c", "d"), "d matches no agent of a, b, c"),
    ):
        with pytest.raises(UsageError, match=f"^teams: {says}"):
            teams_of(AGENTS, patterns)


@pytest.mark.parametrize("form", FORMS)
def test_a_rollout_has_the_rows_of_its_team_bit_for_bit(form: str) -> None:
    """The opponent does what the policy does, so the environment tells the same histories without one."""
    alone = seated_run(form, T=9, N=6, net=())
    run = with_teams(alone)
    ours, all_seats = collect(collector_of(run), run, [0] * 5), collect(collector_of(alone), alone, [None] * 5)
    for got, whole in zip(ours, all_seats, strict=True):
        columns = [n * A + n % A for n in range(6)]
        for name in ("action", "log_prob", "reward", "terminated", "truncated", "valid"):
            assert np.array_equal(getattr(got, name), getattr(whole, name)[:, columns]), name
        assert np.array_equal(got.obs[0], whole.obs[0][:, columns])
        assert np.array_equal(got.state, whole.state[columns])
        assert np.array_equal(got.resets, whole.resets)  # type: ignore[arg-type]
        assert [(e.length, e.opponent) for e in got.episodes] == [(e.length, 0) for e in whole.episodes]


def by_sight() -> Any:
    def act(obs: Array, state: Floats, rng: np.random.Generator) -> Any:
        return seen_as(obs[:, 0]), state, {}

    return SimpleNamespace(act=act)


def seen_as(obs: Any) -> Array:
    """The action of that program; all observations of these environments are different multiples of 1/64."""
    return np.asarray(np.rint(np.multiply(obs, 64)), np.int64) % 3


@pytest.mark.parametrize("form", FORMS)
def test_a_program_sees_what_its_agents_see(form: str) -> None:
    run = with_teams(seated_run(form, T=9, N=3, net=()), scripted=(f"{__name__}:by_sight",))
    collector, acted = collector_of(run), 0
    collect(collector, run, [-1] * 6)
    for n, episodes in enumerate(told(collector)):
        for episode in episodes:
            for agent in AGENTS[:n] + AGENTS[n + 1 :]:
                assert episode[agent].did == seen_as(episode[agent].seen).tolist()
                acted += len(episode[agent].did)
    assert acted > 50


@pytest.mark.parametrize("form", FORMS)
def test_the_learner_finds_the_log_probabilities_of_its_team(form: str) -> None:
    run = with_teams(seated_run(form, T=5, N=6, core="gru", core_size=7))
    ppo = PPO(PPOConfig(core="gru", core_size=7), run.policy, total_steps=1, seed=3)
    policy = make_policy(run.policy)
    policy.load(*ppo.weights())
    collector, other = Collector(run, policy), PPO(PPOConfig(core="gru", core_size=7), run.policy, total_steps=1, seed=4)
    held = {4: Weights(4, *other.weights())}
    for k in range(6):
        (rollout,) = collector.collect([Permit(k, 0, 0, k, k, 4)], 0, 1, no_pulse, held)
        batch = stack_rollouts([rollout])
        found = log_probs(ppo.net, ppo.observations(batch), batch, no_pulse)
        # A chain of some hundred float32 operations on numbers of the size of 1, in other orders.
        np.testing.assert_allclose(found[batch.valid], batch.log_prob[batch.valid], atol=1e-4)


class _Counts:
    """Its state is how often it has acted."""

    def __init__(self) -> None:
        self.found: list[list[float]] = []

    def choose(self, obs: Sequence[Array], state: Floats, generator: Any, *, greedy: bool) -> Array:
        assert not greedy
        self.found.append(state[0, :, 0].tolist())
        state += 1
        return np.full(state.shape[1], 7)


def test_an_opponent_has_a_state_of_its_own_which_is_zeros_when_an_episode_begins() -> None:
    run = with_teams(seated_run("turns", T=5, N=2, core="gru", core_size=7))
    acting: Any = _Counts()
    opponent = Opponent.__new__(Opponent)
    opponent.number, opponent.acting, opponent.to_env_action, opponent.state_size = 3, acting, lambda action: action, 7
    others = OtherTeams(run, [Match(0, opponent), Match(1, opponent)])
    others.generator = np.random.default_rng(0)
    obs, taken = [np.zeros((6, 1), np.float32)], np.zeros(6, np.int64)
    everybody = np.ones(6, bool)
    others.act(obs, everybody, taken)
    assert taken.tolist() == [0, 7, 7, 7, 0, 7]
    others.act(obs, np.array([True, True, False, True, True, False]), taken)  # those that wait keep theirs
    others.begin([1], opponent)
    others.act(obs, everybody, taken)
    others.act(obs, np.array([True, False, False, False, True, False]), taken)  # nobody of theirs: it is not asked
    assert acting.found == [[0, 0, 0, 0], [1, 1], [2, 1, 0, 0]]


def test_the_score_compares_the_return_of_the_team_with_the_best_of_the_others() -> None:
    run, opponent = with_teams(seated_run("turns", T=5, N=1)), Opponent.__new__(Opponent)
    opponent.number = 9
    for team, returns, result in (
        (0, (2.0, 1.0, 1.5), (2.0, 1.0, 9)),
        (0, (2.0, 1.0, 2.0), (2.0, 0.5, 9)),
        (1, (2.0, 1.0, -3.0), (1.0, 0.0, 9)),
        (2, (-2.0, -1.0, -0.5), (-0.5, 1.0, 9)),
        (1, (2.0, 2.0, 2.0), (2.0, 1 / 3, 9)),
        (2, (2.0, 2.0, 1.0), (1.0, 0.0, 9)),
    ):
        assert OtherTeams(run, [Match(team, opponent)]).result(0, returns) == result
    pairs = msgspec.structs.replace(
        run, seats=("r1", "b1", "r2", "b2"), teams=teams_of(("r1", "b1", "r2", "b2"), ("r*", "b*"))
    )
    others = OtherTeams(pairs, [Match(1, opponent)])
    assert others.mine.tolist() == [False, True, False, True]
    assert others.result(0, (1.0, 2.0, 3.0, 1.0)) == (3.0, 0.0, 9)


@given(returns=st.lists(st.integers(-1, 2), min_size=2, max_size=5))
def test_the_scores_of_all_teams_of_an_episode_add_up_to_one(returns: list[int]) -> None:
    """So equal policies score one over the number of teams, however often they tie, and no rating grows without end."""
    seats = tuple("abcde"[: len(returns)])
    run, opponent = with_teams(seated_run("turns", T=5, N=1)), Opponent.__new__(Opponent)
    run = msgspec.structs.replace(run, seats=seats, teams=teams_of(seats))
    opponent.number = 9
    scores = []
    for team in range(len(returns)):
        others = OtherTeams(run, [Match(team, opponent)])
        own, score, _ = others.result(0, returns)
        assert own == returns[team]
        assert wrong_facts(Episode(own, 1, 0.0, (score,), 9), run) == ""
        scores.append(score)
    assert sum(scores) == pytest.approx(1)


def test_an_evaluation_is_played_as_it_is_ordered() -> None:
    run = with_teams(seated_run("together", T=5, N=1, net=()), scripted=(SCRIPTED,))
    policy, weights = random_policy(run.policy), always(0, 0, run.policy)
    policy.load(weights.parameters, weights.buffers)
    evaluator = Evaluator(run, policy)
    order = example(
        Evaluate, session=1, ticket=1, seeds=(5, 6, 7, 8), greedy=True, opponents=(1, -1, 1, -1), teams=(0, 1, 2, 0)
    )
    answer = evaluator.play(order, lambda rows: None, no_pulse, {1: always(1, 1, run.policy)})
    assert [episode.opponent for episode in answer.episodes] == [1, -1, 1, -1]
    (copies,) = evaluator._copies.values()
    for n, (team, action) in enumerate(zip(order.teams, (1, 2, 1, 2), strict=True)):
        (episode,) = copies.envs[n].env.told  # type: ignore[attr-defined]
        for agent, lived in episode.items():
            assert set(lived.did) <= {0 if agent == AGENTS[team] else action}
        assert answer.episodes[n].reward == pytest.approx(episode[AGENTS[team]].total)
    evaluator.close()


def test_an_opponent_lives_while_an_episode_is_played_against_it() -> None:
    run = with_teams(seated_run("together", T=5, N=1, net=()))
    known = KnownOpponents(run)
    first = known.among({1: always(1, 1, run.policy)})(1)
    assert known.among({})(1) is first
    del first
    with pytest.raises(KeyError):
        known.among({})(1)


def fails() -> Any:
    return SimpleNamespace(act=lambda obs, state, rng: 1 / 0)


@pytest.mark.parametrize(
    ("factory", "says"),
    [
        (f"{__name__}:fails", r"^opponent .*:fails: act raised ZeroDivisionError: division by zero$"),
        (f"{__name__}:missing", r"^opponent .*:missing: .*"),
        ("json:dumps", r"^opponent json:dumps: cannot be made: it raised TypeError: "),
    ],
)
def test_a_program_that_fails_is_named(factory: str, says: str) -> None:
    run = with_teams(seated_run("together", T=5, N=1, net=()), scripted=(factory,))
    with pytest.raises(PolicyFailed, match=says):
        collect(collector_of(run), run, [-1])
