"""Plain data that describe a run: spaces, policy, and how much to collect. They travel in `Welcome`."""

from __future__ import annotations

from typing import Literal

import msgspec

from protocol.env_spec import AllowedCode, EnvSpec
from protocol.wire.compression import why_no_zstd


class Leaf(msgspec.Struct, frozen=True):
    """One array of an observation; a Dict or Tuple observation has several."""

    path: str
    """where it stands in the observation, `camera/left`; empty when the observation is one array"""
    kind: Literal["box", "discrete", "multidiscrete", "multibinary"]
    shape: tuple[int, ...]
    dtype: str
    """numpy's name of the stored dtype, `float32`"""
    sizes: tuple[int, ...] = ()
    """how many values each entry can take (discrete, multidiscrete)"""
    start: tuple[int, ...] = ()
    """the smallest value of each entry (discrete, multidiscrete)"""

    @property
    def is_image(self) -> bool:
        """A three-dimensional array of bytes is an image: it goes through a convolutional network."""
        return self.kind == "box" and self.dtype == "uint8" and len(self.shape) == 3


class ActionSpec(msgspec.Struct, frozen=True):
    """What the policy chooses."""

    kind: Literal["discrete", "multidiscrete", "multibinary", "box"]
    shape: tuple[int, ...]
    dtype: str
    """dtype that the environment takes; a Box action is stored as float32, unclipped"""
    sizes: tuple[int, ...] = ()
    """how many choices each entry has (discrete, multidiscrete)"""
    start: tuple[int, ...] = ()
    """the smallest value of each entry (discrete, multidiscrete): stored actions count from 0"""
    low: tuple[float, ...] = ()
    """lower bounds (box), flattened; -inf where unbounded"""
    high: tuple[float, ...] = ()
    """upper bounds (box), flattened"""

    @property
    def stored_dtype(self) -> str:
        """Dtype of `Rollout.action`."""
        return "float32" if self.kind == "box" else "int64"


class NamedShape(msgspec.Struct, frozen=True, array_like=True):
    """An array by its name, and how large it is."""

    name: str
    """as torch's `named_parameters` has it"""
    shape: tuple[int, ...]
    """its sides"""


class EncoderSpec(msgspec.Struct, frozen=True):
    """A torch module of the user's own, which stands before all other layers; see `protocol/policy/encoder.py`."""

    factory: str
    """`my_package.networks:encoder`, a callable that makes it"""
    arrays: tuple[NamedShape, ...]
    """its parameters, in its order"""
    size: int
    """how many features it gives"""


ImagesDtype = Literal["float32", "bfloat16"]


class PolicySpec(msgspec.Struct, frozen=True):
    """A policy as plain data: enough to act in numpy (workers) and to learn in torch (learner)."""

    observation: tuple[Leaf, ...]
    action: ActionSpec
    net: tuple[int, ...] = (64, 64)
    """hidden layers of the actor, and of the critic; or of the action values"""
    activation: Literal["tanh", "relu"] = "tanh"
    normalize_observations: bool = False
    """subtract the running mean, divide by the running standard deviation, clip to ±10 (not images)"""
    head: Literal["actor_critic", "q"] = "actor_critic"
    """a distribution over actions and a value, or the value of every (discrete) action, acted on epsilon-greedily"""
    shared_net: bool = False
    """actor and critic share their hidden layers"""
    dueling: bool = False
    """action values are a state's value and each action's advantage over the mean (Wang et al. 2016)"""
    encoder: EncoderSpec | None = None
    """a module of the user's own before all other layers; none: the arrays as they are, and convolutions of images"""
    core: Literal["lstm", "gru"] | None = None
    """what remembers, between an observation's features and the hidden layers; none: nothing is remembered"""
    core_size: int = 64
    """units of the core"""

    @property
    def state_size(self) -> int:
        """S, how many numbers an env copy carries from one observation to the next: the core's memory."""
        return 0 if self.core is None else self.core_size * (2 if self.core == "lstm" else 1)

    @property
    def needs_torch(self) -> bool:
        """Images need convolutions, which numpy has not, and modules are torch's; every other policy acts without it."""
        return self.encoder is not None or self.convolves

    @property
    def convolves(self) -> bool:
        """Images go through convolutions of ours."""
        return self.encoder is None and any(leaf.is_image for leaf in self.observation)


class RunSpec(msgspec.Struct, frozen=True, tag=True):
    """Everything a worker needs to know of the run it joins: it collects rollouts."""

    env: EnvSpec
    policy: PolicySpec
    rollout_steps: int
    """T"""
    copies: int
    """N, env copies in a lane"""
    lanes: int
    seed: int
    vector: Literal["loop", "native", "envpool"] = "loop"
    """how the copies of a lane are stepped: one after another, or at once, by the environment's own vectorised form or by
    envpool's
    """
    compress: Literal["none", "zstd"] = "none"
    """what workers do with the larger arrays of their rollouts, besides what they do anyway"""
    images_dtype: ImagesDtype = "float32"
    """as what workers look at images, with convolutions of ours"""
    heartbeat_s: float = 1.0
    learner_timeout_s: float = 30.0
    """a worker that heard nothing of the learner for so long starts again with Hello"""

    def why_not(self, code: AllowedCode) -> str:
        """Why a worker that runs so much code cannot take part; empty if it can."""
        if self.compress == "zstd" and (why := why_no_zstd()):
            return why
        if self.policy.encoder is not None and code is AllowedCode.REGISTERED:
            return (
                f"encoder {self.policy.encoder.factory} imports a module, which this worker does not do for a learner it "
                "cannot be sure of; give it a token (and not --no-code)"
            )
        return self.env.why_not(code)


class StepSpec(msgspec.Struct, frozen=True, tag=True):
    """Everything a worker needs to know of the vector environment it joins: it steps copies when it is told to."""

    envs: tuple[EnvSpec, ...]
    """each of the different environments, once"""
    copies: tuple[int, ...]
    """which of `envs` each copy is, in the order of the whole vector environment"""
    lanes: tuple[int, ...]
    """how many copies each lane has; lane 0 has the first ones"""
    observation: tuple[Leaf, ...]
    action: tuple[Leaf, ...]
    """the arrays of an action, described as those of an observation are"""
    autoreset: Literal["NextStep", "SameStep", "Disabled"] = "NextStep"
    """what follows an episode's end, as gymnasium's `AutoresetMode` names it"""
    render_mode: str | None = None
    """passed on to each copy"""
    heartbeat_s: float = 1.0
    learner_timeout_s: float = 600.0
    """a worker that heard nothing of the learner for so long starts again with Hello. The caller may do much between two
    steps, and nobody listens then; workers that end with the learner's process wait for ever (infinity)
    """

    def first_copy(self, lane: int) -> int:
        """Number of the lane's first copy."""
        return sum(self.lanes[:lane])

    def why_not(self, code: AllowedCode) -> str:
        """Why a worker that runs so much code cannot take part; empty if it can."""
        return next((why for env in self.envs if (why := env.why_not(code))), "")
