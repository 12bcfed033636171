"""Addresses: whether one is valid, whether only this machine can reach it, and what to type on another machine.

Rule: an address counts as reachable by other machines unless it certainly is not. An IPv6 address is in brackets. Pure,
except for `needs_ipv6` and `resolves`, which ask the system's resolver about names.
"""

from __future__ import annotations

import ipaddress
import socket

from millrace.protocol.bounds import MAX_NAME, one_line
from millrace.protocol.errors import UsageError

WILDCARDS = {"*", "0.0.0.0", "[::]", "[::ffff:0.0.0.0]"}


def check_address(address: str) -> str:
    """Return the address. Raises `UsageError`, with a one-line message, if it is not valid."""
    if one_line(address, len(address)) != address:
        raise UsageError(f"address {one_line(address, 200)}: expected text without control characters")
    scheme, sep, rest = address.partition("://")
    if not sep or scheme not in {"inproc", "ipc", "tcp"} or not rest:
        raise UsageError(f"address {address}: expected inproc://NAME, ipc://PATH or tcp://HOST:PORT")
    if scheme == "tcp":
        host, _, port = rest.rpartition(":")
        if port != "*" and not (port.isdecimal() and port.isascii() and 0 < int(port) < 65536):
            raise UsageError(f"address {address}: expected a port, 1 to 65535, as in tcp://127.0.0.1:5555")
        _check_host(address, host)
    return address


def _check_host(address: str, host: str) -> None:
    if not host:
        raise UsageError(f"address {address}: expected a host before the port, as in tcp://127.0.0.1:5555")
    if host.startswith("["):
        try:
            ipaddress.IPv6Address(host.removeprefix("[").removesuffix("]") if host.endswith("]") else "")
        except ValueError:
            raise UsageError(f"address {address}: expected an IPv6 address in brackets, as in tcp://[::1]:5555") from None
    elif ":" in host:
        raise UsageError(f"address {address}: expected an IPv6 address in brackets, as in tcp://[{host}]:5555")
    elif not all(character.isalnum() or character in "._-*" for character in host):
        raise UsageError(f"address {address}: expected a host name or an IP address, got {host}")


def host_of(address: str) -> str:
    """The host of a tcp address, with brackets if it is an IPv6 address; empty for other transports."""
    scheme, _, rest = address.partition("://")
    return rest.rpartition(":")[0] if scheme == "tcp" else ""


def is_local(address: str) -> bool:
    """True for addresses that only this machine can reach."""
    host = host_of(address)
    if not address.startswith("tcp://") or host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:  # a name may resolve to anything
        return False


def needs_ipv6(address: str) -> bool:
    """True for an IPv6 address, and for a name with only IPv6 addresses. With IPv6 on, ZeroMQ tries no IPv4 address."""
    host = host_of(address)
    if host.startswith("["):
        return True
    return _is_name(host) and not _has_address(host, socket.AF_INET) and _has_address(host, socket.AF_INET6)


def resolves(address: str) -> bool:
    """False if the address names a host that the system cannot resolve now."""
    host = host_of(address)
    return not _is_name(host) or _has_address(host, socket.AF_UNSPEC)


def advertised_address(bound: str, advertise: str, machine: str) -> str:
    """The address at which other machines reach a learner that listens at `bound`.

    The host is `advertise` if given, else `machine` if `bound` means every interface, else the host of `bound`.
    """
    scheme, _, rest = bound.partition("://")
    host, _, port = rest.rpartition(":")
    if scheme != "tcp":
        return bound
    named = advertise or (machine if host in WILDCARDS else host)
    return f"tcp://{f'[{named}]' if ':' in named and not named.startswith('[') else named}:{port}"


def own_address(bound: str) -> str:
    """The address at which processes on the same machine reach a learner that listens at `bound`."""
    host = host_of(bound)
    if host not in WILDCARDS:
        return bound
    return f"tcp://{'[::1]' if host == '[::]' else '127.0.0.1'}:{bound.rpartition(':')[2]}"


def check_worker_name(name: str) -> None:
    """Raise `UsageError` if no worker can have this name."""
    size = len(name.encode(errors="replace"))
    if not 1 <= size <= MAX_NAME or one_line(name, MAX_NAME) != name:
        raise UsageError(
            f"worker name {name[:40]!r}: expected 1 to {MAX_NAME} bytes without control characters, got {size} bytes"
        )


def worker_name(peer: bytes) -> bytes:
    """The worker's name: the peer's id up to the first zero byte. If the learner has keys, a zero byte and the peer's key
    follow the name.
    """
    return peer.partition(b"\0")[0]


def key_of_peer(peer: bytes) -> bytes:
    """The key at the end of a peer's id, after the last zero byte; empty if the learner has no keys."""
    _, separator, key = peer.rpartition(b"\0")
    return key if separator else b""


def name_for_people(peer: bytes) -> str:
    """The worker's name as text without control characters, for logs and errors. An unknown peer may send any bytes."""
    return one_line(worker_name(peer).decode(errors="replace"), MAX_NAME)


def _is_name(host: str) -> bool:
    if not host or host == "*" or host.startswith("["):
        return False
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return True
    return False


def _has_address(host: str, family: socket.AddressFamily) -> bool:
    try:
        return bool(socket.getaddrinfo(host, None, family))
    except (OSError, UnicodeError):  # UnicodeError: not a valid host name, for example with two dots in a row
        return False
