"""The report: one file that needs nothing else, and tells what the run folders tell."""

import base64
import html
import math
import os
import re
import subprocess
import sys
import tomllib
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import tomli_w

from millrace.extras.monitoring.report import sections
from millrace.extras.monitoring.report.charts import COLORS, MINUS, Series, chart, key, ticks, with_si_prefix
from millrace.extras.monitoring.report.page import STYLE, page, write_page
from millrace.extras.monitoring.report.reported_runs import MAY_DIFFER_IN_A_GROUP, ReportData, group_runs, read_run
from millrace.learner.config.config import Config
from millrace.learner.config.layers import resolve
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.learner.run_folder.sentences import duration
from millrace.protocol.errors import RunError, UsageError
from tests.support.run_folders import LEDGER, a_run

ROOT = Path(__file__).parents[4]


class Reader(HTMLParser):
    """Tags that are opened and closed as they should be, the text between them, and every attribute."""

    VOID = {"meta", "br", "line", "circle"}

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.said: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.said.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.said).split())


def report_data(*runs: Path) -> ReportData:
    return group_runs([read_run(run) for run in runs])


def text_of(section: str) -> str:
    return Reader(section).text


def test_the_page_is_one_file_that_asks_for_nothing(tmp_path: Path) -> None:
    runs = [a_run(tmp_path, seed=seed) for seed in (1, 2)] + [a_run(tmp_path, "Pendulum-v1")]
    (runs[0] / "videos").mkdir()
    (runs[0] / "videos" / "a.mp4").write_bytes(b"film")
    out = write_page(runs, tmp_path / "report.html")
    text = out.read_text()
    found = Reader(text)
    assert text.startswith("<!doctype html>")
    assert "script" not in found.tags
    assert "link" not in found.tags
    assert not re.search(r"https?:|//[a-z]|@import|url\(", text)
    sources = [value for name, value in found.attributes if name in ("src", "href", "srcset", "data", "poster")]
    assert sources == ["data:video/mp4;base64,ZmlsbQ=="]
    assert "default-src 'none'; style-src 'unsafe-inline'; img-src data:; media-src data:" in [
        value for _, value in found.attributes
    ]
    assert "prefers-color-scheme: dark" in text
    assert page(runs) == text
    assert sorted(path.name for path in tmp_path.iterdir() if path.is_file()) == ["report.html"]


def test_text_from_a_run_is_text_and_not_markup(tmp_path: Path) -> None:
    nasty = "<script>alert(1)</script>\"'&"
    run = a_run(tmp_path, finished=False)
    config = tomllib.loads((run / "config.toml").read_text()) | {"env": nasty}
    (run / "config.toml").write_text(tomli_w.dumps(config))
    text = page([run])
    assert "script" not in Reader(text).tags
    assert html.escape(nasty) in text
    assert read_run(run).env == nasty


def test_each_run_has_its_headline(tmp_path: Path) -> None:
    said = text_of(sections.results(report_data(a_run(tmp_path, seed=1), a_run(tmp_path, seed=3))))
    assert "CartPole-v1 PPO greedy −1,232.6 on average, −1,233.6 to −1,231.6" in said
    assert "seed 1 −1,233.6 ± 7.5, 100 episodes 99.5 123,456 4,321 61.0 s 789 all steps done" in said
    assert said.index("seed 1") < said.index("seed 3")


def test_a_run_that_goes_on_is_told_as_far_as_it_got(tmp_path: Path) -> None:
    run = a_run(tmp_path, finished=False)
    assert "seed 1 – not evaluated 101.0 2,000 50 40.0 s 20 not finished" in text_of(sections.results(report_data(run)))
    assert "30 = 20 + 4 + 6 balances" in Reader(page([run])).text
    new = a_run(tmp_path, seed=2, finished=False, length=1)
    text = Reader(page([new])).text
    assert "PPO: no episode has ended yet" in text
    (new / "progress.json").unlink()
    assert "Tickets issued used outstanding lost seed 2 not known" in Reader(page([new])).text


