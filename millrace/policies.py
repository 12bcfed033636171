"""The policies that workers can act with: the classes with which you choose a policy, and the layout of its flat parameters.

A policy here is only the acting part: it maps an observation to a distribution over actions. Anything else that a learner
trains, such as a critic, is up to the learner. Imports no torch.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol

import msgspec
import numpy as np

from millrace.arguments import checked
from millrace.protocol.arrays import Array, Floats
from millrace.protocol.errors import UsageError, check_at_least
from millrace.protocol.policy.layout import Field, acting_size, buffer_layout, named_views, parameter_layout, total_size
from millrace.protocol.random_streams import Purpose, generator
from millrace.protocol.specs import ActionSpec, ExtraArray, Leaf, PolicySpec

Activation = Literal["tanh", "relu"]
Core = Literal["lstm", "gru"]


class PolicyChoice(Protocol):
    """`MLP`, `CNN`, `Recurrent` or `OwnPolicy`: settings from which a policy is made once the spaces are known."""

    @property
    def extra_arrays(self) -> tuple[ExtraArray, ...]:
        """Further arrays that the policy returns with its actions."""
        ...

    def spec(self, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        """The specification of the policy for these spaces. Raises `UsageError` if it can't be used with them."""
        ...


@dataclass(frozen=True, init=False)
class MLP:
    """A policy with fully connected hidden layers and a linear output: `MLP(64, 64)`.

    Images in the observation first pass through convolutions, as they do in `CNN`.

    >>> import millrace
    >>> with millrace.RolloutService("CartPole-v1", millrace.MLP(32), workers=1, envs=2, lanes=1) as service:
    ...     [(piece.name, piece.shape) for piece in service.policy.layout if "weight" in piece.name]
    [('actor.0.weight', (32, 4)), ('actor.out.weight', (2, 32))]
    """

    net: tuple[int, ...]
    """widths of the hidden layers"""
    activation: Activation
    normalize_observations: bool
    """subtract a mean from observations, divide by a standard deviation, and clip to ±10; both are published as buffers"""

    @checked
    def __init__(self, *net: int, activation: Activation = "tanh", normalize_observations: bool = False) -> None:
        object.__setattr__(self, "net", net or (64, 64))
        object.__setattr__(self, "activation", activation)
        object.__setattr__(self, "normalize_observations", normalize_observations)

    @property
    def extra_arrays(self) -> tuple[ExtraArray, ...]:
        """Empty: a batch always has the log-probabilities of this policy."""
        return ()

    def spec(self, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        """The specification of the policy for these spaces. Raises `UsageError` if a width isn't positive."""
        if not all(width > 0 for width in self.net):
            raise UsageError(f"policy: expected widths of hidden layers, as in MLP(64, 64), got {self.net}")
        return PolicySpec(
            observation,
            action,
            net=self.net,
            activation=self.activation,
            normalize_observations=self.normalize_observations,
        )


@dataclass(frozen=True, init=False)
class CNN(MLP):
    """A policy with convolutions for images, followed by hidden layers: `CNN(512)`.

    Large images get the convolutions of Mnih et al. (2015), small images two 3 x 3 convolutions.

    >>> import millrace
    >>> millrace.CNN(128).net
    (128,)
    """

    @checked
    def __init__(self, *net: int, activation: Activation = "relu", normalize_observations: bool = False) -> None:
        super().__init__(*(net or (512,)), activation=activation, normalize_observations=normalize_observations)

    def spec(self, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        """The specification of the policy for these spaces. Raises `UsageError` if the observation has no image."""
        found = super().spec(observation, action)
        if not found.convolves:
            shapes = ", ".join(f"{leaf.dtype}{list(leaf.shape)}" for leaf in observation)
            raise UsageError(f"policy CNN: expected an image (uint8, three dimensions, sides of 5 or more), got {shapes}")
        return found


@dataclass(frozen=True, init=False)
class Recurrent(MLP):
    """A policy with a recurrent core, followed by hidden layers: `Recurrent(64, core="lstm", core_size=64)`.

    `RolloutBatch.state` is the state of the core before the batch's first row.

    >>> import millrace
    >>> policy = millrace.Recurrent(32, core="gru", core_size=16)
    >>> with millrace.RolloutService("CartPole-v1", policy, workers=1, envs=2, lanes=1, rollout_steps=8) as service:
    ...     _ = service.publish(service.policy.initial())
    ...     service.gather().state.shape
    (2, 16)
    """

    core: Core
    core_size: int
    """number of units in the core"""

    @checked
    def __init__(
        self,
        *net: int,
        core: Core = "lstm",
        core_size: int = 64,
        activation: Activation = "tanh",
        normalize_observations: bool = False,
    ) -> None:
        super().__init__(*(net or (64,)), activation=activation, normalize_observations=normalize_observations)
        object.__setattr__(self, "core", core)
        object.__setattr__(self, "core_size", core_size)

    def spec(self, observation: tuple[Leaf, ...], action: ActionSpec) -> PolicySpec:
        """The specification of the policy for these spaces. Raises `UsageError` if `core_size` is below 1."""
        check_at_least("policy: core_size", self.core_size, 1)
        return msgspec.structs.replace(super().spec(observation, action), core=self.core, core_size=self.core_size)


class Piece(NamedTuple):
    """One array of the flat parameter vector: `flat[offset : offset + size].reshape(shape)`.

    >>> import millrace
    >>> piece = millrace.Piece("actor.0.weight", shape=(64, 4), offset=0, gain=1.4)
    >>> piece.size
    256
    """

    name: str
    """such as `actor.0.weight`; weights have shape [outputs, inputs]"""
    shape: tuple[int, ...]
    offset: int
    gain: float
    """gain of the orthogonal initialization; 0: initialized to zero"""

    @property
    def size(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)


class PolicyParameters:
    """The parameters of a policy: names, shapes and offsets in the flat float32 vector, and initial values.

    >>> import millrace
    >>> parameters = millrace.PolicyParameters(millrace.load(run).spec)
    >>> parameters.size == sum(piece.size for piece in parameters.layout)
    True
    """

    def __init__(self, spec: PolicySpec) -> None:
        self.spec = spec
        """The policy as plain data."""
        self.size = acting_size(spec)
        """P, the length of the flat vector."""
        self._fields = parameter_layout(spec)[0]
        self._buffer_fields = buffer_layout(spec)
        self.layout = _pieces(self._fields)
        """The pieces of the flat vector, in order."""
        self.buffers = _pieces(self._buffer_fields)
        """The pieces of the buffers: `observation_mean` and `observation_std` if observations are normalized."""

    @checked
    def initial(self, seed: int = 1) -> Floats:
        """Initial parameters [P] float32: orthogonal weights, scaled by the gains in `layout`, and zero biases.

        Raises `UsageError` for an `OwnPolicy`, because only you know its initial values.

        >>> import millrace
        >>> parameters = millrace.PolicyParameters(millrace.load(run).spec)
        >>> parameters.initial(seed=3).shape == (parameters.size,)
        True
        """
        check_at_least("initial: seed", seed, 0)
        if self.spec.own is not None:
            raise UsageError(f"policy {self.spec.own.factory}: expected your own initial values; publish them")
        drawn = generator(seed, Purpose.WEIGHTS)
        flat = np.zeros(self.size, np.float32)
        for piece in self.layout:
            if piece.gain:
                rows = piece.shape[0]
                columns = math.prod(piece.shape[1:])
                normal = drawn.standard_normal((max(rows, columns), min(rows, columns)))
                q, r = np.linalg.qr(normal)
                q = q * np.sign(np.diag(r))
                weight = piece.gain * (q if rows >= columns else q.T)
                flat[piece.offset : piece.offset + piece.size] = weight.ravel()
        return flat

    def named(self, flat: Floats) -> dict[str, Array]:
        """Views of the pieces of a flat vector [P], by name.

        >>> import millrace
        >>> parameters = millrace.PolicyParameters(millrace.load(run).spec)
        >>> parameters.named(parameters.initial())["actor.out.bias"]
        array([0., 0.], dtype=float32)
        """
        return named_views(flat, self._fields)

    def flat(self, parameters: Mapping[str, Array] | Array) -> Floats:
        """A flat copy [P] float32 of a flat vector, or of arrays by name.

        Raises `UsageError` if an array is missing, has a wrong shape, or isn't finite.

        >>> import millrace
        >>> parameters = millrace.PolicyParameters(millrace.load(run).spec)
        >>> flat = parameters.initial()
        >>> bool((parameters.flat(parameters.named(flat)) == flat).all())
        True
        """
        return _flat(parameters, self._fields, "parameters")

    def flat_buffers(self, buffers: Mapping[str, Array] | Array | None) -> Floats:
        """A flat float32 copy of `buffers`, which may be flat or by name. None stands for mean 0 and standard deviation 1.

        Raises `UsageError` if an array is missing, has a wrong shape, or isn't finite.

        >>> import millrace
        >>> parameters = millrace.PolicyParameters(millrace.load(run).spec)
        >>> parameters.flat_buffers(None)
        array([], dtype=float32)
        """
        if buffers is None:
            buffers = {
                field.name: np.full(field.shape, 1.0 if field.name.endswith("std") else 0.0) for field in self._buffer_fields
            }
        return _flat(buffers, self._buffer_fields, "buffers")


def _pieces(fields: tuple[Field, ...]) -> tuple[Piece, ...]:
    pieces = []
    offset = 0
    for field in fields:
        pieces.append(Piece(field.name, field.shape, offset, field.gain))
        offset += math.prod(field.shape)
    return tuple(pieces)


def _flat(given: Mapping[str, Array] | Array, fields: tuple[Field, ...], what: str) -> Floats:
    flat = np.empty(total_size(fields), np.float32)
    if isinstance(given, Mapping):
        names = [field.name for field in fields]
        if missing := [name for name in names if name not in given]:
            raise UsageError(f"{what}: expected {', '.join(names)}; {missing[0]} is missing")
        for name, view in named_views(flat, fields).items():
            array = _numbers(given[name], f"{what}: {name}")
            if array.shape != view.shape:
                raise UsageError(f"{what}: {name}: expected shape {list(view.shape)}, got {list(array.shape)}")
            view[...] = array
    else:
        array = _numbers(given, what)
        if array.shape != flat.shape:
            raise UsageError(f"{what}: expected a vector of {len(flat)} numbers, got shape {list(array.shape)}")
        flat[:] = array
    if not np.isfinite(flat).all():
        raise UsageError(f"{what}: expected finite numbers, got NaN or infinity; they were not published")
    return flat


def _numbers(value: Any, what: str) -> Floats:
    """The value as a float32 array, in which too large a number becomes infinite. Raises `UsageError` unless it is real."""
    try:
        array = np.asarray(value)
    except ValueError:  # raised for rows of different lengths
        array = np.asarray(None)
    if not np.can_cast(array.dtype, np.float32, "same_kind"):
        raise UsageError(f"{what}: expected real numbers, got an array of {array.dtype}")
    with np.errstate(over="ignore"):
        return array.astype(np.float32, copy=False)
