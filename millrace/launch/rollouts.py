"""Starts a rollout service, with worker processes on this machine or with workers that are started elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack

from millrace.launch.crew import Crew, worker_cores
from millrace.launch.worker_pool import open_worker_pool
from millrace.learner.config.local_workers import local_workers
from millrace.learner.config.rollout_config import RolloutConfig
from millrace.learner.config.validation import workers_to_wait_for
from millrace.learner.env_spaces import EnvSpaces
from millrace.learner.members.describe_coordinator import Unknown
from millrace.learner.members.who_may_connect import BindSettings
from millrace.learner.open_hub import lobby_settings, open_hub
from millrace.learner.rollout_spec import rollout_spec
from millrace.learner.rollouts.hub import Hub
from millrace.learner.rollouts.past_rollouts import PastRollouts
from millrace.own_policy import OwnPolicy
from millrace.policies import PolicyChoice
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.description import DescribedEnv
from millrace.protocol.specs import RunSpec
from millrace.workers.supervise.supervisor import STOP_WITHIN_S


def start(
    config: RolloutConfig,
    env: EnvSpec,
    policy: PolicyChoice,
    rollout_steps: int,
    check_interrupt: Callable[[], None],
    resources: ExitStack,
    *,
    listens: bool,
    past: PastRollouts | None = None,
) -> tuple[Hub, RunSpec, DescribedEnv]:
    """Start a hub and wait until its workers have joined. Returns the hub, the run and the described environment.

    Closing `resources` releases everything. `listens`: wait for workers from elsewhere at `config.bind`, instead of starting
    local ones. `past`: the state of a saved service to continue from. Raises `UserFacingError` if no run can begin.
    """
    workers = workers_to_wait_for(config, None if listens else local_workers(config))
    code = env.called_code or ("a policy's factory" if isinstance(policy, OwnPolicy) else "")
    where = BindSettings(config.bind if listens else "", config.keys, config.insecure, config.advertise)
    pool = resources.enter_context(open_worker_pool(where, config.transport, code))
    crew = Crew() if listens else Crew(local_workers(config), cores=worker_cores(config))
    lobby = resources.enter_context(pool.start(crew, lobby_settings(config)))
    described = lobby.describe(Unknown(env, config.vector), check_interrupt)
    spaces = EnvSpaces.of_description(described, config.action_masks)
    policy_spec = policy.spec(spaces.observation, spaces.action)
    run = rollout_spec(config, env, policy_spec, rollout_steps, policy.extra_arrays, spaces=spaces)
    hub = open_hub(config, run, lobby, check_interrupt, past=past)
    hub.wait_for(workers)
    resources.callback(pool.stop, STOP_WITHIN_S)
    return hub, run, described
