"""What the worker's page says while a policy acts: the user's code is named there, policies of ours are not slowed."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from millrace.protocol.arrays import Array, Floats
from millrace.protocol.errors import PolicyFailed
from millrace.protocol.messages import Weights
from millrace.protocol.policy.called_policy import CalledPolicy
from millrace.protocol.policy.layout import acting_size, buffer_size
from millrace.protocol.policy.policy import Policy, make_policy
from millrace.protocol.policy.recurrent import zero_state
from millrace.protocol.specs import EncoderSpec, OwnPolicySpec, RunSpec
from millrace.workers.acting import acting_of
from millrace.workers.activity import Activity, ActivityReader, activity, share_activity
from millrace.workers.opponents import KnownOpponents
from tests.support.in_process.collectors import random_weights, run_of

RUN = run_of("CartPole-v1")
SEEN: list[str] = []


def note() -> None:
    SEEN.append(ActivityReader(activity()).read(0.0).doing)


class Noting:
    """Notes what the page says in each of its calls."""

    def __init__(self) -> None:
        note()

    def load(self, arrays: dict[str, Array]) -> None:
        note()

    def act(self, obs: Array, state: Array, rng: np.random.Generator) -> tuple[Any, Any, dict[str, Any]]:
        note()
        return np.zeros(len(state), np.int64), state, {}


class Counting(Activity):
    """A page that counts how often the worker begins something."""

    begun = 0

    def begin(self, doing: int) -> None:
        super().begin(doing)
        self.begun += 1


@pytest.fixture
def page() -> Counting:
    SEEN.clear()
    page = Counting()
    share_activity(page)
    page.end()
    return page


def acts(run: RunSpec, policy: Policy | CalledPolicy, steps: int = 3) -> None:
    """As in a rollout of one lane, and then in an evaluation."""
    acting, generators = acting_of(run, policy), [np.random.default_rng(1)]
    acting.load(np.zeros(acting_size(run.policy), np.float32), np.zeros(buffer_size(run.policy), np.float32))
    obs, state = [np.zeros((1, run.columns, 4), np.float32)], zero_state(run.policy, 1, run.columns)
    actions = acting.begin(generators)
    for t in range(steps):
        actions.act(t, obs, state)
    acting.choose(obs, state, lambda: generators[0], greedy=True)


def test_each_call_of_an_own_policy_is_named_and_counts_as_none_of_the_environment(page: Counting) -> None:
    spec = msgspec.structs.replace(RUN.policy, own=OwnPolicySpec(f"{__name__}:Noting", ()))
    policy = CalledPolicy(spec, ())
    SEEN.clear()
    before = ActivityReader(page).read(0.0).env_calls
    acts(msgspec.structs.replace(RUN, policy=spec), policy)
    assert SEEN == ["acting"] * 5
    read = ActivityReader(page).read(0.0)
    assert (read.doing, read.env_calls) == ("waiting", before)


def test_a_policy_of_ours_writes_nothing(page: Counting) -> None:
    begun = page.begun
    acts(RUN, make_policy(RUN.policy))
    assert page.begun == begun


def test_a_pass_through_an_encoder_is_named_and_what_it_raises_is_the_policys(page: Counting) -> None:
    def passes(leaves: Any, state: Floats) -> Floats:
        note()
        if len(SEEN) > 4:
            raise ZeroDivisionError("of the user's")
        return np.zeros((*state.shape[:2], 2), np.float32)

    policy: Any = type("Passes", (), {"load": lambda *weights: None, "__call__": lambda _, *given: passes(*given)})()
    run = msgspec.structs.replace(RUN, policy=msgspec.structs.replace(RUN.policy, encoder=EncoderSpec("mine:net", (), 4)))
    obs, state = [np.zeros((1, run.columns, 4), np.float32)], zero_state(run.policy, 1, run.columns)
    actions = acting_of(run, policy).begin([np.random.default_rng(1)])
    for t in range(4):
        actions.act(t, obs, state)
    assert SEEN == ["acting"] * 4
    with pytest.raises(PolicyFailed, match=r"^encoder mine:net: a pass through it raised ZeroDivisionError: of the user's$"):
        actions.act(4, obs, state)
    assert ActivityReader(page).read(0.0).doing == "waiting"


def test_an_opponent_is_made_under_the_name_of_a_policy(page: Counting, monkeypatch: pytest.MonkeyPatch) -> None:
    """A program is the user's; of snapshots, the first may have to import torch."""
    run = msgspec.structs.replace(RUN, scripted=(f"{__name__}:Noting",))
    parameters, buffers = random_weights(RUN.policy)

    def make_noting(*given: Any) -> Policy:
        note()
        return make_policy(*given)

    monkeypatch.setattr("millrace.workers.opponents.make_policy", make_noting)
    find = KnownOpponents(run).among({7: Weights(7, parameters, buffers)})
    kept = [find(-1), find(7), find(7)]
    assert SEEN == ["preparing"] * 2
    assert kept[1] is kept[2]
