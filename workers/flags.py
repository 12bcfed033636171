"""The flags of a worker program, and of the worker processes that it starts."""

from __future__ import annotations

import os
import socket
from typing import Annotated

import msgspec
from msgspec import Meta

from millrace.flags.fields import Flag, NotNegative

SecondsFlag = Annotated[NotNegative, Flag("S")]
HIDDEN = Flag(hidden=True)


class WorkerFlags(msgspec.Struct, frozen=True, kw_only=True):
    """Start a worker: it steps environments for the learner at ADDRESS until the learner is done."""

    address: Annotated[str, Flag(positional=True)]
    """address of the learner: ipc://PATH or tcp://HOST:PORT"""
    processes: Annotated[int, Flag("N"), Meta(ge=1)] = 1
    """start N workers, one process each; failed ones are restarted. Each version of the weights is sent once for all"""
    name: str = ""
    """name of this worker, unique in the run; if not given, host name and process id"""
    stay: bool = False
    """after a run, wait for the next learner at ADDRESS, until SIGTERM or Ctrl-C; every run gets new processes"""
    evaluate: bool = False
    """only play the evaluations of the run, alongside training if the learner has --eval-workers; never collect"""
    token: Annotated[str, Flag("FILE")] = ""
    """file with the join token; or set MILLRACE_TOKEN to a file or a token"""
    insecure: bool = False
    """connect to a learner on another machine without a token; the learner is not authenticated, so this worker runs only
    environments that are registered here (as with --no-code)
    """
    no_code: bool = False
    """accept only environments that are registered here: no pickled callables, and no modules to import"""
    pin: bool = False
    """with --processes: pin each worker to one CPU core"""
    join_timeout_s: SecondsFlag = 60.0
    """leave if no learner has answered for S seconds (with --stay: never); a worker that has joined waits for its learner to
    come back for S seconds, but at least 600 s
    """

    parent: Annotated[int, HIDDEN] = 0
    """be a worker; leave when it is not the parent"""
    core: Annotated[int | None, HIDDEN] = None
    """run only on this CPU core"""
    activity: Annotated[int | None, HIDDEN] = None
    """descriptor of the page that the parent reads"""
    slots: Annotated[int | None, HIDDEN] = None
    """descriptor whose locks the parent holds too"""
    handed: Annotated[str, HIDDEN] = ""
    """descriptors of shared memory"""
    weights: Annotated[str, HIDDEN] = ""
    """descriptors of the weights that the parent shares"""

    @property
    def called(self) -> str:
        """The name of this worker."""
        return self.name or f"{socket.gethostname()}-{os.getpid()}"
