"""The players of the other teams' seats: earlier weights of the policy, or a user-defined program.

Rule: in each env copy the policy plays one team, and one opponent all others, for whole episodes: the opponent changes when
the copy is reset. So a lane keeps its opponents from rollout to rollout, even if no ticket names their weights any more. An
opponent samples its actions with random numbers of the lane that nothing else uses.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import NamedTuple
from weakref import WeakValueDictionary

import msgspec
import numpy as np

from millrace.protocol.arrays import Array, Bools
from millrace.protocol.envs.env_actions import action_converter_of
from millrace.protocol.messages import Weights
from millrace.protocol.policy.called_policy import CalledPolicy
from millrace.protocol.policy.policy import Policy, make_policy
from millrace.protocol.policy.recurrent import zero_state
from millrace.protocol.rollout import Episode
from millrace.protocol.specs import OwnPolicySpec, RunSpec
from millrace.protocol.wire.weight_dtypes import to_float32
from millrace.workers.acting import acting_of
from millrace.workers.activity import PREPARING, activity


class Opponent:
    """One opponent: a policy that acts, and the number that tickets have for it."""

    def __init__(self, run: RunSpec, number: int, weights: Weights | None) -> None:
        """`weights`: the weights of this version; None for a user-defined program."""
        self.number = number
        if weights is None:
            spec = msgspec.structs.replace(run.policy, own=OwnPolicySpec(run.scripted[-1 - number], ()))
            policy: Policy | CalledPolicy = CalledPolicy(spec, (), "opponent")
        else:
            spec = run.opponent or run.policy
            policy = make_policy(spec, run.images_dtype)
            policy.load(to_float32(weights.parameters), weights.buffers)
        self.acting = acting_of(msgspec.structs.replace(run, policy=spec), policy)
        self.to_env_action = action_converter_of(spec)
        self.state_size = spec.state_size


Opponents = Callable[[int], Opponent]
"""Finds the opponent with a number."""


class KnownOpponents:
    """The opponents of one session. Weights are kept while an episode is played against them."""

    def __init__(self, run: RunSpec) -> None:
        self._run = run
        self._known = WeakValueDictionary[int, Opponent]()
        self._programs: list[Opponent] = []  # they are kept, because making one may take long

    def among(self, weights: Mapping[int, Weights]) -> Opponents:
        """A function that finds an opponent. `weights`: available weights by version, among them those of new opponents."""

        def find(number: int) -> Opponent:
            if (found := self._known.get(number)) is None:
                with activity().during(PREPARING):
                    found = Opponent(self._run, number, weights[number] if number >= 0 else None)
                self._known[number] = found
                if number < 0:
                    self._programs.append(found)
            return found

        return find


class Match(NamedTuple):
    """Which team the policy plays in a copy, and against whom."""

    team: int
    """the policy's team"""
    opponent: Opponent


class OtherTeams:
    """The other teams in some env copies."""

    generator: np.random.Generator
    """draws the actions of opponents"""

    def __init__(self, run: RunSpec, matches: Sequence[Match]) -> None:
        self._run = run
        self._matches = list(matches)
        seats = np.zeros((len(matches), run.seats_of_copy), bool)
        for n, match in enumerate(matches):
            seats[n, run.teams[match.team]] = True
        self.mine: Bools = seats.ravel()
        """[N · A] the seats that the policy plays"""
        self._state = zero_state(run.opponent or run.policy, len(self.mine))  # [N · A, S]

    def act(self, obs: Sequence[Array], acts: Bools, taken: Array) -> None:
        """Replace the actions `taken` [N · A, *action] of acting seats of other teams."""
        theirs = acts & ~self.mine
        for opponent in dict.fromkeys(match.opponent for match in self._matches):
            playing = np.repeat([match.opponent is opponent for match in self._matches], self._run.seats_of_copy)
            if (columns := np.flatnonzero(playing & theirs)).size:
                state = self._state[None, columns, : opponent.state_size]
                seen = [leaf[None, columns] for leaf in obs]
                chosen = opponent.acting.choose(seen, state, lambda: self.generator, greedy=False)
                self._state[columns, : opponent.state_size] = state[0]
                taken[columns] = opponent.to_env_action(chosen)

    def begin(self, copies: Collection[int], opponent: Opponent) -> None:
        """Begin episodes of these copies against this opponent."""
        for n in copies:
            self._matches[n] = self._matches[n]._replace(opponent=opponent)
            self._state[n * self._run.seats_of_copy : (n + 1) * self._run.seats_of_copy] = 0.0

    def result(self, n: int, returns: Sequence[float]) -> tuple[float, float, int]:
        """The result of an episode of copy n, from its seats' returns: the return of the policy's team, score, opponent."""
        of_teams = [sum(returns[seat] for seat in team) for team in self._run.teams]
        own = of_teams[self._matches[n].team]
        best = max(of_teams)
        score = 1 / of_teams.count(best) if own == best else 0.0  # the scores of all teams add up to 1
        return own, score, self._matches[n].opponent.number


def whole_episode(
    run: RunSpec,
    others: OtherTeams | None,
    n: int,
    returns: Sequence[float],
    length: int,
    seconds: float,
    of_info: tuple[float, ...],
) -> Episode:
    """An episode of copy n that has ended, with the returns of its seats. `of_info`: facts that the environment reports."""
    if others is None:
        counted = returns if run.has_seat_returns else ()
        return Episode(sum(returns), length, seconds, (*of_info, *counted))
    total, score, opponent = others.result(n, returns)
    return Episode(total, length, seconds, (*of_info, score), opponent)
