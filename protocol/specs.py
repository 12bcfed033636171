"""Plain data that describe a run: its spaces, its policy, and how much to collect. They are sent in `Welcome`."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Literal

import msgspec
import numpy as np

from millrace.protocol.bounds import MAX_FACTS, MAX_NAME, one_line
from millrace.protocol.call_timeouts import CallTimeouts
from millrace.protocol.env_spec import AllowedCode, EnvSpec, PickledCallable, Scalar
from millrace.protocol.policy.heads import HEADS
from millrace.protocol.space_spec import Shape
from millrace.protocol.wire.weight_dtypes import ActingDtype

WIDE_DTYPES = frozenset({"float64", "int32", "uint32", "int64", "uint64"})  # more precise than float32's 24 bits
MIN_IMAGE_SIDE = 5  # pixels: room for a 3 x 3 convolution, and then for one with stride 2
HEARTBEAT_S = 1.0  # seconds between two heartbeats of a worker, unless the learner wants them more often


class Leaf(msgspec.Struct, frozen=True):
    """One array of an observation. A Dict or Tuple observation has several."""

    path: str
    """position of the array in the observation, such as `camera/left`; empty if the observation is one array"""
    kind: Literal["box", "discrete", "multidiscrete", "multibinary"]
    shape: Shape
    dtype: str
    """numpy's name for the stored dtype, such as `float32`"""
    sizes: tuple[int, ...] = ()
    """how many values each entry can take (discrete, multidiscrete)"""
    start: tuple[int, ...] = ()
    """the smallest value of each entry (discrete, multidiscrete)"""
    divisor: Literal[1, 255] = 1
    """each value is divided by this before a network gets it: 255 for a Box of bytes (uint8) whose bounds are 0 and 255"""

    @property
    def name(self) -> str:
        """The name of the array in errors."""
        return f"observation {self.path}".strip()

    @property
    def is_wide(self) -> bool:
        """Whether this is a Box of numbers that float32 may not distinguish, such as times in seconds since 1970."""
        return self.kind == "box" and self.dtype in WIDE_DTYPES

    @property
    def is_image(self) -> bool:
        """Whether this is an image, which goes through convolutions: a three-dimensional array of bytes (uint8).

        If one of its sides is smaller than the convolutions need, it is not an image, and is flattened like any other array.
        """
        if self.kind != "box" or self.dtype != "uint8" or len(self.shape) != 3:
            return False
        return min(self.shape[:2] if self.has_channels_last else self.shape[1:]) >= MIN_IMAGE_SIDE

    @property
    def has_channels_last(self) -> bool:
        """Whether the channels are an image's last dimension. They are, unless it is larger than the first."""
        return self.shape[2] <= self.shape[0]


class ActionPart(msgspec.Struct, frozen=True):
    """One space inside a Dict or Tuple of actions."""

    path: tuple[str | int, ...]
    """position of the space: the key in each Dict and the index in each Tuple, from the outermost"""
    kind: Literal["discrete", "multidiscrete", "multibinary", "box"]
    shape: Shape
    dtype: str
    """dtype that the environment expects"""


def no_bound(dtype: str) -> float:
    """The size from which a bound of floats means "no bound"."""
    return min(float(np.finfo(kind).max) for kind in (dtype, "float32"))


