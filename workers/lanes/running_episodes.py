"""The episodes that env copies are playing. Only this file sums rewards and counts steps.

Rule: the fields of `RunningEpisodes` are the whole state of an episode before it ends. Returns are summed in float64, before
any reward is rounded.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from millrace.protocol.arrays import Array, Bools, Doubles
from millrace.protocol.bounds import LARGEST, LONGEST_S
from millrace.protocol.rollout import Episode
from millrace.protocol.rows.rollout_checks import LARGEST_REWARD, wrong_episode
from millrace.protocol.specs import RunSpec
from millrace.workers.copies.env_errors import environment_failed
from millrace.workers.opponents import OtherTeams, whole_episode

FactsOfRows = Mapping[tuple[int, int], tuple[float, ...]]
"""The facts of each ended episode. A key is the row and the copy in which the episode ended."""


class EndedEpisode(NamedTuple):
    """An episode that has ended, the copy that played it, and whether it was cut."""

    copy: int
    """number of the copy in its lane"""
    episode: Episode
    cut: bool = False
    """whether the episode was cut because it reached the limit of steps"""


class RunningEpisodes:
    """The running episodes of N copies with A seats each: their returns and lengths so far."""

    def __init__(self, run: RunSpec, copies: int, lane: int | None, most_steps: int = LARGEST) -> None:
        """`lane` is the lane's number for errors, or None for an evaluation. An episode that reaches `most_steps` is cut."""
        self.returns = np.zeros((copies, run.seats_of_copy))
        """[N, A] float64: the sum of each seat's rewards"""
        self.lengths = np.zeros(copies, np.int64)
        """[N] number of steps so far"""
        self.began_s = [0.0] * copies
        """[N] when each running episode began, in seconds of `perf_counter`: at the end of the copy's previous episode, or
        when its first reset began
        """
        self.most_steps = most_steps
        self._run = run
        self._lane = lane
        self._no_facts = (math.nan,) * len(run.info_keys)

    def memory(self, now_s: float) -> Doubles:
        """[N, A + 1] the returns and the seconds of each running episode so far."""
        memory = np.empty((len(self.lengths), self.returns.shape[1] + 1))
        memory[:, :-1] = self.returns
        memory[:, -1] = [now_s - began_s for began_s in self.began_s]
        return memory

    def can_recall(self, memory: Doubles, steps: Sequence[int]) -> bool:
        """Whether these numbers are possible returns and times of episodes that have made so many `steps` [N].

        If they are, a learner will accept the episodes. Environments with seats may give rewards before the first step.
        """
        most = np.maximum(steps, 1) * LARGEST_REWARD
        seconds = memory[:, -1]
        possible = (np.abs(memory[:, :-1]) <= most[:, None]).all() and (seconds >= 0).all()  # NaN is not
        return bool(possible and (seconds <= LONGEST_S / 2).all())  # the other half is left for the rest of the episode

    def recall(self, memory: Doubles, steps: Sequence[int], copies: Sequence[int], now_s: float) -> None:
        """For these copies, restore the state from the `memory` of another lane, and from the numbers of `steps` [N]."""
        for n in copies:
            self.returns[n] = memory[n, :-1]
            self.lengths[n] = steps[n]
            self.began_s[n] = now_s - float(memory[n, -1])

    def begin(self, now_s: float) -> None:
        """Record that the first episodes of all copies begin now, with a reset."""
        self.began_s = [now_s] * len(self.began_s)

    def add(self, rewards: Array, playing: Bools) -> None:  # rule EPISODES
        """Add one step of the copies that are `playing` [N]. `rewards` [N, A] are 0 for seats without a reward."""
        self.returns += rewards
        self.lengths += playing

    # rule EPISODE_ORDER
    def add_rows(self, reward: Array, resets: Bools, step_end_s: Sequence[float], facts: FactsOfRows) -> list[EndedEpisode]:
        """Add T steps of copies with one agent each. Returns the episodes that ended, ordered by step, then by copy.

        This does the same as `add` and `ended` for each row, but is several times faster, because it sums the rewards of a
        copy's rows before it adds them to the return. `reward` [T, N] is 0 where a row only resets its copy. `resets`
        [T+1, N] says whether row t only resets the copy; its last row belongs to the next step. `step_end_s` [T] is when
        each step ended. Episodes are not checked, because a learner accepts them if all these rewards are finite.
        """
        rewards = reward.T.tolist()  # [N][T]
        returns = self.returns[:, 0].tolist()
        lengths = self.lengths.tolist()
        began_s = self.began_s
        # For each copy, the first row that is not yet added to its episode, and whether this row only resets the copy.
        first = [0] * len(rewards)
        only_resets = resets[0].tolist()
        found = []

        def add(n: int, end: int) -> None:
            """Add the rows of copy n up to `end` to its episode."""
            returns[n] += sum(rewards[n][first[n] : end])
            lengths[n] += end - first[n] - only_resets[n]  # only the first of these rows can be a reset
            first[n] = end
            only_resets[n] = True

        for t, n in np.argwhere(resets[1:]).tolist():
            add(n, t + 1)
            if not resets[t, n]:
                seconds = step_end_s[t] - began_s[n]
                of_info = facts.get((t, n), self._no_facts)
                found.append(EndedEpisode(n, Episode(returns[n], lengths[n], seconds, of_info)))
            returns[n] = 0.0
            lengths[n] = 0
            began_s[n] = step_end_s[t]
        for n in range(len(rewards)):
            if first[n] < len(step_end_s):
                add(n, len(step_end_s))
        self.returns[:, 0] = returns
        self.lengths[:] = lengths
        return found

    def ended(
        self, n: int, now_s: float, of_info: tuple[float, ...] | None, others: OtherTeams | None, *, cut: bool = False
    ) -> EndedEpisode:
        """End the episode of copy n, and return it.

        `of_info` are the facts that the environment reports, if any. `others` are the players of the other teams. Raises
        `EnvironmentFailed` if no learner would accept the episode. Its return includes rewards that are in no row, and so
        haven't been checked.
        """
        returns: list[float] = self.returns[n].tolist()
        seconds = now_s - self.began_s[n]
        facts = self._no_facts if of_info is None else of_info
        episode = whole_episode(self._run, others, n, returns, int(self.lengths[n]), seconds, facts)
        if why := wrong_episode(episode, self._run, self.most_steps):
            raise environment_failed(self._lane, f"copy {n}, episode: {why}")
        self.returns[n] = 0.0
        self.lengths[n] = 0
        self.began_s[n] = now_s
        return EndedEpisode(n, episode, cut)
