"""Minutes until a policy is good: curves and rates are read and kept, and the tables follow from them."""

from __future__ import annotations

import argparse
import json
import math
import shlex
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium
import pytest
from msgspec.structs import replace

from benchmarks import slow_env, wall_clock, wall_clock_curves, wall_clock_rates
from benchmarks.kept_records import merged
from benchmarks.wall_clock_curves import Curve, read_curves, write_curves
from benchmarks.wall_clock_programs import COPIES, ENVS, OURS, PROGRAMS, THEIRS, Program, curve_command, rate_command
from benchmarks.wall_clock_rates import Rate, can_be_measured, largest_error, rate_at, rate_of, read_rates, write_rates
from benchmarks.wall_clock_returns import comparison, return_after, returns_table
from benchmarks.wall_clock_tables import (
    NO_MINUTES,
    NOTHING,
    Goal,
    Row,
    goals_of,
    minutes_table,
    page_part,
    quickest,
    ranges_text,
    rows_of,
    spread,
    step_times,
    steps_until,
    target_of,
)
from millrace.cli.main import main
from millrace.learner.config.layers import resolve
from millrace.learner.run_folder.run_format import RUN_FORMAT

ENV = ENVS[0]
SAC, XQC, THEIR_SAC, THEIR_PPO = (
    Program(OURS, "sac"),
    Program(OURS, "xqc"),
    Program(THEIRS, "sac"),
    Program(THEIRS, "ppo"),
)


def curve(program: Program, seed: int, *points: tuple[int, float], command: str = "c") -> Curve:
    return Curve(
        env=ENV, system=program.system, algo=program.algo, seed=seed, command=command, processor="p", points=[*points]
    )


def rate(program: Program, step_s: float, *rates: float) -> Rate:
    return Rate(env=ENV, system=program.system, algo=program.algo, step_s=step_s, processor="p", command="c", rates=[*rates])


def test_the_page_has_the_tables_of_what_is_kept() -> None:
    page = wall_clock.PAGE.read_text(encoding="utf-8")
    assert wall_clock.with_part(page, page_part(read_curves(), read_rates())) == page


def test_the_files_are_as_the_program_writes_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = wall_clock_curves.CURVES.read_bytes(), wall_clock_rates.RATES.read_bytes()
    curves, rates = read_curves(), read_rates()
    monkeypatch.setattr(wall_clock_curves, "CURVES", tmp_path / "curves.json")
    monkeypatch.setattr(wall_clock_rates, "RATES", tmp_path / "rates.json")
    write_curves(curves)
    write_rates(rates)
    assert ((tmp_path / "curves.json").read_bytes(), (tmp_path / "rates.json").read_bytes()) == kept


def test_a_page_without_markers_is_refused() -> None:
    with pytest.raises(ValueError, match="expected the markers"):
        wall_clock.with_part("text", "part")


@pytest.mark.parametrize("program", [program for program in PROGRAMS if program.system == OURS], ids=lambda each: each.algo)
def test_our_commands_parse(program: Program, capfd: pytest.CaptureFixture[str]) -> None:
    for words in (curve_command(program, ENV, 1, "runs"), rate_command(program, ENV, 0.05, 1, 1, "cpu")):
        assert main([*words[words.index("millrace") + 1 :], "--steps", "none_of_this"]) == 2
        assert "steps" in capfd.readouterr().err  # nothing else is wrong with it


def test_a_rate_has_the_settings_of_the_curve() -> None:
    for program in PROGRAMS:
        if program.system == OURS:
            words = curve_command(program, ENV, 1, "runs"), rate_command(program, ENV, 0.05, 1, 1, "cpu")
            flags = [dict(pairwise(each)) for each in words]
            for name in ("--algo", "--envs", "--lanes", "--rollout-steps", "--max-lag"):
                assert flags[0].get(name) == flags[1].get(name), name
            assert (flags[0].get("--max-lag") == "1") == program.overlaps


def test_the_steps_of_an_update_are_those_of_the_settings() -> None:
    assert SAC.steps_of_an_update(ENV) == COPIES * 4
    preset = resolve(ENV)
    assert Program(OURS, "ppo").steps_of_an_update(ENV) == preset.envs * preset.algorithm.rollout_steps
    assert THEIR_PPO.steps_of_an_update(ENV) == 2048
    assert can_be_measured(THEIR_PPO, ENV, 0.05, 30)
    assert not can_be_measured(THEIR_PPO, ENV, 1.0, 30)


