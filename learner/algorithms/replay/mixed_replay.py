"""A replay buffer with prior data: a fixed share of each sample comes from a dataset (RLPD, Ball et al. 2023).

Rule: only the run's own transitions are added, overwritten and rolled back, and only they have priorities. Prior transitions
never change and are drawn uniformly. They aren't part of a saved state: add the same dataset before you load the state.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from millrace.learner.algorithms.replay.replay_buffer import ReplayBuffer, Sample
from millrace.protocol.arrays import Floats, Ints
from millrace.protocol.errors import UsageError
from millrace.protocol.machine.available_memory import GIB, available_bytes
from millrace.protocol.random_streams import Purpose
from millrace.protocol.rollout import Batch

PRIOR_SLOT = -1  # stands for every prior transition in `Sample.slots`


class PriorTransitions(ReplayBuffer):
    """The transitions of a dataset, which no checkpoint copies."""

    _purpose = Purpose.PRIOR

    def _check_memory(self, needed: int) -> None:
        free = available_bytes()
        if free is not None and needed > free:
            raise UsageError(
                f"prior: {self.size} observations of the dataset take {needed / GIB:.1f} GiB, "
                f"but {free / GIB:.1f} GiB of memory are free; record a smaller dataset"
            )


class MixedReplay(ReplayBuffer):
    """The run's own transitions, and prior transitions if there are any. In a sample, the prior transitions come last."""

    prior: ReplayBuffer | None = None
    _prior_share = 0.0
    _remembered_prior: Any = None

    def add_prior(self, batches: Iterable[Batch], slots: int, share: float) -> None:
        """Store prior transitions.

        `slots` is the number of their observations, and `share` the fraction of each sample that is prior. Raises
        `UsageError` if there is too little memory, or, with hindsight, if the rewards don't agree with the goals.
        """
        prior = PriorTransitions(
            tuple(self._observation.values()),
            size=slots,
            n_step=self._n_step,
            gamma=self._gamma,
            seed=self._seed,
            action=self._action,
            hindsight=self._hindsight,
        )
        for episode, batch in enumerate(batches):
            try:
                prior.add(batch)
            except UsageError as error:
                raise UsageError(f"prior: episode {episode}: {error}") from error
        self.prior = prior
        self._prior_share = share

    def sample(self, count: int, beta: float = 1.0) -> Sample:
        """Draw transitions with replacement. Until the run has its own, all are prior. For `beta`, see `ReplayBuffer`."""
        if self.prior is None:
            return super().sample(count, beta)
        prior = round(self._prior_share * count) if len(self) else count
        parts = [] if prior == count else [super().sample(count - prior, beta)]
        if prior:
            drawn = self.prior.sample(prior)
            parts.append(drawn._replace(slots=np.full(prior, PRIOR_SLOT)))
        return parts[0] if len(parts) == 1 else _joined(*parts)

    def samples(self, number: int, count: int, beta: float = 1.0) -> Iterator[Sample]:
        """Yield `number` samples of `count` transitions each. `sample` describes one of them."""
        if self.prior is None:
            return super().samples(number, count, beta)
        return (self.sample(count, beta) for _ in range(number))

    def update_priorities(self, slots: Ints, error: Floats) -> None:
        """Set the priorities of the run's own transitions among these slots [B], from their errors [B]."""
        own = slots != PRIOR_SLOT
        if own.any():
            super().update_priorities(slots[own], error[own])

    def remember(self) -> None:
        """Remember the current state, for `roll_back`."""
        super().remember()
        self._remembered_prior = _generator_state(self.prior)

    def roll_back(self) -> None:
        """Return to the state of the last `remember`."""
        super().roll_back()
        if self.prior is not None and self._remembered_prior is not None:
            self.prior.generator.bit_generator.state = self._remembered_prior

    def state_dict(self) -> dict[str, Any]:
        """A copy of the run's own slots in use, and of the state of the generator that draws prior transitions."""
        state = super().state_dict()
        return (
            state
            if self.prior is None
            else state | {"prior": {"rows": len(self.prior), "next": _generator_state(self.prior)}}
        )

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`, bit for bit. Raises ValueError if its size, or the prior data's, differs."""
        had = state.get("prior", {}).get("rows", 0)
        has = 0 if self.prior is None else len(self.prior)
        if had != has:
            raise ValueError(f"prior: expected the dataset of the run with {had} transitions, got {has}")
        super().load_state_dict(state)
        if self.prior is not None:
            self.prior.generator.bit_generator.state = state["prior"]["next"]


def _joined(own: Sample, prior: Sample) -> Sample:
    """Join two samples into one, field by field."""

    def joined(one: Any, other: Any) -> Any:
        if isinstance(one, tuple):
            return tuple(map(joined, one, other))
        return None if one is None else np.concatenate([one, other])  # None if there are no action masks

    return Sample(*map(joined, own, prior))


def _generator_state(buffer: ReplayBuffer | None) -> Any:
    return None if buffer is None else buffer.generator.bit_generator.state
