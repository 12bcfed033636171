"""Learning curves and their picture: what is drawn is what was measured, and what the report shows."""

import io
import json
import re
import sys
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import resvg_py
from PIL import Image

from millrace.extras.monitoring.report import sections
from millrace.extras.monitoring.report.curve import Curve, common_grid, read_run_files
from millrace.extras.monitoring.report.page import page
from millrace.extras.monitoring.report.picture import LETTERS, Drawing, draw
from millrace.extras.monitoring.report.reported_runs import group_runs, read_run
from millrace.learner.config.layers import resolve
from millrace.learner.run_folder.metrics_log import MetricsLog
from millrace.learner.run_folder.progress import Progress
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.protocol.errors import RunError, UsageError

BLUE, WHITE = (0, 114, 178), (255, 255, 255)


def a_run(folder: Path, env: str = "CartPole-v1", seed: int = 1, length: int = 20, **settings: Any) -> Path:
    run = RunFolder.create(resolve(env, run_dir=str(folder), seed=seed, **settings)).path
    log = MetricsLog(run)
    for i in range(1, length + 1):
        log.write(Progress(env_steps=100 * i, return_mean=None if i == 1 else 5.0 * i + seed), {"eval/mean_reward": 1.0 * i})
    log.close()
    return run


def test_a_curve_is_what_the_run_measured(tmp_path: Path) -> None:
    curve = read_run_files(a_run(tmp_path, seed=3, length=4)).curve()
    assert curve is not None
    assert curve.seed == 3
    assert curve.env_steps.tolist() == [200, 300, 400]  # no episode had ended at 100
    assert curve.returns.tolist() == [13.0, 18.0, 23.0]


def test_seeds_meet_on_a_grid_that_all_of_them_cover() -> None:
    line = np.arange(0.0, 1100.0, 100.0)
    long = Curve(1, line, 2 * line)
    short = Curve(2, line[2:7] + 50, 4 * (line[2:7] + 50))
    grid, returns = common_grid([long, short])
    assert (grid[0], grid[-1]) == (250, 650)
    np.testing.assert_allclose(returns, [2 * grid, 4 * grid])


def texts(picture: Drawing) -> list[str]:
    return [text.text or "" for text in ElementTree.fromstring(picture.svg).iter("{http://www.w3.org/2000/svg}text")]


def pixels(png: bytes) -> np.ndarray[Any, Any]:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), np.int16)


def share_of(image: np.ndarray[Any, Any], rgb: tuple[int, int, int]) -> float:
    return float((np.abs(image - rgb).max(-1) < 25).mean())


def looks(drawn: str) -> list[str]:
    """Class and dashes of everything that is drawn of a group on a wide page, in its order."""
    wide = re.sub(r'<div class="for-narrow">.*?</div>', "", drawn, flags=re.DOTALL)
    return re.findall(r'class="((?:line|thin|band|dots) c[^>]*?")(?= d=|>)', wide)


def test_the_picture_shows_what_the_report_shows(tmp_path: Path) -> None:
    runs = [a_run(tmp_path, seed=seed, max_lag=lag) for lag in range(8) for seed in (1, 2)]
    runs.append(a_run(tmp_path, "Pendulum-v1"))
    picture, reported = draw(runs), sections.curves(group_runs([read_run(run) for run in runs]))
    assert sorted(looks(picture.svg)) == sorted(looks(reported))
    assert len(looks(reported)) > 8 * 6
    said = re.findall(r"</svg>([^<]+)</li>", reported)
    assert "PPO H (max_lag 7), mean of 2 seeds" in said
    assert set(said) < set(texts(picture))


def test_the_png_is_that_picture_and_needs_no_font_of_the_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    picture = draw([a_run(tmp_path / "runs", "Pendulum-v1", seed=seed) for seed in (1, 2, 3)])
    picture.save(tmp_path / "curves.png")
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["curves.png"]
    png = (tmp_path / "curves.png").read_bytes()
    image = pixels(png)
    size = ElementTree.fromstring(picture.svg).attrib
    assert image.shape[:2] == (2 * int(size["height"]), 2 * int(size["width"]))
    assert 0.5 < share_of(image, WHITE) < 0.99
    assert share_of(image, BLUE) > 0.002
    assert (pixels(Drawing(re.sub(r"<text.*</text>", "", picture.svg)).png()) != image).any(-1).mean() > 0.005, "no letters"
    monkeypatch.setattr(resvg_py, "svg_to_bytes", partial(resvg_py.svg_to_bytes, skip_system_fonts=True))
    assert picture.png() == png


