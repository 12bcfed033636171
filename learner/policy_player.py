"""A learner that doesn't train, but has workers play episodes with a policy from a run folder.

Rule: the policy is published once, as version 1; a policy that plays against it is published as version 0. The learner's
process runs no environment code. Timeouts and the number of allowed failures are the same as in training.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from millrace.learner.config.rollout_config import SEAT_ID, WITH_STATE, RolloutConfig
from millrace.learner.members.describe_coordinator import Unknown
from millrace.learner.members.lobby import Lobby
from millrace.learner.open_hub import open_hub
from millrace.learner.rollouts.evaluation_dealer import EvaluationPlan, OnRows, PlayedEpisode
from millrace.learner.rollouts.hub import GOODBYE_IF_CUT_SHORT_S, Hub
from millrace.learner.rollouts.opponent_pool import OpponentPool, PoolSettings, teams_of
from millrace.learner.run_folder.policy_files import PolicyDescription, StoredPolicy
from millrace.learner.run_folder.run_folder import RunFolder, Which
from millrace.protocol.bounds import MAX_FACTS
from millrace.protocol.env_spec import EnvLike, EnvSpec
from millrace.protocol.envs.description import DescribedEnv
from millrace.protocol.envs.wrappers import WrapperLike
from millrace.protocol.errors import UsageError
from millrace.protocol.own_module import refuse_modules_in
from millrace.protocol.specs import SCORE, ActionSpec, Leaf, RunSpec

RIVAL = 0
POLICY = 1
"""The versions under which the rival's and the policy's weights are published."""


class SavedPolicy(NamedTuple):
    """A policy from a run folder, and the environment in which it plays."""

    stored: StoredPolicy
    env: EnvSpec
    against: StoredPolicy | None = None
    """the policy that plays the other teams"""

    @property
    def card(self) -> PolicyDescription:
        """The content of policy.json."""
        return self.stored.card


def saved_policy(
    run: Path, which: Which = "final", *, env: EnvLike | None = None, wrappers: Sequence[WrapperLike] | None = None
) -> SavedPolicy:
    """Read a policy from a run folder, and find its environment and wrappers by the names that the run has saved.

    `env` and `wrappers` override these names. Raises `UsageError`, with a one-line message, if the policy cannot be read, or
    if the environment or a wrapper cannot be found.
    """
    stored = RunFolder.open_policy(run).read_policy(which)
    card = stored.card
    refuse_modules_in(run, (*([card.env] if env is None else []), *(card.wrappers if wrappers is None else [])))
    # The wrappers that other settings add are always kept, because the policy's observations contain what they add.
    of_settings = [wrapper for wrapper in card.wrappers if wrapper in (SEAT_ID, WITH_STATE)]
    outer = card.wrappers if wrappers is None else [*wrappers, *of_settings]
    spec = EnvSpec.of(card.env if env is None else env, card.env_kwargs, outer, card.eval_env_kwargs)
    return SavedPolicy(stored, spec)


class PolicyPlayer:
    """Plays episodes of a saved policy on the workers that join a lobby."""

    def __init__(
        self,
        policy: SavedPolicy,
        lobby: Lobby,
        check_interrupt: Callable[[], None],
        watch: Callable[[str], None],
        settings: RolloutConfig,
        described: DescribedEnv | None = None,
    ) -> None:
        """`settings` has the timeouts and the number of allowed failures.

        `check_interrupt` is called while this object waits, and an exception that it raises ends the wait. `watch` is called
        several times a second with a line that says how far the episodes have got. `described` is the environment's
        description, if a worker has already made one. Raises `UsageError` if one policy cannot play against the other.
        """
        self.policy = policy
        # One lane for each worker of this program, because the failures of a worker without a lane don't count.
        settings = msgspec.structs.replace(settings, lanes=max(1, lobby.processes.expected))
        self.run = _run_to_play(policy, settings)
        self._lobby = lobby
        self._check_interrupt = check_interrupt
        self._watch = watch
        self._settings = settings
        self._described = described
        self._hub: Hub | None = None

    @property
    def workers(self) -> int:
        """The number of workers that are connected, once `play` has been called."""
        return 0 if self._hub is None else len(self._hub.coordinator.members)

    def describe(self, render_mode: str | None = None) -> DescribedEnv:
        """Have a worker describe the environment that evaluations use. Call this before the first `play`.

        Raises `UserFacingError` if no worker can describe it.
        """
        if self._described is not None:
            return self._described
        unknown = Unknown(self.policy.env.for_evaluation(), render_mode=render_mode)
        return self._lobby.describe(unknown, self._check_interrupt)

    def play(
        self,
        plan: EvaluationPlan,
        on_rows: OnRows | None = None,
        *,
        bound: str = "at most",
        before: tuple[int, int] = (0, 0),
    ) -> list[PlayedEpisode]:
        """Play this plan's episodes. Returns them in the order of their seeds. Raises `RunError` if they can't be played.

        Against another policy, both policies sample their actions, because two greedy policies would replay the same few
        games.

        `bound` and `before` are arguments of `EvaluationPlan.how_far`, which makes the line for `watch`.
        """
        if self._hub is None:
            self._hub = self._published()
        show = self._watch
        if self.policy.against is not None:
            plan = replace(plan, greedy=False, opponents=(RIVAL,))
        self._hub.begin_evaluation(plan, on_rows)
        return self._hub.end_evaluation(lambda played, steps: show(plan.how_far(played, steps, bound, before)))

    def leave(self, reason: str) -> None:
        """Ask the workers to leave."""
        if self._hub is not None:
            self._hub.drain(reason, timeout_s=GOODBYE_IF_CUT_SHORT_S)

    def _published(self) -> Hub:
        stored, against = self.policy.stored, self.policy.against
        pool = None
        if against is not None:
            pool = OpponentPool(PoolSettings(seed=0, window=1, save_steps=1, latest=0.0, max_lag=0))
        hub = open_hub(self._settings, self.run, self._lobby, self._check_interrupt, opponents=pool)
        if against is not None:
            hub.publish(RIVAL, against.parameters, against.buffers, deal=False, env_steps=0)
        hub.publish(POLICY, stored.parameters, stored.buffers, deal=False)
        return hub


def _run_to_play(policy: SavedPolicy, settings: RolloutConfig) -> RunSpec:
    """The specification that `Welcome` sends to workers. Raises `UsageError` if one policy can't play against the other."""
    card = policy.card
    run = RunSpec(
        policy.env,
        card.policy,
        rollout_steps=1,
        copies=1,
        lanes=settings.lanes,
        seed=0,
        info_keys=card.info_keys,
        masked=card.masked,
        seats=card.seats,
        takes_turns=bool(card.seats),  # True permits turns, and also agents that all act at once
        **msgspec.structs.asdict(settings.terms()),
    )
    if policy.against is None:
        return run
    rival = policy.against.card
    _check_rival(policy.env.id, card, rival)
    keys = tuple(key for key in card.info_keys if key != SCORE)[: MAX_FACTS - 1]
    teams = card.teams or rival.teams or teams_of(card.seats)
    return msgspec.structs.replace(run, teams=teams, info_keys=keys, opponent=rival.policy)


