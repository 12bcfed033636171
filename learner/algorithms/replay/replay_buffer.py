"""The replay buffer: stores rows, and draws n-step transitions, uniformly or by priority.

A slot of the ring (`ring.py`) holds a raw observation. If a valid row begins with this observation, the slot also holds the
rest of the row: action, reward, whether it terminated, and the slot of the next observation. Each observation is therefore
stored once (or each frame of a frame stack, see `shared_channels.py`). When a transition is drawn, its n-step return is
computed by following the rows from slot to slot. A slot without a row holds the final observation of a truncated episode, or
the newest observation of an env copy, whose row arrives with the copy's next rollout.

Rule: rows that are not valid are never stored. A row's next observation is newer than the row, and the ring overwrites the
oldest slot first, so the rows that follow a stored row are always stored, too. They are rows of the same seat, however long
the seat waits between them. While it waits, its observation stays the one that its last row led to, which is stored only
once.

With hindsight (`hindsight.py`), a share of the rows get another goal when they are drawn. In that case, the final
observation of a terminated episode has a slot, too, because it holds the goal that was achieved last.

This module uses no sockets and no files, and all randomness comes from the seed.
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from millrace.learner.algorithms.replay.episode_paths import NO_SLOT, EpisodePaths
from millrace.learner.algorithms.replay.hindsight import Goals, Hindsight
from millrace.learner.algorithms.replay.ring import Ring
from millrace.learner.algorithms.replay.shared_channels import SharedChannels
from millrace.learner.algorithms.returns import EpisodeEnds
from millrace.protocol.arrays import Array, Bools, Doubles, Floats, Ints
from millrace.protocol.errors import UsageError
from millrace.protocol.rollout import Batch
from millrace.protocol.specs import ActionSpec, Leaf

DRAWN_AT_ONCE = 1 << 20  # transitions are drawn together up to this many bytes, so that they stay in the cache
DISCRETE = ActionSpec("discrete", (), "int64")


def row_dtype(action: ActionSpec) -> np.dtype[Any]:
    """The dtype of a row: a single record, so that a row is drawn with a single copy."""
    fields = [("follows", "i8"), ("reward", "f4"), ("terminated", "?"), ("is_row", "?")]
    return np.dtype([("action", action.stored_dtype, action.shape), *fields], align=True)


class Sample(NamedTuple):
    """B transitions of k steps, where k is `n_step`, or less if the episode or the stored rows end sooner."""

    slots: Ints  # [B] the slots of their first rows
    leaves: tuple[Array, ...]  # [B, *leaf] each
    action: Array  # [B, *action] int64 or float32, as rows store them
    reward: Floats  # [B] Σ γⁱ r over the k steps
    discount: Floats  # [B] γᵏ; 0 where the episode terminated
    next_leaves: tuple[Array, ...]  # [B, *leaf] each, k steps later
    weight: Floats  # [B] importance-sampling weight in the loss, at most 1
    next_mask: Bools | None = None  # [B, choices] actions allowed in the next observation; None without action masks

    def part(self, rows: slice) -> Sample:
        """A range of these transitions, as views."""
        return Sample(
            self.slots[rows],
            tuple(leaf[rows] for leaf in self.leaves),
            self.action[rows],
            self.reward[rows],
            self.discount[rows],
            tuple(leaf[rows] for leaf in self.next_leaves),
            self.weight[rows],
            None if self.next_mask is None else self.next_mask[rows],
        )


def _goes_on(ends: EpisodeEnds, continues: Bools) -> Bools:
    """[T+1, N] True where row t begins with an observation that is already stored, because the previous row led to it.

    `continues` [N] says this for row 0. With seats, rows that are not valid may lie between a row and the previous one.
    """
    goes_on = np.concatenate([continues[None], ends.valid & ~ends.ended])
    if ends.with_seats:
        for t, valid in enumerate(ends.valid):
            goes_on[t + 1] |= goes_on[t] & ~valid
    return goes_on


class ReplayBuffer(Ring):
    """The newest transitions of all lanes, drawn uniformly or by priority."""

    def __init__(
        self,
        observation: tuple[Leaf, ...],
        *,
        size: int,
        n_step: int,
        gamma: float,
        seed: int,
        alpha: float | None = None,
        action: ActionSpec = DISCRETE,
        hindsight: Hindsight | None = None,
    ) -> None:
        """`size` is in slots. Transitions are drawn in proportion to |error|^alpha, or uniformly if `alpha` is None.

        Raises `UsageError` if there is too little memory.
        """
        self._observation = {f"obs{i}": leaf for i, leaf in enumerate(observation)}
        shapes = {name: (leaf.shape, leaf.dtype) for name, leaf in self._observation.items()}
        super().__init__(
            size,
            shapes | {"row": ((), row_dtype(action))},
            seed=seed,
            alpha=alpha,
            images={name: leaf for name, leaf in self._observation.items() if leaf.is_image},
            other_bytes=0 if hindsight is None else EpisodePaths.memory_bytes(size),
        )
        self._share(())
        self._transition_bytes = 2 * self.bytes // size  # a drawn transition has two observations
        self._action = action
        self._n_step = n_step
        self._gamma = gamma
        self._seed = seed
        self._hindsight = hindsight
        self._paths = None if hindsight is None else EpisodePaths(size)

    @property
    def _is_row(self) -> Bools:
        is_row: Bools = self.arrays["row"]["is_row"]
        return is_row

    def _share(self, names: Container[str]) -> None:
        super()._share(names)
        arrays = self._all_arrays()
        self._obs = [arrays[name] for name in self._observation]  # looked up once, because each draw reads them

    # ---------------------------------------------------------------- writing

    def add(self, batch: Batch) -> None:
        """Store the valid rows of a batch.

        Raises `UsageError` if a single rollout does not fit, if there is no memory for the first action masks, or, with
        hindsight, if the rewards don't agree with the goals.
        """
        if self._hindsight is not None:
            self._hindsight.check(batch)
        if batch.mask is not None:
            self._make_masks(batch.mask.shape[-1:])
        if not self._written:  # the first images, from one copy's rollout, show whether sharing channels saves memory
            first = dict(zip(self._observation, (leaf[:, 0] for leaf in batch.obs), strict=True))
            self._share([name for name, leaf in self._images.items() if SharedChannels.worthwhile(leaf, first[name])])
        for at in range(0, len(batch.lane), batch.columns_per_rollout):  # a lane's rollouts are in order of collection
            self._add(batch, slice(at, at + batch.columns_per_rollout), int(batch.lane[at]))

    def _add(self, batch: Batch, columns: slice, lane: int) -> None:
        obs = [leaf[:, columns] for leaf in batch.obs]  # [T+1, N, *leaf] each
        valid = batch.valid[:, columns]
        terminated = batch.terminated[:, columns]
        most = valid.size + valid.shape[1]
        if most > self.size:
            raise UsageError(f"replay_size {self.size}: a rollout takes up to {most}; take --replay-size {most} or more")
        fresh = batch.fresh[columns]
        known = NO_SLOT if fresh.all() else self._newest.get(lane, NO_SLOT)  # a fresh lane may have another number of copies
        newest = np.where(fresh, NO_SLOT, known)
        continues = self._continues([leaf[0] for leaf in obs], newest, most)
        goes_on = _goes_on(EpisodeEnds.of(batch).columns(columns), continues)  # [T+1, N]
        leads = valid & ~terminated if self._paths is None else valid  # [T, N] rows whose next observation is stored
        needed = np.zeros(goes_on.shape, bool)  # [T+1, N] observations to store
        needed[:-1] = valid & ~goes_on[:-1]
        needed[1:] |= leads
        written = np.full(needed.shape, NO_SLOT)  # [T+1, N] value of `_written` when each observation is stored
        written[needed] = self._written + np.arange(np.count_nonzero(needed))
        written[0][continues] = newest[continues]
        written = np.maximum.accumulate(written)  # while a seat waits, its newest observation stays where it is
        self._written += int(np.count_nonzero(needed))
        slot = written % self.size
        new = slot[needed]
        self._keep(new)
        self._keep(slot[0][continues], ["row"])
        row = self.arrays["row"]
        self._rows -= int(np.count_nonzero(row["is_row"][new]))
        row["is_row"][new] = False
        if self._priorities is not None:
            self._priorities.tree.set(new, 0.0)
        if self._paths is not None:
            before = np.full(needed.shape, NO_SLOT)  # [T+1, N] slot of the row that led to each observation
            before[1:][valid] = slot[:-1][valid]
            self._paths.overwrite(new)
            self._paths.append(new, before[needed])
        for stored, leaf in zip(self._obs, obs, strict=True):
            stored[new] = leaf[needed]
        if batch.mask is not None:
            self.arrays["mask"][new] = batch.mask[:, columns][needed]
        rows = slot[:-1][valid]
        row["action"][rows] = batch.action[:, columns][valid]
        row["reward"][rows] = batch.reward[:, columns][valid]
        row["terminated"][rows] = terminated[valid]
        row["follows"][rows] = np.where(leads[valid], slot[1:][valid], rows)
        row["is_row"][rows] = True
        self._rows += len(rows)
        if self._priorities is not None:
            self._priorities.add(rows)
        self._newest[lane] = np.where(goes_on[-1], written[-1], NO_SLOT)

    def _continues(self, first: Sequence[Array], newest: Ints, room: int) -> Bools:
        """[N] True where a copy's rollout begins with the newest observation that is stored for it.

        `newest` [N] is the value of `_written` when that observation was stored, or NO_SLOT. The rollout needs `room` slots.
        The observations are compared, because a caller that stacks rollouts itself may have left a rollout out. The stored
        observation must also be so new that adding this rollout does not overwrite it.
        """
        continues: Bools = (newest != NO_SLOT) & (newest + self.size >= self._written + room)
        for kept, leaf in zip(self._obs, first, strict=True):
            same = kept[newest % self.size] == leaf
            continues &= same.reshape(len(leaf), -1).all(1)
        return continues

    # ---------------------------------------------------------------- reading

    def sample(self, count: int, beta: float = 1.0) -> Sample:
        """Draw `count` transitions with replacement.

        `beta` sets how far importance weights correct for the priorities: 1 corrects fully.
        """
        if self._priorities is None:
            slots, row = self._uniform(count)
            weight = np.ones(count, np.float32)
        else:
            slots, weight = self._priorities.draw(self.generator, count, self._rows, beta)
            row = self.arrays["row"][slots]
        goals = None if self._hindsight is None else self._other_goals(self._hindsight.share, slots)
        reward, discount, last = self._follow(row, goals)
        return Sample(
            slots=slots,
            leaves=self._leaves(slots, goals),
            action=row["action"],
            reward=reward.astype(np.float32),
            discount=discount.astype(np.float32),
            next_leaves=self._leaves(last, goals),
            weight=weight,
            next_mask=self.arrays["mask"][last] if "mask" in self.arrays else None,
        )

    def _other_goals(self, share: float, slots: Ints) -> Goals:
        """Other goals for a random share of the rows in these slots. Each was achieved later in the row's episode."""
        assert self._paths is not None
        assert self._hindsight is not None
        rows = np.flatnonzero(self.generator.random(len(slots)) < share)
        later = self._paths.later(slots[rows], self.generator.random(len(rows)))
        return Goals(rows, self._obs[self._hindsight.achieved][later])

    def _leaves(self, slots: Ints, goals: Goals | None) -> tuple[Array, ...]:
        """Copies of the observations in these slots, with their goals replaced if `goals` are given."""
        leaves = tuple(leaf[slots] for leaf in self._obs)
        if goals is not None and self._hindsight is not None:
            leaves[self._hindsight.desired][goals.rows] = goals.goal
        return leaves

    def samples(self, number: int, count: int, beta: float = 1.0) -> Iterator[Sample]:
        """Yield `number` samples of `count` transitions each. Between the samples, only priorities may change.

        Several small uniform samples are drawn at once, because this is faster.
        """
        at_once = 1 if self.prioritized else max(1, DRAWN_AT_ONCE // (count * self._transition_bytes))
        for first in range(0, number, at_once):
            these = min(at_once, number - first)
            drawn = self.sample(these * count, beta)
            yield from (drawn.part(slice(i * count, (i + 1) * count)) for i in range(these))

    def _uniform(self, count: int) -> tuple[Ints, Array]:
        rows = self.arrays["row"]
        used = self._used
        slots = self.generator.integers(0, used, count)
        while not (found := (row := rows[slots])["is_row"]).all():  # few rounds, because half of the slots have a row
            slots[~found] = self.generator.integers(0, used, np.count_nonzero(~found))
        return slots, row

    def _follow(self, row: Array, goals: Goals | None) -> tuple[Doubles, Doubles, Ints]:
        """Follow each row for up to `n_step` steps. Returns the discounted reward, γᵏ (0 if terminated) and the last slot.

        `row` is a copy. Rows in it that have another goal get the reward and the end that this goal gives.
        """
        self._set_outcome(row, goals)
        reward = row["reward"].astype(np.float64)
        discount = self._gamma * ~row["terminated"]
        ended = row["terminated"]
        at = row["follows"]
        for _ in range(self._n_step - 1):
            row = self.arrays["row"][at]
            self._set_outcome(row, goals)
            going = row["is_row"] & ~ended  # the others stay at the last slot that they reached
            reward += np.where(going, discount * row["reward"], 0)
            discount = np.where(going, discount * self._gamma * ~row["terminated"], discount)
            ended |= going & row["terminated"]
            at = np.where(going, row["follows"], at)
        return reward, discount, at

    def _set_outcome(self, row: Array, goals: Goals | None) -> None:
        """Set the reward and the end of the rows with another goal. For a slot without a row, the result has no meaning."""
        if goals is None or self._hindsight is None:
            return
        led_to = row["follows"][goals.rows]
        achieved = self._obs[self._hindsight.achieved][led_to]
        desired = self._obs[self._hindsight.desired][led_to]
        outcome = self._hindsight.outcome(achieved, desired, row["terminated"][goals.rows], goals.goal)
        row["reward"][goals.rows] = outcome.reward
        row["terminated"][goals.rows] = outcome.terminated

    def update_priorities(self, slots: Ints, error: Floats) -> None:
        """Set the priorities of the transitions in these slots [B] from their errors [B]. Call it before the next `add`."""
        if self._priorities is not None:
            self._keep(slots, [])
            self._priorities.update(slots, np.abs(error).astype(np.float64))

    # ---------------------------------------------------------------- what is recomputed

    def roll_back(self) -> None:
        """Return to the state of the last `remember`."""
        super().roll_back()
        self._find_paths()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`, bit for bit. Raises ValueError if its size differs from this buffer's."""
        super().load_state_dict(state)
        self._find_paths()

    def _find_paths(self) -> None:
        """Recompute the paths of the stored rows. Called after anything other than `add` has changed these rows."""
        if self._paths is not None:
            by_age = np.arange(self._written - self._used, self._written) % self.size
            self._paths = EpisodePaths.rebuilt(self.size, by_age, self._is_row, self.arrays["row"]["follows"])
