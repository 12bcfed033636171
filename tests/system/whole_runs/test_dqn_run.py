"""Whole runs of DQN and Rainbow: the same weights and the same replay ratio for any number of workers, and with lag."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from millrace.launch.training import train
from millrace.learner.config.layers import resolve
from millrace.learner.run_folder.metrics_log import read_rows
from millrace.protocol.errors import UsageError
from tests.system.stage.run_folders import policy_of

SMALL: dict[str, Any] = {
    "algo": "dqn",
    "preset": "none",
    "transport": "inproc",
    "seed": 3,
    "rollout_steps": 16,
    "learning_starts": 300,
    "gradient_steps": 16,
    "eval_episodes": 1,
}
BATCH = 8 * 16  # rows of an update, including those that are not valid


def run(tmp_path: Path, **settings: Any) -> Path:
    keywords = SMALL | {"steps": 3_000} | settings
    name = "-".join(f"{value}" for value in settings.values() if not isinstance(value, dict)).replace("/", "_")
    return train(resolve(keywords.pop("env", "CartPole-v1"), run_dir=str(tmp_path / name), **keywords), None, lambda _: None)


def ratios(folder: Path) -> list[float]:
    """Env steps per gradient step, for each update that made gradient steps."""
    rows = read_rows(folder / "metrics.jsonl")
    return [ratio for row in rows if (ratio := row.get("replay/env_steps_per_gradient_step")) is not None]


@pytest.mark.parametrize(
    "settings",
    [
        pytest.param({}, marks=pytest.mark.soak),
        {"priority_alpha": 0.6, "n_step": 3, "dueling": True, "normalize_observations": True},
        {"algo": "rainbow", "net": (16,), "quantiles": 8},
        {"core": "gru", "core_size": 8, "priority_alpha": 0.6, "n_step": 3},
    ],
)
def test_curve_and_replay_ratio_do_not_depend_on_the_number_of_workers(tmp_path: Path, settings: dict[str, Any]) -> None:
    policies, found = {}, {}
    for workers in (1, 3):
        folder = run(tmp_path, workers=workers, **settings)
        policies[workers] = policy_of(folder)
        found[workers] = ratios(folder)
        summary = json.loads((folder / "summary.json").read_text())
        assert summary["updates"] > 20
    assert policies[1] == policies[3]
    assert found[1] == found[3]
    assert all(0.8 * BATCH <= 16 * ratio <= BATCH for ratio in found[1])


@pytest.mark.parametrize("workers", [1, 4])
def test_the_replay_ratio_holds_while_collecting_and_learning_overlap(tmp_path: Path, workers: int) -> None:
    """With rollouts up to 4 versions old, a batch may contain a lane twice or not at all. The ratio stays the same."""
    folder = run(tmp_path, workers=workers, max_lag=4, n_step=3, steps=1_800)
    rows = read_rows(folder / "metrics.jsonl")
    made = rows[-1]["train/n_updates"]
    assert made is not None
    first = next(i for i, row in enumerate(rows) if row["train/n_updates"])
    assert made == 16 * (len(rows) - first)
    assert all(0.8 * BATCH <= 16 * ratio <= BATCH for ratio in ratios(folder))
    sizes = [row["replay/size"] for row in rows]
    assert sizes == [row["time/total_timesteps"] for row in rows]


def test_dqn_learns_from_images(tmp_path: Path) -> None:
    kwargs = {"observation": "nested", "action": "offset"}
    folder = run(tmp_path, env="tests.support.envs.toy:Spaces-v0", env_kwargs=kwargs, steps=800, gradient_steps=2)
    assert ratios(folder)


def test_an_unsupported_action_space_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(
        UsageError, match=r"dqn: expected an action space Discrete\(n\), got box\[1\]; take --algo ppo, sac or xqc for it"
    ):
        run(tmp_path, env="Pendulum-v1")