def test_the_ledger_balances_or_says_by_how_much_it_does_not(tmp_path: Path) -> None:
    good = a_run(tmp_path)
    bad = a_run(tmp_path, seed=2, ledger={**LEDGER, "used": 13, "transitions_late": 5000, "messages_bad": 3})
    text = Reader(page([good, bad])).text
    assert "seed 1 30 = 20 + 4 + 6 balances" in text
    assert "seed 2 30 = 13 + 4 + 6 off by 7" in text
    assert "seed 1 900 = 800 + 50 + 0 + 50 + 0 balances" in text
    assert "seed 2 900 = 800 + 50 + 0 + 5,000 + 0 off by −4,950" in text
    assert "3 messages could not be read." in text


def test_settings_that_differ_come_first_and_the_rest_is_folded(tmp_path: Path) -> None:
    runs = [a_run(tmp_path, seed=seed) for seed in (1, 2)] + [a_run(tmp_path, seed=3, gamma=0.5, eval_env_kwargs={"g": 1.5})]
    differing, _, folded = sections.settings(report_data(*runs)).partition("<details>")
    said = re.sub(r"<[^>]+>", " ", differing)
    assert " ".join(said.split()) == (
        "Settings What differs CartPole-v1 PPO A CartPole-v1 PPO B seed 1, 2 3 gamma 0.98 0.5 eval_env_kwargs.g – 1.5"
    )
    assert "<dt>gae_lambda</dt><dd>0.8</dd>" in folded
    assert "<dt>gamma</dt>" not in folded
    assert f"{folded.count('<dt>')} settings are the same in all runs" in folded
    alone = sections.settings(report_data(runs[0]))
    assert "<table" not in alone
    assert "<dt>gamma</dt><dd>0.98</dd>" in alone


def test_runs_that_differ_in_their_seeds_alone_are_one_line(tmp_path: Path) -> None:
    found = report_data(
        a_run(tmp_path, seed=2),
        a_run(tmp_path, "Pendulum-v1", seed=1),
        a_run(tmp_path / "elsewhere", seed=1),
        a_run(tmp_path, seed=4, gamma=0.5, n_epochs=3, clip_range=0.3, learning_rate=0.5, max_lag=1),
    )
    assert [(group.env, group.name, [run.seed for run in group.runs]) for group in found.groups] == [
        ("CartPole-v1", "PPO A", [1, 2]),
        ("CartPole-v1", "PPO B", [4]),
        ("Pendulum-v1", "PPO", [1]),
    ]
    assert found.groups[2].differences == ""
    assert found.groups[1].differences.endswith(", 2 more")
    assert "max_lag" not in found.groups[1].differences  # the algorithm's own say more
    assert found.short_names() == [
        "CartPole-v1, PPO A, seed 1", "CartPole-v1, PPO A, seed 2", "CartPole-v1, PPO B, seed 4", "Pendulum-v1, seed 1",
    ]  # fmt: skip
    (first,) = {group.env: group.runs[0].path for group in found.groups if group.env == "Pendulum-v1"}.values()
    twice = report_data(first, a_run(tmp_path / "again", "Pendulum-v1", seed=1))
    assert twice.short_names() == ["seed 1 (1)", "seed 1 (2)"]
    assert Reader(page([first, first])).text == Reader(page([first])).text


def chart_of(section: str) -> str:
    """The only chart of a section, as wide pages show it, without its legend."""
    drawn, _ = re.findall(r'<svg class="chart".*?</svg>', section, re.DOTALL)
    return str(drawn)


