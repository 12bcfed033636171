"""Rows of env copies with seats: each is what one agent lived through, in its own time, wherever rollouts are cut."""

from __future__ import annotations

from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest
from pettingzoo.utils.wrappers import BaseWrapper

from millrace.learner.algorithms.minibatches import log_probs
from millrace.learner.algorithms.ppo import PPO
from millrace.learner.algorithms.replay.replay_buffer import ReplayBuffer
from millrace.learner.algorithms.returns import EpisodeEnds, complete, discounted_return, gae, vtrace
from millrace.learner.config.hyperparameters import PPOConfig
from millrace.learner.rollouts.evaluation_dealer import episode_seeds
from millrace.protocol.arrays import Array
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.spaces import action_spec, observation_leaves
from millrace.protocol.errors import EnvironmentFailed, UsageError
from millrace.protocol.messages import EpisodeRows, Evaluate
from millrace.protocol.policy.policy import make_policy
from millrace.protocol.random_streams import RoundStreams
from millrace.protocol.rollout import Rollout, stack_rollouts
from millrace.protocol.rows.rollout_checks import validate
from millrace.protocol.specs import PolicySpec, RunSpec
from millrace.workers.collect.collector import Collector
from millrace.workers.evaluate.evaluator import Evaluator
from tests.support.conversation.example_messages import example
from tests.support.in_process.collectors import collect, evaluated, no_pulse, random_collector, random_policy
from tests.support.users_code.seat_envs import AGENTS, Lived, RandomCrowd, RandomGame

FORMS: dict[str, Any] = {"turns": RandomGame, "together": RandomCrowd}
GAMMA, LAMBDA, RHO, C = 0.9, 0.8, 1.1, 0.9
A = len(AGENTS)


def seated_run(form: str, T: int, N: int, **policy: Any) -> RunSpec:
    env = FORMS[form]()
    spec = PolicySpec((*observation_leaves(env.observation_space("a")),), action_spec(env.action_space("a")), **policy)
    name = EnvSpec(f"tests.support.users_code.seat_envs:{FORMS[form].__name__}")
    return RunSpec(name, spec, T, N, lanes=8, seed=1, seats=AGENTS, takes_turns=form == "turns")


def collected(run: RunSpec, number: int, lane: int = 0) -> tuple[Collector, list[Rollout]]:
    collector = random_collector(run)
    rollouts = [collect(collector, run, k, lanes=[lane])[0] for k in range(number)]
    for rollout in rollouts:
        validate(rollout, run)
    return collector, rollouts


def in_own_time(collector: Collector, lane: int, rows: int) -> list[tuple[int, int, Lived]]:
    """What each agent lived through: the column, the row of its episode's first step, and its part."""
    found = []
    for n, env in enumerate(collector.lanes[lane].copies.envs):  # type: ignore[attr-defined]
        start = 0
        for episode in env.env.told:
            found += [(n * A + seat, start, episode[agent]) for seat, agent in enumerate(AGENTS)]
            steps = 1 + max((step for lived in episode.values() for step in lived.step), default=rows)
            start += steps + 1  # the row after the last one resets the copy
    return found


def joined(rollouts: list[Rollout]) -> dict[str, Array]:
    """The rows of consecutive rollouts, as those of one."""
    names = ("action", "log_prob", "reward", "terminated", "truncated", "valid")
    found = {name: np.concatenate([getattr(rollout, name) for rollout in rollouts]) for name in names}
    found["obs"] = np.concatenate([*(rollout.obs[0][:-1] for rollout in rollouts), rollouts[-1].obs[0][-1:]])
    found["resets"] = np.concatenate([*(rollout.resets[:-1] for rollout in rollouts), rollouts[-1].resets[-1:]])  # type: ignore[index]
    return found


@pytest.mark.parametrize("form", FORMS)
def test_a_row_is_what_an_agent_lived_through(form: str) -> None:
    run = seated_run(form, T=7, N=40)
    collector, rollouts = collected(run, 6)
    rows, seen = joined(rollouts), 0
    for column, start, lived in in_own_time(collector, 0, 42):
        for k, step in enumerate(lived.step):
            if (t := start + step) >= 42:
                break
            seen += 1
            assert rows["valid"][t, column]
            assert rows["obs"][t, column] == lived.seen[k]
            assert rows["obs"][t + 1, column] == lived.saw[k]
            assert rows["action"][t, column] == lived.did[k]
            assert rows["reward"][t, column] == pytest.approx(lived.reward[k], abs=1e-6)
            last = k == len(lived.step) - 1
            assert rows["terminated"][t, column] == (last and lived.terminated)
            assert rows["truncated"][t, column] == (last and lived.truncated)
    assert seen == np.count_nonzero(rows["valid"]) > 1000
    assert not rows["reward"][~rows["valid"]].any()