def _check_rival(env: str, card: PolicyDescription, rival: PolicyDescription) -> None:
    """Raise `UsageError` unless the policy of this card can play against the rival in the environment of this id."""
    if len(card.seats) < 2:
        raise UsageError(f"against: expected an environment of several agents, got {env}")
    for what, expected, got in (
        ("agents", card.seats, rival.seats),
        ("observations", card.policy.observation, rival.policy.observation),
        ("actions", card.policy.action, rival.policy.action),
        ("action masks", card.masked, rival.masked),
        ("teams", card.teams or rival.teams, rival.teams or card.teams),
    ):
        if expected != got:
            of = "" if env == rival.env else f" of {env}, got one of {rival.env}:"
            raise UsageError(
                f"against: expected a policy{of} with the same {what}, {_in_words(expected)}; got {_in_words(got)}"
            )


def _in_words(compared: Any) -> str:
    """A compared value in words: leaves as path, dtype and shape; action spaces as kind and size; other values unchanged."""
    match compared:
        case tuple((Leaf(), *_)):
            return ", ".join(f"{leaf.path or 'one array'} {leaf.dtype}{list(leaf.shape)}" for leaf in compared)
        case ActionSpec():
            return f"{compared.kind} {list(compared.sizes or compared.shape)}"
        case tuple(()):
            return "none"
    return str(compared)


def useful_workers(workers: int, episodes: int, copies: int) -> int:
    """The number of workers that have something to do: `workers`, but at most one for each ticket."""
    return min(workers, math.ceil(episodes / copies))
