"""Gymnasium's `SyncVectorEnv` with the infos of each copy as the copy returned them, like millrace's vector environment."""

from __future__ import annotations

from typing import Any

from gymnasium.vector import SyncVectorEnv


class InfosByRow(SyncVectorEnv[Any, Any]):
    """Never merges infos; `infos_by_row` has them."""

    merge_infos = True

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
