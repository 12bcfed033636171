"""Measures how many bytes the packing of rollouts saves, and the time that it takes. Part of `benchmarks/wire.py`.

For rollouts of Atari's size and CartPole's, packed in every way, it measures CPU seconds of one thread at each end, minus
those for the unpacked rollout. These determine the network speed below which packing pays off. It also measures the
end-to-end time over an encrypted connection, where every byte costs time, and the time of rounding weights.
"""

from __future__ import annotations

import multiprocessing
import statistics
import time
from datetime import UTC, datetime
from multiprocessing.connection import Connection

import gymnasium
import msgspec
import numpy as np
import zmq
from gymnasium.wrappers import AtariPreprocessing, FrameStackObservation

from benchmarks.simulated import canned, run_spec
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.keys.key_folder import Keyring
from millrace.protocol.keys.keys import ClientList, Key, Token
from millrace.protocol.messages import Permit
from millrace.protocol.policy.layout import acting_size
from millrace.protocol.policy.policy import make_policy
from millrace.protocol.rollout import Rollout, rollout_bytes
from millrace.protocol.specs import ActionSpec, Leaf, PolicySpec, RunSpec
from millrace.protocol.wire.codec import decode_to_learner, encode
from millrace.protocol.wire.compression import Packing
from millrace.protocol.wire.learner_link import LearnerLink
from millrace.protocol.wire.message_sizes import MAX_FRAME_BYTES
from millrace.protocol.wire.weight_dtypes import ActingDtype, to_float32, to_wire_dtype
from millrace.protocol.wire.worker_link import WorkerLink
from millrace.workers.collect.collector import Collector

ATARI = RunSpec(
    EnvSpec("ALE/Pong-v5"),
    PolicySpec((Leaf("", "box", (84, 84, 4), "uint8", divisor=255),), ActionSpec("discrete", (), "int64", (6,), (0,))),
    rollout_steps=128,
    copies=4,
    lanes=2,
    seed=1,
)
STACKS = msgspec.structs.replace(
    ATARI, policy=PolicySpec((Leaf("", "box", (4, 84, 84), "uint8", divisor=255),), ATARI.policy.action)
)

WAYS = {
    "as they lie": Packing(),
    "stack": Packing(stack=True),
    "zstd": Packing(zstd=True),
    "stack + zstd": Packing(stack=True, zstd=True),
}
MNIH = 1_687_206  # number of parameters in the network of Mnih et al. (2015) with six actions


def atari(run: RunSpec) -> Rollout:
    """A rollout of noise. If the run's observations are frame stacks, frames move through the stack, and an episode ends."""
    rollout = canned(run)
    if run != STACKS:  # not `is`, because `run` may come from another process
        return rollout
    (noise,) = rollout.obs
    obs = noise.copy()
    ends = len(noise) // 2
    for t in range(1, len(obs)):
        obs[t, :, :-1] = obs[t - 1, :, 1:]
        if t == ends:
            obs[t, 0] = noise[t, 0]
    return msgspec.structs.replace(rollout, obs=(obs,))


def pong() -> Rollout | None:
    """A rollout of frame stacks of the real game, with random actions; None if the pip extra `atari` isn't installed."""
    try:
        gymnasium.make("ale_py:ALE/Pong-v5")
    except (ImportError, gymnasium.error.Error):
        return None
    rollout = canned(STACKS)
    (obs,) = rollout.obs
    for n in range(STACKS.copies):
        env = FrameStackObservation(AtariPreprocessing(gymnasium.make("ale_py:ALE/Pong-v5", frameskip=1)), 4)
        env.action_space.seed(n)
        obs[0, n], _ = env.reset(seed=n)
        for t in range(1, len(obs)):
            obs[t, n], _, terminated, _, _ = env.step(env.action_space.sample())
            assert not terminated  # a game of 21 points doesn't end in half a minute
        env.close()
    return rollout


def cartpole(copies: int, steps: int) -> Rollout:
    """A rollout of CartPole that a worker collects with weights of 0."""
    run = msgspec.structs.replace(run_spec(1), env=EnvSpec("CartPole-v1"), copies=copies, rollout_steps=steps)
    policy = make_policy(run.policy)
    policy.load(np.zeros(acting_size(run.policy), np.float32), np.zeros(0, np.float32))
    return Collector(run, policy).collect([Permit(0, 0, 0, 0, 0)], 0, 0, lambda: None)[0]


