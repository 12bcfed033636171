"""Addresses: which can be used, which only this machine can reach, and what to type on another machine.

The law: what is not certainly of this machine alone counts as reachable by others. An IPv6 address stands in brackets. Pure,
but for `needs_ipv6` and `resolves`, which ask the system's resolver about names.
"""

from __future__ import annotations

import ipaddress
import socket

from protocol.errors import UsageError

WILDCARDS = {"*", "0.0.0.0", "[::]", "[::ffff:0.0.0.0]"}


def check_address(address: str) -> str:
    """Return the address if it can be used. Raises `UsageError` in one line."""
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
    elif any(character.isspace() or character in "/;@?#[]" for character in host):
        raise UsageError(f"address {address}: expected a host name or an IP address, got {host}")


def host_of(address: str) -> str:
    """The host of a tcp address, an IPv6 address in its brackets; empty for other transports."""
    scheme, _, rest = address.partition("://")
    return rest.rpartition(":")[0] if scheme == "tcp" else ""


def is_local(address: str) -> bool:
    """True for addresses that only this machine can reach."""
    host = host_of(address)
    if not address.startswith("tcp://") or host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:  # a name; whatever it is resolved to, it is not ours to trust
        return False


def needs_ipv6(address: str) -> bool:
    """True for an IPv6 address, and for a name that has no other: with both, ZeroMQ would try IPv6 alone."""
    host = host_of(address)
    if host.startswith("["):
        return True
    return _is_name(host) and not _found(host, socket.AF_INET) and _found(host, socket.AF_INET6)


def resolves(address: str) -> bool:
    """False if the address names a host that the system does not know, at least now."""
    host = host_of(address)
    return not _is_name(host) or _found(host, socket.AF_UNSPEC)


def advertised_address(bound: str, advertise: str, machine: str) -> str:
    """What others type to reach a learner that listens at `bound`.

    `advertise` is the host to name; without it that of the address, and for one that means every interface `machine`.
    """
    scheme, _, rest = bound.partition("://")
    host, _, port = rest.rpartition(":")
    if scheme != "tcp":
        return bound
    named = advertise or (machine if host in WILDCARDS else host)
    return f"tcp://{f'[{named}]' if ':' in named and not named.startswith('[') else named}:{port}"


def worker_name(peer: bytes) -> bytes:
    """The worker's name, with which its routing id begins; under a key a zero byte and more follow."""
    return peer.partition(b"\0")[0]


def _is_name(host: str) -> bool:
    if not host or host == "*" or host.startswith("["):
        return False
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return True
    return False


def _found(host: str, family: socket.AddressFamily) -> bool:
    try:
        return bool(socket.getaddrinfo(host, None, family))
    except OSError:
        return False
