"""Workers that play episodes with a saved policy: processes on this machine, or workers that join from elsewhere."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from millrace.launch.crew import Crew
from millrace.launch.learner_inference import NEVER_S, ActingSettings, open_stepping_pool
from millrace.launch.worker_pool import WorkerPool, open_worker_pool
from millrace.learner.config.rollout_config import RolloutConfig
from millrace.learner.interrupts import Interrupts
from millrace.learner.members.describe_coordinator import Unknown
from millrace.learner.members.who_may_connect import BindSettings
from millrace.learner.open_hub import lobby_settings
from millrace.learner.policy_player import PolicyPlayer, SavedPolicy
from millrace.learner.torch_setup import one_thread
from millrace.learner.vector_env.settings import VectorEnvSettings
from millrace.workers.supervise.supervisor import STOP_WITHIN_S


@dataclass(frozen=True)
class PlayingWorkers:
    """Settings of the workers that play the episodes."""

    workers: int = 2
    """Number of local workers to start."""
    transport: Literal["inproc", "ipc", "tcp"] = "ipc"
    bind: str = ""
    """Address at which workers from elsewhere join. If it isn't empty, no local worker is started."""
    inference: Literal["workers", "learner"] = "workers"
    """Where the policy acts: in each worker, or in this process."""
    copies: int = 1
    """Number of episodes that are played at the same time if the policy acts in this process."""
    settings: RolloutConfig = field(default_factory=RolloutConfig)
    """Timeouts, and the number of failures that are allowed."""


@contextmanager
def policy_player(policy: SavedPolicy, which: PlayingWorkers, watch: Callable[[str], None]) -> Iterator[PolicyPlayer]:
    """A context manager that starts the workers and yields a `PolicyPlayer`, which plays episodes with them.

    `watch` is called with the progress, as text. Raises `UserFacingError` if the workers can't start or fail, or
    `KeyboardInterrupt` after a signal.
    """
    with ExitStack() as stack:
        interrupts = stack.enter_context(Interrupts())
        if which.inference == "learner" or which.transport == "inproc":
            stack.enter_context(one_thread(uses_torch=policy.card.policy.needs_torch))

        def check_interrupt() -> None:
            if interrupts.received:
                raise KeyboardInterrupt

        pool = stack.enter_context(_pool(policy, which))
        crew = Crew(which.workers, logs=_log_folder(which, stack))
        lobby = stack.enter_context(pool.start(crew, lobby_settings(which.settings)))
        described = None
        if which.inference == "learner":
            described = lobby.describe(Unknown(policy.env.for_evaluation()), check_interrupt)
            lobby = pool.begin(described)
        stack.callback(pool.stop, STOP_WITHIN_S)
        player = PolicyPlayer(policy, lobby, check_interrupt, watch, which.settings, described)
        reason = "all episodes played"
        try:
            yield player
        except BaseException as error:
            reason = "interrupted" if isinstance(error, KeyboardInterrupt) else str(error)
            raise
        finally:
            player.leave(reason)


def _pool(policy: SavedPolicy, which: PlayingWorkers) -> AbstractContextManager[WorkerPool]:
    where = BindSettings(which.bind)
    if which.inference == "workers":
        policies = [each.card.policy for each in (policy.stored, policy.against) if each is not None]
        code = policy.env.called_code or ("an encoder" if any(each.encoder is not None for each in policies) else "")
        return open_worker_pool(where, which.transport, code)
    workers = None if which.bind else min(which.workers, which.copies)
    settings = which.settings
    copies = VectorEnvSettings(
        policy.env.for_evaluation(),
        which.copies,
        workers,
        which.copies,
        where,
        which.transport,
        timeout_s=NEVER_S,
        worker_timeout_s=settings.worker_timeout_s,
        call_timeouts=settings.call_timeouts(),
        copy=False,
        evaluates=True,
    )
    acting = ActingSettings(
        copies,
        workers=workers or 1,
        no_workers_timeout_s=settings.no_workers_timeout_s,
        device=lambda: "cpu",
    )
    return open_stepping_pool(acting)


def _log_folder(which: PlayingWorkers, stack: ExitStack) -> Path | None:
    """A folder for the logs of local workers; `stack` removes it. None if there are no local workers."""
    return None if which.bind else Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="millrace-")))
