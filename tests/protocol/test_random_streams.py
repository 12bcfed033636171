"""Random streams: no two of one seed coincide, of those that real parts of a run make, and none is an environment's."""

from __future__ import annotations

from copy import deepcopy
from itertools import islice
from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import nn

from millrace.extras.datasets.played_episodes import recording_seeds
from millrace.learner.algorithms.ppo import PPO
from millrace.learner.algorithms.replay.mixed_replay import MixedReplay
from millrace.learner.algorithms.sac import SAC
from millrace.learner.config.hyperparameters import PPOConfig, SACConfig
from millrace.learner.rollouts.evaluation_dealer import episode_seeds
from millrace.learner.vector_env.lost_lanes import replacement_seeds
from millrace.protocol.messages import Evaluate, Permit
from millrace.protocol.policy.called_policy import Acted, CalledPolicy
from millrace.protocol.policy.own_encoder import describe_encoder
from millrace.protocol.policy.policy import make_policy
from millrace.protocol.random_streams import Purpose, RoundStreams, env_seed, generator, torch_seed
from millrace.protocol.specs import PolicySpec
from millrace.workers.collect.collector import Collector
from millrace.workers.evaluate.evaluator import Evaluator
from tests.support.conversation.example_messages import example
from tests.support.in_process.collectors import no_pulse, run_around, with_env
from tests.support.numbers.batches import BOX, DISCRETE, GAUSSIAN

DRAWS, STEPS = 64, 4_000


def draws(of: np.random.Generator) -> list[int]:
    """The next numbers of a stream, which goes on as if they had not been drawn."""
    return [int(each) for each in deepcopy(of).bit_generator.random_raw(DRAWS)]


def torch_draws(state: torch.Tensor) -> list[int]:
    """The next numbers of a generator of PyTorch in this state."""
    copy = torch.Generator()
    copy.set_state(state)
    return torch.randint(2**63 - 1, (DRAWS,), generator=copy).tolist()


def of_environment(seed: int) -> list[int]:
    return draws(gymnasium.utils.seeding.np_random(seed)[0])


def assert_none_coincide(streams: dict[str, list[int]]) -> None:
    """No number is in two streams, so none is a part of another either. By chance: below 1e-12."""
    seen: dict[int, str] = {}
    for name, numbers in streams.items():
        for number in numbers:
            assert number not in seen, f"{name} and {seen[number]} have the draw {number}"
            seen[number] = name


@pytest.mark.parametrize("seed", [0, 1, 2**64 - 1])
def test_no_two_purposes_or_indices_of_a_seed_have_the_same_stream(seed: int) -> None:
    streams = {"seed": of_environment(seed)}
    of_torch = {"seed": torch_draws(torch.Generator().manual_seed(seed).get_state())}
    for purpose in Purpose:
        of_torch[purpose.name] = torch_draws(torch.Generator().manual_seed(torch_seed(seed, purpose)).get_state())
        for indices in ((), (0,), (1,), (0, 0), (0, 1), (1, 0), (0, 0, 0), (0, 0, 1)):
            streams[f"{purpose.name} {indices}"] = draws(generator(seed, purpose, *indices))
            streams[f"environment {purpose.name} {indices}"] = of_environment(env_seed(seed, purpose, *indices))
    assert_none_coincide(streams)
    assert_none_coincide(of_torch)


class Coin(gymnasium.Env[Any, Any]):
    """Tosses a coin at each step; the reward is 1 if the action is its side. Episodes do not end."""

    observation_space = spaces.Box(-1, 1, (1,), np.float32)
    action_space = spaces.Discrete(2)
    began: list[list[int]] = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        Coin.began.append(draws(self.np_random))
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return np.zeros(1, np.float32), float(action == (self.np_random.random() < 0.5)), False, False, {}


gymnasium.register("millrace-tests/StreamsCoin-v0", entry_point=lambda **kwargs: Coin(**kwargs))
COIN = with_env(run_around(Coin(), T=4), "millrace-tests/StreamsCoin-v0")


class RandomGuess(CalledPolicy):
    """A user's policy that tosses a coin of its own, and keeps what it would have drawn from the first generators."""

    def __init__(self) -> None:
        self.streams: list[list[int]] = []

    def act(self, leaves: Any, state: Any, rng: np.random.Generator, **keywords: Any) -> Acted:
        if len(self.streams) < 16:
            self.streams.append(draws(rng))
        return Acted((rng.random(len(state)) < 0.5).astype(np.int64), state, (np.zeros(len(state), np.float32),))


EXPLORES = PolicySpec(COIN.policy.observation, COIN.policy.action, (), head="q")
"""DQN's policy: one number of its buffers is epsilon."""


