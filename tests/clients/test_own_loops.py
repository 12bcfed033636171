"""Loops of a user over clients: the vector environment (`make_vec`) and the rollout service."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import millrace
from millrace.protocol.errors import NoWorkers
from tests.clients.programs import IN_LEARNER, Clients, ends_well, learner, loopback
from tests.system.stage.processes import START_S, Stage

pytestmark = [pytest.mark.clients, pytest.mark.timeout(600)]

STEPS = 600
JOINED_S = 60.0


def made(address: str, env: str = "CartPole-v1", **settings: Any) -> Any:
    """Four copies in two lanes, of whatever clients join within `JOINED_S`."""
    return millrace.make_vec(env, 4, lanes=2, bind=address, **{"timeout": JOINED_S, **settings})


@pytest.mark.parametrize("mode", ["NextStep", "Disabled"])
def test_the_vector_environment_over_cpp_clients_is_gymnasiums(clients: Clients, mode: str) -> None:
    """Bit for bit, with two clients. The episodes of random actions end after about 20 steps."""
    cartpole, address = clients["cpp cartpole"], loopback()
    running = [cartpole.start(address, name) for name in ("first", "second")]
    make = [lambda: gymnasium.make("CartPole-v1")] * 4
    expected = gymnasium.vector.SyncVectorEnv(make, autoreset_mode=gymnasium.vector.AutoresetMode(mode))
    actions = np.random.default_rng(1).integers(0, 2, (STEPS, 4))
    with made(address, autoreset_mode=mode) as envs:
        assert len(envs.hub.coordinator.members) == 2
        np.testing.assert_array_equal(envs.reset(seed=3)[0], expected.reset(seed=3)[0])
        ends = 0
        for action in actions:
            *got, infos = envs.step(action)
            *wanted, _ = expected.step(action)
            for one, other in zip(got, wanted, strict=True):
                np.testing.assert_array_equal(one, other)
            ended = got[2] | got[3]
            ends += int(ended.sum())
            if mode == "Disabled" and ended.any():
                mask = {"reset_mask": ended}
                np.testing.assert_array_equal(envs.reset(options=mask)[0], expected.reset(options=dict(mask))[0])
        assert infos == {}
        assert ends > STEPS / 15
    assert [ends_well(client).splitlines()[-1] for client in running] == ["the vector environment was closed"] * 2


def test_the_vector_environment_over_js_clients(clients: Clients) -> None:
    """The end of the corridor is five steps to the right: reward 1, terminated; the step after it only resets."""
    corridor, address = clients["js corridor"], loopback()
    running = [corridor.start(address, name) for name in ("first", "second")]
    with made(address, "Corridor-v0") as envs:
        assert envs.single_observation_space == gymnasium.spaces.Box(-50, 5, (1,), np.float32)
        assert envs.single_action_space == gymnasium.spaces.Discrete(2)
        assert envs.spec is None
        assert envs.reset(seed=1)[0].tolist() == [[0.0]] * 4
        right = np.ones(4, np.int64)
        for at in (1, 2, 3, 4, 5, 0, 1):
            obs, reward, terminated, truncated, _ = envs.step(right)
            assert obs.tolist() == [[at]] * 4
            assert reward.tolist() == [1.0 if at == 5 else 0.0 if at == 0 else -0.01] * 4
            assert terminated.tolist() == [at == 5] * 4
            assert not truncated.any()
        envs.reset(seed=1)
        for step in range(1, 51):
            *_, truncated, _ = envs.step(np.zeros(4, np.int64))
            assert truncated.tolist() == [step == 50] * 4
        envs.reset_async(seed=1)
        for _ in range(20):
            obs, *_, infos = envs.recv()
            assert len(infos["env_id"]) in (2, 4)
            envs.send(np.zeros(len(obs), np.int64), infos["env_id"])
        while envs.outstanding:
            envs.recv(len(envs.outstanding))
    for client in running:
        ends_well(client)


@pytest.mark.parametrize("program", ["cpp cartpole", "js cartpole"])
def test_a_lost_client_truncates_its_copies_and_another_takes_them(clients: Clients, program: str) -> None:
    cartpole, address = clients[program], loopback()
    first = cartpole.start(address, "first")
    with millrace.make_vec("CartPole-v1", 2, lanes=1, bind=address, timeout=JOINED_S) as envs:
        envs.reset(seed=1)
        assert not envs.step(np.zeros(2, np.int64))[3].any()
        first.kill()
        second = cartpole.start(address, "second")
        *_, truncated, infos = envs.step(np.zeros(2, np.int64))
        assert truncated.all()
        assert infos["worker_lost"].all()
        obs, reward, _, truncated, _ = envs.step(np.zeros(2, np.int64))
        assert np.abs(obs).max() <= 0.05, "the step after it begins other episodes"
        assert not reward.any()
        assert not truncated.any()
    ends_well(second)


@pytest.mark.parametrize("program", ["cpp cartpole", "js cartpole"])
def test_what_a_client_cannot_do_in_a_vector_environment_is_an_error_of_one_line(clients: Clients, program: str) -> None:
    cartpole, address = clients[program], loopback()
    client = cartpole.start(address)
    with millrace.make_vec("CartPole-v1", 2, lanes=1, bind=address, timeout=JOINED_S) as envs:
        envs.reset(seed=1, options={"low": -0.1})  # not read
        for call in (lambda: envs.get_attr("gravity"), lambda: envs.set_attr("gravity", 1.0), envs.render):
            with pytest.raises(AttributeError, match="no attribute") as raised:
                call()
            assert "\n" not in str(raised.value)
        assert envs.get_attr("spec") == (None, None)
        envs.step(np.zeros(2, np.int64))
    ends_well(client)
    declines = cartpole.start(address)
    with pytest.raises(NoWorkers, match="resets a copy in the next step, the learner asks for autoreset SameStep"):  # noqa: SIM117
        with millrace.make_vec(
            "CartPole-v1", 2, lanes=1, bind=address, timeout=JOINED_S / 4, autoreset_mode="SameStep"
        ) as envs:
            envs.reset()
    assert declines.ends() == 2


def test_the_rollout_service_collects_and_evaluates_with_cpp_clients(clients: Clients, tmp_path: Path) -> None:
    cartpole, address = clients["cpp cartpole"], loopback()
    running = [cartpole.start(address, name) for name in ("first", "second")]
    settings: dict[str, Any] = {"envs": 4, "lanes": 2, "rollout_steps": 32, "min_workers": 2, "bind": address}
    with millrace.RolloutService("CartPole-v1", millrace.MLP(8), **settings) as service:
        assert service.workers() == ["first", "second"]
        parameters = service.policy.initial(seed=1)
        service.publish(parameters)
        for batch in service:
            assert batch.obs.shape == (33, 4, 4)
            assert batch.log_prob.max() <= 0
            x, speed = batch.obs[..., 0], batch.obs[:-1, :, 1]
            moved = np.abs(x[1:] - x[:-1] - 0.02 * speed)[batch.valid]
            assert moved.max() < 1e-5
            if service.publish(parameters) == 3:
                break
        evaluation = service.evaluate(episodes=6)
        assert evaluation.episodes == 6
        assert 8 < evaluation.return_mean <= 500
        ledger = service.ledger()
        assert ledger["transitions_invalid"] == ledger["messages_bad"] == 0
    for client in running:
        ends_well(client)


def test_the_rollout_service_says_why_a_client_left(clients: Clients) -> None:
    cartpole, address = clients["js cartpole"], loopback()
    client = cartpole.start(address)
    settings: dict[str, Any] = {"lanes": 1, "envs": 1, "bind": address, "no_workers_timeout_s": JOINED_S / 4}
    why = r"this client does not act: it needs --inference learner, or millrace\.make_vec"
    with pytest.raises(NoWorkers, match=why):  # noqa: SIM117
        with millrace.RolloutService("CartPole-v1", millrace.MLP(8), **settings) as service:
            service.publish(service.policy.initial(seed=1))
            service.gather()
    assert client.ends() == 2


NO_ATTRIBUTE = "set_env_attr gravity: expected an attribute of the environment that is called gravity, got none"


@pytest.mark.parametrize(
    ("program", "flags", "why"),
    [
        ("cpp cartpole", IN_LEARNER, NO_ATTRIBUTE),
        ("js cartpole", IN_LEARNER, NO_ATTRIBUTE),
        ("cpp cartpole", (), "the C++ client has no attributes that the learner could set in its environments"),
    ],
)
def test_a_curriculum_needs_attributes(
    stage: Stage, clients: Clients, program: str, flags: tuple[str, ...], why: str
) -> None:
    cartpole, address = clients[program], loopback()
    callback = ("--callbacks", "tests.clients.test_own_loops:Gravity", "--no-workers-timeout-s", "3")
    runs = learner(stage, address, *flags, *callback, steps=100_000)
    cartpole.start(address)
    assert runs.ends(START_S + 60) == 1
    assert "Traceback" not in runs.said()
    assert re.search(re.escape(why), runs.said().splitlines()[-1]), runs.said()


class Gravity:
    """A curriculum."""

    def on_update(self, progress: Any) -> None:
        """Set an attribute of each copy."""
        progress.set_env_attr("gravity", 3.0)
