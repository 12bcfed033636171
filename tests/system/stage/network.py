"""Several hosts on this machine, each with its own address: network namespaces, which are connected by a switch.

Rule: nothing outside these namespaces is changed, and they are removed when the network is closed. This needs root, `ip` and
`nft`. `why_not` says what is missing.
"""

from __future__ import annotations

import itertools
import os
import shutil
import subprocess
from types import TracebackType

DEADLINE_S = 10
_numbers = itertools.count()


def why_not() -> str:
    """The reason why this machine cannot have such a network; empty if it can."""
    if os.geteuid() != 0:
        return "network namespaces take root"
    missing = [name for name in ("ip", "nft") if shutil.which(name) is None]
    return f"{' and '.join(missing)} not found: install iproute2 and nftables" if missing else ""


class Host:
    """One machine of the network."""

    def __init__(self, switch: str, number: int) -> None:
        self.address = f"10.99.0.{number}"
        self.namespace = _namespace()
        self.before = ("ip", "netns", "exec", self.namespace)
        """words to put before a command that must run on this host"""
        self._switch, self._port = switch, f"port{number}"
        _ip("netns", "add", self.namespace)
        peer = ("peer", "name", self._port, "netns", switch)
        _ip("link", "add", "eth0", "netns", self.namespace, "type", "veth", *peer)
        self._here("addr", "add", f"{self.address}/24", "dev", "eth0")
        self._here("link", "set", "eth0", "address", f"02:00:00:00:00:{number:02x}")  # the same if it comes back
        for device in ("lo", "eth0"):
            self._here("link", "set", device, "up")
        _ip("-n", switch, "link", "set", self._port, "master", "bridge", "up")

    def cut(self) -> None:
        """Drop all packets between this host and the others. Its link stays up, so neither side is notified."""
        _ip("-n", self._switch, "link", "set", self._port, "nomaster")

    def heal(self) -> None:
        """Stop dropping packets."""
        _ip("-n", self._switch, "link", "set", self._port, "master", "bridge")

    def lose(self, percent: int) -> None:
        """Drop this percentage of the packets in each direction; 0: none."""
        rules = "table inet faults\ndelete table inet faults\n"
        if percent:
            drop = f"numgen random mod 100 < {percent} drop;"
            chains = [f"chain {hook} {{ type filter hook {hook} priority 0; {drop} }}\n" for hook in ("input", "output")]
            rules += f"table inet faults {{\n{''.join(chains)}}}\n"
        _run(["ip", "netns", "exec", self.namespace, "nft", "-f", "-"], rules)

    def slow(self, kilobits_per_s: int) -> None:
        """Limit the rate at which this host sends; 0: no limit."""
        rate = f"rate {kilobits_per_s}kbit burst 2kb latency 2s".split()
        command = ["replace", "dev", "eth0", "root", "tbf", *rate] if kilobits_per_s else ["del", "dev", "eth0", "root"]
        _run(["tc", "-n", self.namespace, "qdisc", *command])

    def processes(self) -> list[int]:
        """The pids of all processes on this host, also of those whose parents have ended."""
        return [int(pid) for pid in _ip("netns", "pids", self.namespace).split()]

    def vanish(self) -> None:
        """Remove the host and its connections without notifying anybody. Call `cut` and end its processes first."""
        _ip("-n", self._switch, "link", "delete", self._port)
        _ip("netns", "delete", self.namespace)

    def _here(self, *arguments: str) -> None:
        _ip("-n", self.namespace, *arguments)


class Network:
    """A switch and its hosts. Use it as a context manager."""

    def __init__(self) -> None:
        self._switch = _namespace()
        self._hosts: dict[int, Host] = {}

    def host(self, number: int) -> Host:
        """A new host with the address 10.99.0.`number`. A host that vanished may be made again."""
        self._hosts[number] = Host(self._switch, number)
        return self._hosts[number]

    def __enter__(self) -> Network:
        _ip("netns", "add", self._switch)
        _ip("-n", self._switch, "link", "add", "bridge", "type", "bridge")
        _ip("-n", self._switch, "link", "set", "bridge", "up")
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        there = _ip("netns", "list")
        for namespace in (*(host.namespace for host in self._hosts.values()), self._switch):
            if namespace in there:
                _ip("netns", "delete", namespace)


def _namespace() -> str:
    return f"millrace-{os.getpid()}-{next(_numbers)}"


def _ip(*arguments: str) -> str:
    return _run(["ip", *arguments])


def _run(command: list[str], stdin: str = "") -> str:
    done = subprocess.run(command, input=stdin, capture_output=True, text=True, timeout=DEADLINE_S, check=False)
    assert done.returncode == 0, f"{' '.join(command)}: {done.stderr.strip()}"
    return done.stdout