class ActionSpec(msgspec.Struct, frozen=True):
    """The action space of the policy."""

    kind: Literal["discrete", "multidiscrete", "multibinary", "box", "mixed"]
    """the kind of gymnasium space; `mixed` is a Dict or Tuple of the others"""
    shape: Shape
    dtype: str
    """dtype that the environment expects; a Box action is stored as float32, unclipped or in [-1, 1] (`PolicySpec.head`). A
    mixed action is stored as a row [D] float32: the choices of all Discrete and MultiDiscrete parts, then the bits of all
    MultiBinary parts, then the numbers of all Box parts, each in the order of `parts`
    """
    sizes: tuple[int, ...] = ()
    """number of choices of each entry (discrete, multidiscrete, mixed); at most 2²⁴ in a mixed action, so that a float32
    represents each choice exactly
    """
    start: tuple[int, ...] = ()
    """the smallest value of each entry (discrete, multidiscrete, mixed): stored actions count from 0"""
    low: tuple[float, ...] = ()
    """lower bounds (box, mixed), flattened; -inf where unbounded"""
    high: tuple[float, ...] = ()
    """upper bounds (box, mixed), flattened"""
    parts: tuple[ActionPart, ...] = ()
    """the parts of a mixed action, in the order of the space"""

    @property
    def stored_dtype(self) -> str:
        """Dtype of `Rollout.action`."""
        return "float32" if self.kind in ("box", "mixed") else "int64"

    @property
    def in_words(self) -> str:
        """The name of the action in errors."""
        return "a Dict or Tuple" if self.kind == "mixed" else f"{self.kind}{list(self.shape)}"

    @property
    def choices(self) -> int:
        """Total number of choices of all entries, which is the number of their logits and the length of a mask."""
        return sum(self.sizes)

    @property
    def bits(self) -> int:
        """Number of bits (multibinary, mixed)."""
        return math.prod(self.shape) - len(self.sizes) - self.numbers

    @property
    def numbers(self) -> int:
        """Number of continuous elements (box, mixed); the policy has a standard deviation for each."""
        return len(self.low)

    @property
    def unbounded(self) -> tuple[float, float] | None:
        """The first pair of bounds (box) with one so large that it means "no bound"; None if there is no such pair."""
        if self.kind != "box":
            return None
        none = no_bound(self.dtype)
        return next(((low, high) for low, high in zip(self.low, self.high, strict=True) if max(-low, high) >= none), None)


class NamedShape(msgspec.Struct, frozen=True, array_like=True):
    """Name and shape of an array."""

    name: str
    """name of the array; for a parameter of a module, the one in torch's `named_parameters`"""
    shape: tuple[int, ...]
    """shape of the array"""


class EncoderSpec(msgspec.Struct, frozen=True):
    """A user-defined torch module that comes before all other layers; see `protocol/policy/own_encoder.py`."""

    factory: str
    """the callable that makes the module, such as `my_package.networks:encoder`"""
    arrays: tuple[NamedShape, ...]
    """the module's parameters, in its own order"""
    size: int
    """number of features that the module returns"""


class OwnPolicySpec(msgspec.Struct, frozen=True):
    """A user-defined policy, which acts in the workers; see `protocol/policy/called_policy.py`."""

    factory: str
    """the callable that makes the policy, such as `my_package.policies:make`; with `code`, only the callable's name"""
    arrays: tuple[NamedShape, ...]
    """the policy's parameters, in the order of the flat vector"""
    kwargs: dict[str, Scalar] = {}
    """keyword arguments of the callable"""
    state_size: int = 0
    """S, the size of the state of one env copy"""
    has_log_prob: bool = False
    """whether the policy returns log-probabilities of its actions; if not, `Rollout.log_prob` is zeros"""
    code: PickledCallable | None = None
    """the callable, pickled by cloudpickle"""