def test_a_step_takes_its_time_whatever_its_own_work_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [100.0]
    slept: list[float] = []

    class Works(gymnasium.Env[Any, Any]):
        def step(self, action: Any) -> Any:
            clock[0] += action
            return action, 0.0, False, False, {}

    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(time, "sleep", slept.append)
    env = slow_env.StepTime(Works(), seconds=0.5)
    assert env.step(0.125)[0] == 0.125
    assert env.step(0.75)[0] == 0.75
    assert slept == [0.375, 0.0]


def test_a_rate_counts_whole_updates_after_the_warm_up() -> None:
    updates = [(64 * n, float(n)) for n in range(20)]
    assert rate_of(updates, 640, 9.0) == 64.0
    assert rate_of(updates, 640, 9.5) is None, "not so long yet"
    assert rate_of(updates[:12], 640, 0.5) is None, "a single update"


def test_a_rate_at_a_step_time_that_was_not_measured() -> None:
    waits, overlaps = rate(THEIR_SAC, 0.01, 100.0, 90.0, 300.0), rate(SAC, 0.01, 200.0)
    assert rate_at(0.01, [waits]) == (100.0, False)
    found = rate_at(1.0, [waits])
    assert found is not None
    assert found.per_s == pytest.approx(16 / (0.16 - 0.01 + 1.0))  # 16 copies step once and learn for 0.15 s
    assert rate_at(1.0, [overlaps]) == (16.0, True)
    assert rate_at(0.05, [overlaps]) == (200.0, True)
    assert rate_at(0.07, [overlaps, rate(SAC, 0.05, 180.0)]) == (180.0, True)
    assert rate_at(1.0, []) is None


def test_the_error_of_computed_rates() -> None:
    assert largest_error([rate(SAC, 0.01, 200.0)]) is None
    assert largest_error([rate(SAC, 0.05, 160.0), rate(SAC, 0.01, 200.0)]) == 0.25


def test_the_return_of_a_task_is_that_of_our_sac() -> None:
    near = [curve(SAC, 1, (99_000, 5000.0), (290_000, 7000.0), (299_968, 7900.0)), curve(SAC, 2, (299_968, 8000.0))]
    assert target_of(near, ENV, 300_000) == 7700
    assert goals_of(near) == [Goal(ENV, 100_000, 5000.0), Goal(ENV, 300_000, 7700.0)]
    assert goals_of([curve(SAC, 1, (130_000, 5.0)), curve(XQC, 1, (300_000, 5.0))]) == []


def test_the_first_evaluation_that_reaches_a_return_counts() -> None:
    points = [(10, 1.0), (20, 5.0), (30, 4.0), (40, 6.0)]
    assert steps_until(points, 5.0) == 20
    assert steps_until(points, 7.0) == math.inf


def test_a_cell_has_the_median_and_the_range_or_how_many_seeds_came_so_far() -> None:
    assert spread([3.0, 1.0, 2.0], 0.0, str) == "2.0 (1.0 to 3.0)"
    assert spread([3.0, math.inf, 2.0], 9.0, str, about=True) == "≈ 3.0 (2 of 3)"
    assert spread([math.inf, math.inf, 2.0], 9.0, str) == "> 9.0 (1 of 3)"
    assert spread([math.inf], 9.0, str, about=True) == "> ≈ 9.0 (0 of 1)"
    assert spread([4.0], 0.0, str) == "4.0"


def example() -> list[Row]:
    """Our SAC is the quicker one as long as steps are fast, our XQC learns more from each."""
    curves = [curve(SAC, 1, (300_000, 5.0)), curve(XQC, 1, (150_000, 5.0)), curve(THEIR_SAC, 1, (300_000, 4.0))]
    rates = [rate(SAC, 0.01, 400.0), rate(XQC, 0.01, 100.0), rate(THEIR_SAC, 0.01, 100.0)]
    return rows_of(curves, rates, Goal(ENV, 300_000, 5.0))


def test_the_table_of_minutes() -> None:
    lines = minutes_table(example()).splitlines()
    assert lines[2] == "| millrace SAC | 300k | **12** | **≈ 16** | ≈ 312 |"
    assert lines[3] == "| Stable-Baselines3 SAC | > 300k (0 of 1) | > 50 (0 of 1) | > ≈ 62 (0 of 1) | > ≈ 359 (0 of 1) |"
    assert lines[4] == "| millrace XQC | 150k | 25 | ≈ 25 | **≈ 156** |"


