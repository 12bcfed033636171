"""`--info-keys` in runs: metrics, evaluations, the summary and the report; workers that act, and `--inference learner`."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import pytest

import millrace
from millrace.cli.main import main
from millrace.extras.monitoring.report.page import write_page
from millrace.learner.run_folder.metrics_log import read_rows
from millrace.learner.run_folder.run_folder import RunFolder

ENV = "tests.support.users_code.fact_envs:Facts-v0"
SMALL: dict[str, Any] = {
    "transport": "inproc", "workers": 1, "lanes": 2, "envs": 4, "rollout_steps": 32, "n_epochs": 1, "net": (8,),
    "steps": 1000, "eval_episodes": 4, "eval_every": 500,
}  # fmt: skip
KEYS = ("rollout/is_success", "rollout/is_success_missing", "rollout/distance", "rollout/distance_missing")


def rows(folder: Path, *names: str) -> list[Any]:
    return [tuple(row.get(name) for name in names) for row in read_rows(folder / "metrics.jsonl")]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("facts")
    return Path(millrace.train(ENV, run_dir=str(folder), info_keys=("is_success", "distance"), **SMALL))


def test_means_of_the_facts_are_logged(run: Path) -> None:
    found = rows(run, *KEYS)
    assert len(found) == 9
    for success, no_success, distance, no_distance in found[3:]:
        assert success == pytest.approx(0.5, abs=0.15)
        assert (no_success, distance > 1.0) == (0, True)
        assert 20 <= no_distance <= 40, "of each three episodes, one has no distance"
    evaluations = [
        one for one in rows(run, "eval/is_success", "eval/distance", "eval/distance_missing") if one != (None,) * 3
    ]
    assert evaluations == [(1.0, None, 4)], "the first episode after a seeded reset"
    summary = RunFolder(run).summary()
    assert summary is not None
    assert (summary.facts_100["is_success"].missing, summary.facts_100["distance"].missing) == (0, found[-1][3])
    assert summary.evaluation is not None
    assert str(summary.evaluation).endswith("is_success 1, distance missing")


def test_the_report_shows_them(run: Path, tmp_path: Path) -> None:
    page = write_page([run], tmp_path / "report.html").read_text()
    assert "<small>is_success 1</small>" in page
    assert "without)</small>" in page


def test_evaluate_prints_them(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", str(run), "--episodes", "3", "--transport", "inproc", "--workers", "1"]) == 0
    assert capsys.readouterr().out.strip().endswith("over 3 episodes, is_success 1, distance missing")


def test_with_inference_learner_they_are_the_same(run: Path, tmp_path: Path) -> None:
    other = Path(
        millrace.train(ENV, run_dir=str(tmp_path), info_keys=["is_success", "distance"], inference="learner", **SMALL)
    )
    names = (*KEYS, "rollout/ep_rew_mean", "eval/is_success")
    assert rows(other, *names) == rows(run, *names)


def test_a_resumed_run_may_ask_for_others(run: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING, "millrace")
    few = {**SMALL, "steps": 600, "eval_every": 0}
    folder = Path(millrace.train(ENV, run_dir=str(tmp_path), info_keys=("is_success", "distance"), **few))
    assert rows(folder, *KEYS) == rows(run, *KEYS)[: len(rows(folder))]
    said = [record.getMessage() for record in caplog.records if "info_keys" in record.getMessage()]
    assert said == []
    assert Path(millrace.train(resume=folder, steps=1000, info_keys=("distance", "is_sucess"))) == folder
    found = rows(folder, "rollout/distance", "rollout/distance_missing", "rollout/is_sucess", "rollout/is_success")
    first, later = found[0], found[len(rows(run)) // 2 + 1]
    assert (first[2], later[3]) == (None, None)
    assert later[0] > 1.0
    assert later[1] < 50, "the distances of the episodes before are kept"
    said = [record.getMessage() for record in caplog.records if "info_keys" in record.getMessage()]
    assert said == [
        "info_keys is_sucess: none of the last 100 episodes had it in the info of its last step; is the name right?"
    ]


@pytest.mark.parametrize(
    ("keys", "line"),
    [
        (["a", "a"], "info_keys: expected at most 32 different names, got 2"),
        ([f"k{n}" for n in range(33)], "info_keys: expected at most 32 different names, got 33"),
        (["a\tb"], "info_keys: expected non-empty names without tabs or line breaks"),
        ([""], "info_keys: expected non-empty names without tabs or line breaks, got ''"),
        (["ep_rew_mean"], "info_keys: expected another name than ep_rew_mean, which is the name of another logged value"),
        (["distance_missing", "distance"], "info_keys: expected another name than distance_missing, which is"),
    ],
)
def test_names_that_are_refused(keys: list[str], line: str, tmp_path: Path) -> None:
    with pytest.raises(millrace.UsageError, match=line):
        millrace.train(ENV, run_dir=str(tmp_path), info_keys=keys, **SMALL)
    assert not list(tmp_path.glob("*Facts*"))


def test_text_in_info_ends_the_run_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(millrace.EnvironmentFailed, match="info name: expected a number, got str 'north'"):
        millrace.train(
            ENV, run_dir=str(tmp_path), info_keys=("name",), env_kwargs={"text": True}, max_env_failures=0, **SMALL
        )
