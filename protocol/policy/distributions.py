"""Action distributions in numpy, for workers. Pure: the noise is an argument.

A network's output is `params` [..., P]. The noise of a whole rollout is drawn in one call, so a step needs only an addition
and a comparison. The log-probabilities of a whole rollout are computed in one call from the stored params.

    Categorical   P = Σ sizes   logits; action = argmax(logits + Gumbel noise)               (Gumbel-max trick)
    Bernoulli     P = K         logits; action = logits + logistic noise > 0
    Gaussian      P = 2 D       mean, log standard deviation; action = mean + exp(log_std) · normal noise, not clipped
    Product       P = Σ Pᵢ      independent factors, whose params, noise and actions are concatenated

A mixed action has at most three factors, because a stored row has the choices of all its parts, then all bits, then all
numbers (`millrace.protocol.action_parts`).

The distributions of DQN, SAC and TD3, whose exploration depends on numbers that the learner sends, are in `exploration.py`.

`millrace.protocol.policy.torch_distributions` computes entropies and the same log-probabilities in torch; a test compares
the two.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from millrace.protocol.arrays import Array, Floats
from millrace.protocol.policy.exploration import LOG_SQRT_2PI, TINY, EpsilonGreedy, NoisyDeterministic, SquashedGaussian
from millrace.protocol.specs import PolicySpec


class Distribution(Protocol):
    """The interface of all distributions.

    Params are [..., P] float32, noise is [..., noise_size] float32, and actions are [..., *action].
    """

    params_size: int
    """P"""

    def noise(self, generator: np.random.Generator, shape: tuple[int, ...]) -> Floats:
        """Draw noise [*shape, noise_size] for `sample`."""
        ...

    def sample(self, params: Floats, noise: Floats) -> Array:
        """Sample an action. The result is a deterministic function of `params` and `noise`."""
        ...

    def mode(self, params: Floats) -> Array:
        """The most probable action."""
        ...

    def log_prob(self, params: Floats, action: Array, noise: Floats | None = None) -> Floats:
        """Log-probability [...] of an action that was sampled with this noise."""
        ...


class Categorical:
    """A categorical distribution (Discrete), or several independent ones (MultiDiscrete)."""

    def __init__(self, sizes: tuple[int, ...], shape: tuple[int, ...]) -> None:
        self.params_size = self.noise_size = sum(sizes)
        self._shape = shape
        ends = np.cumsum(sizes).tolist()
        self._parts = [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]

    def noise(self, generator: np.random.Generator, shape: tuple[int, ...]) -> Floats:
        """Gumbel(0, 1) noise [*shape, P]."""
        exponential = generator.standard_exponential((*shape, self.params_size), dtype=np.float32)
        return -np.log(np.maximum(exponential, TINY))

    def sample(self, params: Floats, noise: Floats) -> Array:
        """Sampled choices, int64, counting from 0."""
        return self.mode(params + noise)

    def mode(self, params: Floats) -> Array:
        """The most probable choice."""
        if not self._shape:
            return np.asarray(params.argmax(-1))
        chosen = np.stack([params[..., part].argmax(-1) for part in self._parts], -1)
        return chosen.reshape(*params.shape[:-1], *self._shape)

    def log_prob(self, params: Floats, action: Array, noise: Floats | None = None) -> Floats:
        """Log π(action) [...]: summed over the entries of a MultiDiscrete."""
        flat = action.reshape(*params.shape[:-1], len(self._parts)).astype(np.int64, copy=False)
        total = np.zeros(params.shape[:-1], np.float32)
        for i, part in enumerate(self._parts):
            logits = params[..., part]
            shifted = logits - logits.max(-1, keepdims=True)
            chosen = np.take_along_axis(shifted, flat[..., i : i + 1], -1)[..., 0]
            total += chosen - np.log(np.exp(shifted).sum(-1))
        return total


class Bernoulli:
    """Independent bits (MultiBinary)."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.params_size = self.noise_size = math.prod(shape)
        self._shape = shape

    def noise(self, generator: np.random.Generator, shape: tuple[int, ...]) -> Floats:
        """Logistic(0, 1) noise [*shape, K]."""
        uniform = generator.random((*shape, self.params_size), dtype=np.float32)
        uniform = np.clip(uniform, np.float32(1e-7), np.float32(1 - 1e-7))
        return np.log(uniform) - np.log1p(-uniform)

    def sample(self, params: Floats, noise: Floats) -> Array:
        """Sampled bits, int64."""
        return self.mode(params + noise)

    def mode(self, params: Floats) -> Array:
        """The most probable bits."""
        return (params > 0).astype(np.int64).reshape(*params.shape[:-1], *self._shape)

    def log_prob(self, params: Floats, action: Array, noise: Floats | None = None) -> Floats:
        """Log π(action) [...], summed over the bits: −softplus(−logit) for 1, −softplus(logit) for 0."""
        signed = np.where(action.reshape(params.shape) > 0, params, -params)
        return np.asarray(-np.logaddexp(np.float32(0), -signed).sum(-1))