@pytest.mark.parametrize("form", FORMS)
def test_episodes_count_every_reward_and_have_the_facts_of_their_last_step(form: str) -> None:
    run = msgspec.structs.replace(seated_run(form, T=30, N=20), info_keys=("steps",))
    collector, rollouts = collected(run, 2)
    episodes = [episode for rollout in rollouts for episode in rollout.episodes]
    envs = [seated.env for seated in collector.lanes[0].copies.envs]  # type: ignore[attr-defined]
    told = [each for env in envs for each in env.told[: -1 if env.agents else None]]
    expected = sorted(tuple(each[agent].total for agent in AGENTS) for each in told)
    np.testing.assert_allclose(sorted(episode.facts[1:] for episode in episodes), expected, atol=1e-9)
    for episode in episodes:
        assert episode.reward == pytest.approx(sum(episode.facts[1:]))
        assert episode.facts[0] == episode.length
    running = sum(env.steps for env in envs if env.agents)
    steps = running + sum(episode.length for episode in episodes)
    assert sum(rollout.env_steps for rollout in rollouts) == collector.steps == steps


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("core", [None, "gru"])
def test_rows_do_not_depend_on_where_rollouts_are_cut(form: str, core: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """One version acts in all of them, so the rows, and the states before them, are the same for the same random numbers."""
    drawn = dict[str, np.random.Generator]()
    monkeypatch.setattr(RoundStreams, "of", lambda *_: drawn["actions"])
    drawn["actions"] = np.random.default_rng(1)
    _, whole = collected(seated_run(form, T=24, N=5, core=core), 1)
    expected = joined(whole)
    for T in (1, 2, 3, 8):
        drawn["actions"] = np.random.default_rng(1)
        _, parts = collected(seated_run(form, T=T, N=5, core=core), 24 // T)
        found = joined(parts)
        for name in expected:
            if name in ("log_prob", "action"):
                valid = expected["valid"]
                np.testing.assert_array_equal(found[name][valid], expected[name][valid], err_msg=name)
            else:
                np.testing.assert_array_equal(found[name], expected[name], err_msg=name)


# ----------------------------------------------------------------------------------------- returns, in each agent's own time


def value(obs: Any) -> Any:
    return np.sin(np.asarray(obs, np.float64) * 1.7).astype(np.float32)


def log_ratio(obs: Any) -> Any:
    return (0.4 * np.cos(np.asarray(obs, np.float64) * 2.3)).astype(np.float32)


class OwnTime:
    """The estimates of one agent's part of an episode, from definitions, in float64. Rollouts are cut every T rows."""

    def __init__(self, start: int, lived: Lived, T: int, rows: int) -> None:
        self.rows = [start + step for step in lived.step if start + step < rows]
        self.advantage, self.target, self.pg = {}, {}, {}
        ahead = vs_ahead = 0.0
        following = -1
        for k in reversed(range(len(self.rows))):
            t, last = self.rows[k], k == len(lived.step) - 1
            v, v_next = float(value(lived.seen[k])), float(value(lived.saw[k]))
            ended = last and (lived.terminated or lived.truncated)
            bootstrap = 0.0 if last and lived.terminated else v_next
            delta = lived.reward[k] + GAMMA * bootstrap - v
            if ended or following // T != t // T or following < 0:
                ahead = vs_ahead = 0.0
            self.advantage[t] = ahead = delta + GAMMA * LAMBDA * ahead
            ratio = np.exp(float(log_ratio(lived.seen[k])))
            rho, c = min(RHO, ratio), LAMBDA * min(C, ratio)
            self.pg[t] = rho * (delta + GAMMA * LAMBDA * vs_ahead)
            vs_ahead = rho * delta + GAMMA * c * vs_ahead
            self.target[t] = vs_ahead + v
            following = t
        total, self.past = 0.0, {}
        for t, reward in zip(self.rows, lived.reward, strict=False):
            self.past[t] = total = reward + GAMMA * total


def cut(rows: dict[str, Array], T: int) -> list[tuple[slice, EpisodeEnds]]:
    count = len(rows["valid"]) // T
    flags = rows["terminated"], rows["truncated"], rows["valid"]
    parts = [slice(i * T, (i + 1) * T) for i in range(count)]
    return [(part, EpisodeEnds(flags[0][part], flags[1][part], flags[2][part], with_seats=True)) for part in parts]


def check_returns(form: str, copies: int, lane: int) -> int:
    """Compare at every T. Returns the number of rows that were compared at T = 1."""
    rows_of_all = 24
    run = seated_run(form, T=rows_of_all, N=copies)
    collector, rollouts = collected(run, 1, lane)
    rows, compared = joined(rollouts), 0
    lives = in_own_time(collector, lane, rows_of_all)
    obs = rows["obs"][..., 0]
    values, ratios = value(obs), log_ratio(obs[:-1])
    for T in range(1, rows_of_all + 1):
        whole = rows_of_all // T * T
        advantage, target, pg = (np.full((whole, copies * A), np.nan) for _ in range(3))
        past, last = np.full((whole, copies * A), np.nan), np.zeros(copies * A)
        for part, ends in cut(rows, T):
            reward = rows["reward"][part]
            v = values[part.start : part.stop + 1]
            advantage[part] = gae(reward, v, ends, GAMMA, LAMBDA)
            target[part], pg[part] = vtrace(reward, v, ratios[part], ends, GAMMA, LAMBDA, RHO, C)
            past[part], last = discounted_return(reward, ends, GAMMA, last)
        expected = {name: np.zeros_like(advantage) for name in ("advantage", "target", "pg", "past")}
        for column, start, lived in lives:
            own = OwnTime(start, lived, T, whole)
            for name, table in expected.items():
                for t, number in getattr(own, name).items():
                    table[t, column] = number
            compared += len(own.rows) if T == 1 else 0
        # Twenty float32 operations on numbers below 30: each rounds by 2e-6 at most.
        for name, found in (("advantage", advantage), ("target", target), ("pg", pg), ("past", past)):
            np.testing.assert_allclose(found, expected[name], atol=1e-4, err_msg=f"{name} at T {T}")
    return compared


@pytest.mark.parametrize("form", FORMS)
def test_returns_equal_those_in_each_agents_own_time_at_every_cut(form: str) -> None:
    assert check_returns(form, 60, 0) > 1000


@pytest.mark.soak
@pytest.mark.parametrize("form", FORMS)
def test_so_do_those_of_ten_thousand_histories(form: str) -> None:
    compared = sum(check_returns(form, 500, lane) for lane in range(5)) + sum(
        check_returns(form, 1250, 5 + k) for k in range(2)
    )
    assert compared > 100_000


def in_own_steps(lived: Lived, k: int, n_step: int, known: int) -> tuple[float, float, float]:
    """From an agent's action k: reward and discount of at most n of its own steps, and what it saw after them.

    `known`: how many of its steps have been collected.
    """
    reward = 0.0
    for i in range(n_step):
        reward += GAMMA**i * lived.reward[k + i]
        if k + i == len(lived.step) - 1 or k + i == known - 1:
            ends = lived.terminated and k + i == len(lived.step) - 1
            return reward, 0.0 if ends else GAMMA ** (i + 1), lived.saw[k + i]
    return reward, GAMMA**n_step, lived.saw[k + n_step - 1]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("T", [1, 3, 16])
@pytest.mark.parametrize("n_step", [1, 3])
def test_the_replay_buffer_follows_each_agent_in_its_own_time_and_stores_what_it_saw_once(
    form: str, T: int, n_step: int
) -> None:
    """Compare every transition with the whole history of the game, as the environment wrote it down."""
    rows = 240
    run = seated_run(form, T=T, N=1)
    collector, rollouts = collected(run, rows // T)
    replay = ReplayBuffer(run.policy.observation, size=2000, n_step=n_step, gamma=GAMMA, seed=0)
    for rollout in rollouts:
        replay.add(stack_rollouts([rollout]))
    expected: dict[float, tuple[int, tuple[float, float, float]]] = {}
    observations = 0
    for _, start, lived in in_own_time(collector, 0, rows):
        known = sum(start + step < rows for step in lived.step)
        for k in range(known):
            expected[lived.seen[k]] = lived.did[k], in_own_steps(lived, k, n_step, known)
        cut = known and not (lived.terminated and known == len(lived.step))
        observations += known + int(cut)  # the last one of a part that goes on, or was truncated, is of no row
    assert len(replay) == len(expected) > 100
    assert len(replay.state_dict()["arrays"]["reward"]) == observations
    drawn = replay.sample(30 * len(expected))
    assert set(drawn.leaves[0].ravel().tolist()) == set(expected)
    for i, seen in enumerate(drawn.leaves[0].ravel().tolist()):
        did, (reward, discount, saw) = expected[seen]
        assert drawn.action[i] == did
        assert drawn.reward[i] == pytest.approx(reward, abs=1e-5)
        assert drawn.discount[i] == pytest.approx(discount)
        assert not discount or drawn.next_leaves[0][i, 0] == saw


def test_a_monte_carlo_return_is_known_where_the_seats_part_ends_within_the_rollout() -> None:
    valid = np.array([[1, 0], [0, 1], [1, 1], [0, 0]], bool)
    terminated = np.array([[0, 0], [0, 0], [1, 0], [0, 0]], bool)
    ends = EpisodeEnds(terminated, np.zeros_like(valid), valid, with_seats=True)
    assert complete(ends).tolist() == [[True, False], [False, False], [True, False], [False, False]]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("core", ["lstm", "gru"])
def test_the_learner_finds_the_log_probabilities_and_states_under_which_seats_acted(form: str, core: Any) -> None:
    """In every rollout, also of actions that were chosen in an earlier one."""
    run = seated_run(form, T=5, N=6, core=core, core_size=7)
    ppo = PPO(PPOConfig(core=core, core_size=7), run.policy, total_steps=1, seed=3)
    policy = make_policy(run.policy)
    policy.load(*ppo.weights())
    collector = Collector(run, policy)
    for k in range(6):
        batch = stack_rollouts(collect(collector, run, k))
        found = log_probs(ppo.net, ppo.observations(batch), batch, no_pulse)
        valid = batch.valid
        # A chain of some hundred float32 operations on numbers of the size of 1, in other orders.
        np.testing.assert_allclose(found[valid], batch.log_prob[valid], atol=1e-4)


def test_a_batch_counts_steps_of_copies() -> None:
    run = seated_run("turns", T=32, N=4)
    batch = stack_rollouts(collected(run, 1)[1])
    assert batch.resets is not None
    assert batch.env_steps == run.rollout_steps * run.copies - np.count_nonzero(batch.resets[:-1])


class Alone(gymnasium.Env[Any, Any]):
    """One agent, which has the spaces of those of the others."""

    observation_space, action_space = RandomCrowd().observation_space("a"), RandomCrowd().action_space("a")


def test_an_environment_of_other_agents_is_refused_in_one_line() -> None:
    together, turns = "agents: a, b, c", "agents that take turns: a, b, c"
    crowd, game = (seated_run(form, T=2, N=2) for form in ("together", "turns"))
    alone = msgspec.structs.replace(crowd, seats=())
    of_alone = EnvSpec(f"{__name__}:{Alone.__name__}")
    for run, env, expected, got in (
        (crowd, of_alone, together, "agents: none"),
        (alone, crowd.env, "agents: none", together),
        (alone, game.env, "agents: none", turns),
        (game, of_alone, turns, "agents: none"),
        (crowd, game.env, together, turns),
        (msgspec.structs.replace(crowd, seats=("a", "b")), crowd.env, "agents: a, b", together),
        (msgspec.structs.replace(crowd, seats=("a", "c", "b")), crowd.env, "agents: a, c, b", together),
    ):
        changed = msgspec.structs.replace(run, env=env)
        says = f"environment {env.id}: expected {expected}, got {got}; install the version .*$"
        with pytest.raises(UsageError, match=says):
            collect(random_collector(changed), changed)
        with pytest.raises(UsageError, match=says):
            evaluated(changed, random_policy(changed.policy), 1, 0)
    may_wait = msgspec.structs.replace(game, env=crowd.env)
    collect(random_collector(may_wait), may_wait)


@pytest.mark.parametrize("form", FORMS)
def test_a_value_that_is_no_number_is_named_by_the_seat_that_it_is_of(form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def rewards(env: Any, agents: list[str]) -> dict[str, float]:
        return {agent: np.nan if agent == "b" else 0.0 for agent in agents}

    monkeypatch.setattr(FORMS[form], "_rewards", rewards)
    run = seated_run(form, T=12, N=3)
    says = r"reward: expected finite values, got nan at step \d+, copy [0-2], b$"
    with pytest.raises(EnvironmentFailed, match=f"lane 0, {says}"):
        collect(random_collector(run), run)
    with pytest.raises(EnvironmentFailed, match=says):
        evaluated(run, random_policy(run.policy), 3, 0)


class PaysLater(RandomCrowd):
    """Rewards `c`, which is never there, from its second step on."""

    paid = float("nan")

    def _begin(self, seed: int | None) -> None:
        super()._begin(seed)
        self.agents = ["a", "b"]

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:
        seen, rewards, *rest = super().step(actions)
        rewards.pop("c", None)
        return seen, rewards | ({} if self.steps < 2 or "c" in self._was_here else {"c": self.paid}), *rest


class PaysFirst(RandomGame):
    """Rewards `c` with the reset, before its first move."""

    paid = float("nan")

    def reset(self, seed: int | None = None, options: Any = None) -> None:
        super().reset(seed, options)
        self._cumulative = dict.fromkeys(AGENTS, 0.0) | {self.agent_selection: self.paid}


@pytest.mark.parametrize("paid", [np.nan, np.inf, -np.inf, 1e300])
@pytest.mark.parametrize(("form", "made"), [("together", PaysLater), ("turns", PaysFirst)])
def test_a_reward_outside_of_any_row_must_be_finite_too(
    form: str, made: Any, paid: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No row holds it, but the return of the episode does."""
    monkeypatch.setattr(made, "paid", paid)
    run = msgspec.structs.replace(seated_run(form, T=12, N=3), env=EnvSpec(f"{__name__}:{made.__name__}"))
    got = "nan" if np.isnan(paid) else "-inf" if paid < 0 else "inf"
    says = rf"reward: expected finite values, got {got} at step \d+, copy [0-2], [abc]$"
    with pytest.raises(EnvironmentFailed, match=f"^lane 0, {says}"):
        collect(random_collector(run), run)
    with pytest.raises(EnvironmentFailed, match=f"^while the policy was evaluated: {says}"):
        evaluated(run, random_policy(run.policy), 3, 0)


class Summing(RandomGame):
    """Sums what agents got since they moved under the name that PettingZoo's base class has for it."""

    rewards_at_reset = 0.0

    @property
    def _cumulative_rewards(self) -> dict[str, float]:
        return self._cumulative


class SummingArrays(Summing):
    """Its sums are arrays of one number."""

    @property
    def _cumulative_rewards(self) -> dict[str, Any]:
        return {agent: np.full(1, total) for agent, total in self._cumulative.items()}


class SummingWords(Summing):
    """Its sums are no numbers."""

    @property
    def _cumulative_rewards(self) -> dict[str, Any]:
        return dict.fromkeys(self._cumulative, "much")


class SummingInWrapper(BaseWrapper):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__(Summing())

    def last(self, observe: bool = True) -> Any:
        return self.env.last(observe)


@pytest.mark.parametrize("made", [Summing, SummingArrays, SummingInWrapper])
def test_an_evaluation_that_is_cut_counts_what_waiting_seats_have_got(made: Any) -> None:
    run = msgspec.structs.replace(seated_run("turns", T=4, N=1), env=EnvSpec(f"{__name__}:{made.__name__}"))
    cut = 0
    for most_steps in (1, 2, 3, 5, 9):
        evaluator, seeds = Evaluator(run, random_policy(run.policy)), episode_seeds(most_steps, 12)
        rows: list[EpisodeRows] = []
        answer = evaluator.play(
            example(Evaluate, session=1, ticket=1, seeds=seeds, greedy=True, most_steps=most_steps, send_rows=True),
            rows.append,
            no_pulse,
        )
        copies = [env.env.unwrapped for env in evaluator._copies[None].envs]  # type: ignore[attr-defined]
        for n, (episode, env) in enumerate(zip(answer.episodes, copies, strict=True)):
            lived = env.told[-1]
            np.testing.assert_allclose(episode.facts, [lived[agent].total for agent in AGENTS], atol=1e-9)
            assert episode.reward == pytest.approx(sum(episode.facts), abs=1e-9)
            of_rows = sum(float(message.reward.sum()) for message in rows if message.episode == n)
            assert of_rows == pytest.approx(episode.reward, abs=1e-9)
        cut += sum(answer.cut)
        evaluator.close()
    assert cut > 20


def test_what_a_waiting_seat_has_got_must_be_a_number() -> None:
    run = msgspec.structs.replace(seated_run("turns", T=4, N=1), env=EnvSpec(f"{__name__}:{SummingWords.__name__}"))
    evaluator = Evaluator(run, random_policy(run.policy))
    order = example(Evaluate, session=1, ticket=1, seeds=episode_seeds(0, 12), greedy=True, most_steps=1)
    says = r"^while the policy was evaluated: copy \d+, step: reward of agent [abc]: expected a number, got 'much'$"
    with pytest.raises(EnvironmentFailed, match=says):
        evaluator.play(order, lambda rows: None, no_pulse)
