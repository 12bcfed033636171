"""What differs between the versions of gymnasium that millrace works with."""

from __future__ import annotations

import gymnasium
import pytest
from packaging.version import Version

TAXI = next(env_id for env_id in gymnasium.registry if env_id.startswith("Taxi-"))
"""Taxi-v4; Taxi-v3 before gymnasium 1.3."""
CLIFF = next(env_id for env_id in gymnasium.registry if env_id.startswith("CliffWalking-v"))
"""CliffWalking-v1; CliffWalking-v0 before gymnasium 1.2. It has no time limit."""
needs_listed_episodes = pytest.mark.skipif(
    Version(gymnasium.__version__) < Version("1.2"),
    reason="DictInfoToList of gymnasium 1.1 raises KeyError for the infos of its own RecordEpisodeStatistics",
)