def test_curves_are_a_line_each_with_a_mean_and_a_band_and_dots_for_evaluations(tmp_path: Path) -> None:
    drawn = chart_of(sections.curves(report_data(*[a_run(tmp_path, seed=seed) for seed in (1, 2, 3)])))
    assert [drawn.count(f'class="{kind} c0"') for kind in ("thin", "line", "band", "dots")] == [3, 1, 1, 3]
    assert "PPO, seed 2: 102.0 at 2,000 env steps" in drawn
    alone = chart_of(sections.curves(report_data(a_run(tmp_path, seed=4))))
    assert [alone.count(f'class="{kind} c0"') for kind in ("thin", "line", "band")] == [0, 1, 0]


def test_a_failed_run_is_in_its_group_and_in_no_mean(tmp_path: Path) -> None:
    good = [a_run(tmp_path, seed=seed) for seed in (1, 2)]
    failed = a_run(tmp_path, seed=3, length=5, failure="ValueError: no such room")
    drawn = sections.curves(report_data(*good, failed))
    assert "PPO, mean of 2 seeds; seed 3 ended early, not in the mean" in drawn
    assert [chart_of(drawn).count(f'class="{kind} c0"') for kind in ("thin", "line", "band")] == [3, 1, 1]
    (mean,) = re.findall(r'<path class="line c0" d="M([^"]*)"', chart_of(drawn))
    assert mean.split("L")[-1].split()[0] == "1066.0", "the mean goes on where the failed run ended"
    said = text_of(sections.results(report_data(*good, failed)))
    assert "greedy −1,233.1 on average of 2 of 3 runs" in said
    assert "seed 3 – not evaluated" in said
    summary = RunFolder(good[1]).summary()
    assert summary is not None
    interrupted = a_run(tmp_path, seed=4)
    RunFolder(interrupted).write_summary(msgspec.structs.replace(summary, stop_reason="interrupted", cut_short=True))
    said = text_of(sections.results(report_data(*good, interrupted)))
    assert "greedy −1,233.1 on average of 2 of 3 runs" in said, "it was evaluated, and then ended early"
    one_good = sections.curves(report_data(good[0], failed))
    assert "PPO, 2 seeds; seed 3 ended early, so there is no mean<" in one_good
    assert "mean over seeds" not in one_good
    assert "PPO, seed 3, ended early<" in sections.curves(report_data(failed))


def test_groups_are_told_apart_however_late_the_setting_comes_that_differs(tmp_path: Path) -> None:
    many: dict[str, Any] = {"gamma": 0.5, "n_epochs": 3, "clip_range": 0.3, "learning_rate": 0.5}
    found = report_data(
        a_run(tmp_path),
        a_run(tmp_path, **many),
        a_run(tmp_path, **many, max_lag=1),
        a_run(tmp_path, **many, eval_env_kwargs={"g": 1.5}),
    )
    labels = [group.differences for group in found.groups]
    assert len(set(labels)) == 4, labels
    assert ["max_lag 1" in label for label in labels] == [False, False, True, False]
    assert ["eval_env_kwargs.g 1.5" in label for label in labels] == [False, False, False, True]
    assert "no eval_env_kwargs.g" in labels[1]


def test_workers_that_came_from_elsewhere_are_not_a_number(tmp_path: Path) -> None:
    here, elsewhere = a_run(tmp_path, workers=2), a_run(tmp_path, workers=2, seed=2)
    RunFolder.open(elsewhere).write_config(resolve("CartPole-v1", run_dir=str(tmp_path), seed=2), workers_elsewhere=True)
    assert "<dt>workers</dt><dd>2</dd>" in sections.settings(report_data(here))
    assert "<dt>workers</dt><dd>started elsewhere</dd>" in sections.settings(report_data(elsewhere))
    assert "<td>2, started elsewhere</td>" in sections.settings(report_data(here, elsewhere))


