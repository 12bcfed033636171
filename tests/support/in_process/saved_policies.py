"""A policy of a run folder that acts without workers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from millrace.learner.policy_player import SavedPolicy, saved_policy
from millrace.learner.run_folder.policy_files import StoredPolicy, decode_description, encode_description
from millrace.learner.run_folder.run_folder import Which
from millrace.protocol.arrays import Floats
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.policy.policy import Policy, make_policy
from millrace.protocol.specs import PolicySpec, RunSpec


def load_policy(run: Path, which: Which = "final") -> tuple[Policy, PolicySpec, EnvSpec]:
    """The policy, its spec, and the environment for which it was trained. Raises `UsageError`."""
    (card, parameters, buffers), env, _ = saved_policy(run, which)
    policy = make_policy(card.policy)
    policy.load(parameters, buffers)
    return policy, card.policy, env


def policy_of_run(run: RunSpec, parameters: Floats, buffers: Floats) -> SavedPolicy:
    """The policy of this run with these weights, as its folder would contain it."""
    return SavedPolicy(StoredPolicy(decode_description(encode_description(run)), parameters, buffers), run.env)


def policy_run(policy: PolicySpec, env: EnvSpec, **more: Any) -> RunSpec:
    """A run of this policy, as its card needs it."""
    return RunSpec(env, policy, rollout_steps=1, copies=1, lanes=1, seed=0, **more)
