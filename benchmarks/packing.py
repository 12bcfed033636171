"""What packing saves of a rollout and what it takes: rollouts as large as Atari's, and CartPole's, packed every way.

CPU seconds of one thread at each end, less those of the same rollout as it lies; from them the speed of a network below
which packing pays.
"""

from __future__ import annotations

import time

import gymnasium
import msgspec
import numpy as np
from gymnasium.wrappers import AtariPreprocessing, FrameStackObservation

from benchmarks.simulated import canned, run_spec
from protocol.codec import MAX_FRAME_BYTES, decode_to_learner, encode
from protocol.packing import Packing
from protocol.policy import layout, make_policy, size
from protocol.rollout import Rollout
from protocol.specs import ActionSpec, EnvSpec, Leaf, PolicySpec, RunSpec
from workers.collector import Collector
from workers.session import Assignment

ATARI = RunSpec(
    EnvSpec("ALE/Pong-v5"),
    PolicySpec((Leaf("", "box", (84, 84, 4), "uint8"),), ActionSpec("discrete", (), "int64", (6,), (0,))),
    rollout_steps=128,
    copies=4,
    lanes=2,
    seed=1,
)
STACKS = msgspec.structs.replace(ATARI, policy=PolicySpec((Leaf("", "box", (4, 84, 84), "uint8"),), ATARI.policy.action))


def atari(run: RunSpec) -> Rollout:
    """A rollout of noise, or, where the run's observations are frame stacks, of stacks; one episode ends in it."""
    rollout = canned(run)
    if run != STACKS:  # not `is`: it may come from another process
        return rollout
    (noise,) = rollout.obs
    obs, ends = noise.copy(), len(noise) // 2
    for t in range(1, len(obs)):
        obs[t, :, :-1] = obs[t - 1, :, 1:]
        if t == ends:
            obs[t, 0] = noise[t, 0]
    return msgspec.structs.replace(rollout, obs=(obs,))


def pong() -> Rollout | None:
    """Frame stacks of the real game, played at random; None without the extra `atari`."""
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
            assert not terminated  # of a game of 21 points, in half a minute
        env.close()
    return rollout


def cartpole(copies: int, steps: int) -> Rollout:
    """What a worker collects with weights of 0."""
    run = msgspec.structs.replace(run_spec(1), env=EnvSpec("CartPole-v1"), copies=copies, rollout_steps=steps)
    policy = make_policy(run.policy)
    policy.load(np.zeros(size(layout(run.policy)[0]), np.float32), np.zeros(0, np.float32))
    return Collector(run, policy).collect([Assignment(0, 0, 0, 0)], 0, 0, lambda: None)[0]


def packing(rounds: int) -> list[dict[str, object]]:
    """A row for each rollout and way of packing it; medians of the CPU seconds of one thread."""
    stacks = {"frame stacks of noise": atari(STACKS)} | ({"frame stacks of Pong": game} if (game := pong()) else {})
    stack, zstd, both = Packing(stack=True), Packing(zstd=True), Packing(stack=True, zstd=True)
    rows: list[tuple[str, Rollout, Packing]] = [(name, each, stack) for name, each in stacks.items()]
    rows += [(name, each, way) for name, each in stacks.items() if each is game for way in (zstd, both)]
    rows += [(f"CartPole, {n} × {t}", cartpole(n, t), zstd) for n, t in ((8, 32), (64, 128))]
    found: list[dict[str, object]] = []
    for name, rollout, way in rows:
        (plain, saved), taken = (sum(map(len, encode(rollout, each))) for each in (None, way)), np.zeros((4, rounds))
        for turn in range(rounds):
            for i, each in enumerate((None, way)):
                began_s = time.thread_time()
                frames = encode(rollout, each)
                packed_s = time.thread_time()
                decode_to_learner(frames, MAX_FRAME_BYTES)
                taken[2 * i : 2 * i + 2, turn] = packed_s - began_s, time.thread_time() - packed_s
        without, unpacked, packed, back = np.median(taken, axis=1).tolist()
        pack_s, unpack_s = packed - without, back - unpacked
        found.append(
            {
                "rollout": name,
                "packing": " + ".join(kind for kind, done in (("stack", way.stack), ("zstd", way.zstd)) if done),
                "bytes": plain,
                "packed": saved,
                "pack_ms": pack_s * 1e3,
                "unpack_ms": unpack_s * 1e3,
                "pack_mb_per_s": plain / pack_s / 1e6,
                "pays_below_gbit_per_s": 8e-9 * (plain - saved) / (pack_s + unpack_s),
            }
        )
    return found
