"""All random streams: each is derived from a seed and its purpose. Pure; imports no torch.

Law: no two streams of a seed share both purpose and indices, and none is the stream of the seed itself, because purpose and
indices form the spawn key of numpy's `SeedSequence`. gymnasium's environments draw from the seed itself (`np_random`), so
the random numbers that choose actions, or rows to learn from, are independent of the environment's, even if both have the
same seed.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class Purpose(IntEnum):
    """The purpose of a stream. The text below each purpose says what is drawn from it and, after a semicolon, its indices.

    The numbers determine the bits of every run, so a new purpose gets a new number.
    """

    WEIGHTS = 1
    """initial weights, except those of an encoder"""
    ENCODER = 2
    """initial weights of an encoder, drawn by PyTorch's global generator"""
    SHUFFLES = 3
    """the rows of each minibatch"""
    NOISE = 4
    """noise of SAC's actions and TD3's target actions in a gradient step"""
    REPLAY = 5
    """the rows sampled from a replay buffer"""
    PRIOR = 6
    """the rows sampled from a dataset of prior data"""
    COPIES = 7
    """reset seeds of env copies; lane, number of the start, copy"""
    ACTIONS = 8
    """actions of rollouts, including exploration; lane, and within it a stream for each round"""
    EVALUATION = 9
    """reset seeds of a run's evaluations; episode"""
    CONFIRMATION = 10
    """reset seeds of the evaluation of the best policy; episode"""
    EPISODES = 11
    """reset seeds of `millrace evaluate` and `RolloutService.evaluate`; episode"""
    RECORDING = 12
    """reset seeds of a recording; episode"""
    PLAYED_ACTIONS = 13
    """actions of a played episode, derived from the episode's reset seed; also actions of a loaded policy"""
    REPLACEMENT = 14
    """reset seed of an env copy that replaces a lost one, derived from the lost one's seed; incarnation"""
    SECOND_INSTANCE = 15
    """reset seed of the second instance of `ResetAhead`, derived from that of the first"""
    CLONING = 16
    """the order of demonstrations; epoch"""
    OPPONENTS = 17
    """actions of opponents; lane, round"""
    MATCHES = 18
    """the opponent of a rollout; lane, round"""
    PLAYED_OPPONENTS = 19
    """actions of opponents in a played episode, derived from the episode's reset seed"""
    ROUNDS = 20
    """durations of the rounds that `millrace plan` simulates"""


def generator(seed: int, purpose: Purpose, *indices: int) -> np.random.Generator:
    """A numpy generator for the stream of this seed, purpose and indices."""
    return np.random.default_rng(_sequence(seed, purpose, indices))


class RoundStreams:
    """One stream for each round: the stream of round r begins 2**64 · r draws after that of round 0 (the period is 2**128).

    This is several times faster than `generator`. The streams share one generator, so draw only from the newest stream.
    """

    def __init__(self, seed: int, purpose: Purpose, *indices: int) -> None:
        self._bits = np.random.PCG64(_sequence(seed, purpose, indices))
        self._generator = np.random.Generator(self._bits)
        self._first = self._bits.state

    def of(self, number: int) -> np.random.Generator:
        """The stream of this round."""
        self._bits.state = self._first
        self._bits.advance(number << 64)
        return self._generator


def env_seed(seed: int, purpose: Purpose, *indices: int) -> int:
    """A reset seed of 31 bits, because environments pass seeds to C. Different indices almost never give the same seed."""
    return int(_sequence(seed, purpose, indices).generate_state(1)[0] >> 1)


def torch_seed(seed: int, purpose: Purpose) -> int:
    """A seed of 63 bits for PyTorch's `manual_seed`."""
    return int(_sequence(seed, purpose, ()).generate_state(1, np.uint64)[0] >> 1)


def _sequence(seed: int, purpose: Purpose, indices: tuple[int, ...]) -> np.random.SeedSequence:
    return np.random.SeedSequence(seed, spawn_key=(purpose, *indices))
