"""A lane: N env copies that are stepped together, and all the state that one step passes on to the next.

Rule: a lane's whole state is here: its copies and their attributes, the observations and the policy's state, which copies
are playing, their running episodes, seats that wait, opponents, and how the newest episodes began. The code that steps lanes
(`runner.py`) is stateless. `bring_back.py` gives a new lane the state of a lane that was lost.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter

import numpy as np
import numpy.typing as npt

from millrace.protocol.arrays import Array, Doubles
from millrace.protocol.bounds import LARGEST
from millrace.protocol.envs.seats import columns_of
from millrace.protocol.lane_past import EpisodeBegin
from millrace.protocol.policy.masks import stored_leaves
from millrace.protocol.policy.recurrent import is_possible, zero_state
from millrace.protocol.rows.rollout_checks import LARGEST_REWARD
from millrace.protocol.specs import RunSpec
from millrace.protocol.wire.plain_values import pack, unpack
from millrace.workers.copies.env_copies import EnvCopies, LoopedCopies, copy_seed
from millrace.workers.copies.env_errors import environment_failures
from millrace.workers.copies.env_loop import Pulse
from millrace.workers.copies.row_writers import ObservationWriter
from millrace.workers.copies.saved_state import CannotSave, SavedCopy
from millrace.workers.copies.seated_copies import SeatedCopies
from millrace.workers.copies.value_checks import check_rewards
from millrace.workers.lanes.running_episodes import RunningEpisodes
from millrace.workers.lanes.seats import Seats
from millrace.workers.opponents import Opponent, OtherTeams


class Lane:
    """N env copies that are stepped together. Each has A columns, one for each seat; A is 1 for a gymnasium environment."""

    def __init__(
        self,
        run: RunSpec,
        copies: EnvCopies,
        count: int,
        *,
        number: int | None,
        incarnation: int = 0,
        most_steps: int = LARGEST,
    ) -> None:
        """Make a lane of the first `count` of these copies.

        `number` is None if the lane plays an evaluation. In that case, no step resets a copy, and a copy whose episode is
        over is not stepped. An episode that reaches `most_steps` steps is cut.
        """
        self.number = number
        self.incarnation = incarnation
        self.copies = copies
        self.autoresets = number is not None
        self.count = count
        """N"""
        self.starts: list[int] = []
        """[N] the number of each copy's start, which determines its seed; empty in an evaluation"""
        self.new_starts: Sequence[int] = ()
        """the copies that have started since `begun` was last called"""
        self.remembers = isinstance(copies, LoopedCopies) and not run.teams
        """whether the lane's episodes can be continued on other copies"""
        self.columns = self.count * run.seats_of_copy
        """N · A"""
        leaves = stored_leaves(run)
        self.obs = tuple(np.empty((self.columns, *leaf.shape), leaf.dtype) for leaf in leaves)
        """[N · A, *leaf] each, the observations at the beginning of the next rows"""
        self.state = zero_state(run.policy, self.columns)
        """[N · A, S] recurrent state of the policy at the beginning of the next rows"""
        self.playing = np.ones(self.count, bool)
        """[N] whether the copy's episode continues; if not, the next step only resets the copy, or, in an evaluation, does
        nothing with it
        """
        self.episodes = RunningEpisodes(run, self.count, number, most_steps)
        self.seats = Seats(run.policy, self.columns) if run.seats else None
        self.others: OtherTeams | None = None
        """the players of the other teams; None if the policy plays all seats"""
        self.opponent: Opponent | None = None
        """the opponent in episodes that begin from now on; None: it doesn't change"""
        self.writer = ObservationWriter(leaves, self.columns, run.seats)
        self._run = run
        self._attributes = b""  # the attributes that were set on the copies last, packed

    def set_attributes(self, packed: bytes, pulse: Pulse) -> None:
        """Set these packed attributes on all copies, except attributes that already have the same value.

        Raises `EnvironmentFailed` if a copy lacks one.
        """
        if packed == self._attributes:
            return
        before, now = (unpack(each) if each else {} for each in (self._attributes, packed))
        for name, value in now.items():
            if name in before and pack(before[name]) == pack(value):
                continue
            with environment_failures(self.number, f"set_env_attr {name}"):
                self.copies.assign(name, pack(value), pulse)
        self._attributes = packed

    def start(self, starts: list[int], pulse: Pulse) -> None:
        """Begin the first episode of each copy, where `starts` [N] has the copies' start numbers. Raises `EnvironmentFailed`
        if a copy raises.
        """
        assert self.number is not None
        self.starts = starts
        self.new_starts = range(self.count)
        self.reset([copy_seed(self._run.seed, self.number, start, n) for n, start in enumerate(starts)], pulse)

    def reset(self, seeds: Sequence[int], pulse: Pulse) -> None:
        """Begin the first episodes, with a seed for each copy. Raises `EnvironmentFailed` if a copy raises."""
        self.episodes.begin(perf_counter())
        with environment_failures(self.number, "first reset" if self.autoresets else "reset"):
            leaves = self.copies.reset(seeds, pulse)
            self.writer.write_some(self.obs, range(self.columns), leaves)
        if self.seats is not None:
            assert isinstance(self.copies, SeatedCopies)
            first = self.copies.columns
            self.seats.acts = first.acts[: self.columns]
            self.add_outside(first.outside[: self.columns], 0)

    def add_outside(self, rewards: Doubles, step: int) -> None:
        """Add to the returns this step's rewards [N · A] that belong to no row.

        They are checked here, because they aren't in the rows that are checked later.
        """
        if not np.abs(rewards).max() < LARGEST_REWARD:  # the comparison is False for NaN too
            check_rewards(self.number, rewards[None], self._run.row_axes, step)
        self.episodes.returns += rewards.reshape(self.episodes.returns.shape)

    @property
    def sent(self) -> slice | npt.NDArray[np.intp]:
        """The columns that are part of a rollout: all, or only those of the policy's team."""
        return slice(None) if self.others is None else np.flatnonzero(self.others.mine)

    def begun(self) -> tuple[EpisodeBegin, ...]:  # rule PAST
        """For each copy that has begun an episode since `begun` was last called, how its newest episode began."""
        random: dict[int, bytes | None] = dict.fromkeys(self.new_starts, b"" if self.remembers else None)
        self.new_starts = ()
        if self.remembers and isinstance(self.copies, LoopedCopies):
            random |= self.copies.begun([n for n, playing in enumerate(self.playing.tolist()) if not playing])
        if not random:
            return ()
        return tuple(EpisodeBegin(n, self.starts[n], state) for n, state in sorted(random.items()))

    def memory(self) -> tuple[Array, ...]:  # rule PAST
        """The state that `recall` needs, in addition to the observations, the actions, and how the episodes began."""
        if not self.remembers:
            return ()
        state = (self.state,) if self.state.size else ()
        return (self.episodes.memory(perf_counter()), *state, *(() if self.seats is None else self.seats.memory()))

    def save(self) -> list[SavedCopy]:
        """The saved state of each copy; empty if the environment can't save it. Raises `EnvironmentFailed` if a
        copy raises.
        """
        copies = self.copies
        if not (self.remembers and isinstance(copies, LoopedCopies) and copies.saves):
            return []
        try:
            with environment_failures(self.number, "save_state"):
                return copies.save()
        except CannotSave as error:
            copies.saves = False
            copies.note = f"{error}, so its episodes are replayed if a worker is lost"
            return []

    def can_recall(self, memory: Sequence[Array], written: Sequence[Array], steps: Sequence[int]) -> bool:
        """Whether this memory fits this lane, and is possible in episodes that have made so many `steps` [N].

        With seats, `written` has arrays [T, N · A, …] of the shapes and dtypes that the policy writes.
        """
        own = self.memory()
        held = () if self.seats is None else written
        expected = [*((each.shape, each.dtype) for each in own), *((each.shape[1:], each.dtype) for each in held)]
        if [(each.shape, each.dtype) for each in memory] != expected:
            return False
        states = memory[1 : len(own)]
        return self.episodes.can_recall(memory[0], steps) and all(is_possible(self._run.policy, each) for each in states)

    def recall(self, memory: Sequence[Array], steps: Sequence[int], copies: Sequence[int]) -> None:
        """For these copies, restore the state from the `memory` of another lane, and from the numbers of `steps` [N] of
        their episodes. `can_recall` must have returned True.
        """
        left = list(memory)
        columns = columns_of(copies, self.columns // self.count)
        self.episodes.recall(left.pop(0), steps, copies, perf_counter())
        if self.state.size:
            self.state[columns] = left.pop(0)[columns]
        if self.seats is not None:
            self.seats.recall(left, columns)

    def close(self) -> None:
        """Close the copies. Never raises."""
        self.copies.close()