def test_a_group_may_differ_in_what_changes_nothing_of_what_is_learned(tmp_path: Path) -> None:
    alike = [
        a_run(tmp_path, "Pendulum-v1", seed=1, steps=500, workers=2, dashboard=True),
        a_run(tmp_path, "Pendulum-v1", seed=2, steps=1_000, eval_every=500, workers=3, torch_threads=2),
    ]
    differ = sections.settings(report_data(*alike))
    assert "PPO, mean of 2 seeds" in sections.curves(report_data(*alike))
    for name, values in {"steps": "500, 1000", "eval_every": "0, 500", "workers": "2, 3"}.items():
        assert f"<code>{name}</code></th><td>{values}</td>" in differ
    annealed = [a_run(tmp_path, "Pendulum-v1", steps=steps, learning_rate_schedule="linear") for steps in (1_000, 2_000)]
    assert [group.differences for group in report_data(*annealed).groups] == ["steps 1000", "steps 2000"]
    evaluated = [a_run(tmp_path, "Pendulum-v1", eval_env_kwargs={"g": g}) for g in (9.0, 10.0)]
    assert len(report_data(*evaluated).groups) == 2, "their evaluations are not comparable"
    assert set(Config.__struct_fields__) > MAY_DIFFER_IN_A_GROUP


def test_no_two_of_fifty_groups_look_alike(tmp_path: Path) -> None:
    found = report_data(*[a_run(tmp_path, seed=seed, max_lag=lag) for lag in range(25) for seed in (1, 2)])
    assert len(found.groups) == 25
    drawn = chart_of(sections.curves(found))
    for kind in ("thin", "band", "line"):
        looks = Counter(re.findall(rf'<path class="{kind} (c.*?) d="M', drawn))
        assert len(looks) == 25, kind
    assert len({key(color) for color in range(50)}) == 50
    style = STYLE.read_text()
    assert all(f".c{color} {{" in style for color in range(COLORS))


def test_long_text_in_a_table_is_wrapped() -> None:
    style = STYLE.read_text()
    for selector in (".runs td.text", ".runs .line th", ".settings td"):
        (rule,) = re.findall(rf"^{re.escape(selector)} {{([^}}]*white-space[^}}]*)}}", style, re.MULTILINE)
        assert "white-space: normal; overflow-wrap: anywhere;" in rule


def test_a_curve_is_drawn_where_it_was_measured() -> None:
    x, y = np.array([0.0, 50.0, 100.0]), np.array([-10.0, 0.0, 10.0])
    drawn = chart([Series("line", 2, x, y)], 200, 100, "env steps", "a & b")
    assert 'aria-label="a &amp; b"' in drawn
    (path,) = re.findall(r'<path class="line c2" d="M([^"]*)"', drawn)
    points = np.array([point.split() for point in path.split("L")], float)
    assert points[[0, -1], 0].tolist() == [52.0, 186.0]  # from the axis to the right margin
    assert points[1, 1] == pytest.approx(points[[0, 2], 1].mean(), abs=0.1)
    assert points[0, 1] > points[2, 1]
    assert f">{MINUS}10</text>" in drawn
    long = np.arange(10_000.0)
    (path,) = re.findall(r' d="([^"]*)"', chart([Series("line", 0, long, long)], 200, 100, "", ""))
    assert 400 < path.count("L") <= 501
    assert path.endswith(path.split("L")[-1])
    assert path.split("L")[-1].split()[0] == "186.0"  # the last point is among them


@pytest.mark.parametrize("value", [0.0, 500.0, -1e300])
def test_a_curve_that_does_not_vary_is_drawn_in_the_middle(value: float) -> None:
    x, y = np.array([0.0, 1.0]), np.array([value, value])
    (path,) = re.findall(r' d="([^"]*)"', chart([Series("line", 0, x, y)], 200, 100, "", ""))
    heights = {float(each) for each in re.findall(r"[ML][\d.]+[ ,]([\d.]+)", path)}
    assert len(heights) == 1
    assert 20 < heights.pop() < 80