def test_from_which_step_time_on_another_algorithm_is_the_quickest() -> None:
    (first, at_once), (second, later) = quickest(example())
    assert (first, second, at_once) == (SAC, XQC, 0.01)
    before = [step_s for step_s in step_times() if step_s < later][-1]
    assert before < 0.08 <= later  # where our SAC makes 200 env steps/s, twice those of our XQC
    assert ranges_text(example()).startswith("millrace SAC; from 8")
    assert ranges_text([row for row in example() if row.program.system == THEIRS]) == "–"


def test_of_two_seeds_one_that_was_too_short_leaves_open_which_algorithm_is_the_quickest() -> None:
    curves = [curve(SAC, 1, (90_000, 5.0)), curve(XQC, 1, (50_000, 5.0)), curve(XQC, 2, (100_000, 4.0))]
    ((first, _),) = quickest(rows_of(curves, [rate(SAC, 0.01, 100.0), rate(XQC, 0.01, 100.0)], Goal(ENV, 100_000, 5.0)))
    assert first is None


def test_a_run_that_was_too_short_might_have_been_the_quickest() -> None:
    curves = [curve(SAC, 1, (300_000, 5.0)), curve(XQC, 1, (150_000, 4.0))]
    rows = rows_of(curves, [rate(SAC, 0.01, 400.0), rate(XQC, 0.01, 100.0)], Goal(ENV, 300_000, 5.0))
    (first, at_once), (second, later) = quickest(rows)
    assert (first, second, at_once) == (SAC, None, 0.01)
    before = [step_s for step_s in step_times() if step_s < later][-1]
    assert before < 0.08 <= later  # from there on, XQC's whole run took less time than SAC's
    assert ranges_text(rows).endswith("on not known")


def test_the_part_of_the_page_has_what_there_is() -> None:
    curves = [curve(SAC, 1, (300_000, 5.0))]
    assert page_part([], []) == NOTHING
    assert page_part(curves, []).endswith(f"{NO_MINUTES}\n"), "without rates"
    assert page_part([curve(XQC, 1, (300_000, 5.0))], [rate(XQC, 0.01, 9.0)]).endswith(f"{NO_MINUTES}\n"), "without a goal"
    whole = page_part([*curves, curve(SAC, 2, (300_000, 4.0))], [rate(SAC, 0.01, 400.0, 300.0), rate(SAC, 0.05, 320.0)])
    assert f"**{ENV}**, minutes until a return of 4.50 (SAC's after 300k env steps) on p:" in whole
    assert "Each row has 2 seeds. A measured rate is the median of at least 1 round." in whole
    assert "the two differ by at most 0 %" in whole
    assert ENVS[1] not in whole


def test_a_return_is_that_of_the_first_evaluation_that_is_late_enough() -> None:
    points = ((90_000, 9.0), (99_999, 8.0), (100_016, 5.0), (110_000, 7.0))
    assert return_after(curve(SAC, 1, *points), 100_000) == 5.0
    assert return_after(curve(SAC, 1, *points), 110_001) is None


def test_the_table_of_returns_has_the_mean_and_the_range_of_the_seeds_that_got_so_far() -> None:
    curves = [
        curve(SAC, 1, (100_000, 400.0), (300_000, 1_000.0)),
        curve(SAC, 2, (100_000, 200.0)),
        curve(XQC, 1, (100_000, 600.0)),
        curve(XQC, 2, (100_001, 1_800.0)),
    ]
    assert returns_table(curves).splitlines()[2:] == [
        f"| {ENV} | millrace SAC | 300 (200 to 400, 2 seeds) | 1,000 (one seed) |",
        f"| {ENV} | millrace XQC | 1,200 (600 to 1,800, 2 seeds) |  |",
    ]
    assert f"300k: 1.20 on {ENV}." in comparison(curves)


def test_of_several_tasks_the_mean_of_the_ratios_is_said() -> None:
    curves = []
    for env, new in zip(ENVS, (500.0, 1_000.0, 3_000.0), strict=True):
        curves += [replace(curve(SAC, 1, (300_000, 1_000.0)), env=env), replace(curve(XQC, 1, (100_000, new)), env=env)]
    assert comparison(curves).endswith("their mean is 1.50.")


