"""Workers that play the episodes of a saved policy: processes of this machine, or workers that join from elsewhere.

Rule: whatever happens, no worker, socket file or temporary folder is left behind.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import zmq

from learner.interrupts import Interrupts
from learner.members.endpoint import BindSettings, join_lines, keyring_for
from learner.members.process_callbacks import ProcessCallbacks
from learner.policy_player import PolicyPlayer, SavedPolicy
from millrace.launch.local_worker_options import private_address
from protocol.wire.learner_link import LearnerLink
from workers.supervise.worker_process import WorkerCommand, WorkerProcess
from workers.supervise.worker_thread import WorkerThread
from workers.supervisor import Running, Supervisor

log = logging.getLogger("millrace.learner")


@dataclass(frozen=True)
class PlayingWorkers:
    """Which workers play."""

    workers: int = 2
    """Number of local workers to start."""
    transport: Literal["inproc", "ipc", "tcp"] = "ipc"
    bind: str = ""
    """Address at which workers from elsewhere join. Then no local worker is started."""


@contextmanager
def policy_player(policy: SavedPolicy, which: PlayingWorkers, watch: Callable[[str], None]) -> Iterator[PolicyPlayer]:
    """A player with its workers. `watch` gets how far it is. Raises `UserFacingError`, or `KeyboardInterrupt`."""
    keyring = keyring_for(BindSettings(which.bind), datetime.now(UTC).replace(microsecond=0)) if which.bind else None
    with ExitStack() as stack:
        interrupts = stack.enter_context(Interrupts())

        def check_interrupt() -> None:
            if interrupts.received:
                raise KeyboardInterrupt

        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        stack.callback(context.term)
        link = LearnerLink(which.bind or private_address(which.transport, stack), context, keyring)
        stack.callback(link.close, 0.5)
        if which.bind:
            processes = ProcessCallbacks()
            for line in join_lines(link.address, "", keyring):
                log.warning("%s", line)
        else:
            logs = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="millrace-")))
            supervisor = Supervisor(_starter(which, link.address, context, logs), which.workers)
            stack.callback(supervisor.stop, 2.0)
            processes = ProcessCallbacks(supervisor.poll, expected=which.workers)
        player = PolicyPlayer(policy, link, processes, check_interrupt, watch)
        reason = "all episodes played"
        try:
            yield player
        except BaseException as error:
            reason = "interrupted" if isinstance(error, KeyboardInterrupt) else str(error)
            raise
        finally:
            player.leave(reason)


def _starter(
    which: PlayingWorkers, address: str, context: zmq.Context[zmq.Socket[bytes]], logs: Path
) -> Callable[[str], Running]:
    if which.transport == "inproc":
        return lambda name: WorkerThread(address, name, context)
    return lambda name: WorkerProcess(WorkerCommand(address, name, logs / f"{name}.log"))
