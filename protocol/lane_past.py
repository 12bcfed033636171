"""The part of a lane's past that is needed to continue the lane on new env copies. Plain data.

Law: an episode is determined by how it began and by its actions. A copy is seeded once, when it starts. Each later episode
begins with a reset without a seed, from the environment's random state at that time. So if you seed a new copy like the old
one, set the random state from before its last reset, reset it and repeat the actions, you get the old copy again, if the
environment repeats itself. A worker reports with each rollout which episodes began in it (`EpisodeBegin`). The learner
accumulates the rollouts, and sends the result (`LanePast`) to the worker that continues the lane. The episodes of an
environment that can save its state are not repeated: the state after the last row is in `LanePast.memory`.

The number of a start determines the seed, and rises when a copy starts anew because it failed or could not be continued.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from millrace.protocol.arrays import Array
from millrace.protocol.bounds import MAX_COPIES, Natural

MAX_RANDOM_BYTES = 64

RandomState = Annotated[bytes, Meta(max_length=MAX_RANDOM_BYTES)]
"""State of an environment's random generator (`workers/copies/random_state.py`), from which a reset without a seed begins an
episode. Empty: the episode began with the seed of the copy's start.
"""


class EpisodeBegin(msgspec.Struct, frozen=True, array_like=True):
    """How the newest episode of a copy began, or will begin if the next step only resets the copy."""

    copy: Natural
    """number of the copy in its lane"""
    start: Natural
    """number of the copy's start"""
    random: RandomState | None
    """None: the episode cannot be repeated"""


class LastEpisode(msgspec.Struct, frozen=True, array_like=True):
    """The episode that a copy was playing, or is about to begin."""

    start: Natural
    """number of the copy's start"""
    random: RandomState | None
    """None: the episode cannot be repeated, so the copy starts anew, with the next number, unless it is `saved`"""
    first: Natural
    """its first row in `LanePast.action`"""
    over: bool
    """whether the episode before it is over, and the next step begins it"""
    saved: bool = False
    """whether the state of the copy after the last row is in `LanePast.memory`: nothing is repeated"""

    @property
    def goes_on(self) -> bool:
        """Whether the copy can be continued."""
        return self.saved or self.random is not None

    @property
    def is_repeated(self) -> bool:
        """Whether it is continued by repeating the actions of a running episode."""
        return self.random is not None and not (self.saved or self.over)


class AttributesFrom(msgspec.Struct, frozen=True, array_like=True):
    """Attributes that the env copies had from a row on (`Weights.env_attributes`)."""

    row: Natural
    """in `LanePast.action`"""
    packed: Array
    """[bytes] uint8"""


class LanePast(msgspec.Struct, frozen=True, array_like=True):
    """The past of a lane of N env copies with A columns each, up to the round that its next rollout is for."""

    lane: Natural
    copies: Annotated[tuple[LastEpisode, ...], Meta(max_length=MAX_COPIES)]
    """one for each env copy"""
    action: Array
    """[K, N · A, *action], as in rollouts: of the rows since the earliest of these episodes began"""
    attributes: tuple[AttributesFrom, ...]
    """by row; the rows before the first one had none"""
    obs: tuple[Array, ...]
    """[N · A, *leaf] for each leaf, then the mask if there are masks: the observations that follow the last row"""
    memory: tuple[Array, ...]
    """`Rollout.memory` of the last rollout"""

    @classmethod
    def unknown(cls, lane: int, copies: int) -> LanePast:
        """The past of a lane whose copies were started once and can't be continued."""
        nothing = np.zeros(0, np.float32)
        return cls(lane, (LastEpisode(0, None, 0, False),) * copies, nothing, attributes=(), obs=(), memory=())

    @property
    def repeated_steps(self) -> int:
        """Number of env steps that are repeated."""
        return sum(len(self.action) - last.first for last in self.copies if last.is_repeated)

    @property
    def new_episodes(self) -> int:
        """Number of copies that start anew."""
        return sum(not last.goes_on for last in self.copies)
