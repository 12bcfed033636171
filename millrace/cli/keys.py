"""`millrace keys`: who may join the learners of this machine. Returns lines; the command line prints them.

Rule: a secret is printed only if the user asked for it by name.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from datetime import UTC, datetime
from typing import NamedTuple

from millrace.cli.arguments import Arguments
from protocol.errors import UsageError, did_you_mean
from protocol.keys.key_folder import DEFAULT_FOLDER, FOLDER_VARIABLE, KeyFolder, chosen_key_folder
from protocol.keys.keys import public_key


class Subcommand(NamedTuple):
    """A subcommand of `millrace keys`."""

    run: Callable[[list[str]], list[str]]
    usage: str
    about: str


def run(argv: list[str]) -> int:
    """Run a subcommand and print its lines. Returns the exit code."""
    print(*keys(argv), sep="\n")
    return 0


def keys(argv: list[str]) -> list[str]:
    """Run a subcommand. Returns the lines to print. Raises `UsageError`."""
    name, *rest = argv or [""]
    if name in ("-h", "--help"):
        return _help()
    if name not in SUBCOMMANDS:
        problem = f"keys {name}: no such command{did_you_mean(name, SUBCOMMANDS)};" if name else "keys: which command?"
        raise UsageError(f"{problem} expected one of {', '.join(SUBCOMMANDS)}")
    return SUBCOMMANDS[name].run(rest)


def _help() -> list[str]:
    return [
        f"usage: millrace keys {'|'.join(SUBCOMMANDS)} …",
        "",
        "Choose which workers of other machines may join the learners of this machine.",
        "",
        *(f"  millrace keys {each.usage:18} {each.about}" for each in SUBCOMMANDS.values()),
        "",
        "millrace keys COMMAND --help lists the flags of each.",
    ]


def _new(argv: list[str]) -> list[str]:
    arguments = _arguments("new")
    arguments.flag("name", metavar="NAME", help="name of the client; `millrace keys revoke NAME` blocks its workers")
    arguments.flag(
        "--server", default="", metavar="PUBLIC",
        help="public key of a learner elsewhere: the token is for that learner, which must allow the key that is printed",
    )  # fmt: skip
    arguments.flag(
        "--print-token", action="store_true",
        help="print the token and nothing else, as for a secret store; whoever sees it can join",
    )  # fmt: skip
    values = arguments.parse(argv)
    folder = _folder(values)
    if values.server:
        token, public = folder.new_for_other_learner(values.name, public_key(values.server, "--server"))
        lines = [f"token: {token}", f"on the learner's machine: millrace keys allow {public.hex()} {values.name}"]
    else:
        token = folder.new(values.name, _now())
        lines = [
            f"token: {token}",
            "a worker on another machine joins with its own copy: millrace worker ADDRESS --token FILE",
        ]
    return [token.read_text().strip()] if values.print_token else lines


def _show(argv: list[str]) -> list[str]:
    folder = _folder(_arguments("show").parse(argv))
    allowed = folder.allowed()
    lines = [f"key folder: {folder.path}", f"learner: {folder.server().public.hex()}"]
    width = max((len(client.name) for client in allowed.clients), default=0)
    for client in allowed.clients:
        state = f"revoked {client.revoked:%Y-%m-%d %H:%M}" if client.revoked else "may connect"
        lines.append(f"{client.name:{width}}  {client.public}  made {client.made:%Y-%m-%d %H:%M}  {state}")
    return lines if allowed.clients else [*lines, "no clients yet: `millrace keys new NAME` makes one"]


def _allow(argv: list[str]) -> list[str]:
    arguments = _arguments("allow")
    arguments.flag("public", metavar="PUBLIC", help="public key of the client: 64 hexadecimal digits")
    arguments.flag("name", metavar="NAME", help="name that you give to the client, for use in `millrace keys revoke NAME`")
    values = arguments.parse(argv)
    _folder(values).allow(values.name, public_key(values.public, "keys allow"), _now())
    return [f"{values.name} may connect"]


def _revoke(argv: list[str]) -> list[str]:
    arguments = _arguments("revoke")
    arguments.flag("name", metavar="NAME", help="name of the client")
    values = arguments.parse(argv)
    _folder(values).revoke(values.name, _now())
    return [f"{values.name} is shut out; running learners cut it off within a second or two"]


def _arguments(name: str) -> Arguments:
    arguments = Arguments(f"keys {name}", SUBCOMMANDS[name].about.capitalize() + ".")
    arguments.flag(
        "--keys", default="", metavar="FOLDER",
        help=f"key folder; if not given, the one that {FOLDER_VARIABLE} names, or {DEFAULT_FOLDER}",
    )  # fmt: skip
    return arguments


def _folder(values: Namespace) -> KeyFolder:
    return KeyFolder(chosen_key_folder(values.keys))


def _now() -> datetime:
    return datetime.now(UTC).replace(microsecond=0)


SUBCOMMANDS = {
    "new": Subcommand(_new, "new NAME", "make a key for workers, allow it here, and write its join token to a file"),
    "show": Subcommand(_show, "show", "list the learner's public key and the clients: names, public keys, dates, states"),
    "allow": Subcommand(_allow, "allow PUBLIC NAME", "allow a client whose key was made on another machine"),
    "revoke": Subcommand(_revoke, "revoke NAME", "block a client; running learners disconnect its workers within seconds"),
}