def test_the_svg_has_the_colors_of_the_style_sheet_and_needs_nothing_else(tmp_path: Path) -> None:
    svg = draw([a_run(tmp_path)]).svg
    assert ".c0 { color: #0072b2; }" in svg
    assert "path.line {" in svg
    assert not re.search(r"var\(|url\(|@|href|script", svg)
    assert re.findall(r"https?:[^\"]*", svg) == ["http://www.w3.org/2000/svg"]


def test_a_run_that_is_given_twice_is_drawn_once(tmp_path: Path) -> None:
    run = a_run(tmp_path)
    assert draw([run, run]).svg == draw([run]).svg


def test_each_environment_has_a_panel_of_its_own(tmp_path: Path) -> None:
    names = ["CartPole-v1", "Pendulum-v1", "Acrobot-v1", "MountainCar-v0", "LunarLander-v3"]
    image = pixels(draw([a_run(tmp_path, name) for name in names]).png())
    height, width = image.shape[0] // 2, image.shape[1] // 3
    panels = [image[y : y + height, x : x + width] for y in (0, height) for x in (0, width, 2 * width)]
    assert [share_of(panel, BLUE) > 0.001 for panel in panels] == [True] * 5 + [False]
    assert share_of(panels[5], WHITE) == 1.0  # no empty axes


def test_games_of_one_environment_id_have_a_panel_each(tmp_path: Path) -> None:
    games = [
        a_run(tmp_path, "millrace/Atari-v0", seed, env_kwargs={"game": game})
        for seed, game in ((1, "Pong"), (2, "Pong"), (3, "Breakout"))
    ]
    said = texts(draw(games))
    assert said.index("millrace/Atari-v0 game Pong") < said.index("PPO, mean of 2 seeds")
    assert said.index("millrace/Atari-v0 game Breakout") < said.index("PPO, seed 3")


def test_what_cannot_be_plotted_is_said_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="nothing to plot, no episode has ended"):
        draw([a_run(tmp_path, length=1)])
    picture = draw([a_run(tmp_path, seed=2)])
    with pytest.raises(RunError, match="not written: No such file or directory"):
        picture.save(tmp_path / "nowhere" / "curves.png")
    with pytest.raises(UsageError, match=r"curves\.pdf: expected a file that ends in \.svg or \.png"):
        picture.save("curves.pdf")


@pytest.mark.parametrize("module", ["PIL", "resvg_py"])
def test_without_its_packages_a_png_is_refused_and_an_svg_is_not(
    module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    picture = draw([a_run(tmp_path / "runs")])
    with pytest.raises(UsageError, match=f"^a PNG needs {module}, which is not installed; pip install pillow resvg_py"):
        picture.save(tmp_path / "curves.png")
    assert not (tmp_path / "curves.png").exists()
    assert picture.save(tmp_path / "curves.svg").read_text() == picture.svg


def test_a_run_without_episodes_is_left_out_beside_others_and_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    whole, empty = a_run(tmp_path / "whole", seed=1), a_run(tmp_path / "empty", seed=1, length=1)
    assert draw([whole, empty]).svg == draw([whole]).svg
    assert [str(empty) in line for line in caplog.messages] == [True]


def test_long_texts_are_wrapped_or_cut(tmp_path: Path) -> None:
    words = {f"argument_{i}": "long" for i in range(20)}
    said = texts(draw([a_run(tmp_path, seed=seed, env_kwargs=words, net=[64] * n) for n in (2, 30) for seed in (1, 2)]))
    assert max(map(len, said)) <= LETTERS
    assert any(text.endswith(" …") for text in said)
    assert f"PPO B (net {' '.join(['64'] * 30)}), mean of 2 seeds" in " ".join(said)


def test_any_text_makes_a_picture(tmp_path: Path) -> None:
    picture = draw([a_run(tmp_path, env_kwargs={"a": "\x1b[2J\x00<&\"'\ufffe\u202e"})])
    assert "[2J" in texts(picture)[0]
    assert picture.png()


def test_returns_of_any_size_are_drawn(tmp_path: Path) -> None:
    """Without a warning of numpy, which would fail this test."""
    run = a_run(tmp_path)
    rows = [{"time/total_timesteps": n * 100, "rollout/ep_rew_mean": (-1) ** n * 1.7e308} for n in range(5)]
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert draw([run]).png()
    shown = page([run])
    assert "nan" not in shown
    assert len(looks(sections.curves(group_runs([read_run(run)])))) == 2  # the curve, and its line in the legend
