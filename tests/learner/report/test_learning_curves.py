"""Learning curves: what is drawn is what was measured."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from learner.config.layers import resolve
from learner.report.curve import Curve, common_grid
from learner.report.learning_curves import curves, plot, read_curve
from learner.report.page import page
from learner.report.reported_runs import group_runs, read_run
from learner.run_folder.metrics_log import MetricsLog
from learner.run_folder.progress import Progress
from learner.run_folder.results import Summary
from learner.run_folder.run_folder import RunFolder
from protocol.errors import RunError, UsageError

Floats = np.ndarray[Any, Any]


def a_run(folder: Path, env: str = "CartPole-v1", seed: int = 1, length: int = 20, **settings: Any) -> Path:
    run = RunFolder.create(resolve(env, run_dir=str(folder), seed=seed, **settings)).path
    log = MetricsLog(run)
    for i in range(1, length + 1):
        log.write(Progress(env_steps=100 * i, return_mean=None if i == 1 else 5.0 * i + seed), {})
    log.close()
    return run


def test_a_curve_is_what_the_run_measured(tmp_path: Path) -> None:
    curve = read_curve(a_run(tmp_path, seed=3, length=4))
    assert (curve.env, curve.algo, curve.seed) == ("CartPole-v1", "ppo", 3)
    assert curve.env_steps.tolist() == [200, 300, 400]  # no episode had ended at 100
    assert curve.returns.tolist() == [13.0, 18.0, 23.0]


def test_seeds_meet_on_a_grid_that_all_of_them_cover() -> None:
    line = np.arange(0.0, 1100.0, 100.0)
    long = Curve("e", "a", 1, line, 2 * line)
    short = Curve("e", "a", 2, line[2:7] + 50, 4 * (line[2:7] + 50))
    grid, returns = common_grid([long, short])
    assert (grid[0], grid[-1]) == (250, 650)
    np.testing.assert_allclose(returns, [2 * grid, 4 * grid])


def pixels(path: Path) -> Floats:
    from matplotlib.image import imread

    image: Floats = imread(path)
    return image


def share_of(image: Floats, rgb: tuple[float, float, float]) -> float:
    return float((np.abs(image[..., :3] - rgb).max(-1) < 0.1).mean())


BLUE, WHITE = (0.0, 0.447, 0.698), (1.0, 1.0, 1.0)


def test_the_picture_shows_curves(tmp_path: Path) -> None:
    runs = [a_run(tmp_path, seed=seed) for seed in (1, 2, 3)]
    out = plot(runs, tmp_path / "curves.png")
    image = pixels(out)
    assert image.shape[:2] == (630, 960)  # 6.4 x 4.2 inches at 150 dpi
    assert 0.5 < share_of(image, WHITE) < 0.99
    assert share_of(image, BLUE) > 0.002
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["curves.png"]


def test_a_run_that_is_given_twice_is_drawn_once(tmp_path: Path) -> None:
    run = a_run(tmp_path)
    (panel,) = curves([run, run]).axes
    assert panel.get_legend_handles_labels()[1] == ["PPO, seed 1"]


def test_each_environment_has_a_panel_of_its_own(tmp_path: Path) -> None:
    runs = [a_run(tmp_path, env) for env in ("CartPole-v1", "Pendulum-v1", "Acrobot-v1", "MountainCar-v0")]
    image = pixels(plot(runs, tmp_path / "curves.png"))
    assert image.shape[:2] == (2 * 630, 3 * 960)
    top, bottom = image[:630], image[630:]
    for column in range(3):
        assert share_of(top[:, 960 * column : 960 * (column + 1)], BLUE) > 0.001
    assert share_of(bottom[:, :960], BLUE) > 0.001
    assert share_of(bottom[:, 960:], WHITE) == 1.0  # no empty axes


def test_games_of_one_environment_id_have_a_panel_each(tmp_path: Path) -> None:
    games = [
        a_run(tmp_path, "millrace/Atari-v0", seed, env_kwargs={"game": game})
        for seed, game in ((1, "Pong"), (2, "Pong"), (3, "Breakout"))
    ]
    panels = curves(games).axes
    titles = [panel.get_title(loc="left") for panel in panels]
    assert titles == ["millrace/Atari-v0 game Breakout", "millrace/Atari-v0 game Pong"], "without what the preset sets"
    assert [panel.get_legend_handles_labels()[1][-1] for panel in panels] == ["PPO, seed 3", "PPO, mean of 2 seeds"]
    assert group_runs([read_run(run) for run in games]).envs == [titles[1], titles[0]]


def test_what_cannot_be_plotted_is_said_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="nothing to plot, no episode has ended"):
        read_curve(a_run(tmp_path, length=1))
    with pytest.raises(RunError, match="not written: No such file or directory"):
        plot([a_run(tmp_path, seed=2)], tmp_path / "nowhere" / "curves.png")


def test_a_run_without_episodes_is_left_out_beside_others_and_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    whole, empty = a_run(tmp_path / "whole", seed=1), a_run(tmp_path / "empty", seed=1, length=1)
    assert legend([whole, empty]) == legend([whole])
    assert [str(empty) in line for line in caplog.messages] == [True]


def legend(runs: list[Path]) -> list[str]:
    found = curves(runs).axes[0].get_legend()
    assert found is not None
    return sorted(text.get_text() for text in found.get_texts())


def test_runs_that_differ_only_in_the_seed_are_one_mean(tmp_path: Path) -> None:
    runs = [a_run(tmp_path / str(seed), seed=seed) for seed in (1, 2, 3)]
    assert legend(runs) == ["PPO, mean of 3 seeds", "PPO, worst to best seed"]


def test_a_long_legend_is_below_the_curves_and_takes_none_of_their_room(tmp_path: Path) -> None:
    many: dict[str, Any] = {"gamma": 0.5, "n_epochs": 3, "clip_range": 0.3, "learning_rate": 0.5}
    figure = curves([a_run(tmp_path, seed=seed, **settings) for settings in ({}, many) for seed in (1, 2)])
    (panel,) = figure.axes
    figure.draw_without_rendering()
    box, legend = panel.get_window_extent(), panel.get_legend()
    assert legend is not None
    below = legend.get_window_extent()
    whole = figure.bbox
    assert box.width > 0.8 * whole.width
    assert box.height > 300
    assert below.y1 < box.y0
    assert below.x0 >= whole.x0
    assert below.x1 <= whole.x1
    assert below.y0 >= whole.y0


def test_a_run_that_an_error_ended_is_in_no_mean(tmp_path: Path) -> None:
    runs = [a_run(tmp_path / str(seed), seed=seed, length=5 if seed == 3 else 20) for seed in (1, 2, 3)]
    summary: dict[str, Any] = {"env": "CartPole-v1", "algo": "ppo", "seed": 3, "env_steps": 500, "updates": 5, "wall_s": 1.0,
               "env_steps_per_s": 500.0, "return_mean_100": 28.0, "evaluation": None}  # fmt: skip
    RunFolder.open(runs[2]).write_summary(Summary(**summary, stop_reason="ValueError: x", cut_short=True))
    assert legend(runs) == ["PPO, mean of 2 seeds; seed 3 ended early, not in the mean", "PPO, worst to best seed"]
    widest = max(curves(runs).axes[0].get_lines(), key=lambda line: line.get_linewidth())
    assert np.max(widest.get_xdata()) == 2000


def test_runs_of_different_settings_are_drawn_apart_with_what_differs(tmp_path: Path) -> None:
    runs = [a_run(tmp_path, seed=seed, gamma=gamma) for gamma in (0.9, 0.95) for seed in (1, 2)]
    assert legend([*runs, a_run(tmp_path, algo="a2c")]) == [
        "A2C, seed 1",
        "PPO A (gamma 0.9), mean of 2 seeds",
        "PPO A (gamma 0.9), worst to best seed",
        "PPO B (gamma 0.95), mean of 2 seeds",
        "PPO B (gamma 0.95), worst to best seed",
    ]


def test_the_groups_are_those_of_the_report(tmp_path: Path) -> None:
    runs = [a_run(tmp_path, gamma=gamma) for gamma in (0.9, 0.95, 0.99)]
    groups = group_runs([read_run(run) for run in runs]).groups
    assert legend(runs) == [f"{group.name} ({group.differences}), seed 1" for group in groups]
    colors = {line.get_color() for line in curves(runs).axes[0].get_lines()}
    assert len(colors) == len(runs)


def test_returns_of_any_size_are_drawn(tmp_path: Path) -> None:
    """Without a warning of numpy, which would fail this test."""
    run = a_run(tmp_path)
    rows = [{"time/total_timesteps": n * 100, "rollout/ep_rew_mean": (-1) ** n * 1.7e308} for n in range(5)]
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    plot([run], tmp_path / "curves.png")
    shown = page([run])
    assert "nan" not in shown
    assert shown.count("<path") == 5  # and the line in the legend and three tables
