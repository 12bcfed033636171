"""The players of the other teams' seats: earlier weights of the policy, or a user-defined program.

Rule: in each env copy, the policy plays one team, and one opponent plays all others, for whole episodes: the opponent
changes only when the copy is reset. A lane therefore keeps its opponents from rollout to rollout, even if tickets no longer
name their weights. Opponents sample their actions from a random stream of the lane that nothing else uses.
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
    """One opponent: a policy that acts, and the number by which tickets name it."""

    def __init__(self, run: RunSpec, number: int, weights: Weights | None) -> None:
        """`weights` are the policy's weights of version `number`, or None if the opponent is a user-defined program."""
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
"""Finds an opponent by its number."""


class KnownOpponents:
    """The opponents of one session. An opponent with weights is kept for as long as an episode is played against it."""

    def __init__(self, run: RunSpec) -> None:
        self._run = run
        self._known = WeakValueDictionary[int, Opponent]()
        self._programs: list[Opponent] = []  # kept, because making one may take long

    def among(self, weights: Mapping[int, Weights]) -> Opponents:
        """Return a function that finds an opponent by its number.

        `weights` has the available weights by version. It must include those of opponents that aren't known yet.
        """

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
    """Which team the policy plays in a copy, and against which opponent."""

    team: int
    """the policy's team"""
    opponent: Opponent


class OtherTeams:
    """The teams that opponents play in the env copies of a lane."""

    generator: np.random.Generator
    """the generator with which opponents sample their actions"""

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
        """In `taken` [N · A, *action], replace the actions of the other teams' acting seats with the opponents' actions.

        `obs` are [N · A, *leaf] each, and `acts` [N · A] says which seats act.
        """
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
        """Begin episodes against this opponent in these copies."""
        for n in copies:
            self._matches[n] = self._matches[n]._replace(opponent=opponent)
            self._state[n * self._run.seats_of_copy : (n + 1) * self._run.seats_of_copy] = 0.0

    def result(self, n: int, returns: Sequence[float]) -> tuple[float, float, int]:
        """The result of an episode of copy n, given the returns of its seats.

        Returns the return of the policy's team, its score, and the number of the opponent.
        """
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
    """The `Episode` that has ended in copy n, given the returns of its seats and the facts `of_info` that the environment
    reported.
    """
    if others is None:
        counted = returns if run.has_seat_returns else ()
        return Episode(sum(returns), length, seconds, (*of_info, *counted))
    total, score, opponent = others.result(n, returns)
    return Episode(total, length, seconds, (*of_info, score), opponent)
