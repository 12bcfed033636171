"""One learner, put together from its parts: link, roster, hub, algorithm, journal. Who its workers are, it does not know.

The law: the first SIGINT or SIGTERM ends the run after the update in hand, with a checkpoint; the second at once.
"""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import zmq

from learner.config.config import Config
from learner.members.endpoint import join_lines, keyring_for
from learner.members.worker_processes import WorkerProcesses
from learner.rollouts.hub import Hub, HubObserver, HubSettings
from learner.rollouts.roster import Roster
from learner.run_folder.progress import Progress
from learner.run_folder.run_folder import Interrupted, RunFolder
from protocol.cpu_cores import cores
from protocol.envs.envpool import check_pool
from protocol.envs.spaces import action_spec, observation_leaves
from protocol.envs.vectorized import check_native
from protocol.errors import UsageError
from protocol.specs import ActionSpec, EnvSpec, Leaf, PolicySpec, RunSpec
from protocol.wire.compression import why_no_zstd
from protocol.wire.link import LearnerLink

if TYPE_CHECKING:  # they bring torch along
    from learner.algorithms import Algorithm
    from learner.journal import Journal, Past

log = logging.getLogger("millrace.learner")

Watch = Callable[[Progress], None]
Begin = Callable[[Path], WorkerProcesses]
"""Told the run folder; it may start worker processes, and says which are this program's."""


class Run:
    """A learner that listens, and has not begun."""

    def __init__(
        self,
        config: Config,
        env: EnvSpec,
        link: LearnerLink,
        resume: Path | None,
        watch: Watch,
        observer: HubObserver,
        begin: Begin = lambda folder: WorkerProcesses(),
        workers: int = 0,
    ) -> None:
        """`resume`: the folder of a run that goes on from its newest checkpoint. Raises `OurError` in one line.

        `workers`: how many processes share this machine's cores with it, and run while it learns if `max_lag` lets them.

        `watch` is called after each update, `observer` whenever the learner has listened to its workers. `begin` is
        called before torch is imported: workers that are started there are ready when the learner is.
        """
        self._signals: list[int] = []
        seen = look_at(env)
        self.folder = RunFolder.create(config) if resume is None else RunFolder.open(resume)
        try:
            processes = begin(self.folder.path)
            past = self._make(config, env, seen, resume is not None, workers)
            self.hub = Hub(
                link,
                self._roster(config, past),
                HubSettings(
                    config.no_workers_timeout_s, config.stall_timeout_s, config.max_env_failures, config.weights_dtype
                ),
                processes,
                self._check_interrupt,
                observer,
            )
            self.journal = self._journal(config, past, watch)
        except BaseException:
            self.folder.remove()
            raise

    def _make(self, config: Config, env: EnvSpec, seen: Spaces, resumed: bool, workers: int) -> Past:
        """The algorithm; where the run stands."""
        import torch

        from learner.algorithms import algorithm_class
        from learner.journal import Past, recall

        self.spec = run_spec(config, env, seen)
        torch.set_num_threads(threads(config, self.spec.policy, workers))
        self.device = _device(config)
        make = algorithm_class(config.algo)
        self.algorithm: Algorithm = make(
            config.algorithm, self.spec.policy, total_steps=config.steps, seed=config.seed, device=self.device
        )
        past = Past()
        if resumed:
            past = recall(self.folder, self.algorithm)
            self.folder.write_config(config)
        return past

    def _roster(self, config: Config, past: Past) -> Roster:
        return Roster(
            self.spec,
            rollouts_per_update=config.lanes,
            max_lag=config.max_lag,
            worker_timeout_s=config.worker_timeout_s,
            first_session=int.from_bytes(os.urandom(6), "little"),
            ledger=past.ledger,
            incarnations=past.incarnations,
        )

    def _journal(self, config: Config, past: Past, watch: Watch) -> Journal:
        from learner.journal import Journal

        return Journal(config, self.folder, self.spec, self.algorithm, self.hub, past, watch)

    def _check_interrupt(self) -> None:
        if self._signals:
            raise Interrupted(self.folder.path)

    def go(self, workers: int) -> None:
        """Train until done. `workers`: how many to wait for."""
        from learner.train import train

        try:
            with _signals_into(self._signals):
                train(self.algorithm, self.hub, self.journal, workers)
        except BaseException as error:
            reason = "interrupted" if isinstance(error, KeyboardInterrupt) else str(error)
            self.hub.drain(reason, timeout_s=2.0)
            self.journal.finish(reason)
            raise
        finally:
            self.journal.close()


