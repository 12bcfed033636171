"""Compares gradient steps of off-policy algorithms and updates of A2C with Stable-Baselines3's, on the same shapes.

DQN: both sample 64 transitions, compute targets with the target network and the Huber loss, clip the gradient by its norm,
and take a step of Adam. A2C, with 8 env copies: Stable-Baselines3 already has the values from acting, while millrace
recomputes them; both compute advantages, losses, one step of RMSProp, and what they log. Continuous actions: the shapes of
Pendulum, with 256 transitions; the peers of TQC and CrossQ are those of sb3-contrib.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium
import msgspec
import numpy as np
import torch
from sb3_contrib import TQC as TheirTQC
from sb3_contrib import CrossQ as TheirCrossQ
from stable_baselines3 import A2C as TheirA2C
from stable_baselines3 import DQN as TheirDQN
from stable_baselines3 import SAC as TheirSAC
from stable_baselines3 import TD3 as TheirTD3
from stable_baselines3.common.env_util import make_vec_env

from benchmarks.contest import Contest, passes_in_torch, repeated
from millrace.learner.algorithms.a2c import A2C
from millrace.learner.algorithms.crossq import CrossQ
from millrace.learner.algorithms.dqn import DQN
from millrace.learner.algorithms.sac import SAC
from millrace.learner.algorithms.td3 import TD3
from millrace.learner.algorithms.tqc import TQC
from millrace.learner.algorithms.xqc import XQC
from millrace.learner.config.hyperparameters import (
    A2CConfig,
    CrossQConfig,
    DQNConfig,
    SACConfig,
    TD3Config,
    TQCConfig,
    XQCConfig,
)
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import ActionSpec, Leaf

OBSERVATION = (Leaf("", "box", (4,), "float32"),)
ACTION = ActionSpec("discrete", (), "int64", (2,), (0,))
PENDULUM = (Leaf("", "box", (3,), "float32"),)
PUSH = ActionSpec("box", (1,), "float32", low=(-2.0,), high=(2.0,))
COPIES = 8
NEVER = 10**9
ROWS = 256
PLAYED = 500  # number of transitions that Stable-Baselines3 samples from; it collects them without learning
STEPS = 8  # number of gradient steps, or updates, that are timed together


def some_batch(steps: int, seed: int) -> Batch:
    """A batch of noise with CartPole's shapes, in which episodes end now and then."""
    generator = np.random.default_rng(seed)
    ends = generator.random((steps, COPIES)) < 0.02
    valid = np.ones((steps, COPIES), bool)
    valid[1:] = ~ends[:-1]
    return Batch(
        obs=(generator.normal(size=(steps + 1, COPIES, 4)).astype(np.float32),),
        action=generator.integers(0, 2, (steps, COPIES)),
        log_prob=np.full((steps, COPIES), -0.693, np.float32),
        reward=np.ones((steps, COPIES), np.float32),
        terminated=ends & valid,
        truncated=np.zeros((steps, COPIES), bool),
        valid=valid,
        state=np.zeros((COPIES, 0), np.float32),
        lane=np.repeat(np.arange(4), 2),
        fresh=np.zeros(COPIES, bool),
        columns_per_rollout=2,
        episodes=(),
    )


def dqn(width: int, target: float) -> Contest:
    """The contest of a DQN gradient step on 64 transitions."""
    rows = 64
    size = 10_000
    config = DQNConfig(
        net=(width, width), double=False, batch_size=rows, replay_size=size, target_every=NEVER, max_grad_norm=10
    )

    def ours(graph: bool) -> Callable[[], float]:
        with passes_in_torch(graph):
            made = DQN(config, DQN.policy_spec(config, OBSERVATION, ACTION), total_steps=NEVER, seed=0)
        for seed in range(20):
            made.replay.add(some_batch(32, seed))
        return lambda: repeated(lambda: made.step(made.transitions(made.replay.sample(rows))), STEPS)

    theirs = TheirDQN(
        "MlpPolicy",
        gymnasium.make("CartPole-v1"),
        batch_size=rows,
        buffer_size=size,
        learning_starts=PLAYED,
        max_grad_norm=10,
        policy_kwargs={"net_arch": [width, width]},
        target_update_interval=NEVER,
        device="cpu",
    )
    theirs.learn(PLAYED)
    runs = {
        "peer": lambda: repeated(lambda: theirs.train(STEPS, rows), 1) / STEPS,
        "graph": ours(True),
        "ours": ours(False),
    }
    return Contest(f"DQN, {width} units", rows, "SB3", STEPS, target, runs)


