"""The program `python -m workers ADDRESS` or `millrace worker ADDRESS`: a supervisor, whose workers are its children.

The supervisor imports neither numpy nor gymnasium. The same program with `--parent` is a worker (`workers/program.py`).

Exit codes: 0 drained or asked to leave; 1 failed, or no learner answered; 2 refused, or bad usage. With --stay, only being
asked to leave or refused ends it.
"""

from __future__ import annotations

import argparse
import logging
import os
import signal
import socket
import sys

from protocol.address import check_worker_name
from protocol.alive import CallTimeouts
from protocol.bounds import MAX_NAME, one_line
from protocol.errors import UsageError, UserFacingError, check_at_least
from protocol.keys.key_folder import TOKEN_VARIABLE, read_token
from protocol.keys.keys import Token
from workers.conversation.connection_rules import REJOIN_TIMEOUT_S, checked_token
from workers.supervise.learner_notice import AliveSender
from workers.supervise.supervisor import Supervisor, core_flags, timeout_flags
from workers.supervise.worker_process import WorkerCommand, WorkerProcess

log = logging.getLogger("millrace.worker")


def main(argv: list[str] | None = None, prog: str = "python -m workers") -> int:
    """Run workers, one or with --processes many. Returns the exit code. `prog`: name in the usage text."""
    flags = _parser(prog).parse_args(argv)
    shown = one_line(flags.name, MAX_NAME)
    logging.basicConfig(
        level=logging.INFO, format=f"%(asctime)s worker {shown.replace('%', '%%')}: %(message)s", stream=sys.stderr
    )
    timeouts = CallTimeouts(flags.start_timeout_s, flags.step_timeout_s)
    signals = _count_signals()
    try:
        _check(flags)
        token = checked_token(flags.address, read_token(flags.token), insecure=flags.insecure)
        if flags.parent:
            from workers.program import work

            return work(flags, token, timeouts, signals)
        return _supervise(flags, token, timeouts, signals)
    except UserFacingError as error:
        sys.stderr.write(f"worker {shown}: {error}\n")
        return error.exit_code


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
        help="start N workers, one process each (default: %(default)d); one that fails is restarted",
    )
    basic.add_argument(
        "--name",
        default=f"{socket.gethostname()}-{os.getpid()}",
        help="name of this worker, unique in the run (default: host name and process id)",
    )
    basic.add_argument(
        "--stay",
        action="store_true",
        help="after a run, wait for the next learner at ADDRESS, until SIGTERM or Ctrl-C; every run gets new processes",
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
        help="leave when no learner has answered for S seconds (default: %(default)g; with --stay: never); a worker that "
        f"had joined waits for its learner to come back, {REJOIN_TIMEOUT_S:g} s or S if that is longer",
    )
    for call, what in (("start", "making or resetting one env copy, or making the policy"), ("step", "a step")):
        faults.add_argument(
            f"--{call}-timeout-s",
            type=float,
            default=600.0,
            metavar="S",
            help=f"end and restart a worker if {what} takes longer than S seconds; 0: no limit (default: %(default)g)",
        )
    # Internal flags: for the process that starts workers.
    parser.add_argument(
        "--parent", type=int, default=0, help=argparse.SUPPRESS
    )  # be a worker; leave when it is not the parent
    parser.add_argument("--activity", type=int, help=argparse.SUPPRESS)  # descriptor of the page that the parent reads
    parser.add_argument("--slots", type=int, help=argparse.SUPPRESS)  # descriptor whose locks the parent holds too
    parser.add_argument("--handed", default="", help=argparse.SUPPRESS)  # descriptors of shared memory
    return parser


def _check(flags: argparse.Namespace) -> None:
    """Raise `UsageError` for a flag that no worker can follow."""
    if flags.address.startswith("inproc://"):
        raise UsageError(f"address {flags.address}: expected ipc://PATH or tcp://HOST:PORT; inproc reaches no other process")
    check_at_least("processes", flags.processes, 1)
    check_worker_name(flags.name if flags.processes == 1 else f"{flags.name}-w{flags.processes - 1}")
    for name in ("join_timeout_s", "start_timeout_s", "step_timeout_s"):
        if not getattr(flags, name) >= 0:  # also true for NaN
            raise UsageError(f"{name}: expected a number of seconds >= 0, got {getattr(flags, name):g}")
    if flags.core is not None and flags.core not in (allowed := os.sched_getaffinity(0)):
        raise UsageError(f"core: expected one that this process may use, of {sorted(allowed)}, got {flags.core}")


def _supervise(flags: argparse.Namespace, token: Token | None, timeouts: CallTimeouts, signals: list[int]) -> int:
    """Run workers, each in a process of its own, and watch them here. Returns the exit code."""
    cores = sorted(os.sched_getaffinity(0)) if flags.pin else []
    passed = ["--join-timeout-s", str(flags.join_timeout_s), *timeout_flags(timeouts)]
    passed += [f"--{flag.replace('_', '-')}" for flag in ("stay", "insecure", "no_code") if getattr(flags, flag)]
    passed += [] if flags.core is None else ["--core", str(flags.core)]

    def start(number: str) -> WorkerProcess:
        name = flags.name if flags.processes == 1 else f"{flags.name}-{number}"
        own_flags = [*passed, *core_flags(cores, number)]
        if flags.stay:
            log.info("worker %s: waiting for a learner at %s", name, flags.address)
        return WorkerProcess(WorkerCommand(flags.address, name, token=token, flags=own_flags))

    notice = AliveSender(flags.address, token)
    try:
        supervisor = Supervisor(start, flags.processes, timeouts=timeouts, stay=flags.stay)
        return supervisor.run(lambda: len(signals), lambda line: log.warning("%s", line), notice)
    finally:
        notice.close()


def _count_signals() -> list[int]:
    """SIGTERM, SIGINT and SIGHUP ask to leave: the first after the rollout in progress, the second at once.

    A SIGHUP that is ignored (`nohup`) stays ignored.
    """
    received: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, lambda signum, frame: received.append(signum))
    return received


if __name__ == "__main__":
    sys.exit(main())