def serve(config: Config, resume: Path | None, watch: Watch) -> Path:
    """The learner alone, at `config.bind`: workers are started elsewhere. Its run folder."""
    if config.inference == "learner":
        raise UsageError("inference learner: python -m learner has no part that steps lanes; start it as millrace learner")
    keyring = keyring_for(config, datetime.now(UTC).replace(microsecond=0))
    with ExitStack() as stack:
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        stack.callback(context.term)
        link = LearnerLink(config.bind, context, keyring)
        stack.callback(link.close)
        observer = stack.enter_context(looking(config))
        run = Run(config, EnvSpec.of(config.env, config.env_kwargs), link, resume, watch, observer)
        for line in join_lines(link.address, config.advertise, keyring):
            log.warning("%s", line)
        run.go(config.min_workers or 1)
        return run.folder.path


def looking(config: Config) -> AbstractContextManager[HubObserver]:
    """What `--metrics-bind` asks for, while it is entered; without it nothing, and no HTTP server is imported."""
    if not config.metrics_bind:
        return nullcontext(lambda hub: None)
    from learner.prometheus import exposed

    return exposed(config)


class Spaces(NamedTuple):
    """What an environment says of itself."""

    observation: tuple[Leaf, ...]
    action: ActionSpec
    longest: int | None
    """env steps after which the clock ends an episode"""


def look_at(env: EnvSpec) -> Spaces:
    """Make one env copy to learn its spaces. Raises `UsageError` if it cannot be made, or used."""
    copy = env.make()
    try:
        longest = copy.spec.max_episode_steps if copy.spec else None
        return Spaces(observation_leaves(copy.observation_space), action_spec(copy.action_space), longest)
    finally:
        copy.close()


def run_spec(config: Config, env: EnvSpec, seen: Spaces | None = None) -> RunSpec:
    """What the workers are told; `seen`: of this environment. Raises `UsageError` if it is not for this algorithm."""
    from learner.algorithms import algorithm_class

    if config.compress == "zstd" and (why := why_no_zstd()):
        raise UsageError(why)
    observation, action, longest = look_at(env) if seen is None else seen
    policy = algorithm_class(config.algo).policy_spec(config.algorithm, observation, action)
    if config.algorithm.encoder is not None:
        from protocol.policy.encoder import describe_encoder

        encoder = describe_encoder(config.algorithm.encoder, observation, action)
        policy = msgspec.structs.replace(policy, encoder=encoder)
    if config.images_dtype != "float32" and not policy.convolves:
        raise UsageError(
            f"images_dtype {config.images_dtype}: expected float32, for this policy has no convolutions of ours"
        )
    if algorithm_class(config.algo).whole_episodes:
        _check_whole_episodes(config, longest)
    match vector := "loop" if config.vector == "auto" else config.vector:
        case "native":
            check_native(env, observation, action)
        case "envpool":
            check_pool(env, observation, action)
    return RunSpec(
        env=env,
        policy=policy,
        rollout_steps=config.algorithm.rollout_steps,
        copies=config.envs // config.lanes,
        lanes=config.lanes,
        seed=config.seed,
        vector=vector,
        compress=config.compress,
        images_dtype=config.images_dtype,
        heartbeat_s=config.heartbeat_s,
    )


def threads(config: Config, policy: PolicySpec, workers: int) -> int:
    """Of torch. What learns without a graph gains nothing by more than one."""
    from learner.algorithms.kernels.fused import applies

    if config.torch_threads is not None:
        return config.torch_threads
    if applies(policy):
        return 1
    return max(1, cores() - (workers if config.max_lag else 0))


def _check_whole_episodes(config: Config, longest: int | None) -> None:
    """Where the clock ends episodes, a rollout must have room for one and for the row that resets before it."""
    steps = config.algorithm.rollout_steps
    if longest is not None and steps <= longest:
        raise UsageError(
            f"rollout_steps {steps}: {config.algo} learns from whole episodes, and those of {config.env} take up to "
            f"{longest} steps; expected at least {longest + 1}"
        )


def _device(config: Config) -> str:
    import torch

    if config.device == "cuda" and not torch.cuda.is_available():
        raise UsageError("device cuda: PyTorch sees no GPU here; use --device cpu")
    return ("cuda" if torch.cuda.is_available() else "cpu") if config.device == "auto" else config.device


@contextmanager
def _signals_into(received: list[int]) -> Iterator[None]:
    """The first SIGINT or SIGTERM is noted; the second does what it would have done anyway."""
    before: dict[int, Any] = {}

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)
        for signum, handler in before.items():
            signal.signal(signum, handler)

    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            before[number] = signal.signal(number, note)
    except ValueError:  # not in the main thread: whoever owns it handles signals
        before.clear()
    try:
        yield
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)
