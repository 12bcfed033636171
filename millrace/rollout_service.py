"""Rollouts for your own learner, in any framework and any loop: millrace collects the rollouts, you train the policy.

    with millrace.RolloutService("CartPole-v1", policy=millrace.MLP(64, 64), workers=2, envs=64) as service:
        parameters = service.policy.initial(seed=1)
        service.publish(parameters)
        for batch in service:
            parameters = update(parameters, batch)
            service.publish(parameters)

The built-in trainer uses the same mechanism, so tickets, ledger, lags, faults and reproducible results work as in
`millrace train`. This module doesn't import torch.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self, Unpack

import gymnasium
import numpy as np

from millrace.arguments import checked
from millrace.keywords import RolloutKeywords
from millrace.launch.rollouts import start
from millrace.learner.config.other_names import in_place_of
from millrace.learner.config.rollout_config import RolloutConfig
from millrace.learner.config.validation import convert_rollout_settings
from millrace.learner.interrupts import Interrupts
from millrace.learner.rollouts.evaluation_dealer import EvaluationPlan, evaluation_of
from millrace.learner.rollouts.past_rollouts import PastRollouts
from millrace.learner.rollouts.rollout_dealer import AcceptedRollout
from millrace.learner.run_folder.episode_window import EpisodeWindow
from millrace.learner.run_folder.progress import Progress, steps_per_second
from millrace.learner.run_folder.results import Evaluation
from millrace.policies import MLP, PolicyChoice, PolicyParameters
from millrace.protocol.arrays import Array, Ints
from millrace.protocol.env_spec import EnvLike, EnvSpec, remembered_name
from millrace.protocol.envs.wrappers import WrapperLike, wrapper_names
from millrace.protocol.errors import CheckpointError, UsageError, check_at_least, did_you_mean, first_line, safe_repr
from millrace.protocol.rollout import Batch, stack_rollouts
from millrace.protocol.specs import PolicySpec
from millrace.saved_state import ServiceState, digest, read, unreadable, write

if TYPE_CHECKING:
    from millrace.learner.algorithms.normalizer import Normalizer

PULSE_S = 0.005  # interval at which messages are answered while the user's code computes
EVALUATION_COPIES = 4  # number of episodes that a worker plays at the same time


class RolloutBatch(Batch, frozen=True, kw_only=True, eq=False):
    """One rollout of each lane, side by side: T steps of N env copies. All arrays are yours, and writable.

    In row t of a column, the policy observed `obs[t]`, took `action[t]`, and got `reward[t]` and `obs[t + 1]`, if `valid[t]`
    is True. A row that isn't valid only resets its env copy: leave it out of every loss, return and count.

    If the environment has several agents, each agent has a column: N is the number of copies times `len(service.seats)`, and
    the columns of a copy are adjacent. Then a row that isn't valid may also belong to an agent that waits for others or has
    left: carry returns and recurrent states through such a row unchanged.

    >>> import millrace
    >>> with millrace.RolloutService("CartPole-v1", workers=1, envs=2, lanes=1, rollout_steps=8) as service:
    ...     _ = service.publish(service.policy.initial())
    ...     batch = service.gather()
    >>> isinstance(batch, millrace.RolloutBatch), batch.obs.shape, batch.action.shape
    (True, (9, 2, 4), (8, 2))

    In addition to the fields below, a batch has

    - `action` [T, N, *action]: int64 counted from 0, or float32 before clipping;
    - `reward` [T, N] float32: raw rewards;
    - `terminated`, `truncated` and `valid`, each [T, N] bool;
    - `state` [N, S] float32: the state of the policy before `obs[0]`;
    - `lane` [N] int64: the lane of each column; `columns_per_rollout`: the number of columns of a lane, which are adjacent;
    - `fresh` [N] bool: False where a column continues the batch before;
    - `mask` [T+1, N, choices] bool: the actions that were allowed; None without action masks;
    - `episodes`: the episodes that ended, with `reward` (the return, summed over all agents), `length`, `seconds`, `facts`;
    - `resets` [T+1, env copies] bool, if there are several agents: which steps only reset a copy; the last row is about the
      first step of the next batch.
    """

    obs: Any
    """[T+1, N, *shape]; for a Dict or Tuple observation, a dict with such an array for each leaf, by its path `a/b`"""
    log_prob: Any
    """[T, N] float32: log-probability of the action under the policy that acted; None if an `OwnPolicy` doesn't return it"""
    extras: Any
    """further arrays that an `OwnPolicy` returned, by name: {name: [T, N, *shape]}; empty for built-in policies"""
    version: Ints
    """[N] int64: version of the weights that chose the actions"""

    def __repr__(self) -> str:
        T, N = self.reward.shape
        return f"RolloutBatch({T} steps of {N} columns: {self.env_steps} env steps, {len(self.episodes)} episodes ended)"


