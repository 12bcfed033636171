"""Measures sending a rollout from one process to another: `python -m benchmarks.wire`.

Large rollouts (14.6 MB, Atari): seconds from before `encode` in the sender until after decoding in the receiver, with one
rollout on its way at a time. For comparison, plain ROUTER and DEALER sockets take turns and send the same arrays unpacked.
The rollouts consist of noise, or of frame stacks, which are sent packed. Small rollouts (9 KB, CartPole): CPU µs of the
Python thread at each end. All rollouts: bytes of the frames and of ZeroMQ's framing, compared with the bytes of the arrays.
Finally, what packing rollouts and rounding weights saves, and how long it takes.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")  # before numpy

import argparse
import math
import multiprocessing
import statistics
import tempfile
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection

import numpy as np
import zmq
from rich.console import Console
from rich.table import Table

from benchmarks.packing import ATARI, STACKS, atari, encrypted, packing, rounding
from benchmarks.simulated import canned, run_spec
from benchmarks.writing import write
from millrace.protocol.rollout import Rollout, rollout_bytes
from millrace.protocol.rows.rollout_checks import validate
from millrace.protocol.specs import RunSpec
from millrace.protocol.wire.codec import Buffer, encode
from millrace.protocol.wire.compression import Packing
from millrace.protocol.wire.learner_link import LearnerLink
from millrace.protocol.wire.worker_link import WorkerLink

TRANSPORTS = ("ipc", "tcp")
# Targets.
SHARE = 0.8
PYTHON_US = 40
OVERHEAD = 1.02
FRAME = 1.05
CARTPOLE = run_spec(4)
PACKING = {
    "bytes": "bytes",
    "packed": "packed",
    "pack, ms": "pack_ms",
    "MB/s": "pack_mb_per_s",
    "unpack, ms": "unpack_ms",
    "pays below, Gbit/s": "pays_below_gbit_per_s",
}
BURST = 200  # number of small rollouts that are sent together


def _send(run: RunSpec, addresses: dict[str, str], told: Connection) -> None:
    """The sender's process: sends a rollout in each way that arrives through the pipe, and sends back when it began.

    Times are by the monotonic clock, which both processes share.
    """
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    rollout = atari(run)
    frames = encode(rollout)
    links = {way: WorkerLink(address, "w", context) for way, address in addresses.items() if way.startswith("ours")}
    sockets = {}
    for way, address in addresses.items():
        if way.startswith("raw"):
            sockets[way] = context.socket(zmq.DEALER)
            sockets[way].routing_id = b"w"
            sockets[way].connect(address)
    told.send(None)
    while (way := told.recv()) is not None:
        began_s = time.monotonic()
        if way in links:
            links[way].send(encode(rollout, Packing(stack=True)))
        else:
            sockets[way].send_multipart(frames, copy=False)
        told.send(began_s)
    for link in links.values():
        link.close(0)
    context.destroy(linger=0)


def large(run: RunSpec, rounds: int) -> list[dict[str, object]]:
    """A row for each transport, with median times of a large rollout of this run."""
    context = multiprocessing.get_context("spawn")
    zmq_context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    times: dict[str, list[float]] = {f"{kind} {transport}": [] for kind in ("raw", "ours") for transport in TRANSPORTS}
    with tempfile.TemporaryDirectory() as folder:
        links = {}
        sockets = {}
        addresses = {}
        for way in times:
            address = f"ipc://{folder}/{way.replace(' ', '-')}" if way.endswith("ipc") else "tcp://127.0.0.1:*"
            if way.startswith("ours"):
                links[way] = LearnerLink(address, zmq_context)
                links[way].packed_bytes_limit = rollout_bytes(run)
                addresses[way] = links[way].address
            else:
                sockets[way] = zmq_context.socket(zmq.ROUTER)
                sockets[way].bind(address)
                addresses[way] = bytes(sockets[way].get(zmq.LAST_ENDPOINT)).decode().rstrip("\0")
        here, there = context.Pipe()
        sender = context.Process(target=_send, args=(run, addresses, there))
        sender.start()
        here.recv()
        for turn in range(-3, rounds):  # turns before 0 are warm-up
            for way in list(times)[:: 1 if turn % 2 else -1]:
                here.send(way)
                if way in links:
                    assert links[way].poll(10)
                    ((_, message),) = links[way].receive()
                    assert isinstance(message, Rollout)
                    del message  # as with raw sockets; if it were kept, the next one would need new memory
                else:
                    assert sockets[way].poll(10_000)
                    sockets[way].recv_multipart(copy=False)
                now = time.monotonic()
                if (began_s := here.recv()) and turn >= 0:
                    times[way].append(now - began_s)
        here.send(None)
        sender.join()
        for link in links.values():
            link.close(0)
        zmq_context.destroy(linger=0)
    payload = rollout_bytes(run)
    return [
        {
            "transport": transport,
            "raw_ms": statistics.median(times[f"raw {transport}"]) * 1e3,
            "ours_ms": statistics.median(times[f"ours {transport}"]) * 1e3,
            "gb_per_s": payload / statistics.median(times[f"ours {transport}"]) / 1e9,
            "share": statistics.median(
                raw / ours for raw, ours in zip(times[f"raw {transport}"], times[f"ours {transport}"], strict=True)
            ),
        }
        for transport in TRANSPORTS
    ]


def small(rounds: int) -> dict[str, float]:
    """Median CPU µs of the Python thread for a rollout of 9 KB, by part of the work."""
    rollout = canned(CARTPOLE)
    parts: dict[str, list[float]] = {"encode": [], "send": [], "receive and decode": [], "validate": []}
    with tempfile.TemporaryDirectory() as folder:
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        learner = LearnerLink(f"ipc://{folder}/learner", context)
        worker = WorkerLink(learner.address, "w", context)
        for turn in range(-2, rounds):
            marks = [time.thread_time()]
            messages = [encode(rollout) for _ in range(BURST)]
            marks.append(time.thread_time())
            for frames in messages:
                worker.send(frames)
            marks.append(time.thread_time())
            time.sleep(0.05)  # until all have arrived, so that no waiting is timed
            assert learner.poll(10)
            before_s = time.thread_time()
            received = [message for _, message in learner.receive()]
            marks.append(marks[-1] + time.thread_time() - before_s)
            assert len(received) == BURST
            before_s = time.thread_time()
            for message in received:
                assert isinstance(message, Rollout)
                validate(message, CARTPOLE)
            marks.append(marks[-1] + time.thread_time() - before_s)
            if turn >= 0:
                for part, taken in zip(parts.values(), np.diff(marks), strict=True):
                    part.append(taken / BURST * 1e6)
        worker.close(0)
        learner.close(0)
        context.term()
    return {part: statistics.median(found) for part, found in parts.items()}


def on_the_wire(frames: Sequence[Buffer]) -> tuple[int, int]:
    """The bytes of the arrays, and the bytes on the connection: each frame has a head of 2 bytes, or 9 if it is long."""
    return sum(map(len, frames[1:])), sum(len(frame) + (2 if len(frame) < 256 else 9) for frame in frames)


def stack_sizes() -> tuple[int, int]:
    """The bytes of one image frame, and of a rollout of frame stacks on the connection."""
    (leaf,) = STACKS.policy.observation
    return math.prod(leaf.shape[1:]), on_the_wire(encode(atari(STACKS), Packing(stack=True)))[1]


def main() -> None:
    parser = argparse.ArgumentParser(description="the way of a rollout")
    parser.add_argument("--rounds", type=int, default=40)
    rounds = parser.parse_args().rounds
    console = Console(width=130)
    found = {"of noise": large(ATARI, rounds), "of frame stacks": large(STACKS, rounds)}
    first = Table(title=f"A rollout of {rollout_bytes(ATARI) / 1e6:.1f} MB, medians of {rounds}")
    for column in ("", "", "raw ZeroMQ, ms", "ours, ms", "GB/s", "share", "target"):
        first.add_column(column, justify="right")
    for kind, rows in found.items():
        for row in rows:
            numbers = (f"{row[key]:.2f}" for key in ("raw_ms", "ours_ms", "gb_per_s", "share"))
            first.add_row(kind, str(row["transport"]), *numbers, f"≥ {SHARE}" if kind == "of noise" else "–")
    console.print(first)
    parts = small(rounds)
    second = Table(*parts, "worker", "learner", "target", title="A rollout of 9 KB, µs of Python")
    ends = {"worker": parts["encode"] + parts["send"], "learner": parts["receive and decode"]}
    second.add_row(*(f"{us:.1f}" for us in (*parts.values(), *ends.values())), f"≤ {PYTHON_US}")
    console.print(second)
    ways = packing(rounds)  # the rest is in `benchmarks/packing.py`
    third = Table("rollout", "packing", *PACKING, title="Packing, CPU of one thread")
    for row in ways:
        third.add_row(str(row["rollout"]), str(row["packing"]), *(f"{row[key]:,.4g}" for key in PACKING.values()))
    console.print(third)
    keyed = encrypted(rounds)
    fourth = Table(*keyed, title="Frame stacks, encrypted, ms")
    fourth.add_row(*(f"{ms:.1f}" for ms in keyed.values()))
    console.print(fourth)
    weights = rounding(rounds)
    fifth = Table("weights", "MB", "learner, ms", "worker, ms", title="Rounding the weights of an image network")
    for row in weights:
        fifth.add_row(str(row["dtype"]), *(f"{row[key]:.2f}" for key in ("mb", "learner_ms", "worker_ms")))
    console.print(fifth)
    overhead = {name: on_the_wire(encode(canned(run))) for name, run in (("Atari", ATARI), ("CartPole", CARTPOLE))}
    for name, (payload, wire) in overhead.items():
        ratio = f"{wire / payload:.4f} (target ≤ {OVERHEAD})"
        console.print(f"{name}: {wire:,} bytes on the wire for {payload:,} of arrays: {ratio}")
    transitions, (frame_bytes, stack_bytes) = STACKS.rollout_steps * STACKS.copies, stack_sizes()
    ratio = f"{stack_bytes / transitions / frame_bytes:.3f} of one frame (target ≤ {FRAME})"
    console.print(f"frame stacks: {stack_bytes:,} bytes on the wire, {stack_bytes / transitions:,.0f} a transition: {ratio}")
    charts = [
        (
            f"a rollout of 14.6 MB {kind}, ms",
            {
                f"{who}, {row['transport']}": float(str(row[f"{who.split()[0]}_ms"]))
                for row in rows
                for who in ("raw ZeroMQ", "ours")
            },
        )
        for kind, rows in found.items()
    ]
    charts.append(("a rollout of 9 KB, µs of Python", parts))
    record: dict[str, object] = {"large": found["of noise"], "stacks": found["of frame stacks"], "small_us": parts | ends}
    record |= {"packing": ways, "encrypted_ms": keyed, "weights": weights, "bytes": overhead, "stack_bytes": stack_bytes}
    write("wire", record, charts)


if __name__ == "__main__":
    main()
