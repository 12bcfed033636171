"""The replay buffer: stores rows, and draws n-step transitions, uniformly or by priority.

The buffer is a ring of preallocated numpy arrays. A slot holds a raw observation. If a valid row begins with this
observation, the slot also holds the rest of the row: action, reward, whether it terminated, and the slot of the next
observation. Each observation is therefore stored once (or each frame of a frame stack, see `shared_channels.py`). When a
transition is drawn, its n-step return is computed by following the rows from slot to slot. A slot without a row holds the
final observation of a truncated episode, or the newest observation of an env copy, whose row arrives with the copy's next
rollout.

Rule: rows that are not valid are never stored. A row's next observation is newer than the row, and the ring overwrites the
oldest slot first, so the rows that follow a stored row are always stored, too. They are rows of the same seat, however long
the seat waits between them. While it waits, its observation stays the one that its last row led to, which is stored only
once.

With hindsight (`hindsight.py`), a share of the rows get another goal when they are drawn. In that case, the final
observation of a terminated episode has a slot, too, because it holds the goal that was achieved last.

This module uses no sockets and no files, and all randomness comes from the seed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from millrace.learner.algorithms.replay.episode_paths import NO_SLOT, EpisodePaths
from millrace.learner.algorithms.replay.hindsight import Goals, Hindsight
from millrace.learner.algorithms.replay.priorities import Priorities
from millrace.learner.algorithms.replay.rewinding import Remembered, Rewinding
from millrace.learner.algorithms.replay.shared_channels import SharedChannels
from millrace.learner.algorithms.replay.sum_tree import SumTree
from millrace.learner.algorithms.returns import EpisodeEnds
from millrace.protocol.arrays import Array, Bools, Doubles, Floats, Ints
from millrace.protocol.errors import UsageError
from millrace.protocol.machine.available_memory import GIB, available_bytes
from millrace.protocol.random_streams import Purpose, generator
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


class Content(NamedTuple):
    """The properties of a replay buffer that determine how much memory it needs."""

    observation: tuple[Leaf, ...]
    size: int
    """the number of slots"""
    prioritized: bool = False
    action: ActionSpec = DISCRETE
    linked: bool = False
    """whether it stores the paths that lead to the later rows of an episode"""
    choices: int = 0
    """the number of choices in an action mask; 0 without masks"""

    @property
    def bytes(self) -> int:
        """Size of the replay buffer in bytes."""
        leaves = sum(int(np.prod(leaf.shape)) * np.dtype(leaf.dtype).itemsize for leaf in self.observation)
        slots = self.size * (leaves + self.choices + row_dtype(self.action).itemsize)
        tree = SumTree.memory_bytes(self.size) if self.prioritized else 0
        paths = EpisodePaths.memory_bytes(self.size) if self.linked else 0
        return slots + tree + paths


def check_fits_memory(content: Content) -> None:
    """Raise `UsageError` if there isn't enough memory for the buffer and a copy of it. The error names a size that fits.

    Writing a checkpoint needs such a copy.
    """
    size = content.size
    needed = 2 * content.bytes
    free = available_bytes()
    if free is None or needed <= free:
        return
    fits = size * free // needed
    fits -= fits % 10 ** max(0, len(str(fits)) - 2)
    raise UsageError(
        f"replay_size {size}: {size} transitions take {needed / 2 / GIB:.1f} GiB, and as much again while a checkpoint is "
        f"written, but {free / GIB:.1f} GiB of memory are free; take --replay-size {fits} or less"
    )


class Overwritten(NamedTuple):
    """The contents of some slots before they were written."""

    slots: Ints  # [K]
    rows: Array  # [K] with dtype `row_dtype`
    weights: Doubles | None  # [K] their weights in the sum tree; None without priorities
    leaves: tuple[Array, ...]  # [K, *leaf] each; empty if only rows or priorities were written


def _goes_on(ends: EpisodeEnds, continues: Bools) -> Bools:
    """[T+1, N] True where row t begins with an observation that is already stored, because the previous row led to it.

    `continues` [N] says this for row 0. With seats, rows that are not valid may lie between a row and the previous one.
    """
    goes_on = np.concatenate([continues[None], ends.valid & ~ends.ended])
    if ends.with_seats:
        for t, valid in enumerate(ends.valid):
            goes_on[t + 1] |= goes_on[t] & ~valid
    return goes_on


class ReplayBuffer(Rewinding[Overwritten]):
    """The newest transitions of all lanes, drawn uniformly or by priority."""

    _purpose = Purpose.REPLAY
    _check_memory = staticmethod(check_fits_memory)

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
        self._content = Content(observation, size, alpha is not None, action, linked=hindsight is not None)
        self.size = size  # number of slots
        self._check_memory(self._content)
        self._transition_bytes = 2 * self._content.bytes // size  # a drawn transition has two observations
        self._n_step = n_step
        self._gamma = gamma
        self._seed = seed
        self.generator = generator(seed, self._purpose)  # the source of random numbers for all samples
        self._obs = tuple(self._room(leaf) for leaf in observation)
        self._mask: Bools | None = None  # [size, choices], the masks of `_obs`; allocated when the first masks arrive
        self._row = np.zeros(size, row_dtype(action))
        self._action: Array = self._row["action"]  # this array and the next four are views of `_row`
        self._reward: Floats = self._row["reward"]
        self._terminated: Bools = self._row["terminated"]
        self._follows: Ints = self._row["follows"]  # slot of the next observation; its own slot if that is not stored
        self._is_row: Bools = self._row["is_row"]
        self._priorities = None if alpha is None else Priorities(size, alpha)
        self._hindsight = hindsight
        self._paths = None if hindsight is None else EpisodePaths(size)
        self._written = 0  # number of slots ever written; modulo the size, it is the next slot
        self._rows = 0
        self._remembered: Remembered | None = None
        self._overwritten: list[Overwritten] = []  # contents saved since `remember`, oldest first
        self._newest: dict[int, Ints] = {}  # by lane, [columns] `_written` when each column's newest observation was stored

    def __len__(self) -> int:
        """The number of transitions that can be drawn."""
        return self._rows

    @property
    def bytes(self) -> int:
        """Memory of the replay buffer, in bytes."""
        saved = 0
        for leaf, stored in zip(self._content.observation, self._obs, strict=True):
            if isinstance(stored, SharedChannels):
                saved += self.size * math.prod(leaf.shape) - stored.nbytes
        return self._content.bytes - saved

    # ---------------------------------------------------------------- writing

    def add(self, batch: Batch) -> None:
        """Store the valid rows of a batch.

        Raises `UsageError` if a single rollout does not fit, if there is no memory for the first action masks, or, with
        hindsight, if the rewards don't agree with the goals.
        """
        if self._hindsight is not None:
            self._hindsight.check(batch)
        if batch.mask is not None:
            self._make_mask(batch.mask.shape[-1])
        if not self._written:
            self._share_channels([leaf[:, 0] for leaf in batch.obs])
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
        if batch.mask is not None:
            obs.append(batch.mask[:, columns])
        new = slot[needed]
        self._keep(new, self._per_observation())
        self._keep(slot[0][continues], ())
        self._rows -= int(np.count_nonzero(self._is_row[new]))
        self._is_row[new] = False
        if self._priorities is not None:
            self._priorities.tree.set(new, 0.0)
        if self._paths is not None:
            before = np.full(needed.shape, NO_SLOT)  # [T+1, N] slot of the row that led to each observation
            before[1:][valid] = slot[:-1][valid]
            self._paths.overwrite(new)
            self._paths.append(new, before[needed])
        for kept, leaf in zip(self._per_observation(), obs, strict=True):
            kept[new] = leaf[needed]
        rows = slot[:-1][valid]
        self._action[rows] = batch.action[:, columns][valid]
        self._reward[rows] = batch.reward[:, columns][valid]
        self._terminated[rows] = terminated[valid]
        self._follows[rows] = np.where(leads[valid], slot[1:][valid], rows)
        self._is_row[rows] = True
        self._rows += len(rows)
        if self._priorities is not None:
            self._priorities.add(rows)
        self._newest[lane] = np.where(goes_on[-1], written[-1], NO_SLOT)

    def _make_mask(self, choices: int) -> None:
        if self._mask is None:
            content = self._content._replace(choices=choices)
            self._check_memory(content)
            self._content = content
            self._mask = np.ones((self.size, choices), bool)

    def _share_channels(self, first: Sequence[Array]) -> None:
        """Share equal channels of image leaves if the first images, from one copy's rollout, show that this saves memory."""
        self._obs = tuple(
            self._room(leaf, shared=leaf.is_image and SharedChannels.worthwhile(leaf, images))
            for leaf, images in zip(self._content.observation, first, strict=True)
        )

    def _room(self, leaf: Leaf, *, shared: bool = False) -> Array | SharedChannels:
        """Allocate the array that holds a leaf of each observation."""
        return SharedChannels(self.size, leaf) if shared else np.zeros((self.size, *leaf.shape), leaf.dtype)

    def _per_observation(self) -> tuple[Array | SharedChannels, ...]:
        """The arrays with one entry for each stored observation: the leaves, and the mask if there are masks."""
        return self._obs if self._mask is None else (*self._obs, self._mask)

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
            row = self._row[slots]
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
            next_mask=None if self._mask is None else self._mask[last],
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
        used = min(self._written, self.size)
        slots = self.generator.integers(0, used, count)
        while not (found := (row := self._row[slots])["is_row"]).all():  # few rounds, because half of the slots have a row
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
            row = self._row[at]
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

    @property
    def prioritized(self) -> bool:
        """Whether transitions are drawn by priority."""
        return self._priorities is not None

    def update_priorities(self, slots: Ints, error: Floats) -> None:
        """Set the priorities of the transitions in these slots [B] from their errors [B]. Call it before the next `add`."""
        if self._priorities is not None:
            self._keep(slots, ())
            self._priorities.update(slots, np.abs(error).astype(np.float64))

    # ---------------------------------------------------------------- rolling back

    def roll_back(self) -> None:
        """Return to the state of the last `remember`."""
        super().roll_back()
        self._find_paths()

    def _put_back(self, old: Overwritten) -> None:
        self._row[old.slots] = old.rows
        for leaf, before in zip(self._per_observation(), old.leaves, strict=False):
            leaf[old.slots] = before
        if self._priorities is not None and old.weights is not None:
            self._priorities.tree.set(old.slots, old.weights)

    def _find_paths(self) -> None:
        """Recompute the paths of the stored rows. Called after anything other than `add` has changed these rows."""
        if self._paths is not None:
            used = min(self._written, self.size)
            by_age = np.arange(self._written - used, self._written) % self.size
            self._paths = EpisodePaths.rebuilt(self.size, by_age, self._is_row, self._follows)

    def _keep(self, slots: Ints, leaves: Sequence[Array | SharedChannels]) -> None:
        """If `remember` was called, save the contents of these slots, which are about to be overwritten."""
        if self._remembered is not None and len(slots):
            weights = None if self._priorities is None else self._priorities.tree.weights[slots]
            self._overwritten.append(Overwritten(slots, self._row[slots], weights, tuple(leaf[slots] for leaf in leaves)))

    # ---------------------------------------------------------------- saving

    def _arrays(self) -> dict[str, Array]:
        """All arrays with one entry for each slot, by name."""
        own = {name: getattr(self, f"_{name}") for name in ("action", "reward", "terminated", "follows", "is_row")}
        tree = {} if self._priorities is None else {"weight": self._priorities.tree.weights}
        masks = {} if self._mask is None else {"mask": self._mask}
        leaves = {f"obs{i}": leaf for i, leaf in enumerate(self._obs) if not isinstance(leaf, SharedChannels)}
        return leaves | masks | own | tree

    def _shared(self) -> dict[str, SharedChannels]:
        return {f"obs{i}": leaf for i, leaf in enumerate(self._obs) if isinstance(leaf, SharedChannels)}

    def state_dict(self) -> dict[str, Any]:
        """A copy of the slots in use, as tensors and plain data."""
        used = min(self._written, self.size)
        return {
            "size": self.size,
            "arrays": {name: torch.tensor(array[:used]) for name, array in self._arrays().items()},
            "shared": {name: list(map(torch.from_numpy, images.saved(used))) for name, images in self._shared().items()},
            "newest": {lane: torch.tensor(written) for lane, written in self._newest.items()},
            "written": self._written,
            "highest": self._highest,
            "generator": self.generator.bit_generator.state,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`, bit for bit. Raises ValueError if its size differs from this buffer's."""
        if state["size"] != self.size:
            raise ValueError(f"replay_size: expected {state['size']}, got {self.size}")
        self._written = state["written"]
        used = min(self._written, self.size)
        self._is_row[used:] = False
        if "mask" in state["arrays"]:
            self._make_mask(state["arrays"]["mask"].shape[1])
        shared = state.get("shared", {})
        self._obs = tuple(self._room(leaf, shared=f"obs{i}" in shared) for i, leaf in enumerate(self._content.observation))
        for name, images in self._shared().items():
            images.load(*(tensor.numpy() for tensor in shared[name]))
        for name, array in self._arrays().items():
            if name != "weight":
                array[:used] = state["arrays"][name].numpy()
        if self._priorities is not None:
            self._priorities.load(state["arrays"]["weight"].numpy(), state["highest"])
        self._rows = int(np.count_nonzero(self._is_row))
        self._newest = {int(lane): written.numpy().copy() for lane, written in state["newest"].items()}
        self._find_paths()
        self.generator.bit_generator.state = state["generator"]