def packing(rounds: int) -> list[dict[str, object]]:
    """A row for each rollout and way of packing it, with medians of the CPU seconds of one thread."""
    stacks = {"frame stacks of noise": atari(STACKS)} | ({"frame stacks of Pong": game} if (game := pong()) else {})
    rows = [(name, each, "stack") for name, each in stacks.items()]
    rows += [(name, each, way) for name, each in stacks.items() if each is game for way in ("zstd", "stack + zstd")]
    rows += [(f"CartPole, {n} × {t}", cartpole(n, t), "zstd") for n, t in ((8, 32), (64, 128))]
    found: list[dict[str, object]] = []
    for name, rollout, packed_by in rows:
        way = WAYS[packed_by]
        taken = np.zeros((4, rounds))
        plain, saved = (sum(map(len, encode(rollout, each))) for each in (None, way))
        for turn in range(rounds):
            for i, each in enumerate((None, way)):
                began_s = time.thread_time()
                frames = encode(rollout, each)
                packed_s = time.thread_time()
                decode_to_learner(frames, MAX_FRAME_BYTES)
                taken[2 * i : 2 * i + 2, turn] = packed_s - began_s, time.thread_time() - packed_s
        without, unpacked, packed, back = np.median(taken, axis=1).tolist()
        pack_s = packed - without
        unpack_s = back - unpacked
        found.append(
            {
                "rollout": name,
                "packing": packed_by,
                "bytes": plain,
                "packed": saved,
                "pack_ms": pack_s * 1e3,
                "unpack_ms": unpack_s * 1e3,
                "pack_mb_per_s": plain / pack_s / 1e6,
                "pays_below_gbit_per_s": 8e-9 * (plain - saved) / (pack_s + unpack_s),
            }
        )
    return found


def _send(address: str, token: Token, told: Connection) -> None:
    """The sender's process: sends a rollout of frame stacks for each way of packing that arrives through the pipe."""
    link = WorkerLink(address, "w", zmq.Context(), token)
    rollout = pong() or atari(STACKS)
    told.send(None)
    while (way := told.recv()) is not None:
        began_s = time.monotonic()
        link.send(encode(rollout, WAYS[way]))
        told.send(began_s)
    link.close(0)


def encrypted(rounds: int) -> dict[str, float]:
    """Milliseconds from before `encode` until after decoding, for a rollout of frame stacks over encrypted loopback TCP."""
    server = Key.new()
    client = Key.new()
    keyring = Keyring(server, ClientList().with_client("w", client.public, datetime.now(UTC)))
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    link = LearnerLink("tcp://127.0.0.1:*", context, keyring)
    link.packed_bytes_limit = rollout_bytes(STACKS)
    spawn = multiprocessing.get_context("spawn")
    here, there = spawn.Pipe()
    sender = spawn.Process(target=_send, args=(link.address, Token(server.public, client), there))
    sender.start()
    here.recv()
    times: dict[str, list[float]] = {way: [] for way in WAYS}
    for turn in range(-2, rounds):  # turns before 0 are warm-up
        for way, taken in times.items():
            here.send(way)
            assert link.poll(10)
            ((_, message),) = link.receive()
            assert isinstance(message, Rollout)
            now = time.monotonic()
            if (began_s := here.recv()) and turn >= 0:
                taken.append((now - began_s) * 1e3)
    here.send(None)
    sender.join()
    link.close(0)
    context.term()
    return {way: statistics.median(taken) for way, taken in times.items()}


def rounding(rounds: int) -> list[dict[str, object]]:
    """A row for each dtype in which weights of an image network may be sent: MB, and median CPU ms at each end."""
    parameters = np.random.default_rng(0).normal(0, 0.1, MNIH).astype(np.float32)
    found: list[dict[str, object]] = []
    dtypes: list[ActingDtype] = ["float32", "bfloat16"]
    for dtype in dtypes:
        times = []
        for _ in range(rounds):
            began_s = time.thread_time()
            travelling = to_wire_dtype(parameters, dtype)
            rounded_s = time.thread_time()
            to_float32(travelling)
            times.append((rounded_s - began_s, time.thread_time() - rounded_s))
        learner_ms, worker_ms = (np.median(times, axis=0) * 1e3).tolist()
        found.append({"dtype": dtype, "mb": travelling.nbytes / 1e6, "learner_ms": learner_ms, "worker_ms": worker_ms})
    return found
