"""`millrace status ADDRESS|RUN`: asks a learner for the state of its run and prints it. Needs only a worker's packages.

If no process trains the run, this prints the last state in the run's folder.

Rule: anyone who may connect may ask, and asking changes nothing. If a learner doesn't answer within the deadline, the error
is one line. Names that a peer has chosen are escaped, so that they can't control the terminal.
"""

from __future__ import annotations

import os
import shutil
import socket
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, TextIO

import msgspec
from msgspec import Meta

from millrace.flags.fields import Flag
from millrace.flags.parse import parse_flags
from millrace.learner.members.held_up import in_words
from millrace.learner.run_folder.living_owner import learner_of_run
from millrace.learner.run_folder.regular_files import read, reason
from millrace.learner.run_folder.run_format import MOST_CONFIG_BYTES, is_run_folder, parse_toml
from millrace.learner.run_folder.sentences import (
    bottleneck,
    lag_in_words,
    per_second,
    return_in_words,
    steps_in_words,
    weights_in_words,
    went_wrong,
    workers_here,
)
from millrace.learner.run_lines import RunLine, in_sentences, read_line
from millrace.protocol.errors import Refused, RunError, UsageError
from millrace.protocol.keys.key_folder import KeyFolder
from millrace.protocol.keys.keys import ClientList, Token
from millrace.protocol.keys.worker_token import TOKEN_VARIABLE, read_token
from millrace.protocol.messages import Inquire, Status, WorkerStatus
from millrace.protocol.wire.codec import encode
from millrace.protocol.wire.worker_link import OF_OBSERVER, WorkerLink
from millrace.workers.conversation.connection_rules import checked_token

ASK_AGAIN_S = WATCH_EVERY_S = 1.0
LEFT_ALIGNED = ("worker", "host", "lanes", "doing")  # text; the other columns contain numbers and are right-aligned


class StatusFlags(msgspec.Struct, frozen=True, kw_only=True):
    """Show a run's workers (speed, memory, seconds since the last message) and what was dropped, or how the run ended."""

    address: Annotated[str, Flag("ADDRESS|RUN", positional=True)]
    """where the learner listens, as in tcp://HOST:5555, or a run folder"""
    watch: bool = False
    """ask again every second, until Ctrl-C or until the learner ends"""
    json: bool = False
    """print one line of JSON instead of a table"""
    timeout_s: Annotated[float, Meta(gt=0)] = 5.0
    """seconds to wait for the learner's answer"""
    token: Annotated[str, Flag("FILE")] = ""
    """file with a join token, if workers need one; default: from MILLRACE_TOKEN or RUN's key folder"""
    insecure: bool = False
    """ask a learner on another machine without a token, and trust the answer"""


def run(argv: list[str]) -> int:
    """Print the status. Returns the exit code."""
    status(argv, sys.stdout)
    return 0


def status(argv: list[str], out: TextIO) -> None:
    """Run the command, and write to `out`. Raises `UsageError` for wrong flags, `RunError` if the learner doesn't answer."""
    values = parse_flags(StatusFlags, argv, "status")
    if "://" not in values.address and (last := last_state(Path(values.address))) is not None:
        out.write(f"{last_in_json(last) if values.json else in_sentences(last)}\n")
        return
    address, token = whom_to_ask(values.address, read_token(values.token), insecure=values.insecure)
    link = WorkerLink(address, observer_name(), token=token, limits=OF_OBSERVER)
    try:
        while True:
            answer = ask(link, values.timeout_s)
            text = in_json(answer) if values.json else as_table(answer)
            if not values.watch:
                out.write(f"{text}\n")
                return
            if values.json or not out.isatty():
                out.write(f"{text}\n")
                out.flush()
            else:
                redraw(text, out)
            time.sleep(WATCH_EVERY_S)
    finally:
        link.close(linger_s=0)


def last_state(run: Path) -> RunLine | None:
    """The last state of a run that no process trains; None if a process seems to train it, or if the folder isn't a run."""
    line = read_line(run, time.time()) if is_run_folder(run) else None
    return None if line is None or line.state in ("training", "unreadable") else line


def whom_to_ask(where: str, token: Token | None, *, insecure: bool) -> tuple[str, Token | None]:
    """The address of a learner, and the token with which to connect. `where`: its address, or the folder of its run.

    A run folder names the learner's key folder. If `token` is None, a token from that folder is used. Raises `UsageError` if
    the folder or the token can't be used.
    """
    if "://" in where:
        return where, checked_token(where, token, insecure=insecure)
    learner = learner_of_run(Path(where))
    if token is None and learner.keys is not None and not insecure:
        token = token_of_learner(where, learner.keys)
    if learner.is_here:
        return learner.address, None if learner.keys is None else token
    return learner.address, checked_token(learner.address, token, insecure=insecure)


