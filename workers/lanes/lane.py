"""A lane: N env copies that are stepped together, and all that one step of them passes on to the next.

Rule: whatever a lane remembers is here: its copies and what was set in them, the observations and the policy's state, which
copies are playing, their running episodes, seats that wait, opponents, and the generator of its random numbers. What steps
lanes (`runner.py`) remembers nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter

import numpy as np
import numpy.typing as npt

from millrace.protocol.arrays import Doubles
from millrace.protocol.bounds import LARGEST
from millrace.protocol.policy.masks import stored_leaves
from millrace.protocol.policy.recurrent import zero_state
from millrace.protocol.rows.rollout_checks import LARGEST_REWARD
from millrace.protocol.specs import RunSpec
from millrace.protocol.wire.plain_values import pack, unpack
from millrace.workers.copies.env_copies import EnvCopies
from millrace.workers.copies.env_errors import CopyFailed, environment_failed
from millrace.workers.copies.env_loop import Pulse
from millrace.workers.copies.row_writers import ObservationWriter
from millrace.workers.copies.seated_copies import SeatedCopies
from millrace.workers.copies.value_checks import check_rewards
from millrace.workers.lanes.running_episodes import RunningEpisodes
from millrace.workers.lanes.seats import Seats
from millrace.workers.opponents import Opponent, OtherTeams


class Lane:
    """N env copies. Each has A columns, one for each seat; A is 1 for an environment of gymnasium's."""

    def __init__(
        self,
        run: RunSpec,
        copies: EnvCopies,
        seeds: Sequence[int],
        generator: np.random.Generator,
        *,
        number: int | None,
        incarnation: int = 0,
        most_steps: int = LARGEST,
    ) -> None:
        """`seeds`: of the first episodes, one for each copy. `generator`: of actions.

        `number`: None if the lane plays an evaluation. Then no step resets a copy, and one whose episode is over is not
        stepped. `most_steps`: an episode that reaches so many is cut.
        """
        self.number = number
        self.incarnation = incarnation
        self.copies = copies
        self.generator = generator
        self.autoresets = number is not None
        self.count = len(seeds)
        """N"""
        self.columns = self.count * run.seats_of_copy
        """N · A"""
        leaves = stored_leaves(run)
        self.obs = tuple(np.empty((self.columns, *leaf.shape), leaf.dtype) for leaf in leaves)
        """[N · A, *leaf] each, with which the next rows begin"""
        self.state = zero_state(run.policy, self.columns)
        """[N · A, S] recurrent state of the policy, with which the next rows begin"""
        self.playing = np.ones(self.count, bool)
        """[N] whether the copy's episode goes on: if not, the next step only resets the copy, or leaves it as it is"""
        self.episodes = RunningEpisodes(run, self.count, number, most_steps)
        self.seats = Seats(run.policy, self.columns) if run.seats else None
        self.others: OtherTeams | None = None
        """those who play the other teams, if the policy plays one team alone"""
        self.opponent: Opponent | None = None
        """who plays them in the episodes that begin from now on; None: as before"""
        self.writer = ObservationWriter(leaves, self.columns, run.seats)
        self._run = run
        self._seeds = seeds
        self._attributes = b""  # that were set in the copies

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
        """Start the first episodes. Raises `EnvironmentFailed`."""
        self.episodes.begin(perf_counter())
        try:
            leaves = self.copies.reset(self._seeds, pulse)
            self.writer.write_some(self.obs, range(self.columns), leaves)
        except CopyFailed as error:
            raise environment_failed(self.number, error, "first reset" if self.autoresets else "reset") from error
        if self.seats is not None:
            assert isinstance(self.copies, SeatedCopies)
            first = self.copies.columns
            self.seats.acts = first.acts[: self.columns]
            self.add_outside(first.outside[: self.columns], 0)

    def add_outside(self, rewards: Doubles, step: int) -> None:
        """Add rewards [N · A] of this step that are in no row to the returns. No later check sees them."""
        if not np.abs(rewards).max() < LARGEST_REWARD:  # false for NaN too
            check_rewards(self.number, rewards[None], self._run.row_axes, step)
        self.episodes.returns += rewards.reshape(self.episodes.returns.shape)

    @property
    def sent(self) -> slice | npt.NDArray[np.intp]:
        """The columns whose rows a rollout has."""
        return slice(None) if self.others is None else np.flatnonzero(self.others.mine)

    def close(self) -> None:
        """Close the copies. Raises nothing."""
        self.copies.close()
