"""`python -m workers ADDRESS`: one worker process. Imports no torch unless the policy looks at images.

Exit codes: 0 drained, told to stop, or its host is gone; 1 broke, or no learner answered; 2 refused or bad usage.
"""

from __future__ import annotations

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")  # before numpy: workers share the cores by being many

import argparse
import logging
import signal
import socket
import sys
import time
from contextlib import suppress
from pathlib import Path

from protocol.errors import OurError, UsageError
from protocol.keys.key_folder import TOKEN_VARIABLE, read_token
from protocol.keys.keys import Token
from protocol.specs import Code
from protocol.wire.link import WorkerLink
from protocol.wire.shared_memory import Handed
from workers.code_trust import entry, trusted
from workers.host import NOBODY, Host, Process, keeping_to
from workers.session import NO_LEARNER, Session
from workers.watchdog import Watchdog
from workers.worker import Worker, identity, parent_is_gone

log = logging.getLogger("millrace.worker")


def main(argv: list[str] | None = None, prog: str = "python -m workers") -> int:
    """Run one worker; the exit code. `prog` is the command that the help names."""
    parser = argparse.ArgumentParser(prog=prog, description="Step an environment for a learner.")
    parser.add_argument("address", help="where the learner listens: ipc://PATH or tcp://HOST:PORT")
    parser.add_argument(
        "--name", default=f"{socket.gethostname()}-{os.getpid()}", help="this worker's name, unique in the run"
    )
    parser.add_argument("--parent", type=int, default=0, help="leave when the process of this pid is no longer the parent")
    parser.add_argument("--join-timeout-s", type=float, default=60.0, help="leave when no learner has answered for so long")
    parser.add_argument(
        "--token", default="", help=f"file of the join token; or {TOKEN_VARIABLE}, which holds a file or a token"
    )
    parser.add_argument(
        "--insecure", action="store_true", help="believe whoever answers on another machine; no code of theirs"
    )
    parser.add_argument(
        "--no-code", action="store_true", help="only environments registered here: no pickled callables, no modules"
    )
    parser.add_argument(
        "--step-timeout-s", type=float, default=120.0, help="end when a step of one env copy takes longer; 0: however long"
    )
    parser.add_argument("--core", type=int, help="run on this core alone")
    parser.add_argument(
        "--processes",
        type=int,
        default=1,
        help="so many workers, each in a process of its own, restarted when it breaks",
    )
    parser.add_argument("--pin", action="store_true", help="with --processes: each keeps to one core")
    parser.add_argument("--handed", default="", help=argparse.SUPPRESS)  # descriptors of shared memory, from its host
    options = parser.parse_args(argv)
    logging.basicConfig(level=logging.INFO, format=f"%(asctime)s worker {options.name}: %(message)s", stream=sys.stderr)
    try:
        token = entry(options.address, read_token(options.token), insecure=options.insecure)
        if options.processes != 1:
            return _host(options, token)
        link = WorkerLink(options.address, options.name, token=token)
    except OurError as error:
        sys.stderr.write(f"worker {options.name}: {error}\n")
        return error.exit_code
    if options.core is not None:
        os.sched_setaffinity(0, {options.core})
    watchdog = Watchdog(options.step_timeout_s) if options.step_timeout_s else None
    stops = _count_signals()
    session = Session(identity(options.name), time.monotonic(), join_timeout_s=options.join_timeout_s)
    worker = Worker(
        link,
        session,
        told_to_stop=lambda: len(stops) or int(bool(options.parent) and parent_is_gone(options.parent)),
        alive=watchdog.feed if watchdog else lambda now: None,
        handed=Handed(*map(int, options.handed.split(","))) if options.handed else None,
        code=Code.REGISTERED if options.no_code else trusted(options.address, token),
    )
    left = worker.run()
    if watchdog:
        watchdog.stop()
    if options.parent and parent_is_gone(options.parent):
        _tidy_up_after(options.address)
    if left.exit_code:
        sys.stderr.write(f"worker {options.name}: {_advice(left.reason, link)}\n")
    return NOBODY if options.parent and left.reason.startswith(NO_LEARNER) else left.exit_code


def _host(options: argparse.Namespace, token: Token | None) -> int:
    """Many workers, and this process to look after them."""
    if options.processes < 1:
        raise UsageError(f"processes expected int >= 1, got {options.processes}")
    cores = sorted(os.sched_getaffinity(0)) if options.pin else []
    flags = ["--join-timeout-s", str(options.join_timeout_s), "--step-timeout-s", str(options.step_timeout_s)]
    flags += [flag for flag, given in (("--insecure", options.insecure), ("--no-code", options.no_code)) if given]

    def start(name: str) -> Process:
        return Process(options.address, f"{options.name}-{name}", None, token, [*flags, *keeping_to(cores, name)])

    stops = _count_signals()
    host = Host(start, options.processes)
    return host.keep(lambda: len(stops), lambda line: log.warning("%s", line))


def _count_signals() -> list[int]:
    """SIGTERM and SIGINT ask to leave: the first after the rollout in hand, the second at once."""
    received: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda signum, frame: received.append(signum))
    return received


def _tidy_up_after(address: str) -> None:
    """A host that was killed could not remove its socket and the folder that it had made for it."""
    scheme, _, path = address.partition("://")
    if scheme == "ipc" and Path(path).parent.name.startswith("millrace-"):
        Path(path).unlink(missing_ok=True)
        with suppress(OSError):
            Path(path).parent.rmdir()


def _advice(reason: str, link: WorkerLink) -> str:
    if not reason.startswith(NO_LEARNER):
        return reason
    if link.trouble is not None:
        return f"{reason}: {link.trouble.line}"
    return f"{reason} at {link.address}; is the learner running, and is this its address?"


if __name__ == "__main__":
    sys.exit(main())