class RolloutService:
    """Collects rollouts of one policy with worker processes, on this machine or elsewhere, for your own learner.

    Use it in a `with` statement and from one thread. While your code computes, a thread of the service answers the workers,
    so that none of them is lost during a long computation.

    `publish` sets the weights: the flat float32 vector [P] of the policy, or an array for each of its pieces. `gather`, or
    one iteration over the service, waits until a rollout of each lane has arrived, and returns all of them as one
    `RolloutBatch`. It has T = `rollout_steps` rows for each of the `envs` env copies. With `max_lag=0`, a batch was
    collected with the weights that you published last. With `max_lag=n`, it was collected with the weights that were the
    newest at the `gather` call n batches earlier.

    `publish`, `gather`, `evaluate` and `save` raise `UsageError` after `close`, and if they are called from another thread.
    `gather` and `evaluate` raise a `RunError` if no further rollout can arrive: `NoWorkers`, `Stalled`, `EnvironmentFailed`
    or `PolicyFailed`. Ctrl-C raises `KeyboardInterrupt`.

    >>> import millrace
    >>> with millrace.RolloutService("CartPole-v1", millrace.MLP(64), workers=1, envs=4, rollout_steps=8) as service:
    ...     parameters = service.policy.initial(seed=1)
    ...     service.publish(parameters)
    ...     for batch in service:
    ...         parameters = parameters * 0.99  # learn from the batch here
    ...         if service.publish(parameters) == 2:
    ...             break
    0
    """

    @checked
    def __init__(
        self,
        env: EnvLike,
        policy: PolicyChoice | None = None,
        *,
        wrappers: Sequence[WrapperLike] = (),
        rollout_steps: int = 128,
        restore: str | os.PathLike[str] | None = None,
        **settings: Unpack[RolloutKeywords],
    ) -> None:
        """Start the workers and wait until they have joined.

        Args:
            env: an id that `gymnasium.make` accepts, a `gymnasium.envs.registration.EnvSpec`, or a callable that returns an
                environment. The environment may be defined in your script or notebook, and it may be PettingZoo's, with
                several agents.
            policy: `MLP`, `CNN`, `Recurrent` or your `OwnPolicy`; by default `MLP(64, 64)`.
            wrappers: applied to every env copy in its worker, the first one innermost: classes, functions, or names such as
                "gymnasium.wrappers:FlattenObservation".
            rollout_steps: T, the number of steps of each env copy in a batch.
            restore: a file that `save` wrote, from which to continue. Your arrays in it are then in `restored`.
            **settings: the settings of `millrace train` for environments, workers, network and timeouts. They have the same
                names and defaults, such as `envs=8`, `lanes=4` and `max_lag=0`. With `bind="tcp://0.0.0.0:5555"` no worker
                is started here: workers elsewhere join with `millrace worker`.

        Raises `UsageError` if an argument is wrong, `NoWorkers` if too few workers join in time, `EnvironmentFailed` if the
        environment can't be made, and `PolicyFailed` if your `OwnPolicy` can't be made.
        """
        listens = bool(settings.get("bind"))
        config = _config(env, wrappers, dict(settings))
        policy = MLP() if policy is None else policy
        if isinstance(policy, type) or not hasattr(policy, "spec"):
            raise UsageError(
                f"policy: expected MLP, CNN, Recurrent or OwnPolicy, as in MLP(64, 64), got {safe_repr(policy)}"
            )
        check_at_least("rollout_steps", rollout_steps, 1)
        self.restored: dict[str, Array] = {}
        """The arrays that you passed to `save`, by name, if the service was restored; otherwise empty."""
        past: PastRollouts | None = None
        self._version = -1
        self.env_steps: int = 0
        """Env steps in all batches so far, including those before a restore."""
        state: ServiceState | None = None
        if restore is not None:
            state, self.restored = read(Path(restore))
            past = state.rollouts
            self._version = state.version - 1
            self.env_steps = state.env_steps
        self.config: RolloutConfig = config
        """All settings of the service."""
        self._interrupts = Interrupts()
        self._lock = threading.Lock()
        self._over = threading.Event()
        self._owner = threading.get_ident()
        self._published = False
        self._window = EpisodeWindow()
        self._steps_before = self.env_steps
        self._began_s = time.monotonic()
        self._normalizer: Normalizer | None = None
        self._resources = ExitStack()
        spec = EnvSpec.of(env, config.env_kwargs, config.all_wrappers(wrappers), config.eval_env_kwargs)
        try:
            with self._interrupts:
                self._hub, self.run, described = start(
                    config,
                    spec,
                    policy,
                    rollout_steps,
                    self._check_interrupt,
                    self._resources,
                    listens=listens,
                    past=past,
                )
            if state is not None:
                _check_restored(state, spec.id, self.run.policy, str(restore))
                if state.normalizer is not None:
                    try:
                        self.normalizer.restore(state.normalizer)
                    except Exception as error:  # dicts, numpy and torch raise many exception types for an invalid state
                        raise unreadable(str(restore), error) from error
        except BaseException:
            self._resources.close()
            raise
        self.policy: PolicyParameters = PolicyParameters(self.run.policy)
        """Names, shapes and offsets of the parameters in the flat vector, and initial values."""
        self.seats: tuple[str, ...] = self.run.seats
        """The names of the agents of each env copy, in the order of their columns; empty for a gymnasium environment."""
        self.observation_space: gymnasium.Space[Any] = described.observation_space
        """The space of a single env copy, or of a single agent."""
        self.action_space: gymnasium.Space[Any] = described.action_space
        """The space of a single env copy, or of a single agent."""
        self._thread = threading.Thread(target=self._answer_workers, name="millrace-service", daemon=True)
        self._thread.start()

    # ---------------------------------------------------------------- a learner's loop

    @property
    def version(self) -> int:
        """The version of the newest weights, counted from 0; -1 before any were published.

        >>> import millrace
        >>> with millrace.RolloutService("CartPole-v1", workers=1, envs=2, lanes=1, rollout_steps=8) as service:
        ...     _ = service.publish(service.policy.initial())
        ...     service.version
        0
        """
        return self._version

    def publish(self, parameters: Mapping[str, Array] | Array, buffers: Mapping[str, Array] | Array | None = None) -> int:
        """Set the newest weights, with which rollouts are collected from the next `gather` on. Returns their version.

        `parameters`: the flat vector [P], or an array for each name in `policy.layout`. `buffers`: likewise, flat or by the
        names in `policy.buffers`, for a policy that normalizes observations; by default `normalizer.buffers()` if you have
        used `normalizer`, otherwise mean 0 and standard deviation 1. All arrays are copied.
        Raises `UsageError` for wrong shapes, or numbers that aren't finite.

        >>> import millrace
        >>> with millrace.RolloutService("CartPole-v1", workers=1, envs=2, lanes=1, rollout_steps=8) as service:
        ...     service.publish(service.policy.named(service.policy.initial()))
        0
        """
        self._check_open()
        if buffers is None and self._normalizer is not None and self.run.policy.normalize_observations:
            buffers = self._normalizer.buffers()
        flat = self.policy.flat(parameters)
        flat_buffers = self.policy.flat_buffers(buffers)
        with self._lock:
            self._hub.publish(self._version + 1, flat, flat_buffers, deal=False)
        self._version += 1
        self._published = True
        return self._version

    @property
    def normalizer(self) -> Normalizer:
        """Running mean and standard deviation of observations and returns, as in the built-in trainer.

        The first access creates it and imports torch. From then on, `publish` sends its mean and standard deviation to a
        policy that normalizes observations.

        >>> import millrace
        >>> with millrace.RolloutService("CartPole-v1", workers=1, envs=2, lanes=1, rollout_steps=8) as service:
        ...     _ = service.publish(service.policy.initial())
        ...     service.normalizer.update(service.gather())
        ...     service.normalizer.mean.shape
        (4,)
        """
        if self._normalizer is None:
            from millrace.learner.algorithms.normalizer import Normalizer

            self._normalizer = Normalizer(self.run.policy)
        return self._normalizer

    def gather(self) -> RolloutBatch:
        """Wait for the next batch, and return it.

        Raises `NoWorkers` if there has been no worker for `no_workers_timeout_s`, `EnvironmentFailed` or `PolicyFailed` if
        the environment or the policy failed more often than `max_env_failures` allows, `Stalled` if no env step has ended
        for ten minutes (or for as long as one env step may take), and `UsageError` before the first `publish`.

        >>> import millrace
        >>> with millrace.RolloutService("CartPole-v1", workers=1, envs=2, lanes=1, rollout_steps=8) as service:
        ...     _ = service.publish(service.policy.initial())
        ...     service.gather().reward.shape
        (8, 2)
        """
        self._check_open()
        if not self._published:
            raise UsageError("rollout service: expected weights before the first batch; call publish")
        with self._lock, self._interrupts:
            arrived = self._hub.gather()
        batch = self._batch(arrived)
        self.env_steps += batch.env_steps
        self._window.extend(batch.episodes)
        with self._lock:
            self._hub.report_progress(self._progress(self._version - batch.version))
        return batch

    def __iter__(self) -> Iterator[RolloutBatch]:
        """Yield batches forever: each one is the result of `gather`."""
        while True:
            yield self.gather()

    @checked
    def evaluate(self, episodes: int = 100, *, seed: int = 1_000_000, max_steps: int = 1_000_000) -> Evaluation:
        """Let the workers play greedy episodes with the newest weights, on env copies that aren't used for rollouts.

        The result does not depend on the number of workers. `seed`: seed of the episodes. `max_steps`: the limit on the env
        steps of all episodes together; each episode gets an equal share, and is cut when it is used up.

        >>> import millrace
        >>> with millrace.RolloutService("CartPole-v1", workers=1, envs=2, lanes=1, rollout_steps=8) as service:
        ...     _ = service.publish(service.policy.initial())
        ...     service.evaluate(episodes=4).episodes
        4
        """
        self._check_open()
        if not self._published:
            raise UsageError("rollout service: expected weights to evaluate; call publish first")
        for name, value, least in (("episodes", episodes, 1), ("seed", seed, 0), ("max_steps", max_steps, 1)):
            check_at_least(f"evaluate: {name}", value, least)
        plan = EvaluationPlan.of(episodes, seed, EVALUATION_COPIES, max_steps)
        with self._lock, self._interrupts:
            self._hub.begin_evaluation(plan)
            return evaluation_of(self._hub.end_evaluation(lambda played, env_steps: None), self.run.facts)

    # ---------------------------------------------------------------- saving, and the state of the service

    @checked
    def save(self, path: str | os.PathLike[str], **arrays: object) -> None:
        """Write the service's state and your arrays into one .npz file, atomically.

        Call it right after `publish`. `RolloutService(..., restore=path)` continues from this file: it restores the ledger,
        versions, rounds and normalizer, and puts your arrays into `restored`. Its workers first replay the episodes that
        were running when the last batch was gathered. If the environment is deterministic, the restored service returns the
        same batches as this service would return next.

        Raises `UsageError` for arrays that don't consist of numbers, and `RunError` if the file can't be written.

        >>> import millrace
        >>> with millrace.RolloutService("CartPole-v1", workers=1, envs=2, lanes=1, rollout_steps=8) as service:
        ...     _ = service.publish(service.policy.initial())
        ...     service.save("state.npz", parameters=service.policy.initial())
        >>> with millrace.RolloutService("CartPole-v1", restore="state.npz", workers=1, envs=2, lanes=1) as service:
        ...     service.publish(service.restored["parameters"])
        0
        """
        self._check_open()
        newest = self._version if self._published else self._version + 1  # a restored service publishes this version first
        with self._lock:
            rollouts = self._hub.past(newest)
        state = ServiceState(
            env=self.run.env.id,
            policy=digest(self.run.policy),
            version=newest,
            env_steps=self.env_steps,
            rollouts=rollouts,
            normalizer=None if self._normalizer is None else self._normalizer.state(),
        )
        write(Path(path), state, arrays)

    def ledger(self) -> dict[str, int]:
        """Number of tickets and transitions by their outcome, such as `used` and `lost`.

        >>> import millrace
        >>> with millrace.RolloutService("CartPole-v1", workers=1, envs=2, lanes=1, rollout_steps=8) as service:
        ...     _ = service.publish(service.policy.initial())
        ...     _ = service.gather()
        ...     service.ledger()["transitions_received"]
        16
        """
        with self._lock:
            return self._hub.coordinator.rollouts.ledger.counts()

    def lags(self) -> dict[str, int]:
        """Number of rollouts in the batches so far, by their lag: the age of their weights, in versions.

        >>> import millrace
        >>> with millrace.RolloutService("CartPole-v1", workers=1, envs=2, lanes=1, rollout_steps=8) as service:
        ...     _ = service.publish(service.policy.initial())
        ...     _ = service.gather()
        ...     service.lags()
        {'0': 1}
        """
        with self._lock:
            return self._hub.lag_statistics.histogram()

    def workers(self) -> list[str]:
        """The names of the workers that have joined.

        >>> import millrace
        >>> with millrace.RolloutService("CartPole-v1", workers=1, envs=2, lanes=1, rollout_steps=8) as service:
        ...     service.workers()
        ['w0']
        """
        with self._lock:
            return sorted({member.hello.worker for member in self._hub.coordinator.members.values()})

    def close(self, reason: str = "the learner has ended") -> None:
        """Ask the workers to leave, and release all resources. A second call does nothing. `reason`: sent to the workers.

        >>> import millrace
        >>> service = millrace.RolloutService("CartPole-v1", workers=1, envs=2, lanes=1)
        >>> service.close()
        """
        if self._over.is_set():
            return
        self._over.set()
        self._thread.join()
        try:
            self._hub.drain(reason)
        finally:
            self._resources.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close("the learner has ended" if error is None else f"the learner failed: {first_line(error, str(kind))}")

    def __repr__(self) -> str:
        state = "closed" if self._over.is_set() else f"version {self._version}, {self.env_steps:,} env steps"
        return f"RolloutService({self.run.env.id!r}, {state})"

    # ---------------------------------------------------------------- inside

    def _answer_workers(self) -> None:
        """Answer the workers while the user's code computes. `publish`, `gather` and `evaluate` also answer them."""
        while not self._over.wait(PULSE_S):
            with self._lock:
                self._hub.pulse()

    def _batch(self, arrived: Sequence[AcceptedRollout]) -> RolloutBatch:
        stacked = stack_rollouts([one.rollout for one in arrived], [one.fresh for one in arrived])
        leaves = self.run.policy.observation
        named = {leaf.path: array for leaf, array in zip(leaves, stacked.obs, strict=True)}
        own = self.run.policy.own
        extras = zip(self.run.extras, stacked.extras, strict=True)
        fields = {name: getattr(stacked, name) for name in Batch.__struct_fields__}
        return RolloutBatch(
            **fields
            | {
                "obs": stacked.obs[0] if not leaves[0].path else named,
                "log_prob": stacked.log_prob if own is None or own.has_log_prob else None,
                "extras": {extra.name: array for extra, array in extras},
                "version": np.repeat(np.array([one.rollout.version for one in arrived]), stacked.columns_per_rollout),
            }
        )

    def _progress(self, lags: Ints) -> Progress:
        """The progress that `millrace status` shows after a batch whose columns have these lags [N]."""
        return Progress(
            env_steps=self.env_steps,
            steps_per_s=steps_per_second(self.env_steps - self._steps_before, time.monotonic() - self._began_s),
            return_mean=self._window.return_mean,
            length_mean=self._window.length_mean,
            lag_mean=float(lags.mean()),
            lag_max=int(lags.max()),
        )

    def _check_interrupt(self) -> None:
        if self._interrupts.received:
            self._interrupts.received = False
            raise KeyboardInterrupt

    def _check_open(self) -> None:
        if self._over.is_set():
            raise UsageError("rollout service: expected an open one, but it was closed")
        if threading.get_ident() != self._owner:
            raise UsageError("rollout service: expected calls from the thread that made it, got one from another thread")


def _config(env: EnvLike, wrappers: Sequence[WrapperLike], settings: dict[str, Any]) -> RolloutConfig:
    """The settings as a checked record. Raises `UsageError` if one is wrong."""
    known = RolloutConfig.__struct_fields__
    if unknown := [name for name in settings if name not in known]:
        known = (*known, "rollout_steps")
        hint = in_place_of(unknown[0], known) or did_you_mean(unknown[0], known)
        raise UsageError(f"RolloutService: unknown setting {unknown[0]}{hint}")
    plain = {name: os.fspath(value) if isinstance(value, os.PathLike) else value for name, value in settings.items()}
    given = {**plain, "env": remembered_name(env), "wrappers": wrapper_names(wrappers)}
    if not given.get("bind"):
        given.pop("bind", None)
    return convert_rollout_settings(given, "RolloutService")


def _check_restored(state: ServiceState, env: str, policy: PolicySpec, file: str) -> None:
    if state.env != env:
        raise CheckpointError(f"{file}: expected environment {state.env} as it was saved, got {env}")
    if state.policy != digest(policy):
        raise CheckpointError(f"{file}: expected the policy it was saved with, got another; its spaces or settings differ")
