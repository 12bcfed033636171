"""The worker program: `python -m workers ADDRESS` or `millrace worker ADDRESS`. Imports torch only for an image policy.

Exit codes: 0 drained, asked to leave, or its supervisor has ended; 1 failed, or no learner answered; 2 refused, or bad
usage.
"""

from __future__ import annotations

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")  # before numpy is imported: there is a worker for each core

import argparse
import logging
import signal
import socket
import sys
import time
from contextlib import suppress
from pathlib import Path

from protocol.env_spec import AllowedCode
from protocol.errors import UsageError, UserFacingError
from protocol.keys.key_folder import TOKEN_VARIABLE, read_token
from protocol.keys.keys import Token
from protocol.wire.shared_memory import InheritedDescriptors
from protocol.wire.worker_link import WorkerLink
from workers.security import allowed_code, checked_token
from workers.session import NO_LEARNER, Session
from workers.supervisor import EXIT_NO_LEARNER, Supervisor, WorkerCommand, WorkerProcess, core_flags
from workers.watchdog import Watchdog
from workers.worker import Worker, WorkerOptions, identity, parent_is_gone

log = logging.getLogger("millrace.worker")


def main(argv: list[str] | None = None, prog: str = "python -m workers") -> int:
    """Run one worker, or with --processes many. Returns the exit code. `prog`: name in the usage text."""
    flags = _parser(prog).parse_args(argv)
    logging.basicConfig(level=logging.INFO, format=f"%(asctime)s worker {flags.name}: %(message)s", stream=sys.stderr)
    try:
        token = checked_token(flags.address, read_token(flags.token), insecure=flags.insecure)
        if flags.processes != 1:
            return _supervise(flags, token)
        link = WorkerLink(flags.address, flags.name, token=token)
    except UserFacingError as error:
        sys.stderr.write(f"worker {flags.name}: {error}\n")
        return error.exit_code
    return _work(flags, link, AllowedCode.REGISTERED if flags.no_code else allowed_code(flags.address, token))


def _parser(prog: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=prog, description="Start a worker: it steps environments for the learner at ADDRESS until the learner is done."
    )
    parser.add_argument("address", metavar="ADDRESS", help="address of the learner: ipc://PATH or tcp://HOST:PORT")

    basic = parser.add_argument_group("basic")
    basic.add_argument(
        "--processes",
        type=int,
        default=1,
        metavar="N",
        help="start N workers, one process each; one that fails is restarted",
    )
    basic.add_argument(
        "--name",
        default=f"{socket.gethostname()}-{os.getpid()}",
        help="name of this worker, unique in the run (default: host name and process id)",
    )

    network = parser.add_argument_group("workers and network")
    network.add_argument(
        "--token", default="", metavar="FILE", help=f"file with the join token; or set {TOKEN_VARIABLE} to a file or a token"
    )
    network.add_argument(
        "--insecure",
        action="store_true",
        help="connect to a learner on another machine without a token; the learner is not authenticated, so this worker "
        "runs only environments that are registered here (as with --no-code)",
    )
    network.add_argument(
        "--no-code",
        action="store_true",
        help="accept only environments that are registered here: no pickled callables, and no modules to import",
    )
    network.add_argument("--core", type=int, metavar="CORE", help="run only on this CPU core")
    network.add_argument("--pin", action="store_true", help="with --processes: pin each worker to one CPU core")

    faults = parser.add_argument_group("faults")
    faults.add_argument(
        "--join-timeout-s",
        type=float,
        default=60.0,
        metavar="S",
        help="leave when no learner has answered for S seconds (default: %(default)g)",
    )
    faults.add_argument(
        "--step-timeout-s",
        type=float,
        default=120.0,
        metavar="S",
        help="exit when a step of one env copy takes longer than S seconds; 0: no limit (default: %(default)g)",
    )
    # Internal flags: for the process that starts workers.
    parser.add_argument("--parent", type=int, default=0, help=argparse.SUPPRESS)  # leave when this is no longer the parent
    parser.add_argument("--handed", default="", help=argparse.SUPPRESS)  # descriptors of shared memory
    return parser


def _work(flags: argparse.Namespace, link: WorkerLink, code: AllowedCode) -> int:
    """Run one worker in this process. Returns the exit code."""
    if flags.core is not None:
        os.sched_setaffinity(0, {flags.core})
    watchdog = Watchdog(flags.step_timeout_s) if flags.step_timeout_s else None
    signals = _count_signals()
    session = Session(identity(flags.name), time.monotonic(), join_timeout_s=flags.join_timeout_s)
    options = WorkerOptions(
        code=code,
        stop_requests=lambda: len(signals) or int(bool(flags.parent) and parent_is_gone(flags.parent)),
        feed_watchdog=watchdog.feed if watchdog else lambda now: None,
        shared_memory=InheritedDescriptors(*map(int, flags.handed.split(","))) if flags.handed else None,
    )
    left = Worker(link, session, options).run()
    if watchdog:
        watchdog.stop()
    if flags.parent and parent_is_gone(flags.parent):
        _remove_socket_of_killed_parent(flags.address)
    if left.exit_code:
        sys.stderr.write(f"worker {flags.name}: {_explained(left.reason, link)}\n")
    return EXIT_NO_LEARNER if flags.parent and left.reason.startswith(NO_LEARNER) else left.exit_code


def _supervise(flags: argparse.Namespace, token: Token | None) -> int:
    """Run many workers, each in a process of its own, and watch them here. Returns the exit code."""
    if flags.processes < 1:
        raise UsageError(f"processes: expected int >= 1, got {flags.processes}")
    cores = sorted(os.sched_getaffinity(0)) if flags.pin else []
    passed = ["--join-timeout-s", str(flags.join_timeout_s), "--step-timeout-s", str(flags.step_timeout_s)]
    passed += [flag for flag, is_set in (("--insecure", flags.insecure), ("--no-code", flags.no_code)) if is_set]

    def start(name: str) -> WorkerProcess:
        own_flags = [*passed, *core_flags(cores, name)]
        return WorkerProcess(WorkerCommand(flags.address, f"{flags.name}-{name}", token=token, flags=own_flags))

    signals = _count_signals()
    return Supervisor(start, flags.processes).run(lambda: len(signals), lambda line: log.warning("%s", line))


def _count_signals() -> list[int]:
    """SIGTERM and SIGINT ask to leave: the first after the rollout in progress, the second at once."""
    received: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda signum, frame: received.append(signum))
    return received


def _remove_socket_of_killed_parent(address: str) -> None:
    """Remove the socket, and the folder that the learner made for it: a killed learner could not."""
    scheme, _, path = address.partition("://")
    if scheme == "ipc" and Path(path).parent.name.startswith("millrace-"):
        Path(path).unlink(missing_ok=True)
        with suppress(OSError):
            Path(path).parent.rmdir()


def _explained(reason: str, link: WorkerLink) -> str:
    """The reason for leaving, and if no learner answered, the likely cause."""
    if not reason.startswith(NO_LEARNER):
        return reason
    if link.problem is not None:
        return f"{reason}: {link.problem.line}"
    return f"{reason} at {link.address}; is the learner running, and is this its address?"


if __name__ == "__main__":
    sys.exit(main())
