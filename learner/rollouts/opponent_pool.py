"""Self-play: which opponents there are, who meets whom, and how strong they are. Pure.

Rule: the opponent of a rollout is a pure function of the seed, the lane, the round, and the pool as it was when the acting
weights were made. It therefore depends neither on speed nor on the number of workers. Opponents are the newest snapshots of
the policy, and programs that the user wrote.

Rule: ratings are computed from the episodes that updates used, in order (Elo 1978; ML-Agents' self-play). An opponent's
rating changes by the same amount as the policy's, in the opposite direction. Episodes against a version that isn't a
snapshot change no rating.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase
from typing import NamedTuple

import msgspec

from millrace.protocol.bounds import Count, Natural, Real
from millrace.protocol.errors import UsageError, did_you_mean
from millrace.protocol.random_streams import Purpose, generator
from millrace.protocol.rollout import Episode

FIRST_RATING = 1200.0
ELO_KEY = "self_play/elo"
K = 8.0
"""Elo's K: the largest change in a rating caused by one episode."""
SCALE = 400.0
"""The rating difference at which the weaker of two players loses ten times as often as it wins."""


class Snapshot(msgspec.Struct):
    """A version of the policy that serves as an opponent."""

    version: Natural
    env_steps: Natural
    rating: Real


class PoolState(msgspec.Struct, kw_only=True):
    """The part of the pool that a checkpoint saves in addition to the weights of the snapshots."""

    rating: Real = FIRST_RATING
    """the rating of the policy"""
    snapshots: list[Snapshot] = []
    """the first snapshot and the newest ones, in order"""
    scripted: list[Real] = []
    """the ratings of the user's programs"""


def teams_of(seats: tuple[str, ...], patterns: Sequence[str] = ()) -> tuple[tuple[int, ...], ...]:
    """The seats of each team, selected by patterns for seat names; without patterns, each seat is a team.

    Raises `UsageError` if the patterns don't divide the seats into teams of equal size.
    """
    if not patterns:
        return tuple((seat,) for seat in range(len(seats)))
    teams = [tuple(n for n, seat in enumerate(seats) if fnmatchcase(seat, pattern)) for pattern in patterns]
    for pattern, team in zip(patterns, teams, strict=True):
        if not team:
            raise UsageError(f"teams: {pattern} matches no agent of {', '.join(seats)}{did_you_mean(f'{pattern}*', seats)}")
    for n, seat in enumerate(seats):
        if (count := sum(n in team for team in teams)) != 1:
            raise UsageError(f"teams: expected each agent in one team, got {seat} in {count}: {' '.join(patterns)}")
    if len({len(team) for team in teams}) > 1 or len(teams) < 2:
        sizes = ", ".join(f"{len(team)} in {pattern}" for pattern, team in zip(patterns, teams, strict=True))
        raise UsageError(f"teams: expected two teams or more, with as many agents in each; got {sizes}")
    return tuple(teams)


class PoolSettings(NamedTuple):
    """The settings of self-play."""

    seed: int
    window: int
    """How many of the newest snapshots serve as opponents."""
    save_steps: Count
    """Env steps between two snapshots."""
    latest: float
    """The share of rollouts in which the policy plays against itself."""
    max_lag: int
    scripted: int = 0
    """How many of the opponents are programs that the user wrote."""
    teams: int = 2
    """The number of teams. The policy plays one of them."""


class OpponentPool:
    """The opponents of one run."""

    def __init__(self, settings: PoolSettings, state: PoolState | None = None) -> None:
        self._settings = settings
        self.state = state or PoolState()
        missing = settings.scripted - len(self.state.scripted)
        self.state.scripted.extend([FIRST_RATING] * missing)

    @property
    def versions(self) -> list[int]:
        """The versions of the snapshots."""
        return [snapshot.version for snapshot in self.state.snapshots]

    @property
    def yardsticks(self) -> tuple[int, ...]:
        """The opponents of evaluations, which never change: the programs or, if there are none, the first snapshot."""
        programs = self._settings.scripted
        return tuple(-1 - k for k in range(programs)) or tuple(self.versions[:1])

    def made(self, version: int, env_steps: int) -> bool:
        """Make a snapshot of new weights if one is due. Returns whether the weights became a snapshot."""
        snapshots = self.state.snapshots
        settings = self._settings
        if not settings.window:
            return False
        if snapshots and (version <= snapshots[-1].version or env_steps < snapshots[-1].env_steps + settings.save_steps):
            return False
        snapshots.append(Snapshot(version, env_steps, self.state.rating))
        # Older weights that still act, within max_lag, may meet snapshots that were in the window when those weights were
        # made.
        del snapshots[1 : max(1, len(snapshots) - settings.window - settings.max_lag)]
        return True

    def of(self, lane: int, round_number: int, version: int) -> int:
        """The opponent in episodes that begin in this lane's rollout of this round. The rollout is collected with `version`.

        A result of at least 0 is the version of a snapshot or of the acting weights; -1 - k is program k.
        """
        settings = self._settings
        window = [each for each in self.versions if each <= version][-settings.window :] if settings.window else []
        drawn = generator(settings.seed, Purpose.MATCHES, lane, round_number)
        others = [*window, *(-1 - k for k in range(settings.scripted))]
        if settings.window and (not others or drawn.random() < settings.latest):
            return version
        return others[int(drawn.integers(len(others)))]

    def metrics(self) -> dict[str, float]:
        """The pool's entries in a row of the metrics."""
        return {ELO_KEY: self.state.rating, "self_play/snapshots": float(len(self.versions))}

    def played(self, episodes: Iterable[Episode]) -> None:
        """Update the ratings with the episodes that an update used."""
        state = self.state
        by_version = {snapshot.version: snapshot for snapshot in state.snapshots}
        for episode in episodes:
            number = episode.opponent
            if number is None:
                continue
            if number < 0:
                change = self._change(state.scripted[-1 - number], episode.facts[-1])
                state.scripted[-1 - number] -= change
            elif (snapshot := by_version.get(number)) is not None:
                change = self._change(snapshot.rating, episode.facts[-1])
                snapshot.rating -= change
            else:
                continue
            state.rating += change

    def _change(self, of_opponent: float, score: float) -> float:
        """The change in the policy's rating that this score causes. Equally strong teams should win equally often."""
        others = self._settings.teams - 1
        return K * (score - 1 / (1 + others * 10 ** ((of_opponent - self.state.rating) / SCALE)))