def test_without_both_curves_nothing_is_compared() -> None:
    assert comparison([curve(XQC, 1, (100_000, 600.0)), curve(SAC, 1, (299_999, 1.0))]) == ""
    assert returns_table([]) == ""


def test_a_newer_curve_takes_the_place_of_that_of_the_same_seed() -> None:
    old, new = curve(SAC, 1, (1, 1.0)), curve(SAC, 1, (2, 2.0), command="d")
    other = curve(SAC, 2, (3, 3.0))
    kept = merged([old, other], [new])
    assert sorted(kept, key=lambda each: each.seed) == [new, other]
    (line,) = wall_clock.different(kept)
    assert "HalfCheetah-v5 millrace sac: the seeds have different commands" in line


def write_run(folder: Path) -> None:
    folder.mkdir()
    (folder / "run.json").write_text(json.dumps({"format": RUN_FORMAT, "millrace": "0"}))
    (folder / "config.toml").write_text(resolve(ENV, algo="sac", seed=4, workers=3, max_lag=1).to_toml() + "# end\n")
    rows = [{"time/total_timesteps": n, **more} for n, more in ((64, {"eval/mean_reward": 1.26}), (128, {}))]
    rows.append({"time/total_timesteps": 192, "eval/mean_reward": 3.0, "eval/env_steps": 150})
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))


def test_curves_are_collected_from_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(wall_clock_curves, "CURVES", tmp_path / "curves.json")
    write_curves([])
    write_run(tmp_path / "ours")
    (tmp_path / "theirs").mkdir()
    about: dict[str, Any] = {"env": ENV, "system": THEIRS, "algo": "tqc", "seed": 2, "command": "c", "processor": "q"}
    lines = [json.dumps(about), json.dumps({"env_steps": 10_000, "return": 7.0}), '{"env_steps": 20']
    (tmp_path / "theirs" / "curve.jsonl").write_text("\n".join(lines))
    wall_clock.collect([tmp_path], "p")
    theirs, ours = sorted(read_curves(), key=lambda each: each.system)
    assert theirs == Curve(**{**about, "points": [(10_000, 7.0)]})
    assert (ours.key, ours.processor) == ((ENV, OURS, "sac", 4), "p")
    assert ours.points == [(64, 1.3), (150, 3.0)]
    assert shlex.split(ours.command)[:5] == ["millrace", "train", ENV, "--seed", "S"]
    assert "--workers 3" in ours.command
    assert "sac seed 4: 3.0 after 150 env steps" in capsys.readouterr().out


def test_a_curve_of_stable_baselines3_goes_on_from_its_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("sb3_contrib")
    from benchmarks import wall_clock_stable_baselines3 as peer

    evaluations = []

    def evaluate(*_: object, **__: object) -> tuple[float, float]:
        evaluations.append(0)
        if len(evaluations) == 8:
            raise KeyboardInterrupt
        return float(len(evaluations)), 0.0

    monkeypatch.setattr(peer, "evaluate_policy", evaluate)
    arguments = argparse.Namespace(
        env="Pendulum-v1", algo="sac", seed=3, steps=160, out=tmp_path / "run", one_process=True, eval_every=16,
        eval_episodes=1, learning_starts=1000, device="cpu",
    )  # fmt: skip
    with pytest.raises(KeyboardInterrupt):
        peer.train_curve(arguments)
    peer.train_curve(arguments)
    (found,) = wall_clock_curves.found_in(tmp_path, None)
    assert found.key == ("Pendulum-v1", THEIRS, "sac", 3)
    assert found.points[:5] == [(16 * n, float(n)) for n in range(1, 6)], "up to the checkpoint"
    assert found.points[5:] == [(16 * n, float(n + 3)) for n in range(6, 11)], "evaluations 9 to 13"
    assert not (tmp_path / "run" / peer.REPLAY).exists()


def test_stable_baselines3_makes_a_gradient_step_for_each_env_step() -> None:
    pytest.importorskip("sb3_contrib")
    from stable_baselines3.common.env_util import make_vec_env

    from benchmarks import wall_clock_stable_baselines3 as peer

    for algo in ("sac", "tqc", "crossq"):
        model = peer.make(algo, make_vec_env("Pendulum-v1", COPIES), 1, "cpu", learning_starts=16)
        model.learn(32)
        assert model._n_updates == 16, algo
