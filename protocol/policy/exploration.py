"""How DQN, SAC and TD3 explore: ε-greedy actions, a squashed normal distribution, normal noise. Pure: noise is an argument.

As in `distributions.py`, a distribution has parameters `params` [..., P]. Here, the last parameters aren't outputs of the
network. The learner sends them with the weights, and they are the same for every observation. The learner therefore controls
how much workers explore, and workers need no schedule.

    EpsilonGreedy       P = n + 1     action values, ε
                                      action = uniform at random where noise₀ < ε, else argmax
    SquashedGaussian    P = 2 D + 1   mean, log standard deviation, warm-up
                                      action = tanh(mean + exp(log_std) · normal noise)
    NoisyDeterministic  P = D + 2     output, noise scale, warm-up
                                      action = tanh(output) + scale · normal noise, clipped to ±1

The warm-up number is 1 until `learning_starts`, then 0. While it is 1, both kinds of actions in [-1, 1] are drawn uniformly.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from millrace.protocol.arrays import Array, Floats

LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)
TINY = np.float32(1e-30)
"""lower bound for the argument of a logarithm"""


class ActionValues(NamedTuple):
    """The parameters of `EpsilonGreedy`."""

    values: Floats
    """[..., n] value of each action; `FORBIDDEN` where a mask forbids the action"""
    epsilon: Floats
    """[...] ε"""

    @staticmethod
    def of(params: Floats) -> ActionValues:
        """Views of `params` [..., n + 1]."""
        return ActionValues(params[..., :-1], params[..., -1])


class GreedyNoise(NamedTuple):
    """The noise of `EpsilonGreedy`: uniform numbers in [0, 1)."""

    whether: Floats
    """[...] a random action is chosen where this is less than ε"""
    which: Floats
    """[...] selects the random action"""

    @staticmethod
    def of(noise: Floats) -> GreedyNoise:
        """Views of `noise` [..., 2]."""
        return GreedyNoise(noise[..., 0], noise[..., 1])


class BoundedParams(NamedTuple):
    """The parameters of `SquashedGaussian` or `NoisyDeterministic`."""

    center: Floats
    """[..., D] the action without noise, before tanh"""
    spread: Floats
    """[..., D] log standard deviation of `SquashedGaussian`, or [..., 1] noise scale of `NoisyDeterministic`"""
    warm_up: Floats
    """[..., 1] above 0 during the warm-up"""


class BoundedNoise(NamedTuple):
    """The noise of `SquashedGaussian` or `NoisyDeterministic`."""

    normal: Floats
    """[..., D] standard normal"""
    uniform: Floats
    """[..., D] uniform in [-1, 1]: the actions during the warm-up"""


class EpsilonGreedy:
    """The action with the highest value, or, with probability ε, one drawn uniformly from all actions (Discrete)."""

    def __init__(self, actions: int) -> None:
        self.params_size = actions + 1
        self._actions = actions

    def noise(self, generator: np.random.Generator, shape: tuple[int, ...]) -> Floats:
        """Uniform(0, 1) noise [*shape, 2]: see `GreedyNoise`."""
        return generator.random((*shape, 2), dtype=np.float32)

    def sample(self, params: Floats, noise: Floats) -> Array:
        """Sampled actions, int64, counting from 0."""
        whether, which = GreedyNoise.of(noise)
        uniform = (which * self._actions).astype(np.int64)  # below n: float32 noise is at most 1 - 2**-24
        return np.where(whether < ActionValues.of(params).epsilon, uniform, self.mode(params))

    def mode(self, params: Floats) -> Array:
        """The action with the highest value."""
        return np.asarray(ActionValues.of(params).values.argmax(-1))

    def log_prob(self, params: Floats, action: Array, noise: Floats | None = None) -> Floats:
        """log(ε / n + (1 − ε) [action is the best]) [...], at least log 1e-30 ≈ −69.1."""
        epsilon = ActionValues.of(params).epsilon
        chance = epsilon / np.float32(self._actions) + (1 - epsilon) * (action == self.mode(params))
        return np.asarray(np.log(np.maximum(chance, TINY)), np.float32)


class _Bounded:
    """Base of the two distributions of actions in [-1, 1]. Noise is [..., 2 D]: D normal, then D uniform numbers."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._size = math.prod(shape)
        self._shape = shape

    def noise(self, generator: np.random.Generator, shape: tuple[int, ...]) -> Floats:
        """Normal(0, 1) and Uniform(-1, 1) noise [*shape, 2 D]."""
        noise = np.empty((*shape, 2 * self._size), np.float32)
        noise[..., : self._size] = generator.standard_normal((*shape, self._size), dtype=np.float32)
        noise[..., self._size :] = 2 * generator.random((*shape, self._size), dtype=np.float32) - 1
        return noise

    def mode(self, params: Floats) -> Array:
        """The action without noise: the hyperbolic tangent of the first D numbers."""
        return np.tanh(self._params(params).center).reshape(*params.shape[:-1], *self._shape)

    def _params(self, params: Floats) -> BoundedParams:
        """Views of `params` [..., P]."""
        return BoundedParams(params[..., : self._size], params[..., self._size : -1], params[..., -1:])

    def _noise(self, noise: Floats) -> BoundedNoise:
        """Views of `noise` [..., 2 D]."""
        return BoundedNoise(noise[..., : self._size], noise[..., self._size :])

    def _uniform_in_warm_up(self, warm_up: Floats, uniform: Floats, action: Floats) -> Array:
        """The action [..., D], or `uniform` where `warm_up` [..., 1] is above 0, in the shape of the action space."""
        chosen = np.where(warm_up > 0, uniform, action)
        return chosen.reshape(*action.shape[:-1], *self._shape)


