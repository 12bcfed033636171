"""Workers that play the episodes of a saved policy: processes of this machine, or workers that join from elsewhere.

Rule: whatever happens, no worker, socket file or temporary folder is left behind.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from millrace.launch.acting_thread import NEVER_S, acting_processes, acting_thread, lanes_of
from millrace.launch.endpoint import open_endpoint
from millrace.launch.local_worker_options import FlagsOfWorker
from millrace.launch.vector import listen
from millrace.learner.config.rollout_config import RolloutConfig
from millrace.learner.conversations import lobby_settings
from millrace.learner.interrupts import Interrupts
from millrace.learner.members.lobby import Lobby
from millrace.learner.members.who_may_connect import BindSettings
from millrace.learner.policy_player import PolicyPlayer, SavedPolicy
from millrace.learner.torch_setup import one_thread
from millrace.learner.vector_env.settings import VectorEnvSettings


@dataclass(frozen=True)
class PlayingWorkers:
    """Which workers play."""

    workers: int = 2
    """Number of local workers to start."""
    transport: Literal["inproc", "ipc", "tcp"] = "ipc"
    bind: str = ""
    """Address at which workers from elsewhere join. Then no local worker is started."""
    inference: Literal["workers", "learner"] = "workers"
    """Where the policy acts: in each worker, or in this process."""
    copies: int = 1
    """Episodes that are played at the same time, if the policy acts in this process."""
    settings: RolloutConfig = field(default_factory=RolloutConfig)
    """Timeouts, and how many failures are allowed."""


@contextmanager
def policy_player(policy: SavedPolicy, which: PlayingWorkers, watch: Callable[[str], None]) -> Iterator[PolicyPlayer]:
    """A player with its workers. `watch` gets how far it is. Raises `UserFacingError`, or `KeyboardInterrupt`."""
    with ExitStack() as stack:
        interrupts = stack.enter_context(Interrupts())
        if which.inference == "learner" or which.transport == "inproc":
            stack.enter_context(one_thread(uses_torch=policy.spec.needs_torch))

        def check_interrupt() -> None:
            if interrupts.received:
                raise KeyboardInterrupt

        if which.inference == "learner":
            player = _acting_player(policy, which, check_interrupt, watch, stack)
        else:
            player = _player(policy, which, check_interrupt, watch, stack)
        reason = "all episodes played"
        try:
            yield player
        except BaseException as error:
            reason = "interrupted" if isinstance(error, KeyboardInterrupt) else str(error)
            raise
        finally:
            player.leave(reason)


def _player(
    policy: SavedPolicy,
    which: PlayingWorkers,
    check_interrupt: Callable[[], None],
    watch: Callable[[str], None],
    stack: ExitStack,
) -> PolicyPlayer:
    """A player whose workers act."""
    endpoint = open_endpoint(BindSettings(which.bind), which.transport, stack)
    started = endpoint.workers(which.workers, _own_logs(which, stack), 2.0)
    _, processes = stack.enter_context(started)
    lobby = Lobby(endpoint.link, processes, lobby_settings(which.settings))
    return PolicyPlayer(policy, lobby, check_interrupt, watch, which.settings)


def _acting_player(
    policy: SavedPolicy,
    which: PlayingWorkers,
    check_interrupt: Callable[[], None],
    watch: Callable[[str], None],
    stack: ExitStack,
) -> PolicyPlayer:
    """A player that acts itself, in a thread: its workers step the copies of a vector environment, each a lane."""
    endpoint = open_endpoint(BindSettings(), "inproc", stack)
    workers, settings = None if which.bind else min(which.workers, which.copies), which.settings
    copies = VectorEnvSettings(
        policy.env.for_evaluation(),
        which.copies,
        workers,
        which.copies,
        BindSettings(which.bind),
        which.transport,
        timeout_s=NEVER_S,
        worker_timeout_s=settings.worker_timeout_s,
        call_timeouts=settings.call_timeouts(),
        copy=False,
        evaluates=True,
    )
    started = listen(copies, stack.enter_context(ExitStack())).start(_own_logs(which, stack), lobby_settings(settings))
    described = started.describe(check_interrupt)
    env = started.vector_env(described)
    stack.callback(env.close)
    lanes = lanes_of(env, 0, policy.facts, workers or 1, settings.no_workers_timeout_s, masked=policy.masked)
    thread = acting_thread(endpoint, lanes, lanes.evaluation_lane(which.copies), lambda: "cpu")
    stack.callback(thread.stop, 2.0)
    processes = acting_processes(thread, lanes, env, workers or 0)
    lobby = Lobby(endpoint.link, processes, lobby_settings(settings))
    return PolicyPlayer(policy, lobby, check_interrupt, watch, settings, described)


def _own_logs(which: PlayingWorkers, stack: ExitStack) -> FlagsOfWorker:
    """No flags, and for each worker that is started here a log in a folder that is removed at the end."""
    if which.bind:
        return lambda name: ([], None)
    logs = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="millrace-")))
    return lambda name: ([], logs / f"{name}.log")
