"""Gymnasium's `SyncVectorEnv` with what `SplitVectorEnv` needs of millrace's vector environment: the infos of each copy as
the copy returned them, and steps that begin and end.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gymnasium.vector import SyncVectorEnv

from millrace.protocol.specs import RunSpec
from millrace.workers.copies.split_vector_env import SplitVectorEnv


class InfosByRow(SyncVectorEnv[Any, Any]):
    """Never merges infos; `infos_by_row` has them. Begins no step before it is waited for, and steps all copies then."""

    merge_infos = True
    calls: Any = None

    def __init__(self, makes: Any) -> None:
        super().__init__(makes)
        self.infos_by_row: dict[int, dict[str, Any]] = {}

    def reset(self, **keywords: Any) -> Any:
        self.infos_by_row = {}
        return super().reset(**keywords)

    def step(self, actions: Any) -> Any:
        self.infos_by_row = {}
        return super().step(actions)

    def _add_info(self, vector_infos: dict[str, Any], env_info: dict[str, Any], env_num: int) -> dict[str, Any]:
        if env_info:
            self.infos_by_row[env_num] = env_info
        return vector_infos

    def incarnations(self) -> Sequence[int]:
        return [0] * self.num_envs

    def begin_step(self, lanes: Sequence[int], actions: Any) -> None:
        self.begun = actions

    def end_step(self, lanes: Sequence[int]) -> Any:
        return self.step(self.begun)

    def abandon(self) -> None:
        pass


def split_in_one_part(env: InfosByRow, run: RunSpec) -> SplitVectorEnv:
    """The run's lanes in this vector environment, which can step them only together."""
    split = SplitVectorEnv(env, run)
    split.in_parts = 1
    return split
