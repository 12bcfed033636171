"""A loop over N env copies with A seats each. They have N · A columns; the columns of one copy are adjacent.

Rule: a column's mask comes from the last observation of this episode in which the column's seat acts. Until there is such an
observation, all actions are allowed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import gymnasium
import numpy as np

from millrace.protocol.arrays import Array, Bools
from millrace.protocol.envs.answers import WrongAnswer
from millrace.protocol.envs.seats import SeatedEnv, SeatStep, side_by_side
from millrace.protocol.envs.which_copy import FIRST_COPY, EnvCopy
from millrace.workers.copies.env_copies import PLAIN_COPIES, CopySettings, Leaves, LoopedCopies, SeatColumns, StepResult
from millrace.workers.copies.env_errors import CopyFailed
from millrace.workers.copies.env_loop import CopyInfos, Pulse
from millrace.workers.copies.episode_facts import facts_of_info
from millrace.workers.copies.mask_reader import unused_mask
from millrace.workers.copies.row_writers import read_leaves


class SeatedCopies(LoopedCopies):
    """A loop over N environments with seats; see `LoopedCopies`."""

    def __init__(
        self,
        makes: Iterable[Callable[[], gymnasium.Env[Any, Any]]],
        pulse: Pulse,
        seats: Sequence[str],
        settings: CopySettings = PLAIN_COPIES,
        first: EnvCopy = FIRST_COPY,
    ) -> None:
        """`seats` are the names of the A agents. For the other parameters, see `LoopedCopies`."""
        super().__init__(makes, pulse, settings, first)
        self._names = seats
        self._seats = len(seats)
        self._allowed: list[Bools | None] = [None] * (self.count * len(seats))  # None: all actions are allowed
        self.columns: SeatColumns

    def reset(self, seeds: Sequence[int], pulse: Pulse) -> Leaves:
        """Begin episodes in all copies, or in the first ones, with a seed for each. `columns` then says which seats act."""
        copies = range(len(seeds))
        self._allowed = [None] * (self.count * self._seats)
        self._loop.reset(copies, seeds, self._observations, pulse)
        self.note = self._loop.never_anew()
        if self._masks is None:
            infos = [info for step in self._observations if step is not None for info in step.infos]
            self.note = self.note or unused_mask(infos, self.action_space)
        return self._result(copies).leaves

    def step(self, actions: Array, pulse: Pulse, copies: Sequence[int] | None = None) -> StepResult:
        """Step all copies with actions [N · A, *action], or only `copies`, with A actions for each.

        The result has an entry for every column.
        """
        of_copies = actions.reshape(-1, self._seats, *actions.shape[1:])
        stepped = range(self.count) if copies is None else copies
        loop = self._loop
        self._forget_masks(n for n in stepped if loop.terminated[n] or loop.truncated[n])  # this step resets them
        loop.step(of_copies, self._observations, pulse, copies)
        return self._result(stepped)

    def _after_reset(self, copies: Sequence[int], infos: CopyInfos) -> StepResult:
        self._forget_masks(copies)
        return self._result(copies)

    def _forget_masks(self, copies: Iterable[int]) -> None:
        """Forget the masks of these copies, because they begin an episode."""
        for n in copies:
            self._allowed[n * self._seats : (n + 1) * self._seats] = [None] * self._seats

    def _result(self, stepped: Sequence[int]) -> StepResult:
        """The result of a step in which the copies `stepped` were stepped.

        The others keep their last rows; copies that were never reset are left out.
        """
        steps: list[SeatStep] = [step for step in self._observations if step is not None]
        columns = side_by_side(steps)
        observations = columns.observations
        leaves: Leaves = read_leaves(self._read, observations, self._names) if self._nested else (observations,)
        if self._masks is not None:
            for n in stepped:
                for seat, name in enumerate(self._names):
                    column = n * self._seats + seat
                    if not (columns.acts[column] or columns.complete[column]):
                        continue
                    over = not columns.acts[column]
                    terminated = over and columns.terminated[column]
                    try:
                        self._allowed[column] = self._masks.read(
                            n, observations[column], columns.infos[column], terminated, over
                        )
                    except CopyFailed as error:
                        raise CopyFailed(n, error.doing, f"{name}, {error.line}") from error
            everything = self._masks.everything
            allowed = self._allowed[: len(columns.acts)]
            leaves = (*leaves, [everything if mask is None else mask for mask in allowed])
        ended = np.array(self._loop.terminated[: len(steps)], bool)
        self.columns = SeatColumns(
            complete=np.array(columns.complete, bool),
            acts=np.array(columns.acts, bool),
            outside=np.array(columns.outside, np.float64),
            over=ended,
        )
        facts = {n: self._facts_of(steps[n]) for n in stepped if ended[n]} if self._facts else {}
        return StepResult(leaves, columns.reward, columns.terminated, columns.truncated, facts=facts, columns=self.columns)

    def pending(self, copy: int) -> Array:
        """[A] rewards that this copy's seats have earned, and that no step has returned yet. Raises `CopyFailed`."""
        env = self.envs[copy]
        assert isinstance(env, SeatedEnv)
        try:
            return np.array(env.pending(), np.float64)
        except WrongAnswer as error:
            raise CopyFailed(copy, "step") from error

    def _facts_of(self, last: SeatStep) -> tuple[float, ...]:
        """For each fact, the mean over the seats that report it in the last step of a copy's episode; NaN if none does."""
        of_seats = np.array([facts_of_info(self._facts, info) for info in last.infos])
        there = ~np.isnan(of_seats)
        sums = np.where(there, of_seats, 0).sum(0)
        return tuple(np.where(there.any(0), sums / np.maximum(there.sum(0), 1), np.nan).tolist())
