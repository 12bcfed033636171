"""Plain data that describe a run: which environment, which policy, how much. They travel in `Welcome`.

This is the one file that may unpickle, and only in `EnvSpec.make`: a factory that the *learner* sent to a worker which
agreed to run code (`Code`). Nothing that a worker sends is ever unpickled.
"""

from __future__ import annotations

import importlib
import traceback
from collections.abc import Callable
from enum import Enum
from importlib.util import find_spec
from typing import Any, Literal, TypeVar

import gymnasium
import msgspec
from gymnasium.envs.registration import VectorizeMode
from gymnasium.vector import VectorEnv

from protocol.errors import UsageError, first_line
from protocol.wire.compression import why_no_zstd

REGISTRARS = {"millrace": "workers.envs", "ALE": "ale_py"}  # of a namespace: gymnasium imports them as it would a user's own
Scalar = bool | int | float | str
_Made = TypeVar("_Made")


class Code(Enum):
    """How much code a learner may have a worker run, by how sure the worker is of who the learner is."""

    REGISTERED = 0
    """environments that are registered where the worker runs, by their ids alone, and of their attributes those whose names
    do not begin with an underscore: anybody may have answered
    """
    MODULES = 1
    """also `module:EnvId`, which imports the module: somebody on this machine has answered"""
    CALLABLES = 2
    """also pickled callables: the learner whose key is pinned, or one that only this user can be"""


class EnvSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The environment: a gymnasium id, or a factory that was pickled by the learner."""

    id: str
    """anything `gymnasium.make` takes: `CartPole-v1`, `ALE/Pong-v5`, `my_package.envs:MyEnv-v0`"""
    kwargs: dict[str, Scalar] = {}
    """keyword arguments of `gymnasium.make`"""
    factory: bytes | None = None
    """a cloudpickled callable that returns one environment; `id` is then only its name"""

    @staticmethod
    def of(env: str | Callable[[], object], kwargs: dict[str, Scalar] | None = None) -> EnvSpec:
        """From an id, or from a callable that takes `kwargs` and returns a `gymnasium.Env`."""
        if isinstance(env, str):
            return EnvSpec(env, kwargs or {})
        import cloudpickle

        return EnvSpec(getattr(env, "__name__", type(env).__name__), kwargs or {}, cloudpickle.dumps(env))

    def why_not(self, code: Code) -> str:
        """Why a worker that runs so much code cannot make it; empty if it can."""
        if self.factory is not None and code is not Code.CALLABLES:
            return (
                f"environment {self.id} is a callable, which this worker does not unpickle; it may come over ipc, inproc or "
                "with a token (and not with --no-code), else name it as my_module:MyEnv-v0"
            )
        if self.factory is None and ":" in self.id and code is Code.REGISTERED:
            return (
                f"environment {self.id} imports a module, which this worker does not do for a learner it cannot be sure of; "
                "give it a token (and not --no-code)"
            )
        return ""

    def make(self, render_mode: str | None = None) -> gymnasium.Env[object, object]:
        """One env copy. Raises `UsageError` with what to do when the id is unknown or a package is missing."""
        extra: dict[str, object] = {} if render_mode is None else {"render_mode": render_mode}
        if self.factory is not None:
            import cloudpickle

            env = cloudpickle.loads(self.factory)(**self.kwargs, **extra)
            if not isinstance(env, gymnasium.Env):
                raise UsageError(f"env factory {self.id}: expected it to return a gymnasium.Env, got {type(env).__name__}")
            return env
        # The checker is left out: it costs a tenth of a CartPole step, and `Rollout.validate` checks every row.
        return self._made(lambda env_id: gymnasium.make(env_id, disable_env_checker=True, **self.kwargs, **extra))  # type: ignore[arg-type]

    def make_vectorised(self, copies: int) -> VectorEnv[Any, Any, Any]:
        """So many copies as the environment's own vectorised form; `protocol.envs.vectorized` says which can serve."""
        own, kwargs = VectorizeMode.VECTOR_ENTRY_POINT, dict[str, Any](self.kwargs)
        return self._made(lambda env_id: gymnasium.make_vec(env_id, copies, own, **kwargs))

    def registered(self) -> gymnasium.envs.registration.EnvSpec:
        """What gymnasium knows of the id. Raises `UsageError`."""

        def look_up(env_id: str) -> gymnasium.envs.registration.EnvSpec:
            module, colon, name = env_id.partition(":")
            if colon:
                importlib.import_module(module)
            return gymnasium.spec(name if colon else env_id)

        return self._made(look_up)

    def _made(self, make: Callable[[str], _Made]) -> _Made:
        """What `make` makes of the id. Raises `UsageError`."""
        registrar = REGISTRARS.get(self.id.partition("/")[0])
        try:
            return make(f"{registrar}:{self.id}" if registrar and find_spec(registrar) else self.id)
        except (gymnasium.error.Error, ImportError, TypeError) as error:  # TypeError: keyword arguments it does not take
            raise UsageError(_why_not_made(self.id, error)) from error
        except Exception as error:  # its own constructor raised, whatever that may be
            line = f"environment {self.id} cannot be made: {type(error).__name__}: {first_line(error)}"
            raise UsageError(line, traceback.format_exc()) from error


def _why_not_made(env_id: str, error: Exception) -> str:
    """One line for an environment that is not known, or whose package is missing."""
    module, colon, _ = env_id.partition(":")
    says = first_line(error)
    match error:
        case gymnasium.error.NamespaceNotFound() if env_id.startswith("ALE/"):
            return f"environment {env_id}: Atari games are an extra; pip install 'millrace-rl[atari]'"
        case gymnasium.error.DependencyNotInstalled():
            return f"environment {env_id}: {says}"
        case ModuleNotFoundError() if colon and f"'{module.split('.')[0]}" in says:
            return f"environment {env_id}: no module named {module}; is it installed, or its folder on PYTHONPATH?"
        case ImportError():
            return f"environment {env_id}: a package it needs is missing ({says}); pip install it, then try again"
        case gymnasium.error.Error() if "vector entry point" in says:
            return (
                f"environment {env_id} has no vectorised form of its own (gymnasium's vector_entry_point); use --vector loop"
            )
        case gymnasium.error.UnregisteredEnv() if not colon:
            return f"environment {env_id} is not registered: {says} One of your own is given as my_module:MyEnv-v0"
        case _:
            return f"environment {env_id} cannot be made: {says}"


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

    def why_not(self, code: Code) -> str:
        """Why a worker that runs so much code cannot take part; empty if it can."""
        if self.compress == "zstd" and (why := why_no_zstd()):
            return why
        if self.policy.encoder is not None and code is Code.REGISTERED:
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

    def first(self, lane: int) -> int:
        """Number of the lane's first copy."""
        return sum(self.lanes[:lane])

    def why_not(self, code: Code) -> str:
        """Why a worker that runs so much code cannot take part; empty if it can."""
        return next((why for env in self.envs if (why := env.why_not(code))), "")
