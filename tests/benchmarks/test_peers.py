"""The peers of `millrace bench train`: their settings, their reports, and which of them are left out."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import programs, train
from benchmarks.peers import install
from benchmarks.peers.cleanrl_ppo import arguments
from benchmarks.peers.peer_run import PeerRun, mean_return, scheduled
from benchmarks.programs import CONTENDERS, LARGE, OURS, ZOO
from benchmarks.train import PEERS_MEASURES, PPO_MEASURES, SECONDS, SMALL_RATE, Measure, against, summary, table

RUN = {"steps": 10_000, "seed": 1}


def balanced(obs: Any) -> Any:
    """Pushes to where the pole falls: good for some 200 steps and more."""
    return (obs[:, 2] + obs[:, 3] > 0).astype(np.int64)


def worst(obs: Any) -> Any:
    return np.zeros(len(obs), np.int64)


def test_the_worst_policy_falls_at_once_and_a_better_one_later() -> None:
    assert mean_return("CartPole-v1", 3, worst) < 11
    assert mean_return("CartPole-v1", 3, balanced) > 100


def test_it_looks_when_it_is_due_and_ends_when_it_is_solved(capsys: pytest.CaptureFixture[str]) -> None:
    run = PeerRun([json.dumps(ZOO | RUN), "--target", "100"])
    assert not run.update(4864, balanced), "looked too early"
    assert not run.update(5120, worst)
    assert not run.update(5376, balanced), "looked twice for 5,000 env steps"
    assert run.update(10_240, balanced)
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["env_steps"] for line in lines if "env_steps" in line] == [4864, 5120, 5376, 10_240]
    assert [line["solved"] >= 100 for line in lines if "solved" in line] == [True]


def test_without_a_target_it_ends_after_its_steps() -> None:
    run = PeerRun([json.dumps(ZOO | RUN)])
    assert not run.update(9984, worst)
    assert run.update(10_240, worst)


def test_a_schedule_falls_to_zero_or_stays() -> None:
    assert scheduled(ZOO | RUN, "learning_rate", 2500) == pytest.approx(0.75e-3)
    assert scheduled(ZOO | RUN, "clip_range", 12_000) == 0.0
    assert scheduled(LARGE | RUN, "learning_rate", 9000) == 3e-4


@pytest.mark.parametrize(("settings", "minibatches"), [(ZOO, "1"), (LARGE, "4")])
def test_cleanrl_is_told_minibatches_and_twice_the_value_coefficient(settings: dict[str, Any], minibatches: str) -> None:
    words = arguments(settings | RUN)
    said = dict(zip(words[::2], words[1::2], strict=True))
    assert said["--num-minibatches"] == minibatches
    assert said["--vf-coef"] == "1.0"


def test_each_contender_is_a_file_with_a_main() -> None:
    for each in CONTENDERS.values():
        path = programs.ROOT / Path(*each.module.split("."))
        text = (path / "__main__.py" if each.ours else path.with_suffix(".py")).read_text()
        assert "__main__" in text or each.ours
        assert not each.peer or each.peer in install.PEERS


def test_only_what_is_installed_whole_is_compared(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(install, "ENVS", tmp_path)
    (tmp_path / "tianshou").mkdir()
    assert "Tianshou" not in programs.contenders(peers=True)
    assert programs.missing() == list(install.PEERS)
    (tmp_path / "tianshou" / install.DONE).touch()
    assert "Tianshou" in programs.contenders(peers=True)
    assert "Tianshou" not in programs.contenders()
    assert "tianshou" not in programs.missing()


def test_an_unknown_peer_is_refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.argv", ["install", "brax"])
    with pytest.raises(SystemExit):
        install.main()
    assert "expected names of cleanrl" in capsys.readouterr().err


def test_own_settings_are_not_asked_for_the_large_batch() -> None:
    small, large, _ = PPO_MEASURES
    assert small.fits("PufferLib, own settings")
    assert not large.fits("PufferLib, own settings")
    assert not large.fits("SB3, SubprocVecEnv")
    assert [name for name in CONTENDERS if PEERS_MEASURES[-1].fits(name)] == [OURS, programs.OURS_OWN, programs.DUMMY]


def test_what_fails_is_said_and_left_out(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def run(contender: str, *_: object) -> programs.ProgramResult:
        if contender == "Tianshou":
            raise RuntimeError("Tianshou ended with 1: no")
        return programs.ProgramResult(math.nan, [(256 * update, float(update)) for update in range(5)])

    monkeypatch.setattr(train, "run", run)
    turn = train.take_turns([OURS, "Tianshou"], [Measure(SMALL_RATE, ZOO, 1000, "rate")], 1)
    assert turn == {OURS: {SMALL_RATE: 256.0}, "Tianshou": {}}
    assert "left out: env steps/s, 8 × 32: Tianshou ended with 1" in capsys.readouterr().err


def test_a_task_that_was_not_solved_is_longer_than_any_and_said() -> None:
    peer = "Tianshou"
    turns = [{OURS: {SECONDS: 2.0}, peer: {SECONDS: 8.0}}, {OURS: {SECONDS: 4.0}, peer: {SECONDS: math.nan}}]
    rows = summary([OURS, peer], [*turns, {OURS: {SECONDS: 3.0}, peer: {SECONDS: 6.0}}])
    assert [row["median"] for row in rows] == [{SECONDS: 3.0}, {SECONDS: 8.0}]
    assert against(rows) == [f"{SECONDS}, against the best peer, {peer}: {OURS} 0.38 ×"]
    assert [*table(rows, "").columns[1].cells] == ["3.0 (2.0 to 4.0)", "8.0 (6.0 to 8.0, 1 not solved)"]
