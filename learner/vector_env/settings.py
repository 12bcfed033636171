"""The arguments of `millrace.make_vec` as one record.

Rule: a value out of its range is refused here, with a one-line error, before a worker is started. `make_vec` has already
checked the types.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from gymnasium import Space
from gymnasium.vector import AutoresetMode

from millrace.learner.members.who_may_connect import BindSettings
from millrace.protocol.call_timeouts import CallTimeouts
from millrace.protocol.env_spec import EnvLike, EnvSpec, Scalar
from millrace.protocol.envs.wrappers import WrapperLike
from millrace.protocol.errors import UsageError, safe_repr
from millrace.protocol.machine.cpu_cores import usable_cores
from millrace.protocol.specs import SessionTerms, session_terms

ObservationMode = Literal["same", "different"] | tuple[Space[Any], Space[Any]]
"""Gymnasium's `observation_mode`. A tuple has the observation spaces of the batch and of a single copy."""


@dataclass(frozen=True)
class VectorEnvSettings:
    """The arguments of `millrace.make_vec`, with the same meanings and defaults. Raises `UsageError` if one is invalid."""

    env: EnvLike | EnvSpec | Sequence[EnvLike]
    num_envs: int | None = None
    workers: int | None = None
    lanes: int | None = None
    listen: BindSettings = field(default_factory=BindSettings)
    """The address at which to listen for workers that are started elsewhere, and its keys. Empty for local workers."""
    transport: Literal["ipc", "tcp", "inproc"] = "ipc"
    shared_memory: bool = True
    autoreset_mode: AutoresetMode | str = "NextStep"
    observation_mode: ObservationMode = "same"
    on_worker_loss: Literal["truncate", "raise"] = "truncate"
    timeout_s: float = 60.0
    worker_timeout_s: float = 5.0
    """A worker that was started elsewhere counts as lost if it is silent for this many seconds while the learner listens."""
    call_timeouts: CallTimeouts = field(default_factory=CallTimeouts)
    """How long a call to the environment may take before its worker is ended."""
    max_env_failures: int = 3
    """How many times workers may die in the environment's code before `make_vec` raises. See `FailureCount`."""
    copy: bool = True
    render_mode: str | None = None
    kwargs: dict[str, Scalar] = field(default_factory=dict)
    """Keyword arguments of the environment."""
    wrappers: Sequence[WrapperLike] = ()
    """Wrappers of every env copy, the innermost first."""
    single_lanes: int = 0
    """Number of additional evaluation copies, which follow the other copies. Each is a lane of its own, and can be stepped
    alone with `ZmqVectorEnv.begin_step`.
    """
    evaluates: bool = False
    """Whether all copies are evaluation copies."""

    def __post_init__(self) -> None:
        if not self.timeout_s > 0:  # this way, NaN is refused, too
            raise UsageError(f"timeout: expected a number of seconds above 0, got {safe_repr(self.timeout_s)}")
        if self.workers is not None and self.workers < 0:
            raise UsageError(f"workers: expected at least 0, got {self.workers}")
        if self.max_env_failures < 0:
            raise UsageError(f"max_env_failures: expected at least 0, got {self.max_env_failures}")
        mode = self.observation_mode
        if isinstance(mode, tuple) and [isinstance(space, Space) for space in mode] != [True, True]:
            raise UsageError(f"observation_mode: expected the spaces of the batch and of a single copy, got {mode}")

    @property
    def terms(self) -> SessionTerms:
        """The terms of all workers, before the spaces of the copies are known and afterwards."""
        return session_terms(self.call_timeouts, self.worker_timeout_s)

    @property
    def envs(self) -> list[EnvLike | EnvSpec]:
        """The environment of each copy: the same one `num_envs` times, or the given list."""
        if isinstance(self.env, Sequence) and not isinstance(self.env, str):
            return list(self.env)
        try:
            return [self.env] * (1 if self.num_envs is None else self.num_envs)
        except (MemoryError, OverflowError) as error:
            raise UsageError(
                f"num_envs: expected a number of env copies that fit into memory, got {self.num_envs}"
            ) from error

    @property
    def local_workers(self) -> int:
        """The number of worker processes to start on this machine; 0 if workers are started elsewhere."""
        if self.listen.bind:
            return 0
        return min(self.workers if self.workers is not None else usable_cores(), len(self.envs))

    @property
    def lane_count(self) -> int:
        """The number of lanes, by default one for each local worker."""
        return max(self.local_workers, 1) if self.lanes is None else self.lanes

    @property
    def lane_sizes(self) -> tuple[int, ...]:
        """The number of copies in each lane."""
        N = len(self.envs)
        lanes = self.lane_count
        return (*(N // lanes + (lane < N % lanes) for lane in range(lanes)), *[1] * self.single_lanes)
