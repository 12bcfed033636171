"""Start a rollout service: with worker processes on this machine, or with workers that are started elsewhere.

Rule: whatever happens, no worker, socket file or folder of ours is left behind.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack

from millrace.launch.endpoint import open_endpoint
from millrace.launch.local_worker_options import stopped_on_error, worker_cores
from millrace.learner.config.rollout_config import RolloutConfig
from millrace.learner.config.validation import workers_to_wait_for
from millrace.learner.conversations import lobby_settings, open_hub, rollout_spec
from millrace.learner.env_spaces import EnvSpaces
from millrace.learner.members.describe_coordinator import Unknown
from millrace.learner.members.lobby import Lobby
from millrace.learner.members.who_may_connect import BindSettings
from millrace.learner.rollouts.hub import Hub
from millrace.learner.rollouts.ledger import Ledger
from millrace.own_policy import OwnPolicy
from millrace.policies import PolicyChoice
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.description import DescribedEnv
from millrace.protocol.specs import RunSpec
from millrace.workers.supervise.supervisor import core_flags


def start(
    config: RolloutConfig,
    env: EnvSpec,
    policy: PolicyChoice,
    rollout_steps: int,
    check_interrupt: Callable[[], None],
    resources: ExitStack,
    *,
    listens: bool,
    past: tuple[Ledger, Sequence[int]] | None = None,
) -> tuple[Hub, RunSpec, DescribedEnv]:
    """A hub whose workers have joined, with its run and environment. Closing `resources` releases all that was acquired.

    `listens`: wait for workers elsewhere at `config.bind`, and start none. Raises `UserFacingError`.
    """
    workers = workers_to_wait_for(config, None if listens else config.workers)
    code = env.called_code or ("a policy's factory" if isinstance(policy, OwnPolicy) else "")
    where = BindSettings(config.bind if listens else "", config.keys, config.insecure, config.advertise)
    endpoint = open_endpoint(where, config.transport, resources, code)
    cores = [] if listens else worker_cores(config)

    def flags(name: str) -> tuple[list[str], None]:
        return core_flags(cores, name), None

    supervisor, processes = resources.enter_context(endpoint.workers(config.workers, flags))
    with stopped_on_error(supervisor):
        lobby = Lobby(endpoint.link, processes, lobby_settings(config))
        described = lobby.describe(Unknown(env, config.vector), check_interrupt)
        spaces = EnvSpaces.of_description(described, config.action_masks)
        policy_spec = policy.spec(spaces.observation, spaces.action)
        run = rollout_spec(config, env, policy_spec, rollout_steps, policy.extra_arrays, spaces=spaces)
        hub = open_hub(config, run, lobby, check_interrupt, past=past)
        hub.wait_for(workers)
    return hub, run, described
