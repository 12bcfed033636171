"""Workers that play the episodes of a saved policy: processes of this machine, or workers that join from elsewhere.

Rule: whatever happens, no worker, socket file or temporary folder is left behind.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from learner.interrupts import Interrupts
from learner.members.endpoint import BindSettings
from learner.members.process_callbacks import ProcessCallbacks
from learner.policy_player import PolicyPlayer, SavedPolicy
from millrace.launch.endpoint import open_endpoint
from workers.supervisor import Supervisor


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
    with ExitStack() as stack:
        interrupts = stack.enter_context(Interrupts())

        def check_interrupt() -> None:
            if interrupts.received:
                raise KeyboardInterrupt

        endpoint = open_endpoint(BindSettings(which.bind), which.transport, stack)
        if which.bind:
            processes = ProcessCallbacks()
            endpoint.announce("")
        else:
            logs = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="millrace-")))
            supervisor = Supervisor(endpoint.starter(lambda name: ([], logs / f"{name}.log")), which.workers)
            stack.callback(supervisor.stop, 2.0)
            processes = ProcessCallbacks(supervisor.poll, expected=which.workers)
        player = PolicyPlayer(policy, endpoint.link, processes, check_interrupt, watch)
        reason = "all episodes played"
        try:
            yield player
        except BaseException as error:
            reason = "interrupted" if isinstance(error, KeyboardInterrupt) else str(error)
            raise
        finally:
            player.leave(reason)
