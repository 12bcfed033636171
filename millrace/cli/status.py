"""`millrace status ADDRESS`: ask a learner how its run is, and show it.

The law: whoever may connect may ask, and asking changes nothing; a learner that does not answer within the deadline is an
error, in one line.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable

import msgspec
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from millrace.cli.flags import StatusFlags
from protocol.errors import Refused, RunError
from protocol.messages import Inquire, Status, WorkerStatus
from protocol.wire.codec import encode
from protocol.wire.link import WorkerLink

ASK_AGAIN_S = EVERY_S = 1.0
DROPS = {
    "lost": "tickets of workers that were lost",
    "stale": "rollouts too old",
    "transitions_duplicate": "transitions sent twice",
    "transitions_late": "transitions of sessions that had ended",
    "transitions_invalid": "transitions that broke the law of a row",
    "messages_bad": "messages that could not be read",
}
LEFT = ("worker", "host", "lanes")  # columns of words; those of numbers stand to the right


def observer_name() -> str:
    """A name that no worker has."""
    return f"status-{socket.gethostname()}-{os.getpid()}-{os.urandom(3).hex()}"


def ask(link: WorkerLink, timeout_s: float, clock: Callable[[], float] = time.monotonic) -> Status:
    """One answer. Raises `RunError` when none comes within `timeout_s`."""
    deadline_s = clock() + timeout_s
    while (left_s := deadline_s - clock()) > 0:
        link.send(encode(Inquire()))
        if link.poll(min(ASK_AGAIN_S, left_s)):
            for message in link.answers():
                if isinstance(message, Status):
                    return message
        if link.trouble is not None and link.trouble.final:
            raise Refused(link.trouble.line)
    trouble = f": {link.trouble.line}" if link.trouble else "; is it running, and is this its address?"
    raise RunError(f"no learner answered within {timeout_s:g} s{trouble}")


def observe(link: WorkerLink, flags: StatusFlags) -> None:
    """Show one answer, or with --watch one every second. Raises `RunError` when the learner does not answer."""
    console = Console()
    if flags.json or not flags.watch or not console.is_terminal:
        while True:
            status = ask(link, flags.timeout_s)
            if flags.json:
                console.out(in_json(status), highlight=False)
            else:
                console.print(shown(status))
            if not flags.watch:
                return
            time.sleep(EVERY_S)
    with Live(console=console, auto_refresh=False) as live:
        while True:
            live.update(shown(ask(link, flags.timeout_s)), refresh=True)
            time.sleep(EVERY_S)


def in_json(status: Status) -> str:
    """One line, fields by name, which the message itself leaves out."""
    return msgspec.json.encode({"type": Status.__name__, **msgspec.structs.asdict(status)}).decode()


def shown(status: Status) -> RenderableType:
    """The run in two lines, its workers as a table, and what was dropped, by reason."""
    done = f"{status.env_steps:,} of {status.total_steps:,} env steps"
    score = "none yet" if status.return_mean is None else f"{status.return_mean:,.1f}"
    lag = f"lag {status.lag_mean:.1f} (max {status.lag_max})"
    run = f"{status.env}: {done}, {status.steps_per_s:,.0f} steps/s, return {score}, update {max(status.version, 0)}, {lag}"
    if not status.total_steps:
        run = f"{status.env}, a vector environment: {status.env_steps:,} env steps, {status.steps_per_s:,.0f} steps/s"
    table = Table(box=None, pad_edge=False, header_style="dim")
    rows = [_cells(worker, status.version) for worker in status.workers]
    for name in rows[0] if rows else ():
        table.add_column(name, justify="left" if name in LEFT else "right")
    for row in rows:
        table.add_row(*row.values())
    dropped = [f"{status.ledger[name]:,} {what}" for name, what in DROPS.items() if status.ledger.get(name)]
    workers = table if status.workers else Text("no worker is here", style="bold yellow")
    return Group(Text(run, style="bold"), Text(""), workers, Text(""), Text(f"dropped: {', '.join(dropped) or 'nothing'}"))


def _cells(worker: WorkerStatus, version: int) -> dict[str, str]:
    behind = version - worker.version
    return {
        "worker": worker.worker + (f" ({worker.strikes} strikes)" if worker.strikes else ""),
        "host": worker.host,
        "pid": str(worker.pid),
        "lanes": "draining" if worker.standing == "draining" else ",".join(map(str, worker.lanes)) or "spare",
        "tickets": str(worker.tickets),
        "steps/s": f"{worker.steps_per_s:,.0f}",
        "weights": "none" if worker.version < 0 else "newest" if behind <= 0 else f"{behind} behind",
        "silent": f"{worker.silent_s:.1f} s",
        "memory": f"{worker.resident_bytes / 2**20:,.0f} MB" if worker.resident_bytes else "-",
    }
