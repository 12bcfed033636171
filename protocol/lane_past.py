"""The part of a lane's history that is needed to continue the lane on new env copies. Plain data.

Law: an episode is determined by how it began and by its actions. A copy is seeded once, when it starts. Each later episode
begins with a reset without a seed, from the environment's random state at that time. If the environment is deterministic,
the old copy can therefore be recreated: seed a new copy like the old one, give it the random state that the old copy had
before its last reset, reset it, and replay the actions. A worker reports with each rollout which episodes began in it
(`EpisodeBegin`). The learner accumulates the rollouts, and sends the result (`LanePast`) to the worker that continues the
lane. If an environment can save its state, its episodes are not replayed, because the state after the last row is in
`LanePast.memory`.

Each copy counts its starts. A start's number determines its seed; the number rises when a new copy replaces one that failed
or could not be continued.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Self

import msgspec
import numpy as np
from msgspec import Meta

from millrace.protocol.arrays import Array
from millrace.protocol.bounds import MAX_COPIES, Natural

MAX_RANDOM_BYTES = 64

RandomState = Annotated[bytes, Meta(max_length=MAX_RANDOM_BYTES)]
"""State of the environment's random generator (`workers/copies/random_state.py`) just before the reset without a seed that
began an episode. It is empty if the episode began with the seed of the copy's start.
"""


class EpisodeBegin(msgspec.Struct, frozen=True, array_like=True):
    """How the newest episode of a copy began, or will begin if the next step only resets the copy."""

    copy: Natural
    """number of the copy in its lane"""
    start: Natural
    """number of the copy's start"""
    random: RandomState | None
    """None if the episode cannot be replayed"""


class LastEpisode(msgspec.Struct, frozen=True, array_like=True):
    """The episode that a copy was playing, or is about to begin."""

    start: Natural
    """number of the copy's start"""
    random: RandomState | None
    """None if the episode cannot be replayed; then, unless `saved`, a new copy is started, with the next start number"""
    first: Natural
    """index of the episode's first row in `LanePast.action`"""
    over: bool
    """whether the previous episode is over, so that the next step begins this one"""
    saved: bool = False
    """whether `LanePast.memory` has the state of the copy after the last row, so nothing needs to be replayed"""
    steps: Natural = 0
    """number of steps of the copy's running episode so far, as the learner counts them in the rows"""

    @property
    def goes_on(self) -> bool:
        """Whether the copy can be continued."""
        return self.saved or self.random is not None

    @property
    def is_repeated(self) -> bool:
        """Whether the copy is continued by replaying the actions of its running episode."""
        return self.random is not None and not (self.saved or self.over)


class AttributeChanges(msgspec.Struct, frozen=True, array_like=True):
    """Attributes that were set on the env copies (`Weights.env_attributes`), and the rows before which they were set.

    There may be any number of changes. They share three arrays, because a message has at most 256 frames.
    """

    rows: Array
    """[C] int64, ascending: the indices of these rows in `LanePast.action`"""
    ends: Array
    """[C] int64: for each row, where its attributes end in `packed`; they begin at the previous end"""
    packed: Array
    """[bytes] uint8: the attributes of all these rows, one after another, each as in `Weights.env_attributes`"""

    @classmethod
    def of(cls, by_row: Mapping[int, bytes]) -> Self:
        """The attributes that were set before these rows."""
        ends = np.cumsum([len(packed) for packed in by_row.values()], dtype=np.int64)
        return cls(np.array([*by_row], np.int64), ends, np.frombuffer(b"".join(by_row.values()), np.uint8))

    def by_row(self) -> dict[int, bytes]:
        """The attributes, packed, by the row before which they were set."""
        ends: list[int] = self.ends.tolist()
        packed = self.packed.tobytes()
        return {row: packed[begin:end] for row, begin, end in zip(self.rows.tolist(), [0, *ends], ends, strict=False)}


class LanePast(msgspec.Struct, frozen=True, array_like=True):
    """The history of a lane of N env copies with A columns each, up to the round of its next rollout."""

    lane: Natural
    copies: Annotated[tuple[LastEpisode, ...], Meta(max_length=MAX_COPIES)]
    """one for each env copy"""
    action: Array
    """[K, N · A, *action], as in rollouts: the actions of the K rows since the earliest episode in `copies` began"""
    attributes: AttributeChanges
    """no attributes were set before the first row that it lists"""
    obs: tuple[Array, ...]
    """the observations after the last row: one array [N · A, *leaf] for each leaf, then the mask if there are masks"""
    memory: tuple[Array, ...]
    """`Rollout.memory` of the last rollout"""

    @classmethod
    def unknown(cls, lane: int, copies: int) -> LanePast:
        """The history of a lane whose copies were started once and can't be continued, so all of them are replaced."""
        nothing = np.zeros(0, np.float32)
        unknown = (LastEpisode(0, None, 0, False),) * copies
        return cls(lane, unknown, nothing, AttributeChanges.of({}), obs=(), memory=())

    @property
    def repeated_steps(self) -> int:
        """Number of env steps that must be replayed to continue the lane, summed over its copies."""
        return sum(len(self.action) - last.first for last in self.copies if last.is_repeated)

    @property
    def new_episodes(self) -> int:
        """Number of copies that can't be continued, and are replaced by new ones."""
        return sum(not last.goes_on for last in self.copies)