@pytest.mark.parametrize("own", [False, True])
def test_sampled_actions_agree_with_a_coin_of_the_environment_in_half_of_the_steps(own: bool) -> None:
    policy = RandomGuess() if own else make_policy(EXPLORES)
    if not own:
        policy.load(np.array([1, 0, 0, 0], np.float32), np.ones(1, np.float32))
    evaluator = Evaluator(msgspec.structs.replace(COIN, policy=COIN.policy if own else EXPLORES), policy)
    order = example(Evaluate, session=3, ticket=70, seeds=(7,), most_steps=STEPS)
    (episode,) = evaluator.play(order, lambda rows: None, no_pulse).episodes
    assert abs(episode.reward - STEPS / 2) < 5 * (STEPS / 4) ** 0.5  # the chance of more is below 1e-6


def test_no_two_generators_of_a_run_coincide(monkeypatch: pytest.MonkeyPatch) -> None:
    """All that one seed makes in the learner and in workers, each taken where it is used."""
    seed, streams = 7, {"seed": of_environment(7)}
    of_torch: dict[str, list[int]] = {}
    Coin.began.clear()

    guess = RandomGuess()
    collector = Collector(msgspec.structs.replace(COIN, seed=seed, copies=2), guess)
    for number in (0, 1):
        collector.collect([Permit(n, n, 0, number, number) for n in (0, 1)], 0, 3, no_pulse)
    streams |= {f"actions of lane {n}": guess.streams[at] for n, at in enumerate((0, 1, 8, 9))}
    (recorded, *_) = seeds = list(islice(recording_seeds(seed), 2))
    of_episodes = [episode_seeds(seed, 2, p) for p in (Purpose.EPISODES, Purpose.EVALUATION, Purpose.CONFIRMATION)]
    for played in ((seed,), (recorded,)):
        guess.streams.clear()
        Evaluator(COIN, guess).play(
            example(Evaluate, session=3, ticket=70, seeds=played, most_steps=1), lambda rows: None, no_pulse
        )
        streams[f"actions of the episode {played}"] = guess.streams[0]
    assert Coin.began.pop(-2) == streams["seed"]
    streams |= {f"env copy {n}": began for n, began in enumerate(Coin.began)}
    others = [
        *seeds[1:],
        *sum(of_episodes, ()),
        *filter(None, replacement_seeds((seed,), 1)),
        env_seed(seed, Purpose.SECOND_INSTANCE),
    ]
    streams |= {f"environment {n}": of_environment(each) for n, each in enumerate(others)}

    def initial(tensor: torch.Tensor, gain: float, of: torch.Generator) -> None:
        of_torch.setdefault("weights", torch_draws(of.get_state()))

    monkeypatch.setattr(torch.nn.init, "orthogonal_", initial)
    config = SACConfig()
    sac = SAC(config, SAC.policy_spec(config, (BOX,), GAUSSIAN.action), total_steps=100, seed=seed)
    assert isinstance(sac.replay, MixedReplay)
    sac.replay.add_prior([], 500, 0.5)
    assert sac.replay.prior is not None
    streams |= {"replay": draws(sac.replay.generator), "prior": draws(sac.replay.prior.generator)}
    factory = f"{__name__}:drawing_encoder"
    encoded = msgspec.structs.replace(DISCRETE, encoder=describe_encoder(factory, (BOX,), DISCRETE.action))
    ppo = PPO(PPOConfig(), encoded, total_steps=100, seed=seed)
    of_torch |= {
        "seed": torch_draws(torch.Generator().manual_seed(seed).get_state()),
        "noise": torch_draws(sac._generator.get_state()),
        "shuffles": torch_draws(ppo.generator.get_state()),
        "encoder": ENCODER_DRAWS[-1],
    }
    assert len(of_torch) == 5
    assert_none_coincide(streams)
    assert_none_coincide(of_torch)


ENCODER_DRAWS: list[list[int]] = []


def drawing_encoder(features: int, images: Any) -> nn.Module:
    """An encoder that keeps what it would draw."""
    ENCODER_DRAWS.append(torch_draws(torch.random.get_rng_state()))
    return nn.Linear(features, 4)


def test_the_stream_of_a_round_does_not_depend_on_the_rounds_before_and_shares_no_number_with_another() -> None:
    streams = RoundStreams(7, Purpose.ACTIONS, 3)
    drawn = {number: streams.of(number).integers(2**63, size=100).tolist() for number in (5, 0, 1, 2**40)}
    assert RoundStreams(7, Purpose.ACTIONS, 3).of(5).integers(2**63, size=100).tolist() == drawn[5]
    assert len({draw for of_round in drawn.values() for draw in of_round}) == 400
    half = streams.of(5)
    half.integers(2**31, dtype=np.uint32)  # leaves half of a number, which the next stream must not give
    assert streams.of(0).integers(2**31, dtype=np.uint32, size=3).tolist() == (
        RoundStreams(7, Purpose.ACTIONS, 3).of(0).integers(2**31, dtype=np.uint32, size=3).tolist()
    )