class Gaussian:
    """A diagonal normal distribution (Box). Actions are stored as sampled; only the action converter clips them."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._size = self.noise_size = math.prod(shape)
        self.params_size = 2 * self._size
        self._shape = shape

    def noise(self, generator: np.random.Generator, shape: tuple[int, ...]) -> Floats:
        """Normal(0, 1) noise [*shape, D]."""
        return generator.standard_normal((*shape, self._size), dtype=np.float32)

    def sample(self, params: Floats, noise: Floats) -> Array:
        """A sample, float32."""
        drawn = params[..., : self._size] + np.exp(params[..., self._size :]) * noise
        return drawn.reshape(*params.shape[:-1], *self._shape)

    def mode(self, params: Floats) -> Array:
        """The mean."""
        return params[..., : self._size].reshape(*params.shape[:-1], *self._shape)

    def log_prob(self, params: Floats, action: Array, noise: Floats | None = None) -> Floats:
        """Log π(action) [...], summed over dimensions: −½ z² − log σ − ½ log 2π."""
        mean = params[..., : self._size]
        log_std = params[..., self._size :]
        z = (action.reshape(mean.shape) - mean) * np.exp(-log_std)
        return np.asarray((np.float32(-0.5) * z * z - log_std - np.float32(LOG_SQRT_2PI)).sum(-1))


class Factor(NamedTuple):
    """A factor of a product, and the slice of the last axis of params, noise and actions that belongs to it."""

    distribution: Categorical | Bernoulli | Gaussian
    params: slice
    noise: slice
    action: slice


class Product:
    """A product of independent distributions, whose actions are concatenated to one row [D] float32 (Dict, Tuple)."""

    def __init__(self, factors: Sequence[tuple[Categorical | Bernoulli | Gaussian, int]]) -> None:
        """`factors` has pairs of a distribution and the size of its actions."""
        self._factors: list[Factor] = []
        self.params_size = noise_size = size = 0
        for factor, count in factors:
            params = slice(self.params_size, self.params_size + factor.params_size)
            noise = slice(noise_size, noise_size + factor.noise_size)
            action = slice(size, size + count)
            self._factors.append(Factor(factor, params, noise, action))
            self.params_size = params.stop
            noise_size = noise.stop
            size = action.stop

    def noise(self, generator: np.random.Generator, shape: tuple[int, ...]) -> Floats:
        """The noise of all factors, concatenated: [*shape, noise_size]."""
        return np.concatenate([factor.distribution.noise(generator, shape) for factor in self._factors], -1)

    def sample(self, params: Floats, noise: Floats) -> Array:
        """A sample of each factor, concatenated: [..., D] float32."""
        return self._row(
            each.distribution.sample(params[..., each.params], noise[..., each.noise]) for each in self._factors
        )

    def mode(self, params: Floats) -> Array:
        """The most probable action of each factor, concatenated: [..., D] float32."""
        return self._row(each.distribution.mode(params[..., each.params]) for each in self._factors)

    def log_prob(self, params: Floats, action: Array, noise: Floats | None = None) -> Floats:
        """Log π(action) [...], the sum over the factors."""
        total = np.zeros(params.shape[:-1], np.float32)
        for each in self._factors:
            total += each.distribution.log_prob(params[..., each.params], action[..., each.action])
        return total

    @staticmethod
    def _row(actions: Iterable[Array]) -> Array:
        return np.concatenate([action.astype(np.float32, copy=False) for action in actions], -1)


def distribution(spec: PolicySpec) -> Distribution:
    """The action distribution of this policy."""
    action = spec.action
    if spec.head == "q":
        return EpsilonGreedy(action.sizes[0])
    if spec.head == "squashed":
        return SquashedGaussian(action.shape)
    if spec.head == "deterministic":
        return NoisyDeterministic(action.shape)
    match action.kind:
        case "discrete" | "multidiscrete":
            return Categorical(action.sizes, action.shape)
        case "multibinary":
            return Bernoulli(action.shape)
        case "box":
            return Gaussian(action.shape)
        case "mixed":
            entries = len(action.sizes)
            factors = (
                (Categorical(action.sizes, (entries,)), entries),
                (Bernoulli((action.bits,)), action.bits),
                (Gaussian((action.numbers,)), action.numbers),
            )
            return Product([(factor, size) for factor, size in factors if size])