class PolicySpec(msgspec.Struct, frozen=True):
    """A policy as plain data: enough to act in numpy (workers) and to learn in torch (learner)."""

    observation: tuple[Leaf, ...]
    action: ActionSpec
    net: tuple[int, ...] = (64, 64)
    """widths of the hidden layers of the actor and of the critic, or of the Q-network"""
    activation: Literal["tanh", "relu"] = "tanh"
    normalize_observations: bool = False
    """whether to subtract the running mean from observations, divide them by the running standard deviation, and clip them
    to ±10 (not images)"""
    head: Literal["actor_critic", "q", "squashed", "deterministic"] = "actor_critic"
    """the outputs. `actor_critic`: a distribution over actions, and a state value. `q`: the value of every discrete action,
    for epsilon-greedy acting. `squashed` and `deterministic`: an actor with two critics, for a bounded Box. Its action is a
    squashed Gaussian (tanh), or deterministic (tanh) plus noise. These actions are stored in [-1, 1] and scaled to low …
    high for the environment
    """
    shared_net: bool = False
    """whether actor and critic share their hidden layers"""
    dueling: bool = False
    """whether to use the dueling architecture: action values from a state value and advantages (Wang et al. 2016)"""
    encoder: EncoderSpec | None = None
    """a user-defined module; null: images go through convolutions, and other arrays are used directly"""
    core: Literal["lstm", "gru"] | None = None
    """the recurrent core between the features and the hidden layers; null: a policy without memory"""
    core_size: int = 64
    """number of units of the core"""
    own: OwnPolicySpec | None = None
    """a user-defined policy, which replaces everything that the fields after `action` describe"""
    critic: tuple[Leaf, ...] = ()
    """further arrays of an observation, which only the critic sees; in rows, they come after the others"""

    @property
    def seen(self) -> tuple[Leaf, ...]:
        """All arrays of an observation that rows contain."""
        return (*self.observation, *self.critic)

    @property
    def critic_keys(self) -> tuple[str, ...]:
        """The keys of a Dict observation that only the critic sees."""
        return tuple(dict.fromkeys(leaf.path.partition("/")[0] for leaf in self.critic))

    @property
    def state_size(self) -> int:
        """S, the size of the recurrent state of one env copy; 0 without a core."""
        if self.own is not None:
            return self.own.state_size
        return 0 if self.core is None else self.core_size * (2 if self.core == "lstm" else 1)

    @property
    def stores_scaled_actions(self) -> bool:
        """True if stored actions are in [-1, 1], and -1 and 1 stand for the bounds of the Box."""
        return self.own is None and HEADS[self.head].stores_scaled_actions

    @property
    def needs_torch(self) -> bool:
        """True for policies with images (convolutions) or an encoder. Every other policy acts in numpy."""
        return self.own is None and (self.encoder is not None or self.convolves)

    @property
    def has_encoder_layers(self) -> bool:
        """True if layers come before the hidden layers: convolutions, an encoder or a core."""
        return self.needs_torch or (self.own is None and self.core is not None)

    @property
    def convolves(self) -> bool:
        """True if images go through the built-in convolutions."""
        return self.own is None and self.encoder is None and any(leaf.is_image for leaf in self.observation)


class ExtraArray(msgspec.Struct, frozen=True, array_like=True):
    """An additional array of a rollout, [T, N, *shape]."""

    name: str
    shape: tuple[int, ...]
    dtype: str


class SessionTerms(msgspec.Struct, frozen=True, kw_only=True):
    """What each worker of a learner must follow, whatever it does in its session. Every spec contains these fields.

    `learner_timeout_s` isn't one of them, because it depends on how long the learner may read no messages meanwhile.
    """

    call_timeouts: CallTimeouts = CallTimeouts()
    """how long a call to user code may take before the worker is ended by its supervisor, if it has one"""
    heartbeat_s: float = HEARTBEAT_S


def session_terms(call_timeouts: CallTimeouts, worker_timeout_s: float) -> SessionTerms:
    """The terms of workers that count as lost if they are silent for `worker_timeout_s`.

    Heartbeats are so frequent that a worker doesn't count as silent if some arrive late.
    """
    return SessionTerms(call_timeouts=call_timeouts, heartbeat_s=min(HEARTBEAT_S, worker_timeout_s / 5))


class WaitSpec(SessionTerms, frozen=True, tag=True):
    """The run has not begun, because the learner does not know the environment yet. The worker waits in its session for
    orders to describe an environment, and for a second `Welcome`, which contains the run.
    """

    learner_timeout_s: float = 600.0
    """how many seconds after a Heartbeat a worker says Hello again if the learner has sent nothing since. Before the run
    begins, the learner may read a checkpoint or a dataset for a long time, without reading messages
    """


