"""`millrace keys`: who may join the learners of this machine. Gives lines; the command line prints them.

The law: a secret is printed only where it was asked for by name.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime

from learner.config.did_you_mean import did_you_mean
from learner.config.flag_parser import parse_flags
from millrace.cli.flags import KeysAllowFlags, KeysFlags, KeysNewFlags, KeysRevokeFlags, KeysShowFlags
from protocol.errors import UsageError
from protocol.keys.key_folder import KeyFolder, asked_folder
from protocol.keys.keys import public_key


def keys(argv: list[str]) -> list[str]:
    """What was done, in lines. Raises `UsageError`."""
    command, *rest = argv or [""]
    if command in ("-h", "--help"):
        return [f"  millrace keys {usage:18} {what}" for usage, what in USAGE.items()]
    if command not in COMMANDS:
        said = f"keys {command}: no such command{did_you_mean(command, COMMANDS)};" if command else "keys: which command?"
        raise UsageError(f"{said} expected one of {', '.join(COMMANDS)}")
    return COMMANDS[command](rest)


def _new(argv: list[str]) -> list[str]:
    flags = parse_flags(KeysNewFlags, argv, "keys new")
    folder = _folder(flags)
    if flags.server:
        token, public = folder.foreign(flags.name, public_key(flags.server, "--server"))
        lines = [f"token: {token}", f"on the learner's machine: millrace keys allow {public.hex()} {flags.name}"]
    else:
        token = folder.new(flags.name, _now())
        lines = [
            f"token: {token}",
            "a worker on another machine joins with its own copy: millrace worker ADDRESS --token FILE",
        ]
    return [token.read_text().strip()] if flags.print_token else lines


def _show(argv: list[str]) -> list[str]:
    folder = _folder(parse_flags(KeysShowFlags, argv, "keys show"))
    allowed = folder.allowed()
    lines = [f"key folder: {folder.path}", f"learner: {folder.server().public.hex()}"]
    width = max((len(client.name) for client in allowed.clients), default=0)
    for client in allowed.clients:
        state = f"revoked {client.revoked:%Y-%m-%d %H:%M}" if client.revoked else "may connect"
        lines.append(f"{client.name:{width}}  {client.public}  made {client.made:%Y-%m-%d %H:%M}  {state}")
    return lines if allowed.clients else [*lines, "no clients yet: `millrace keys new NAME` makes one"]


def _allow(argv: list[str]) -> list[str]:
    flags = parse_flags(KeysAllowFlags, argv, "keys allow")
    folder = _folder(flags)
    folder.allow(flags.name, public_key(flags.public, "keys allow"), _now())
    return [f"{flags.name} may connect"]


def _revoke(argv: list[str]) -> list[str]:
    flags = parse_flags(KeysRevokeFlags, argv, "keys revoke")
    _folder(flags).revoke(flags.name, _now())
    return [f"{flags.name} is shut out; learners that run cut it off within a second or two"]


def _folder(flags: KeysFlags) -> KeyFolder:
    return KeyFolder(asked_folder(flags.keys))


def _now() -> datetime:
    return datetime.now(UTC).replace(microsecond=0)


COMMANDS: dict[str, Callable[[list[str]], list[str]]] = {"new": _new, "show": _show, "allow": _allow, "revoke": _revoke}
USAGE = {
    "new NAME": "make a key and its join token, and allow it",
    "show": "public halves, names, dates, state",
    "allow PUBLIC NAME": "allow a key that was made elsewhere",
    "revoke NAME": "shut a key out, at once",
}
