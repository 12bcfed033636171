"""Runs CleanRL's installed ppo.py as a script. This file replaces its TensorBoard writer, to notice the end of each update.

CleanRL lacks these settings: a decreasing clip range (it stays 0.2), bootstrapping from the value of a truncated episode
(which counts as terminated), and any vector environment but its own (in one process).
"""

from __future__ import annotations

import importlib.util
import runpy
import sys
from types import FrameType
from typing import Any

import numpy as np
import torch
import torch.utils.tensorboard

from benchmarks.peers.peer_run import PeerRun

LAST = "charts/SPS"  # the last figure that ppo.py writes in an update


def arguments(s: dict[str, Any]) -> list[str]:
    """The settings as flags of CleanRL. Its value loss is half the squared error, so its coefficient is doubled."""
    flags = {
        "env-id": s["env"], "seed": s["seed"], "num-envs": s["envs"], "num-steps": s["rollout_steps"],
        "num-minibatches": s["envs"] * s["rollout_steps"] // s["batch_size"], "update-epochs": s["n_epochs"],
        "total-timesteps": s["steps"], "gamma": s["gamma"], "gae-lambda": s["gae_lambda"], "ent-coef": s["ent_coef"],
        "vf-coef": 2.0 * s["vf_coef"], "max-grad-norm": s["max_grad_norm"], "clip-coef": s["clip_range"],
        "learning-rate": s["learning_rate"], "anneal-lr": s["learning_rate_schedule"] == "linear",
        "clip-vloss": False, "cuda": False,
    }  # fmt: skip
    return [word for name, value in flags.items() for word in (f"--{name}", str(value))]


class Writer:
    """Replaces TensorBoard's `SummaryWriter`, and reports each update."""

    run: PeerRun

    def __init__(self, *_: object) -> None:
        pass

    def add_text(self, *_: object) -> None:
        pass

    def close(self) -> None:
        pass

    def add_scalar(self, name: str, _: float, env_steps: int) -> None:
        if name == LAST:
            script = sys._getframe(1)
            if self.run.update(env_steps, lambda obs: greedy(script, obs)):
                sys.exit()


def greedy(script: FrameType, obs: Any) -> Any:
    """The greedy actions of the agent in the running script."""
    with torch.no_grad():
        return script.f_globals["agent"].actor(torch.from_numpy(obs)).argmax(-1).numpy()


def main() -> None:
    torch.set_num_threads(1)
    Writer.run = PeerRun()
    torch.utils.tensorboard.SummaryWriter = Writer  # type: ignore[misc, assignment]
    np.bool8 = np.bool_  # type: ignore[attr-defined]  # CleanRL needs a gym of 2022
    found = importlib.util.find_spec("cleanrl.ppo")
    assert found is not None
    assert found.origin is not None
    sys.argv = [found.origin, *arguments(Writer.run.settings)]
    runpy.run_path(found.origin, run_name="__main__")


if __name__ == "__main__":
    main()
