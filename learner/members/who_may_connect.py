"""The learner's endpoint: its address, who may connect, and the command that starts a worker on another machine.

Rule: an address that other machines can reach needs keys, unless the user sets `insecure`. Keys are made automatically on
first use. On loopback they are needed only if a key folder was specified, or if workers must call code that the learner
names or sends, because a worker does that only for a learner that it can be sure of. Over ipc and inproc, the operating
system decides who may connect. `membership.py` then decides which of the connected workers may join a run.
"""

from __future__ import annotations

import logging
import socket
from dataclasses import dataclass
from datetime import datetime
from typing import Protocol

from millrace.protocol.address import advertised_address, is_local
from millrace.protocol.errors import UsageError
from millrace.protocol.keys.key_folder import KeyFolder, Keyring, chosen_key_folder
from millrace.protocol.keys.keys import ClientList, Key, Token

log = logging.getLogger("millrace.learner")


class Listening(Protocol):
    """Settings that say where a learner listens: a run's `Config`, or a vector environment's `BindSettings`."""

    @property
    def bind(self) -> str:
        """The address."""
        ...

    @property
    def keys(self) -> str:
        """The key folder that the user specified; empty if none."""
        ...

    @property
    def insecure(self) -> bool:
        """Whether other machines may connect without keys."""
        ...


@dataclass(frozen=True)
class BindSettings:
    """Where a vector environment listens. Fields are named as in `Config`. Without an address, it starts its own workers."""

    bind: str = ""
    keys: str = ""
    insecure: bool = False
    advertise: str = ""


def keyring_for(config: Listening, now: datetime, *, calls_code: bool = False) -> Keyring | None:
    """The keys that may connect to `config.bind`; None if no key is needed. `calls_code`: whether workers must call code.

    Raises `UsageError` if both keys and `insecure` are given, or if the key folder can't be used.
    """
    if config.insecure and config.keys:
        raise UsageError(f"keys {config.keys} or insecure: expected one, got both")
    if not config.bind.startswith("tcp://"):
        return None
    if config.insecure:
        if not is_local(config.bind):
            log.warning(
                "%s is open to anyone who can reach it, without keys: they can read this run, feed it false rollouts and "
                "stop it, and nothing is encrypted; leave out --insecure to use keys",
                config.bind,
            )
        return None
    asked = chosen_key_folder(config.keys)
    if asked is None and is_local(config.bind) and not calls_code:
        return None
    folder = KeyFolder(asked)
    return Keyring(folder.server(), folder.ensure_first_client(now), folder)


def generate_run_keys(worker: str, now: datetime) -> tuple[Keyring, Token]:
    """Make keys for one run on this machine. They are not written to any file."""
    server = Key.new()
    client = Key.new()
    return Keyring(server, ClientList().with_client(worker, client.public, now)), Token(server.public, client)


def join_lines(address: str, advertise: str, keyring: Keyring | None) -> list[str]:
    """Lines that tell a person how to start a worker for the learner that listens at `address`."""
    reach = advertised_address(address, advertise, socket.gethostname())
    if keyring is None:
        insecure = "" if is_local(reach) else " --insecure"
        return [f"waiting for workers; start one with: millrace worker {reach}{insecure}"]
    token = None if keyring.folder is None else keyring.folder.first_token(keyring.allowed)
    if token is None:
        return [f"waiting for workers at {reach}; no token is here: `millrace keys new NAME` makes one"]
    if is_local(reach):
        return [f"waiting for workers; start one with: millrace worker {reach} --token {token}"]
    return [
        f"waiting for workers; start one with: millrace worker {reach} --token {token.name}",
        f"the token is {token}: a secret; copy it to the worker's machine, for example with scp, and keep its mode 0600",
    ]
