"""gymnasium's `observation_mode`: how the observation spaces of the env copies become that of the batch. Pure.

Rule: the observations of all copies have the same shapes and dtypes, because they share arrays. With "same" they have the
same space.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Any, Literal

from gymnasium import Space
from gymnasium.spaces.utils import is_space_dtype_shape_equiv
from gymnasium.vector.utils import batch_differing_spaces, batch_space

from protocol.envs.description import DescribedEnv
from protocol.errors import EnvironmentFailed

ObservationMode = Literal["same", "different"] | tuple[Space[Any], Space[Any]]
"""A tuple has the space of the batch and that of a single copy."""


def observation_spaces(
    mode: ObservationMode, first: tuple[Space[Any], Space[Any]], copies: Sequence[DescribedEnv | None]
) -> tuple[Space[Any], Space[Any]]:
    """The observation spaces of a single copy and of the batch.

    `first`: observation and action space of copy 0. `copies`: None for one that its client did not describe. Raises
    `EnvironmentFailed` for a copy that does not fit.
    """
    observation, action = first
    single = observation if isinstance(mode, str) else mode[1]
    fits = operator.eq if mode == "same" else is_space_dtype_shape_equiv
    for n, copy in enumerate(copies):
        if copy is not None and not (fits(copy.observation_space, single) and copy.action_space == action):
            raise EnvironmentFailed(
                f"copy {n}: its observations {copy.observation_space} and actions {copy.action_space} are not those of "
                f"copy 0, {single} and {action}; all copies must have the same, and each machine the same version of the "
                "environment; observation_mode='different' allows other bounds of observations"
            )
    match mode:
        case "same":
            return single, batch_space(single, len(copies))
        case "different":
            return single, batch_differing_spaces([copy.observation_space if copy else single for copy in copies])
        case (batch, _):
            return single, batch
