"""Creates the specification of a training run for its workers. Its policy is the one that the algorithm trains."""

from __future__ import annotations

import msgspec

from millrace.learner.algorithms import algorithm_class
from millrace.learner.config.config import Config
from millrace.learner.env_spaces import EnvSpaces
from millrace.learner.rollout_spec import rollout_spec
from millrace.learner.rollouts.opponent_pool import teams_of
from millrace.protocol.bounds import MAX_FACTS
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.errors import UsageError
from millrace.protocol.policy.own_encoder import describe_encoder
from millrace.protocol.specs import SCORE, PolicySpec, RunSpec


def run_spec(config: Config, env: EnvSpec, spaces: EnvSpaces) -> RunSpec:
    """The specification that `Welcome` sends to workers. `spaces` are the spaces of `env`.

    Raises `UsageError` if algorithm, settings and spaces do not fit together.
    """
    policy = _policy_spec(config, spaces)
    if algorithm_class(config.algo).whole_episodes:
        _check_room_for_whole_episodes(config, spaces.max_episode_steps)
    for given, why in ((spaces.seats, f"{config.env} has several agents"), (spaces.critic, "the run has critic_keys")):
        for setting in ("prior", "record"):
            if given and getattr(config, setting):
                raise UsageError(f"{setting}: expected none, because {why}, which a dataset can't have")
        if given and config.inference == "learner":
            raise UsageError(f"inference learner: {why}, and workers must act; use --inference workers")
    teams = _teams(config, spaces.seats)
    steps = config.algorithm.rollout_steps
    programs = config.opponents
    return rollout_spec(config, env, policy, steps, spaces=spaces, teams=teams, scripted=programs)


def _teams(config: Config, seats: tuple[str, ...]) -> tuple[tuple[int, ...], ...]:
    """The seats of each team; empty without opponents. Raises `UsageError` if settings and agents don't fit together."""
    if not (config.self_play or config.opponents):
        if config.teams:
            raise UsageError("teams: expected none without opponents; give self_play, or opponents")
        return ()
    what = "self_play" if config.self_play else "opponents"
    if len(seats) < 2:
        raise UsageError(f"{what}: expected an environment of several agents, got {config.env}")
    if len(config.info_keys) >= MAX_FACTS:
        raise UsageError(f"info_keys: expected fewer than {MAX_FACTS} in a run with opponents, got {len(config.info_keys)}")
    if SCORE in config.info_keys:
        raise UsageError(f"info_keys: expected another name than {SCORE}, which is counted in a run with opponents")
    teams = teams_of(seats, config.teams)
    if config.envs < len(teams):
        raise UsageError(f"{what}: expected envs {len(teams)} or more, so that each team is played, got {config.envs}")
    return teams


def _policy_spec(config: Config, spaces: EnvSpaces) -> PolicySpec:
    policy = algorithm_class(config.algo).policy_spec(config.algorithm, spaces.observation, spaces.action)
    if spaces.critic:
        if policy.head != "actor_critic" or policy.shared_net:
            got = f"{config.algo} with shared_net" if policy.shared_net else config.algo
            raise UsageError(f"critic_keys: expected an algorithm whose critic is a network of its own, got {got}")
        policy = msgspec.structs.replace(policy, critic=spaces.critic)
    if config.algorithm.encoder is not None:
        encoder = describe_encoder(config.algorithm.encoder, spaces.observation, spaces.action)
        policy = msgspec.structs.replace(policy, encoder=encoder)
    return policy


def _check_room_for_whole_episodes(config: Config, max_episode_steps: int | None) -> None:
    """Raise `UsageError` unless a rollout has room for the longest episode and the preceding row, which resets the copy."""
    steps = config.algorithm.rollout_steps
    if max_episode_steps is not None and steps <= max_episode_steps:
        raise UsageError(
            f"rollout_steps {steps}: {config.algo} learns from whole episodes, and those of {config.env} take up to "
            f"{max_episode_steps} steps; expected at least {max_episode_steps + 1}"
        )
