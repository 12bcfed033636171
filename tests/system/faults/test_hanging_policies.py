"""A call of the user's policy that does not return ends its worker, and counts as a failure of the policy, with its line."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import millrace
from tests.system.faults import hanging_policies
from tests.system.faults.hanging_policies import Hangs

HERE = hanging_policies.__name__
SMALL: dict[str, Any] = {"workers": 1, "envs": 2, "lanes": 1, "max_env_failures": 0}


@pytest.mark.parametrize(
    ("call", "what"),
    [
        ("made", r"the construction of the policy took longer than 5 s \(--start-timeout-s\)"),
        ("load", r"a call of the policy took longer than 1\.5 s \(--step-timeout-s\)"),
        ("act", r"a call of the policy took longer than 1\.5 s \(--step-timeout-s\)"),
    ],
)
def test_an_own_policy_that_hangs_is_named(call: str, what: str) -> None:
    policy = millrace.OwnPolicy(f"{HERE}:Hangs", {"w": (1,)}, kwargs={"where": call})
    limits: dict[str, Any] = {"start_timeout_s": 5.0, "step_timeout_s": 1.5, "worker_timeout_s": 1.0}
    where = r"hanging_policies.py:\d+, in _hang"
    with (
        pytest.raises(millrace.PolicyFailed, match=f"its process was ended: {what}, at .*{where}"),
        millrace.RolloutService("CartPole-v1", policy, rollout_steps=8, **SMALL, **limits) as service,
    ):
        service.publish({"w": np.zeros(1)})
        service.gather()


@pytest.mark.parametrize(
    ("env", "settings", "where"),
    [
        ("CartPole-v1", {"encoder": f"{HERE}:encoder"}, "forward"),
        ("tests.support.users_code.seat_envs:RockPaperScissors", {"opponents": (f"{HERE}:Hangs",)}, "_hang"),
    ],
    ids=["encoder", "opponent"],
)
def test_an_encoder_or_an_opponent_that_hangs_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, env: str, settings: dict[str, Any], where: str
) -> None:
    monkeypatch.setenv(hanging_policies.LEARNER, str(os.getpid()))
    limits: dict[str, Any] = {"step_timeout_s": 1.5, "worker_timeout_s": 1.0}
    what = r"a call of the policy took longer than 1\.5 s \(--step-timeout-s\)"
    with pytest.raises(millrace.PolicyFailed, match=rf"{what}, at .*hanging_policies.py:\d+, in {where}"):
        millrace.train(
            env, steps=500, rollout_steps=16, run_dir=str(tmp_path), progress=False, **SMALL, **limits, **settings
        )


def test_an_environment_that_hangs_beside_it_is_not_called_a_policy() -> None:
    policy = millrace.OwnPolicy(Hangs, {"w": (1,)}, kwargs={"where": "nowhere"})
    with (
        pytest.raises(millrace.EnvironmentFailed, match=r"a step of its environment took longer than 1\.5 s"),
        millrace.RolloutService("tests.support.envs.toy:Hangs-v0", policy, step_timeout_s=1.5, **SMALL) as service,
    ):
        service.publish({"w": np.zeros(1)})
        service.gather()