class RunSpec(SessionTerms, frozen=True, tag=True):
    """Everything that a worker needs to know about a run for which it collects rollouts."""

    env: EnvSpec
    policy: PolicySpec
    rollout_steps: int
    """T, the number of steps of a rollout"""
    copies: int
    """N, the number of env copies in a lane"""
    lanes: int
    seed: int
    vector: str = "loop"
    """how the copies of a lane are stepped: one after another (`loop`), together by the environment's own vectorized form
    (`native`) or by envpool's (`envpool`), or in a way that a package on the worker's machine adds
    """
    zstd: bool = False
    """whether workers may compress the larger arrays of their rollouts with Zstandard"""
    images_dtype: ActingDtype = "float32"
    """precision in which workers process images with the built-in convolutions"""
    masked: bool = False
    """whether rollouts contain masks of the allowed actions"""
    info_keys: tuple[str, ...] = ()
    """names of numbers that the environment reports in `info` when an episode ends; they are an episode's first `facts`"""
    extras: tuple[ExtraArray, ...] = ()
    """additional arrays of each rollout"""
    seats: tuple[str, ...] = ()
    """names of the A agents of each copy; empty if the environment is gymnasium's, which has one"""
    takes_turns: bool = False
    """whether a seat may have to wait for others between two of its actions"""
    teams: tuple[tuple[int, ...], ...] = ()
    """with opponents: the seats of each team; all teams have the same size. In each copy, the policy plays one team, and
    rollouts contain only the rows of that team. Empty: the policy plays all seats"""
    scripted: tuple[str, ...] = ()
    """opponents that aren't weights: each is a callable that makes a policy (`protocol/policy/called_policy.py`)"""
    opponent: PolicySpec | None = None
    """the policy of the opponents, if it differs from `policy`"""
    restart_episodes: int = 0
    """after this many episodes, a worker that can do so closes an env copy and creates a new one, which continues exactly as
    the old one would have; 0: never
    """
    learner_timeout_s: float = 30.0
    """how many seconds after a Heartbeat a worker says Hello again if the learner has sent nothing since"""

    @property
    def columns(self) -> int:
        """N · A, the number of columns of a lane. The columns of a copy's seats are adjacent."""
        return self.copies * self.seats_of_copy

    @property
    def sent_seats(self) -> int:
        """Number of seats of each copy that have rows in a rollout."""
        return len(self.teams[0]) if self.teams else self.seats_of_copy

    @property
    def sent_columns(self) -> int:
        """Number of columns of a rollout: all those of the lane, or only those of the policy's team."""
        return self.copies * self.sent_seats

    def team_of(self, lane: int, copy: int) -> int:
        """The team that the policy plays in this copy of a lane, for all episodes."""
        return (lane * self.copies + copy) % len(self.teams)

    @property
    def facts(self) -> tuple[str, ...]:
        """Names of the facts of an episode: those that the environment reports, then the score or the seats' returns."""
        if self.teams:
            return (*self.info_keys, SCORE)
        return self.info_keys + seat_returns(self.seats) if self.has_seat_returns else self.info_keys

    @property
    def has_seat_returns(self) -> bool:
        """Whether the facts of an episode include the return of each seat: not with opponents, nor with too many seats."""
        return bool(self.seats) and not self.teams and len(self.info_keys) + len(self.seats) <= MAX_FACTS

    @property
    def seats_of_copy(self) -> int:
        """A, the number of seats of a copy; 1 for a gymnasium environment."""
        return max(1, len(self.seats))

    @property
    def row_axes(self) -> tuple[str, str | tuple[str, ...]]:
        """The axes of the rows of a rollout, for errors (`millrace.protocol.rows.array_checks`)."""
        return "step", self.seats or "copy"

    @property
    def sent_axes(self) -> tuple[str, str | tuple[str, ...]]:
        """The axes of the rows that are sent, for errors.

        With teams, a column can't be named after a seat, because it belongs to different seats in different copies.
        """
        return ("step", "column") if self.teams else self.row_axes

    @property
    def policy_code(self) -> tuple[str, ...]:
        """Names, for errors, of the user-defined callables that make policies, or parts of policies, in the workers."""
        called = [("encoder", self.policy.encoder), ("policy", self.policy.own)]
        if self.opponent is not None:
            called.append(("encoder", self.opponent.encoder))
        factories = [f"{what} {each.factory}" for what, each in called if each is not None]
        return (*factories, *(f"opponent {factory}" for factory in self.scripted))

    def rejection_reason(self, code: AllowedCode) -> str:
        """Why a worker that allows only this code cannot take part, or an empty string if it can."""
        for what in self.policy_code:
            if why := code.refuses_to_call(what):
                return why
        return self.env.rejection_reason(code)


