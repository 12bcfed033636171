"""One lane that a worker collects on: its env copies, the return and length of their running episodes, its random generator.

`finish` says which rows are valid: all but resets; with seats, `seat_rows.py` does.

It keeps what one rollout passes on to the next: the last observations, which copies have ended, the running episodes. The
collector steps it.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter

import numpy as np
import numpy.typing as npt

from millrace.protocol.arrays import Array, Bools
from millrace.protocol.policy.masks import stored_leaves
from millrace.protocol.policy.recurrent import zero_state
from millrace.protocol.random_streams import Purpose, generator
from millrace.protocol.rollout import Episode
from millrace.protocol.specs import RunSpec
from millrace.protocol.wire.plain_values import pack, unpack
from millrace.workers.collect.seat_rows import SeatRows
from millrace.workers.copies.env_copies import EnvCopies, check_spaces, copy_seeds
from millrace.workers.copies.env_errors import CopyFailed, environment_failed
from millrace.workers.copies.env_loop import Pulse
from millrace.workers.copies.episode_facts import Facts
from millrace.workers.copies.row_writers import ObservationWriter
from millrace.workers.copies.seated_copies import SeatedCopies
from millrace.workers.lanes.running_episodes import RunningEpisodes
from millrace.workers.opponents import Opponent


class CollectedLane:
    """A numbered group of N env copies that are stepped together."""

    def __init__(self, run: RunSpec, number: int, incarnation: int, copies: EnvCopies) -> None:
        self.number = number
        self.incarnation = incarnation
        self.copies = copies
        self.generator = generator(run.seed, Purpose.ACTIONS, number, incarnation)
        self.obs = tuple(np.empty((run.columns, *leaf.shape), leaf.dtype) for leaf in stored_leaves(run))  # [N, *leaf] each
        self.state = zero_state(run.policy, run.columns)  # [N, S] recurrent state of the policy
        self.state_before = self.state  # of this rollout
        self.ended = np.zeros(run.copies, bool)  # [N] the next step only resets this copy
        self.episodes = RunningEpisodes(run, run.copies, number)
        self.seats = SeatRows(run, number, incarnation, self.episodes) if run.seats else None
        self._run = run
        self._seeds = copy_seeds(run.seed, number, incarnation, run.copies)
        self._attributes = b""  # that were set in the copies
        self._facts: dict[tuple[int, int], tuple[float, ...]] = {}  # by row and copy, of episodes that ended in this rollout
        self.writer = ObservationWriter(stored_leaves(run), run.columns, run.seats)

    def set_attributes(self, packed: bytes, pulse: Pulse) -> None:
        """Set these attributes in all copies unless they are set. Raises `EnvironmentFailed` if a copy has none."""
        if packed == self._attributes:
            return
        before, now = (unpack(each) if each else {} for each in (self._attributes, packed))
        for name, value in now.items():
            if name in before and pack(before[name]) == pack(value):
                continue
            try:
                self.copies.assign(name, pack(value), pulse)
            except CopyFailed as error:
                raise environment_failed(self.number, error, f"set_env_attr {name}") from error
        self._attributes = packed

    def reset(self, pulse: Pulse) -> None:
        """Start episodes in all copies. Raises `UsageError` when their spaces are not those of the run."""
        check_spaces(self._run, self.copies)
        try:
            leaves = self.copies.reset(self._seeds, pulse)
            self.writer.write(self.writer.joined(array[None] for array in self.obs), 0, leaves)
        except CopyFailed as error:
            raise environment_failed(self.number, error, "first reset") from error
        self.episodes.begin(perf_counter())
        if self.seats is not None:
            assert isinstance(self.copies, SeatedCopies)
            self.seats.start(self.copies.columns)

    def begin(self, opponent: Opponent | None) -> None:
        """A rollout begins. `opponent`: of the episodes that begin in it, if the policy plays one team alone."""
        self.state_before = self.state if self.seats is None else self.seats.begin(self.state, opponent)

    @property
    def sent(self) -> slice | npt.NDArray[np.intp]:
        """The columns of a rollout's rows."""
        others = None if self.seats is None else self.seats.others
        return slice(None) if others is None else np.flatnonzero(others.mine)

    def close(self) -> None:
        """Close the copies. Raises nothing."""
        self.copies.close()

    def keep_facts(self, t: int, facts: Facts) -> None:
        """Keep the facts of the episodes that ended in row `t` for `finish`."""
        for n, of_copy in facts.items():
            self._facts[t, n] = of_copy

    def finish(self, reward: Array, done: Bools, step_end_s: Sequence[float]) -> tuple[Bools, tuple[Episode, ...]]:
        """After T steps: which rows are valid [T, N], and the episodes that ended, oldest first.

        `reward` [T, N] float64 is raw; it is set to 0 in rows that are not valid. `done` [T, N] is terminated or truncated.
        `step_end_s` [T] is when each step ended. The seconds of an episode count from the end of the copy's last episode.
        """
        if self.seats is not None:
            return self.seats.valid, self.seats.episodes
        resets = np.concatenate([self.ended[None], done])
        reward[resets[:-1]] = 0.0
        self.ended = done[-1].copy()
        ended = self.episodes.add_rows(reward, resets, step_end_s, self._facts)
        self._facts.clear()
        return ~resets[:-1], tuple(each.episode for each in ended)
