"""Keys, join tokens and the list of clients that may connect, as text and as records. Pure: no files, no sockets, no clock.

Rule: damaged text is reported, and no part of it is used. No repr and no error contains the secret half of a key. A key that
is not on the list, or was revoked, gives no access.
"""

from __future__ import annotations

import base64
import hashlib
import re
import tomllib
from dataclasses import dataclass, field
from datetime import datetime
from functools import cached_property
from typing import Any

import msgspec
import zmq
import zmq.utils.z85

from millrace.protocol.bounds import INVALID
from millrace.protocol.errors import UsageError

KEY_BYTES = 32
CHECK_BYTES = 4
TOKEN_PREFIX = "millrace1."  # the number is the version of the format
TOKEN_CHARACTERS = len(TOKEN_PREFIX) + -(-(2 * KEY_BYTES + CHECK_BYTES) * 4 // 3)
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
LIST_HEADER = """\
# The clients that may connect to learners of this machine. `millrace keys` edits it; a running learner reads it within
# a second or two. A client with a date at `revoked`, or without an entry, cannot connect, and is disconnected if it is.
"""


@dataclass(frozen=True)
class Key:
    """A CURVE key pair, 32 bytes each half."""

    public: bytes
    secret: bytes = field(repr=False)

    @staticmethod
    def new() -> Key:
        """A new random key pair from libzmq."""
        public, secret = zmq.curve_keypair()
        return Key(zmq.utils.z85.decode(public), zmq.utils.z85.decode(secret))

    @staticmethod
    def from_secret(secret: bytes) -> Key:
        """The key pair with this secret half."""
        return Key(zmq.utils.z85.decode(zmq.curve_public(zmq.utils.z85.encode(secret))), secret)


@dataclass(frozen=True)
class Token:
    """A join token: the learner's public key, and the key pair of one client."""

    server: bytes
    """public key of the learner, 32 bytes"""
    client: Key

    def to_text(self) -> str:
        """The token as one line of letters, digits, `-`, `_` and one `.`."""
        body = self.server + self.client.secret
        return TOKEN_PREFIX + base64.urlsafe_b64encode(body + _check(body)).decode().rstrip("=")

    @staticmethod
    def from_text(text: str, where: str) -> Token:
        """Parse a token. Raises a `UsageError` that names `where` and doesn't quote the text, because half of
        it is secret.
        """
        text = text.strip()
        if not text:
            raise UsageError(f"{where} is empty: expected a join token, one line that begins with {TOKEN_PREFIX}")
        if not text.startswith(TOKEN_PREFIX):
            other = re.match(r"millrace(\d+)\.", text)
            got = f"one of version {other[1]}; install the learner's version of millrace" if other else "something else"
            raise UsageError(f"{where}: expected a join token, one line that begins with {TOKEN_PREFIX}, got {got}")
        if len(text.split()) > 1:
            raise UsageError(f"{where}: expected a join token in one line and nothing else, got {len(text.split())} words")
        if len(text) != TOKEN_CHARACTERS:
            what = "cut short" if len(text) < TOKEN_CHARACTERS else "too long"
            raise UsageError(
                f"{where}: the join token is {what}: expected {TOKEN_CHARACTERS} characters, got {len(text)}; copy it again"
            )
        try:
            raw = base64.b64decode(text[len(TOKEN_PREFIX) :] + "=", altchars=b"-_", validate=True)
        except ValueError:
            raw = b""
        body = raw[: 2 * KEY_BYTES]
        if Token(body[:KEY_BYTES], Key(b"", body[KEY_BYTES:])).to_text() != text:  # compares checksum and text
            raise UsageError(f"{where}: the join token is damaged (its checksum does not fit); copy it again")
        return Token(body[:KEY_BYTES], Key.from_secret(body[KEY_BYTES:]))


def _check(body: bytes) -> bytes:
    return hashlib.sha256(TOKEN_PREFIX.encode() + body).digest()[:CHECK_BYTES]


class Client(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """One client: its name, its public key, and the dates at which the key was made and revoked."""

    name: str
    public: str
    """64 hexadecimal digits"""
    made: datetime
    revoked: datetime | None = None


@dataclass(frozen=True)
class ClientList:
    """The clients that may connect, and those whose keys were revoked."""

    clients: tuple[Client, ...] = ()

    def rejection_reason(self, public: bytes) -> str:
        """Why messages and handshakes with this key are refused, or an empty string if they are not."""
        client = self._known.get(public)
        if client is None:
            return f"its key {fingerprint(public)} is not allowed here"
        if client.revoked is not None:
            return f"its key {client.name} ({fingerprint(public)}) was revoked"
        return ""

    def name_of(self, public: bytes) -> str:
        """The name of the client with this key, or the key's fingerprint if there is no such client."""
        client = self._known.get(public)
        return fingerprint(public) if client is None else client.name

    @cached_property
    def _known(self) -> dict[bytes, Client]:
        """Clients by public key. If a key occurs twice, a revoked entry wins."""
        return {bytes.fromhex(one.public): one for one in sorted(self.clients, key=lambda one: one.revoked is not None)}

    def valid(self, name: str) -> Client | None:
        """The client with this name that may connect; None if there is none."""
        return next((client for client in self.clients if client.name == name and client.revoked is None), None)

    def names(self) -> list[str]:
        """Names of the clients that may connect."""
        return [client.name for client in self.clients if client.revoked is None]

    def with_client(self, name: str, public: bytes, made: datetime) -> ClientList:
        """The list with one more client. Raises `UsageError` if the name is taken or the key is on the list already."""
        check_name(name)
        if self.valid(name) is not None:
            raise UsageError(f"key {name} exists already; choose another name, or revoke it first")
        known = next((client for client in self.clients if client.public == public.hex()), None)
        if known is not None:
            state = "is allowed already" if known.revoked is None else "was revoked, which is final; make a new key"
            raise UsageError(f"public key {fingerprint(public)} ({known.name}) {state}")
        return ClientList((*self.clients, Client(name, public.hex(), made)))

    def with_revoked(self, name: str, now: datetime) -> ClientList:
        """The list with this client revoked. Raises `UsageError` if no client with this name may connect."""
        victim = self.valid(name)
        if victim is None:
            before = any(client.name == name for client in self.clients)
            raise UsageError(
                f"key {name}: {'it is revoked already' if before else 'no key has this name'}{_describe_allowed(self)}"
            )
        gone = msgspec.structs.replace(victim, revoked=now)
        return ClientList(tuple(gone if client is victim else client for client in self.clients))

    def to_toml(self) -> str:
        """The list as TOML, in the form that `from_toml` parses."""
        return LIST_HEADER + "".join(f"\n{_toml_table(client)}" for client in self.clients)

    @staticmethod
    def from_toml(text: str, where: str) -> ClientList:
        """Parse a list. If any part is invalid, raises a `UsageError` that names `where`; then nobody may connect."""
        try:
            table: dict[str, Any] = tomllib.loads(text)
            clients = msgspec.convert(table.pop("client", []), tuple[Client, ...])
        except INVALID as error:
            raise UsageError(f"{where} cannot be understood: {error}") from error
        if table:
            raise UsageError(f"{where}: expected tables [[client]] alone, got {min(table)}")
        for client in clients:
            check_name(client.name, f"{where}: ")
            public_key(client.public, f"{where}: client {client.name}")
        return ClientList(clients)


def _toml_table(client: Client) -> str:
    """A client as a TOML table. Names and public keys contain no character that TOML would escape."""
    lines = [f'name = "{client.name}"', f'public = "{client.public}"', f"made = {client.made}"]
    if client.revoked is not None:
        lines.append(f"revoked = {client.revoked}")
    return "\n".join(["[[client]]", *lines, ""])


def _describe_allowed(allowed: ClientList) -> str:
    return f"; those that may connect: {', '.join(allowed.names()) or 'none'}"


def check_name(name: str, where: str = "") -> str:
    """Return the name if it is valid, that is, if it can be part of a file name. Otherwise, raise `UsageError`."""
    if not NAME.fullmatch(name):
        raise UsageError(
            f"{where}name {name[:70]!r}: expected 1 to 64 letters, digits, '.', '_' or '-', beginning with one of the former"
        )
    return name


def public_key(text: str, where: str) -> bytes:
    """Parse the hexadecimal digits of a public key. Returns its 32 bytes. Raises a `UsageError` that names `where`."""
    try:
        key = bytes.fromhex(text) if text.isascii() and not re.search(r"\s", text) else b""
    except ValueError:
        key = b""
    if len(key) != KEY_BYTES:
        if text.strip().startswith(TOKEN_PREFIX):
            raise UsageError(
                f"{where}: expected a public key, got a join token, which is secret; millrace keys show lists public keys"
            )
        raise UsageError(f"{where}: expected a public key of {2 * KEY_BYTES} hexadecimal digits, got {len(text)} characters")
    return key


def fingerprint(public: bytes) -> str:
    """The first 12 hexadecimal digits of a public key, by which people distinguish keys."""
    return public.hex()[:12]
