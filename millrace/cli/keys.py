"""`millrace keys`: manages the keys with which workers may join this machine's learners.

Rule: a secret is printed only if the user asks for it with a flag.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated

import msgspec

from millrace.cli.subcommands import chosen_subcommand
from millrace.flags.fields import Flag
from millrace.flags.parse import parse_flags
from millrace.protocol.keys.key_folder import KeyFolder, chosen_key_folder
from millrace.protocol.keys.keys import public_key


class KeysFlags(msgspec.Struct, frozen=True, kw_only=True):
    """Flags that every subcommand has."""

    keys: Annotated[str, Flag("FOLDER")] = ""
    """key folder; if not given, the one that MILLRACE_KEYS names, or ~/.config/millrace/keys"""


class NewFlags(KeysFlags, frozen=True, kw_only=True):
    """Make a key for workers, allow it here, and write its join token to a file."""

    name: Annotated[str, Flag(positional=True)]
    """name of the client; `millrace keys revoke NAME` blocks its workers"""
    server: Annotated[str, Flag("PUBLIC")] = ""
    """public key of a learner on another machine; the token is for that learner, which must allow the printed key"""
    print_token: bool = False
    """print only the token, for example for a secret store; anyone who sees it can join"""


class ShowFlags(KeysFlags, frozen=True, kw_only=True):
    """List the learner's public key and the clients: names, public keys, dates, states."""


class AllowFlags(KeysFlags, frozen=True, kw_only=True):
    """Allow a client whose key was made on another machine."""

    public: Annotated[str, Flag(positional=True)]
    """public key of the client: 64 hexadecimal digits"""
    name: Annotated[str, Flag(positional=True)]
    """name that you give to the client, for use in `millrace keys revoke NAME`"""


class RevokeFlags(KeysFlags, frozen=True, kw_only=True):
    """Block a client; running learners disconnect its workers within seconds."""

    name: Annotated[str, Flag(positional=True)]
    """name of the client"""


SUBCOMMANDS: dict[str, type[KeysFlags]] = {
    "new": NewFlags,
    "show": ShowFlags,
    "allow": AllowFlags,
    "revoke": RevokeFlags,
}


def run(argv: list[str]) -> int:
    """Run a subcommand and print its lines. Returns the exit code."""
    print(*keys(argv), sep="\n")
    return 0


def keys(argv: list[str]) -> list[str]:
    """Run a subcommand. Returns the lines to print. Raises `UsageError` if the flags or the key folder can't be used."""
    about = "Choose which workers of other machines may join the learners of this machine."
    name, rest = chosen_subcommand("keys", about, SUBCOMMANDS, argv)
    flags = parse_flags(SUBCOMMANDS[name], rest, f"keys {name}")
    folder = KeyFolder(chosen_key_folder(flags.keys))
    now = datetime.now(UTC).replace(microsecond=0)
    match flags:
        case NewFlags():
            return _new(folder, flags, now)
        case AllowFlags():
            folder.allow(flags.name, public_key(flags.public, "keys allow"), now)
            return [f"{flags.name} may connect"]
        case RevokeFlags():
            folder.revoke(flags.name, now)
            return [f"{flags.name} is revoked; running learners disconnect it within a second or two"]
    return _show(folder)


def _new(folder: KeyFolder, flags: NewFlags, now: datetime) -> list[str]:
    if flags.server:
        token, public = folder.new_for_other_learner(flags.name, public_key(flags.server, "--server"))
        lines = [f"token: {token}", f"on the learner's machine: millrace keys allow {public.hex()} {flags.name}"]
    else:
        token = folder.new(flags.name, now)
        lines = [
            f"token: {token}",
            "a worker on another machine joins with its own copy: millrace worker ADDRESS --token FILE",
        ]
    return [token.read_text().strip()] if flags.print_token else lines


def _show(folder: KeyFolder) -> list[str]:
    allowed = folder.allowed()
    lines = [f"key folder: {folder.path}", f"learner: {folder.server().public.hex()}"]
    width = max((len(client.name) for client in allowed.clients), default=0)
    for client in allowed.clients:
        state = f"revoked {client.revoked:%Y-%m-%d %H:%M}" if client.revoked else "may connect"
        lines.append(f"{client.name:{width}}  {client.public}  made {client.made:%Y-%m-%d %H:%M}  {state}")
    return lines if allowed.clients else [*lines, "no clients yet: `millrace keys new NAME` makes one"]
