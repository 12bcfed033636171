"""The replay buffer for recurrent policies: stores sequences, and draws each one together with its predecessor.

A sequence is the part of a rollout that belongs to one env copy, or to one seat. It has T rows, and the state that the
recurrent core had on the worker before these rows. This state was computed with older weights. To compute a state with the
current weights, the previous sequence is therefore passed through the core first, from its own stored state and without a
gradient (stored state and burn-in, Kapturowski et al. 2019, R2D2).

Rule: each row is in exactly one sequence. Unless replay is prioritized, all sequences are equally likely to be drawn, so all
rows are used equally often, however long their episodes are. Rows follow the row format (`millrace.protocol.rollout`). If an
episode ends inside a sequence, the state is reset to zeros there, and a row that is not valid passes the state on.

This module uses no files, and all randomness comes from the seed.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from millrace.learner.algorithms.replay.ring import Ring
from millrace.learner.algorithms.returns import EpisodeEnds, n_step_returns
from millrace.protocol.arrays import Array, Bools, Floats, Ints
from millrace.protocol.errors import UsageError
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import PolicySpec

NONE = -1  # stands for "no sequence" where a sequence's number is expected
FEWEST = 16
"""The smallest number of sequences in a sample. Rows of a sequence are similar, so few sequences give a noisy gradient."""
HIGHEST_SHARE = 0.9  # weight of the highest error in a priority; the mean error has the rest (Kapturowski et al. 2019)


class SequenceSample(NamedTuple):
    """B rows in C sequences of T rows, each preceded by T rows of burn-in. Arrays of steps are in time order."""

    slots: Ints  # [B] the slot of the sequence that each row is in
    leaves: tuple[Array, ...]  # [2 T + 1, C, *leaf] each: T observations of burn-in, then the sequence's observations
    state: Floats  # [C, S] the core's state before the burn-in, or before the sequence if it has no predecessor
    keep_state: Bools  # [2 T + 1, C] False where an episode begins
    advances: Bools  # [2 T + 1, C] False where a row leaves the core's state unchanged
    rows: Ints  # [B] indices of the rows in [T, C], flattened
    next_rows: Ints  # [B] indices of the observations k steps later in [T + 1, C], flattened
    action: Array  # [B, *action] int64 or float32, as rows store them
    reward: Floats  # [B] Σ γⁱ r over k steps; k is `n_step`, or less where the episode or the sequence ends
    discount: Floats  # [B] γᵏ; 0 where the episode terminated
    weight: Floats  # [B] importance-sampling weight in the loss, at most 1
    next_mask: Bools | None  # [B, choices] actions allowed k steps later; None without action masks


class SequenceReplay(Ring):
    """The newest sequences of all lanes, drawn uniformly or by priority."""

    def __init__(
        self,
        policy: PolicySpec,
        *,
        rows: int,
        steps: int,
        n_step: int,
        gamma: float,
        seed: int,
        alpha: float | None = None,
    ) -> None:
        """Allocate memory for `rows` rows, in sequences of T = `steps` rows. For `alpha`, see `ReplayBuffer`.

        Raises `UsageError` if there is too little memory.
        """
        T = steps
        self._leaves = [f"obs{i}" for i in range(len(policy.observation))]
        shapes: dict[str, tuple[tuple[int, ...], Any]] = {
            name: ((T + 1, *leaf.shape), leaf.dtype) for name, leaf in zip(self._leaves, policy.observation, strict=True)
        }
        shapes |= {
            "action": ((T, *policy.action.shape), policy.action.stored_dtype),
            "reward": ((T,), "float32"),
            "terminated": ((T,), "bool"),
            "truncated": ((T,), "bool"),
            "valid": ((T,), "bool"),
            "begins": ((T,), "bool"),  # True where obs[t+1] begins an episode
            "state": ((policy.state_size,), "float32"),
            "before": ((), "int64"),  # the number of the previous sequence, in the order in which they were written
        }
        super().__init__(max(1, rows // steps), shapes, seed=seed, alpha=alpha, steps=steps)
        self._n_step = n_step
        self._gamma = gamma

    @property
    def _is_row(self) -> Bools:
        return self.arrays["valid"]

    # ---------------------------------------------------------------- writing

    def add(self, batch: Batch) -> None:
        """Store the sequences of a batch that have a valid row. Raises `UsageError` if there is no room for two rollouts."""
        N = batch.columns_per_rollout
        if self.size < 2 * N:
            least = 2 * N * self._steps
            raise UsageError(
                f"replay_size {self.size * self._steps}: expected room for two rollouts of a lane, {least} rows; "
                f"take --replay-size {least} or more"
            )
        if batch.mask is not None:
            self._make_masks((self._steps + 1, batch.mask.shape[-1]))
        begins = batch.begins
        for at in range(0, len(batch.lane), N):  # a lane's rollouts are in order of collection
            self._add(batch, begins, slice(at, at + N), int(batch.lane[at]))

    def _add(self, batch: Batch, begins: Bools, columns: slice, lane: int) -> None:
        arrays = {
            name: leaf[:, columns].swapaxes(0, 1) for name, leaf in zip(self._leaves, batch.obs, strict=True)
        }  # [N, T + 1, *leaf] each
        for name in ("action", "reward", "terminated", "truncated", "valid"):
            arrays[name] = getattr(batch, name)[:, columns].swapaxes(0, 1)
        if batch.mask is not None:
            arrays["mask"] = batch.mask[:, columns].swapaxes(0, 1)
        arrays["begins"] = begins[:, columns].swapaxes(0, 1)
        arrays["state"] = batch.state[columns]
        arrays["before"] = self._before(lane, batch.fresh[columns], arrays)
        used = np.flatnonzero(arrays["valid"].any(1))  # the columns that have a valid row
        numbers = self._written + np.arange(len(used))
        slots = numbers % self.size
        self._keep(slots)
        self._rows += int(np.count_nonzero(arrays["valid"])) - int(np.count_nonzero(self.arrays["valid"][slots]))
        for name, array in arrays.items():
            self.arrays[name][slots] = array[used]
        if self._priorities is not None:
            self._priorities.add(slots)
        self._written += len(used)
        # A seat that waited throughout this rollout gets no sequence, and its next rollout continues its previous sequence.
        waits = ~arrays["begins"].any(1)
        newest = np.where(waits, arrays["before"], NONE)
        newest[used] = numbers
        self._newest[lane] = newest

    def _before(self, lane: int, fresh: Bools, arrays: dict[str, Array]) -> Ints:
        """[N] the number of the sequence that each column continues; NONE if there is none.

        The observations are compared, because a caller that stacks rollouts itself may have left a rollout out.
        """
        known = self._newest.get(lane)
        if known is None or len(known) != len(fresh):
            return np.full(len(fresh), NONE)
        continues = ~fresh & (known != NONE)
        for name in self._leaves:
            same = self.arrays[name][known % self.size, -1] == arrays[name][:, 0]
            continues &= same.reshape(len(fresh), -1).all(1)
        return np.where(continues, known, NONE)

    # ---------------------------------------------------------------- reading

    def samples(self, number: int, count: int, beta: float = 1.0) -> Iterator[SequenceSample]:
        """Yield `number` samples. For `count` and `beta`, see `sample`."""
        return (self.sample(count, beta) for _ in range(number))

    def sample(self, count: int, beta: float = 1.0) -> SequenceSample:
        """Draw sequences with replacement: as many as hold `count` rows if all rows are valid, but at least `FEWEST`.

        For `beta`, see `ReplayBuffer`.
        """
        sequences = max(FEWEST, count // self._steps)
        if self._priorities is None:
            slots = self.generator.integers(0, self._used, sequences)
            weight = np.ones(sequences, np.float32)
        else:
            slots, weight = self._priorities.draw(self.generator, sequences, self._used, beta)
        return self._drawn(slots, weight)

    def _drawn(self, slots: Ints, weight: Floats) -> SequenceSample:
        T, C = self._steps, len(slots)
        own = {name: array[slots].swapaxes(0, 1) for name, array in self.arrays.items() if array.ndim > 1}  # [T, C, …] each
        number = self.arrays["before"][slots]
        has_before = (number != NONE) & (number >= self._written - self.size)  # older ones have been overwritten
        earlier = number % self.size
        before = {name: self.arrays[name][earlier].swapaxes(0, 1) for name in (*self._leaves, "valid", "begins")}
        begins_before = before["begins"] & has_before
        first = np.zeros((1, C), bool)
        begins = np.concatenate([first, begins_before, own["begins"]])  # [2 T + 1, C]
        advances = np.concatenate([before["valid"] & has_before, own["valid"], first])
        state = np.where(has_before[:, None], self.arrays["state"][earlier], self.arrays["state"][slots])
        ends = EpisodeEnds(own["terminated"], own["truncated"], own["valid"], with_seats=True)
        returns = n_step_returns(own["reward"], ends, self._gamma, self._n_step)
        rows = np.flatnonzero(own["valid"])
        next_rows = (returns.last * C + np.arange(C)).ravel()[rows]
        column = rows % C
        return SequenceSample(
            slots=slots[column],
            leaves=tuple(np.concatenate([before[name][:T], own[name]]) for name in self._leaves),
            state=state,
            keep_state=~begins,
            advances=advances,
            rows=rows,
            next_rows=next_rows,
            action=_flat(own["action"])[rows],
            reward=returns.reward.ravel()[rows].astype(np.float32),
            discount=returns.discount.ravel()[rows].astype(np.float32),
            weight=weight[column],
            next_mask=_flat(own["mask"])[next_rows] if "mask" in own else None,
        )

    def update_priorities(self, slots: Ints, error: Floats) -> None:
        """Set the priorities of sequences from the errors [B] of their rows. `slots` [B] are the rows' slots."""
        if self._priorities is None:
            return
        sequences, of_row = np.unique(slots, return_inverse=True)
        size = np.abs(error).astype(np.float64)
        highest = np.zeros(len(sequences))
        np.maximum.at(highest, of_row, size)
        mean = np.bincount(of_row, size) / np.bincount(of_row)
        self._keep(sequences, [])
        self._priorities.update(sequences, HIGHEST_SHARE * highest + (1 - HIGHEST_SHARE) * mean)

    # ---------------------------------------------------------------- saving

    def state_dict(self) -> dict[str, Any]:
        """A copy of the slots in use, as tensors and plain data."""
        return super().state_dict() | {"steps": self._steps}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`, bit for bit. Raises ValueError if the number or length of sequences differs."""
        if state["steps"] != self._steps:
            raise ValueError(f"rollout_steps: expected {state['steps']}, got {self._steps}")
        super().load_state_dict(state)


def _flat(array: Array) -> Array:
    """An array [T, C, …] reshaped to [T · C, …], as a view where possible."""
    return array.reshape(-1, *array.shape[2:])
