"""A run folder is enough to act again."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from millrace.learner.config.layers import resolve
from millrace.learner.config.rollout_config import RolloutConfig
from millrace.learner.members.lobby import Lobby
from millrace.learner.members.worker_processes import WorkerProcesses
from millrace.learner.open_hub import lobby_settings
from millrace.learner.policy_player import PolicyPlayer, saved_policy
from millrace.learner.rollouts.evaluation_dealer import EvaluationPlan
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.spaces import action_spec, observation_leaves
from millrace.protocol.errors import EnvironmentFailed
from millrace.protocol.messages import Evaluate, Evaluated, Heartbeat, Hello, WorkerExit
from millrace.protocol.policy.layout import acting_size, buffer_size
from millrace.protocol.policy.recurrent import zero_state
from millrace.protocol.rollout import Episode
from millrace.protocol.specs import PolicySpec
from millrace.protocol.wire.codec import Buffer, decode_to_worker
from millrace.protocol.wire.learner_link import LearnerLink
from tests.support.conversation.example_messages import example
from tests.support.conversation.fake_ends import BUFFERS, PARAMETERS, run_spec
from tests.support.conversation.fake_link import FakeLink
from tests.support.in_process.fake_processes import FakeProcesses
from tests.support.in_process.saved_policies import load_policy, policy_of_run, policy_run


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1"])
def test_a_run_folder_is_enough_to_act_again(tmp_path: Path, env_id: str) -> None:
    env = EnvSpec(env_id)
    made = env.make()
    spec = PolicySpec(
        observation_leaves(made.observation_space), action_spec(made.action_space), net=(8, 8), normalize_observations=True
    )
    rng = np.random.default_rng(0)
    folder = RunFolder.create(resolve(env_id, run_dir=str(tmp_path)))
    parameters = rng.standard_normal(acting_size(spec), dtype=np.float32)
    folder.write_policy(policy_run(spec, env), parameters, rng.random(buffer_size(spec), dtype=np.float32) + 0.5)
    policy, found_spec, found_env = load_policy(folder.path)
    assert (found_spec, found_env) == (spec, env)
    seen = [rng.standard_normal((1, 3, *leaf.shape), dtype=np.float32) for leaf in spec.observation]
    first = policy(seen, zero_state(spec, 1, 3))
    assert np.array_equal(first, load_policy(folder.path)[0](seen, zero_state(spec, 1, 3)))
    folder.write_policy(policy_run(spec, env), -parameters, np.ones(buffer_size(spec), np.float32))
    assert not np.array_equal(first, load_policy(folder.path)[0](seen, zero_state(spec, 1, 3)))


def test_the_numbers_that_a_run_logs_of_its_episodes_stand_in_policy_json(tmp_path: Path) -> None:
    env = EnvSpec("CartPole-v1")
    made = env.make()
    spec = PolicySpec(observation_leaves(made.observation_space), action_spec(made.action_space), net=(8,))
    folder = RunFolder.create(resolve("CartPole-v1", run_dir=str(tmp_path), info_keys=("of_config",)))
    folder.write_policy(
        policy_run(spec, env, info_keys=("of_card",)), np.zeros(acting_size(spec), np.float32), np.zeros(0, np.float32)
    )
    assert saved_policy(folder.path).card.info_keys == ("of_card",)


def lobby(link: FakeLink, processes: WorkerProcesses) -> Lobby:
    return Lobby(cast(LearnerLink, link), processes, lobby_settings(RolloutConfig()))


class FourWorkers(FakeLink):
    """Four workers that answer each ticket at once. One of them is killed by its first."""

    def __init__(self, killed: bytes) -> None:
        super().__init__()
        self.killed, self.exits = killed, list[WorkerExit]()
        self.inbox += [(f"w{n}".encode(), example(Hello, worker=f"w{n}", pid=n, process_nonce=n)) for n in range(4)]

    def send(self, peer: bytes, frames: Sequence[Buffer]) -> bool:
        message = decode_to_worker([bytes(frame) for frame in frames])
        if isinstance(message, Evaluate) and peer == self.killed:
            nonce = int(peer[1:])
            self.exits = [WorkerExit(peer.decode(), nonce, "was killed by SIGKILL", failed=True)]
        elif isinstance(message, Evaluate):
            episodes = tuple(Episode(float(seed), 2, 0.0) for seed in message.seeds)
            self.inbox.append(
                (
                    peer,
                    example(
                        Evaluated,
                        session=message.session,
                        ticket=message.ticket,
                        episodes=episodes,
                        cut=(False,) * len(episodes),
                    ),
                )
            )
        return True

    def ended(self) -> list[WorkerExit]:
        exits, self.exits = self.exits, []
        return exits

    def player(self, max_env_failures: int) -> PolicyPlayer:
        run = run_spec()
        policy = policy_of_run(run, PARAMETERS, BUFFERS)
        processes, settings = (
            FakeProcesses(of_ended=self.ended, expected=4),
            RolloutConfig(max_env_failures=max_env_failures),
        )
        return PolicyPlayer(policy, lobby(self, processes), lambda: None, lambda text: None, settings)


@pytest.mark.parametrize("killed", [b"w0", b"w3"])
def test_a_killed_worker_counts_as_a_failure_and_its_episodes_are_played_by_others(killed: bytes) -> None:
    plan = EvaluationPlan.of(20, seed=5, copies=2, max_steps=200)
    played = FourWorkers(killed).player(max_env_failures=1).play(plan)
    assert [one.episode.reward for one in played] == list(plan.seeds)
    with pytest.raises(EnvironmentFailed, match="was killed by SIGKILL; failure 1 in a row; max_env_failures allows 0 in a"):
        FourWorkers(killed).player(max_env_failures=0).play(plan)


class Endless(FakeLink):
    """A worker whose first episode does not end: it says only how many env steps it has made."""

    def __init__(self) -> None:
        super().__init__()
        self.inbox.append((b"w0", example(Hello)))

    def send(self, peer: bytes, frames: Sequence[Buffer]) -> bool:
        message = decode_to_worker([bytes(frame) for frame in frames])
        if isinstance(message, Evaluate):
            self.inbox.append(
                (peer, example(Heartbeat, session=message.session, versions=(0,), tickets=(message.ticket,), steps=31_000))
            )
        return True


def test_an_episode_that_does_not_end_is_shown_with_its_env_steps_and_their_bound() -> None:
    run, shown = run_spec(), list[str]()

    def stop() -> None:
        if len(shown) == 5:
            raise KeyboardInterrupt

    policy = policy_of_run(run, PARAMETERS, BUFFERS)
    player = PolicyPlayer(policy, lobby(Endless(), WorkerProcesses()), stop, shown.append, RolloutConfig())
    with pytest.raises(KeyboardInterrupt):
        player.play(EvaluationPlan.of(2, seed=5, copies=2, max_steps=100_000), bound="--max-steps:", before=(3, 500))
    assert shown[-1] == "3 of 5 episodes, 31,500 env steps (--max-steps: 50,000 each)"