def token_of_learner(run: str, folder: Path) -> Token:
    """A token from the learner's key folder. Raises `UsageError` if this machine has none.

    The run, which names the folder, may come from a stranger, so the folder must be outside the run and is read with limits.
    """
    keys = KeyFolder(folder)
    path = None
    try:
        if Path(os.path.realpath(folder)).is_relative_to(os.path.realpath(run)):
            raise UsageError(f"run {run}: its lock names a key folder inside the run folder; expected --token FILE")
        text = read(keys.list_path, MOST_CONFIG_BYTES).decode()
        parse_toml(text, f"list {keys.list_path}")  # raises an error if the next line would take long
        path = keys.first_token(ClientList.from_toml(text, f"list {keys.list_path}"))
    except FileNotFoundError:
        pass
    except (OSError, ValueError) as error:
        raise UsageError(f"run {run}: key folder {folder} cannot be read: {reason(error)}; expected --token FILE") from error
    if path is None:
        raise UsageError(
            f"run {run}: its learner needs a key, and no token is in {folder} here: expected --token FILE (or "
            f"{TOKEN_VARIABLE}); on the learner's machine, `millrace keys new NAME --keys {folder}` makes one"
        )
    token = read_token(str(path))
    assert token is not None, "the path is not empty"
    return token


def observer_name() -> str:
    """A name for the connection that no worker has."""
    return f"status-{socket.gethostname()}-{os.getpid()}-{os.urandom(3).hex()}"


def ask(link: WorkerLink, timeout_s: float, clock: Callable[[], float] = time.monotonic) -> Status:
    """Ask the learner for its status. Raises `RunError` if it doesn't answer within `timeout_s`."""
    deadline_s = clock() + timeout_s
    while (left_s := deadline_s - clock()) > 0:
        link.send(encode(Inquire()))
        if link.poll(min(ASK_AGAIN_S, left_s)):
            for message in link.answers():
                if isinstance(message, Status):
                    return message
        if link.problem is not None and link.problem.final:
            raise Refused(link.problem.line)
    trouble = f": {link.problem.line}" if link.problem else "; is it running, and is this its address?"
    raise RunError(f"no learner answered within {timeout_s:g} s{trouble}")


def in_json(status: Status) -> str:
    """The status as one line of JSON, with the names of all fields (the message itself has only values)."""
    return msgspec.json.encode({"type": Status.__name__, **msgspec.structs.asdict(status)}).decode()


def last_in_json(line: RunLine) -> str:
    """One line of JSON about a run that no process trains."""
    known = {"type": "LastState"} | line._asdict() | {"path": str(line.path)}
    return msgspec.json.encode({name: value for name, value in known.items() if name not in ("owner", "problem")}).decode()


def as_table(status: Status) -> str:
    """The status as text: a line about the run, who waits for whom, a table of workers, and what went wrong."""
    late = any(worker.late_actions for worker in status.workers)
    wanted = f"workers: {workers_here(status)}\n" if status.workers_wanted else ""
    held_up = bottleneck(status.progress)
    return "\n".join(
        [
            _run_line(status),
            *([_printable(held_up)] if held_up else []),
            "",
            *table([_cells(worker, status.version, late) for worker in status.workers], LEFT_ALIGNED, "no worker is here"),
            "",
            f"{wanted}{went_wrong(status.progress.ledger) or 'nothing was lost or dropped'}",
        ]
    )


def redraw(text: str, out: TextIO) -> None:
    """Clear the terminal and print as much of the text as fits."""
    columns, rows = shutil.get_terminal_size()
    lines = [line[:columns] for line in text.splitlines()[: rows - 1]]
    out.write("\x1b[H\x1b[2J" + "\n".join(lines) + "\n")
    out.flush()


def _run_line(status: Status) -> str:
    env = _printable(status.env)
    progress = status.progress
    steps = f"{steps_in_words(progress)} env steps"
    speed = f"{per_second(progress.steps_per_s)} steps/s"
    if not (progress.total_steps or progress.ledger):
        return f"{env}, a vector environment: {steps}, {speed}"
    score = f"return {return_in_words(progress.return_mean)}"
    figures = [f"{env}: {steps}", speed, score, f"update {max(status.version, 0):,}", lag_in_words(progress)]
    return ", ".join(filter(None, figures))


def _cells(worker: WorkerStatus, version: int, late: bool) -> dict[str, str]:
    """A row of the table, by column. `late`: include the column of late actions."""
    return {
        "worker": _printable(worker.worker) + (f" ({worker.strikes} strikes)" if worker.strikes else ""),
        "host": _printable(worker.host),
        "pid": str(worker.pid),
        "lanes": ",".join(map(str, worker.lanes)) if worker.state == "active" else _printable(worker.state),
        "tickets": str(worker.tickets),
        "steps/s": per_second(worker.steps_per_s),
        "weights": weights_in_words(worker.version, version),
        "silent": f"{worker.silent_s:.1f} s",
        "doing": in_words(_printable(worker.doing), worker.doing_s),
        "memory": f"{worker.resident_bytes / 2**20:,.0f} MB" if worker.resident_bytes else "-",
    } | ({"late actions": f"{worker.late_actions:,}"} if late else {})


def table(rows: Sequence[dict[str, str]], left_aligned: Sequence[str], empty: str) -> list[str]:
    """The lines of a table: the column names, followed by the rows; `empty` if there are no rows."""
    if not rows:
        return [empty]
    widths = {name: max(len(name), *(len(row[name]) for row in rows)) for name in rows[0]}

    def line(row: dict[str, str]) -> str:
        cells = (f"{row[name]:{'<' if name in left_aligned else '>'}{width}}" for name, width in widths.items())
        return "  ".join(cells).rstrip()

    return [line({name: name for name in widths}), *map(line, rows)]


def _printable(text: str) -> str:
    """Text from a peer, with control characters escaped."""
    return "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in text)