class Continuous(NamedTuple):
    """An algorithm for continuous actions, and its counterpart in Stable-Baselines3 or sb3-contrib, if there is one."""

    algorithm: Any
    config: Any
    peer: Any = None
    has_critic_net: bool = False

    def settings(self, width: int) -> Any:
        """The settings of our algorithm, with critics whose two layers have this width."""
        replay = {"batch_size": ROWS, "replay_size": 10_000}
        if self.has_critic_net:
            return self.config(critic_net=(width, width), policy_delay=3, **replay)
        return self.config(net=(width, width), **replay)

    def peers(self, width: int) -> Any:
        """The counterpart's object, which has already collected transitions."""
        made = self.peer(
            "MlpPolicy",
            gymnasium.make("Pendulum-v1"),
            batch_size=ROWS,
            buffer_size=10_000,
            learning_starts=PLAYED,
            policy_kwargs={"net_arch": {"pi": [256, 256], "qf": [width, width]} if self.has_critic_net else [width, width]},
            device="cpu",
        )
        made.learn(PLAYED)
        return made

    def steps(self, width: int, in_torch: bool = False) -> Callable[[], float]:
        """A function that times our gradient steps, and returns the CPU seconds of one."""
        config = self.settings(width)
        with passes_in_torch(in_torch):
            policy = self.algorithm.policy_spec(config, PENDULUM, PUSH)
            made = self.algorithm(config, policy, total_steps=NEVER, seed=0)
        generator = np.random.default_rng(0)
        for seed in range(20):
            batch = some_batch(32, seed)
            actions = generator.uniform(-1, 1, (*batch.reward.shape, 1)).astype(np.float32)
            made.replay.add(msgspec.structs.replace(batch, obs=(batch.obs[0][..., :3],), action=actions))
        return lambda: repeated(lambda: made.step(made.transitions(made.replay.sample(ROWS))), STEPS)


CONTINUOUS = {
    "SAC": Continuous(SAC, SACConfig, TheirSAC),
    "TD3": Continuous(TD3, TD3Config, TheirTD3),
    "TQC": Continuous(TQC, TQCConfig, TheirTQC),
    "CrossQ": Continuous(CrossQ, CrossQConfig, TheirCrossQ, has_critic_net=True),
    "XQC": Continuous(XQC, XQCConfig, has_critic_net=True),
}


def continuous(name: str, width: int, target: float | None) -> Contest:
    """The contest of a gradient step on 256 transitions, with Stable-Baselines3 or sb3-contrib as the peer."""
    one = CONTINUOUS[name]
    theirs = one.peers(width)
    runs = {
        "peer": lambda: repeated(lambda: theirs.train(STEPS, ROWS), 1) / STEPS,
        "graph": one.steps(width, in_torch=True),
        "ours": one.steps(width),
    }
    return Contest(f"{name}, {width} units", ROWS, "SB3", STEPS, target, runs)


def beside_sac(name: str, width: int) -> Contest:
    """The contest of a gradient step on 256 transitions, with our own SAC with layers of 256 units as the peer."""
    one = CONTINUOUS[name]
    runs = {
        "peer": CONTINUOUS["SAC"].steps(256),
        "graph": one.steps(width, in_torch=True),
        "ours": one.steps(width),
    }
    return Contest(f"{name}, {width} units", ROWS, "SAC", STEPS, None, runs)


def a2c(steps: int, target: float) -> Contest:
    """The contest of an A2C update on this number of steps of 8 env copies."""
    batch = some_batch(steps, 0)
    config = A2CConfig(rollout_steps=steps)

    def ours(graph: bool) -> Callable[[], float]:
        with passes_in_torch(graph):
            made = A2C(config, A2C.policy_spec(config, OBSERVATION, ACTION), total_steps=NEVER, seed=0)
        return lambda: repeated(lambda: made.update(batch, lambda: None), STEPS)

    theirs = TheirA2C("MlpPolicy", make_vec_env("CartPole-v1", COPIES), n_steps=steps, device="cpu")
    theirs.learn(steps * COPIES)
    buffer: Any = theirs.rollout_buffer
    nothing = torch.zeros(COPIES)
    starts = np.zeros(COPIES)

    def update() -> None:
        buffer.compute_returns_and_advantage(nothing, starts)
        theirs.train()

    def run() -> float:
        taken = 0.0
        for _ in range(STEPS):
            buffer.reset()
            for obs, action, reward in zip(batch.obs[0], batch.action, batch.reward, strict=False):
                buffer.add(obs, action[:, None], reward, starts, nothing, nothing - 0.693)
            taken += repeated(update, 1)
        return taken / STEPS

    runs = {"peer": run, "graph": ours(True), "ours": ours(False)}
    return Contest("A2C, 64 units", steps * COPIES, "SB3", STEPS, target, runs)