class SquashedGaussian(_Bounded):
    """The hyperbolic tangent of a diagonal normal distribution (bounded Box). Actions are in [-1, 1]."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        super().__init__(shape)
        self.params_size = 2 * self._size + 1

    def sample(self, params: Floats, noise: Floats) -> Array:
        """A sample, float32."""
        mean, log_std, warm_up = self._params(params)
        normal, uniform = self._noise(noise)
        return self._uniform_in_warm_up(warm_up, uniform, np.tanh(mean + np.exp(log_std) * normal))

    def log_prob(self, params: Floats, action: Array, noise: Floats | None = None) -> Floats:
        """Log-density [...] of the action in [-1, 1]^D.

        This is the log-density of the normal distribution minus log(1 − tanh²), summed over dimensions; during the warm-up,
        it is −D log 2. It is computed from the noise, because an action near ±1 doesn't determine the normal sample that
        produced it. Raises `ValueError` if there is no noise.
        """
        if noise is None:
            raise ValueError("log_prob of a squashed action: expected the noise that it was sampled with, got none")
        mean, log_std, warm_up = self._params(params)
        z = self._noise(noise).normal
        normal = np.float32(-0.5) * z * z - log_std - np.float32(LOG_SQRT_2PI)
        before_tanh: Floats = np.asarray(mean + np.exp(log_std) * z)
        squashed = (normal - log_tanh_derivative(before_tanh)).sum(-1)
        return np.where(warm_up[..., 0] > 0, np.float32(-self._size * math.log(2)), squashed)


class NoisyDeterministic(_Bounded):
    """One action for each observation, plus normal noise for exploration (bounded Box). Actions are in [-1, 1]."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        super().__init__(shape)
        self.params_size = self._size + 2

    def sample(self, params: Floats, noise: Floats) -> Array:
        """The action with noise, clipped to ±1, float32."""
        output, scale, warm_up = self._params(params)
        normal, uniform = self._noise(noise)
        return self._uniform_in_warm_up(warm_up, uniform, np.clip(np.tanh(output) + scale * normal, -1, 1))

    def log_prob(self, params: Floats, action: Array, noise: Floats | None = None) -> Floats:
        """Zeros [...], because clipped noise has no density."""
        return np.zeros(params.shape[:-1], np.float32)


def log_tanh_derivative(x: Floats) -> Floats:
    """Log(1 − tanh²(x)), computed as 2 (log 2 − x − softplus(−2x)), which is numerically stable for every x."""
    return np.asarray(2 * (np.float32(math.log(2)) - x - np.logaddexp(np.float32(0), -2 * x)))
