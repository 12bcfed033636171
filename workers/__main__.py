"""The program `python -m millrace.workers ADDRESS` or `millrace worker ADDRESS`: a supervisor of workers.

The supervisor imports neither numpy nor gymnasium. The same program with `--parent` is a worker (`workers/program.py`).

Exit codes: 0 if the workers were drained or asked to leave; 1 if one failed, or no learner answered; 2 if one was refused,
or the flags were wrong. With --stay, the program ends only if it is asked to leave, or refused.
"""

from __future__ import annotations

import logging
import os
import signal
import sys

from millrace.flags.parse import parse_flags
from millrace.protocol.address import check_worker_name
from millrace.protocol.bounds import MAX_NAME, one_line
from millrace.protocol.errors import UsageError, UserFacingError
from millrace.protocol.keys.keys import Token
from millrace.protocol.keys.worker_token import read_token
from millrace.protocol.machine.deferred_signals import heeded
from millrace.workers.conversation.connection_rules import checked_token
from millrace.workers.flags import WorkerFlags
from millrace.workers.shared_weights import SUPPORTED, SharedWeights
from millrace.workers.supervise.learner_notice import AliveSender
from millrace.workers.supervise.supervisor import Supervisor, core_flags
from millrace.workers.supervise.worker_process import WorkerCommand, WorkerProcess

log = logging.getLogger("millrace.worker")


def main(argv: list[str] | None = None) -> int:
    """Run one worker, or several with --processes. Returns the exit code. Raises `UsageError` for words that
    aren't flags.
    """
    flags = parse_flags(WorkerFlags, sys.argv[1:] if argv is None else argv, "worker")
    shown = one_line(flags.called, MAX_NAME)
    logging.basicConfig(
        level=logging.INFO, format=f"%(asctime)s worker {shown.replace('%', '%%')}: %(message)s", stream=sys.stderr
    )
    signals = _count_signals()
    try:
        _check(flags)
        token = checked_token(flags.address, read_token(flags.token), insecure=flags.insecure)
        if flags.parent:
            from millrace.workers.program import work

            return work(flags, token, signals)
        return _supervise(flags, token, signals)
    except UserFacingError as error:
        sys.stderr.write(f"worker {shown}: {error}\n")
        return error.exit_code


def _check(flags: WorkerFlags) -> None:
    """Raise `UsageError` if the value of a flag is one that no worker can use."""
    if flags.address.startswith("inproc://"):
        raise UsageError(f"address {flags.address}: expected ipc://PATH or tcp://HOST:PORT; inproc reaches no other process")
    check_worker_name(flags.called if flags.processes == 1 else f"{flags.called}-w{flags.processes - 1}")
    if flags.core is not None and flags.core not in (allowed := os.sched_getaffinity(0)):
        raise UsageError(f"core: expected one that this process may use, of {sorted(allowed)}, got {flags.core}")


def _supervise(flags: WorkerFlags, token: Token | None, signals: list[int]) -> int:
    """Run workers, each in its own process, and watch them here. Returns the exit code."""
    cores = sorted(os.sched_getaffinity(0)) if flags.pin else []
    passed = ["--join-timeout-s", str(flags.join_timeout_s)]
    passed += [f"--{flag.replace('_', '-')}" for flag in ("stay", "evaluate", "insecure", "no_code") if getattr(flags, flag)]
    passed += [] if flags.core is None else ["--core", str(flags.core)]

    def start(number: str) -> WorkerProcess:
        name = flags.called if flags.processes == 1 else f"{flags.called}-{number}"
        own_flags = [*passed, *core_flags(cores, number)]
        if flags.stay:
            log.info("worker %s: waiting for a learner at %s", name, flags.address)
        descriptors = () if weights is None else weights.descriptors(name)
        if descriptors:
            own_flags += ["--weights", ",".join(map(str, descriptors))]
        return WorkerProcess(WorkerCommand(flags.address, name, token=token, flags=own_flags, handed=descriptors))

    weights = SharedWeights() if SUPPORTED and flags.processes > 1 else None
    notice = AliveSender(flags.address, token, weights)
    try:
        supervisor = Supervisor(start, flags.processes, stay=flags.stay)
        return supervisor.run(lambda: len(signals), lambda line: log.warning("%s", line), notice)
    finally:
        notice.close()
        if weights is not None:
            weights.close()


def _count_signals() -> list[int]:
    """Install handlers that append each signal that ends the program to the returned list.

    The first signal asks the program to leave after the rollout in progress, the second to leave immediately.
    """
    received: list[int] = []
    for number in heeded():
        signal.signal(number, lambda signum, frame: received.append(signum))
    return received


if __name__ == "__main__":
    sys.exit(main())
