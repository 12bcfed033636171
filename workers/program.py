"""Runs one worker in a process that a supervisor has started. Imports torch only if the policy needs it.

Exit codes: 0 if the worker was drained or asked to leave, or its supervisor has ended; EXIT_NO_LEARNER if no learner
answered; EXIT_UNSUITABLE if it cannot take part in this run; 1 if it failed; 2 if it was refused, or its flags were wrong.
The worker also writes the code to the page that the supervisor reads; if it exits without doing so, it counts as failed.
"""

from __future__ import annotations

import errno
import os
import signal
import socket
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

from millrace.protocol.env_spec import AllowedCode
from millrace.protocol.errors import UserFacingError
from millrace.protocol.keys.keys import Token
from millrace.protocol.wire.shared_memory import InheritedDescriptors
from millrace.protocol.wire.worker_link import WorkerLink
from millrace.workers.activity import Activity, ActivityReader, activity, share_activity
from millrace.workers.allowed_code import allowed_code
from millrace.workers.conversation.connection_rules import wait_limits_s
from millrace.workers.conversation.session import NO_LEARNER, Session
from millrace.workers.exit_codes import EXIT_NO_LEARNER
from millrace.workers.flags import WorkerFlags
from millrace.workers.machine_slots import share_slots
from millrace.workers.shared_weights import SharedWeightsReader
from millrace.workers.supervise.process_group import kill, live_members
from millrace.workers.supervise.worker_process import KILLED_WITHIN_S, NONCE_VARIABLE, POLL_S
from millrace.workers.watchdog import STDERR, Watchdog
from millrace.workers.worker import Worker, WorkerOptions, identity, parent_is_gone

LEAVE_AT_ONCE = 2  # number of requests to leave after which the rollout in progress is abandoned
LOOK_FOR_PARENT_S = 0.5
LEAVE_ORPHANED_WITHIN_S = 2.0  # time for leaving after the supervisor has died
CLOSED_WITHIN_S = 1.0  # seconds within which the sockets of a killed process are closed
AFTER_SUPERVISOR_S = 60.0  # the watchdog ends a hung worker this long after the supervisor should have


def work(flags: WorkerFlags, token: Token | None, signals: list[int]) -> int:
    """Run one worker in this process until it leaves. Returns the exit code.

    Each request to leave appends an entry to `signals`.
    """
    nonce = int(os.environ.pop(NONCE_VARIABLE, "0")) or None
    if flags.activity is not None:
        share_activity(Activity(flags.activity))
    if flags.slots is not None:
        share_slots(flags.slots)
    try:
        link = WorkerLink(flags.address, flags.called, token=token)
    except UserFacingError as error:
        activity().leave(error.exit_code)
        raise
    if flags.core is not None:
        os.sched_setaffinity(0, {flags.core})
    page = ActivityReader(activity())
    watchdog = Watchdog(lambda: page.timeouts().longest_s() + AFTER_SUPERVISOR_S)
    threading.Thread(target=_end_after_supervisor, args=(flags.parent, flags.address), daemon=True).start()
    join_timeout_s, rejoin_timeout_s = wait_limits_s(flags.join_timeout_s, stay=flags.stay)
    session = Session(
        identity(flags.called, nonce, evaluates=flags.evaluate),
        time.monotonic(),
        join_timeout_s=join_timeout_s,
        rejoin_timeout_s=rejoin_timeout_s,
    )
    options = WorkerOptions(
        code=AllowedCode.REGISTERED if flags.no_code else allowed_code(flags.address, token),
        stop_requests=lambda: LEAVE_AT_ONCE if parent_is_gone(flags.parent) else len(signals),
        feed_watchdog=watchdog.feed,
        shared_memory=InheritedDescriptors(*map(int, flags.handed.split(","))) if flags.handed else None,
        shared_weights=SharedWeightsReader(*map(int, flags.weights.split(","))) if flags.weights else None,
        exit_code=_exit_code,
    )
    left = Worker(link, session, options).run()
    watchdog.stop()
    if left.exit_code:
        _say(f"worker {flags.called}: {_explained(left.reason, link)}\n")
    if parent_is_gone(flags.parent):
        _remove_socket_of_killed_parent(flags.address)
        _kill_own_session()
    return _exit_code(left.exit_code, left.reason)


def _flush() -> None:
    """Write what is buffered to stderr, unless the environment has replaced or closed `sys.stderr`."""
    with suppress(Exception):
        sys.stderr.flush()


def _say(text: str) -> None:
    """Write to stderr, even if the environment has replaced or closed `sys.stderr`."""
    _flush()
    with suppress(OSError):
        os.write(STDERR, text.encode(errors="backslashreplace"))


def _exit_code(code: int, reason: str) -> int:
    """The exit code of this process. It tells the supervisor more than `code`, the exit code of the conversation."""
    return EXIT_NO_LEARNER if reason.startswith(NO_LEARNER) else code


def _end_after_supervisor(parent: int, address: str) -> None:
    """End this process if the supervisor is dead and the worker can't leave because the environment doesn't return."""
    while not parent_is_gone(parent):
        time.sleep(LOOK_FOR_PARENT_S)
    time.sleep(LEAVE_ORPHANED_WITHIN_S)
    _remove_socket_of_killed_parent(address)
    _kill_own_session()


def _kill_own_session() -> None:
    """End all processes that the environment has started, and then this one, because the supervisor can no longer do so.

    This process is ended last, because only it still holds the slots of its env copies.
    """
    if os.getpgrp() == os.getpid():
        _flush()
        give_up_at_s = time.monotonic() + KILLED_WITHIN_S
        while (others := set(live_members(os.getpid())) - {os.getpid()}) and time.monotonic() < give_up_at_s:
            kill(others)
            time.sleep(POLL_S)
        os.killpg(os.getpid(), signal.SIGKILL)


def _remove_socket_of_killed_parent(address: str) -> None:
    """Remove the learner's socket and the folder that the learner made for it, because a killed learner could not.

    If the parent was the supervisor of a `millrace worker`, the learner is alive, and the next worker needs the socket. The
    socket is therefore removed only once nothing listens on it. That may take a moment, because Linux reparents the children
    of a killed process before the last thread of that process has freed its memory and closed its sockets.
    """
    scheme, _, path = address.partition("://")
    if scheme == "ipc" and Path(path).parent.name.startswith("millrace-"):
        lives_at_s = time.monotonic() + CLOSED_WITHIN_S
        while _listens(path):
            if time.monotonic() > lives_at_s:
                return
            time.sleep(POLL_S)
        Path(path).unlink(missing_ok=True)
        with suppress(OSError):
            Path(path).parent.rmdir()


def _listens(path: str) -> bool:
    with socket.socket(socket.AF_UNIX) as caller:
        return caller.connect_ex(path) not in (errno.ECONNREFUSED, errno.ENOENT)


def _explained(reason: str, link: WorkerLink) -> str:
    """The reason for leaving; if no learner answered, followed by the likely cause."""
    if not reason.startswith(NO_LEARNER):
        return reason
    if link.problem is not None:
        return f"{reason}: {link.problem.line}"
    return f"{reason} at {link.address}; is the learner running, and is this its address?"
