"""A policy of a run folder that acts without workers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from millrace.learner.policy_player import saved_policy
from millrace.learner.run_folder.run_folder import Which
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.policy.policy import Policy, make_policy
from millrace.protocol.specs import PolicySpec, RunSpec


def load_policy(run: Path, which: Which = "final") -> tuple[Policy, PolicySpec, EnvSpec]:
    """The policy, its spec, and the environment for which it was trained. Raises `UsageError`."""
    saved = saved_policy(run, which)
    policy = make_policy(saved.spec)
    policy.load(saved.parameters, saved.buffers)
    return policy, saved.spec, saved.env


def policy_run(policy: PolicySpec, env: EnvSpec, **more: Any) -> RunSpec:
    """A run of this policy, as its card needs it."""
    return RunSpec(env, policy, rollout_steps=1, copies=1, lanes=1, seed=0, **more)
