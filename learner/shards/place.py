"""Finds this process's place among the learner processes, from the environment variables of torchrun or another launcher."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from typing import NamedTuple

from millrace.learner.shards.division import Division
from millrace.protocol.address import is_local
from millrace.protocol.bounds import one_line
from millrace.protocol.errors import UsageError

LOOPBACK = ("lo", "lo0")  # names of the loopback interface, on Linux and on macOS
INTERFACES = ("GLOO_SOCKET_IFNAME", "NCCL_SOCKET_IFNAME")  # variables that name the interface where gloo and NCCL listen


class Place(NamedTuple):
    """The place of a process among those that torchrun, or another launcher that sets the same variables, has started."""

    rank: int
    processes: int
    host: str
    """the host where rank 0 listens"""
    port: int

    @staticmethod
    def of(environment: Mapping[str, str]) -> Place:
        """The place that RANK, WORLD_SIZE, MASTER_ADDR and MASTER_PORT describe; without WORLD_SIZE there is one process.

        Raises `UsageError` if they are incomplete or not valid.
        """
        if "WORLD_SIZE" not in environment:
            return ALONE
        try:
            numbers = [int(environment[name]) for name in ("RANK", "WORLD_SIZE")]
            if numbers[1] == 1:
                return ALONE
            rank, processes = numbers
            place = Place(rank, processes, environment["MASTER_ADDR"], int(environment["MASTER_PORT"]))
        except (KeyError, ValueError) as error:
            raise UsageError(
                f"shards: expected RANK, WORLD_SIZE, MASTER_ADDR and MASTER_PORT, as torchrun sets them, got {error}"
            ) from None
        if not 0 <= rank < processes:
            raise UsageError(f"shards: expected RANK from 0 to {processes - 1}, got {rank}")
        return place

    @property
    def is_local(self) -> bool:
        """Whether only processes on this machine can reach the address of rank 0."""
        return is_local(f"tcp://{self.host}:{self.port}")

    def division(self, shards: int) -> Division:
        """The division of shards among the processes. Raises `UsageError` if they can't be divided evenly."""
        if shards % self.processes:
            raise UsageError(
                f"shards {shards}: expected a multiple of {self.processes}, the number of learner processes (WORLD_SIZE)"
            )
        return Division(shards, self.processes, self.rank)


ALONE = Place(0, 1, "", 0)


def trains_alone(environment: Mapping[str, str]) -> str:
    """A warning if a launcher has started several processes of a run without shards; otherwise empty."""
    processes = environment.get("WORLD_SIZE", "1")
    if processes == "1":
        return ""
    return (
        f"WORLD_SIZE is {one_line(processes, 20)}, but shards is 1: each process trains a run of its own; to train one run "
        "with all of them, set --shards to a multiple of their number"
    )


def check_loopback(place: Place, *, insecure: bool) -> None:
    """Make torch.distributed listen on loopback. Raise `UsageError` if it would listen on a network, unless `insecure`."""
    if place.processes == 1:
        return
    if place.is_local:
        names = {name for _, name in socket.if_nameindex()}
        for name in names.intersection(LOOPBACK):
            for variable in INTERFACES:
                # Clusters often set these variables to a network interface, for all jobs.
                os.environ[variable] = os.environ.get(variable, name) if insecure else name
    elif not insecure:
        raise UsageError(
            f"MASTER_ADDR {place.host}: expected localhost, because torch.distributed checks nobody's identity and encrypts "
            "nothing; in a network that only you can reach, add --insecure-shards"
        )