SCORE = "score"
"""Name of the last fact of an episode with opponents: 1 if the policy's team had the highest return, 1/n if n teams tied for
it, else 0.
"""


@lru_cache  # the facts of each episode are counted
def seat_returns(seats: tuple[str, ...]) -> tuple[str, ...]:
    """The names that the returns of these seats have among the facts of an episode."""
    return tuple(one_line(f"return_{seat}", MAX_NAME) for seat in seats)


SEAT_LEAVES = (Leaf("acts", "box", (), "bool"), Leaf("complete", "box", (), "bool"), Leaf("outside", "box", (), "float64"))
"""The arrays that follow those of the observation in a vector environment with seats; see
`millrace.protocol.envs.seats.SeatStep`.
"""


class StepSpec(SessionTerms, frozen=True, tag=True):
    """Everything that a worker needs to know about a vector environment whose copies it steps on order."""

    envs: tuple[EnvSpec, ...]
    """the different environments, each listed once"""
    copies: tuple[int, ...]
    """index in `envs` for each copy, in the order of the whole vector environment"""
    lanes: tuple[int, ...]
    """number of copies of each lane; lane 0 has the first copies"""
    observation: tuple[Leaf, ...]
    action: tuple[Leaf, ...]
    """the arrays of an action, described in the same way as those of an observation"""
    autoreset: Literal["NextStep", "SameStep", "Disabled"] = "NextStep"
    """what happens when an episode ends, by the names of gymnasium's `AutoresetMode`"""
    render_mode: str | None = None
    """the render mode with which each copy is made"""
    evaluation_copies: int = 0
    """how many of the copies are evaluation copies; they are the last ones, and are numbered separately, from 0"""
    seats: tuple[str, ...] = ()
    """names of the A agents of each copy; empty if the environments are gymnasium's. With seats, arrays have N · A rows
    instead of N, where the rows of a copy are adjacent, and three more arrays follow those of the observation: `acts` and
    `complete` (bool), and `outside` (float64)
    """
    learner_timeout_s: float = 600.0
    """how many seconds after a Heartbeat a worker says Hello again if the learner has sent nothing since. Between two steps,
    the caller may compute for a long time, without reading messages; infinite for workers that end with the learner's
    process
    """

    def first_copy(self, lane: int) -> int:
        """The number that the lane's first copy has in the whole vector environment."""
        return sum(self.lanes[:lane])

    @property
    def seats_of_copy(self) -> int:
        """A, the number of seats of a copy; 1 for gymnasium environments."""
        return max(1, len(self.seats))

    @property
    def leaves(self) -> tuple[Leaf, ...]:
        """The leaves of the arrays in `Stepped.obs`."""
        return (*self.observation, *(SEAT_LEAVES if self.seats else ()))

    def rows(self, lane: int) -> slice:
        """The lane's rows in arrays of all lanes."""
        first = self.first_copy(lane)
        A = self.seats_of_copy
        return slice(first * A, (first + self.lanes[lane]) * A)

    def rejection_reason(self, code: AllowedCode) -> str:
        """Why a worker that allows only this code cannot take part, or an empty string if it can."""
        return next((why for env in self.envs if (why := env.rejection_reason(code))), "")