def test_ticks_are_round_and_within() -> None:
    assert ticks(0, 100_000, 5) == [0, 20_000, 40_000, 60_000, 80_000, 100_000]
    assert ticks(-1290, -140, 5) == [-1200, -1000, -800, -600, -400, -200]
    assert ticks(0.1, 0.9, 4) == pytest.approx([0.2, 0.4, 0.6, 0.8])
    assert ticks(3, 3, 5) == [3]
    assert ticks(0, 5e-324, 5) == [0]
    assert [with_si_prefix(x) for x in (0, 0.25, 500, 2e4, -1200, 1.5e6)] == [
        "0",
        "0.25",
        "500",
        "20k",
        f"{MINUS}1.2k",
        "1.5M",
    ]
    assert [duration(s) for s in (0.04, 99.96, 119.8, 3599.0, 7260.0, math.inf)] == [
        "0.0 s", "100.0 s", "2 min 0 s", "59 min 59 s", "2 h 1 min", "inf s",
    ]  # fmt: skip


def test_stages_are_shares_of_a_bar(tmp_path: Path) -> None:
    text = page([a_run(tmp_path)])
    assert re.search(r'class="b0" x="0.00%" width="75.00%" height="100%"><title>update: 3.0 s, 75.0 %</title>', text)
    assert re.search(r'class="wait" x="75.00%" width="25.00%" height="100%"><title>wait: 1.0 s, 25.0 %</title>', text)
    assert re.search(r'class="on-bar on-wait" x="75.00%"[^>]*>25 %<', text)


def test_the_newest_film_is_on_the_page_if_it_is_small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = a_run(tmp_path)
    assert sections.videos(report_data(run)) == ""
    (run / "videos").mkdir()
    for age, name in ((200, "b.mp4"), (100, "a.mp4"), (300, "c.mp4")):
        (run / "videos" / name).write_bytes(name.encode())
        os.utime(run / "videos" / name, (10_000 - age, 10_000 - age))
    shown = sections.videos(report_data(run))
    assert "base64,YS5tcDQ=" in shown
    assert shown.count("<video") == 1
    monkeypatch.setattr(sections, "MOST_BYTES_OF_ONE", 3)
    assert "<video" not in sections.videos(report_data(run))
    assert "too large for this page" in sections.videos(report_data(run))


def test_what_cannot_be_reported_is_one_line(tmp_path: Path) -> None:
    run = a_run(tmp_path)
    with pytest.raises(RunError, match="not written: No such file or directory"):
        write_page([run], tmp_path / "no" / "report.html")
    with pytest.raises(UsageError, match=r"is a folder; expected the file to write"):
        write_page([run], tmp_path)
    (run / "config.toml").write_text("env = ")
    with pytest.raises(UsageError, match=r"config\.toml is not TOML"):
        page([run])


def test_rows_that_cannot_be_read_are_left_out_and_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    run = a_run(tmp_path)
    whole = page([run])
    metrics = run / "metrics.jsonl"
    metrics.write_bytes(b'not json\n{"time/total_timesteps": "x"}\n[]\n' + metrics.read_bytes() + b"\xff\n")
    assert page([run]) == whole
    lines = len(metrics.read_bytes().splitlines())
    assert [record.getMessage() for record in caplog.records] == [
        f"{metrics}: 4 of {lines} rows cannot be read; they are left out"
    ]


def test_the_report_starts_quickly() -> None:
    heavy = {"torch", "PIL", "resvg_py", "tensorboard", "minari", "h5py", "moviepy", "pygame"}
    asks = f"import sys, millrace.extras.monitoring.report.page; assert not sys.modules.keys() & {heavy}, sys.modules"
    done = subprocess.run([sys.executable, "-c", asks], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr


def test_pictures_of_what_the_policy_sees_are_shown_once_for_each_environment(tmp_path: Path) -> None:
    run = a_run(tmp_path)
    assert sections.images(report_data(run)) == ""
    (run / "observation.png").write_bytes(b"first")
    (run / "observation-wrist.png").write_bytes(b"second")
    shown = sections.images(report_data(run))
    assert [base64.b64decode(data) for data in re.findall(r"base64,([^\"]+)", shown)] == [b"second", b"first"]
    assert "<span>wrist</span>" in shown
