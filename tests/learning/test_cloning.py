"""Cloning 20 episodes of an expert: most of the way from random to expert before the first update, and PPO keeps it."""

from __future__ import annotations

from pathlib import Path

import pytest

import millrace
from millrace.cli.main import main
from millrace.learner.run_folder.metrics_log import read_rows

CASES = [("CartPole-v1", 22.0, 10_000, 15), ("Pendulum-v1", -1_220.0, 4_000, 400)]
"""Each environment with the return of random actions, the env steps of 20 episodes, and the epochs"""


@pytest.mark.learning
@pytest.mark.timeout(1200)
@pytest.mark.parametrize(("env", "of_random", "steps", "epochs"), CASES)
def test_cloning_goes_most_of_the_way_and_ppo_goes_on_from_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, env: str, of_random: float, steps: int, epochs: int
) -> None:
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    expert = millrace.train(env, seed=1, run_dir=str(tmp_path), progress=False)
    summary = expert.summary
    assert summary is not None
    assert summary.evaluation is not None
    wanted = of_random + 0.8 * (summary.evaluation.return_mean - of_random)
    assert main(["record", str(expert.path), "--out", "expert/episodes-v0", "--steps", str(steps)]) == 0
    for seed in (1, 2, 3):
        run = millrace.train(
            env,
            seed=seed,
            steps=40_000,
            prior="expert/episodes-v0",
            clone_epochs=epochs,
            eval_every=8_192,
            eval_episodes=20,
            run_dir=str(tmp_path),
            progress=False,
        )
        found = [row["eval/mean_reward"] for row in read_rows(run.path / "metrics.jsonl") if "eval/mean_reward" in row]
        assert len(found) >= 5
        assert min(found) >= wanted
