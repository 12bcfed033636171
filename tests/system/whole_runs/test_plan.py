"""`millrace plan`, from the environment to the command: real workers, and environments that wait, crash and hang."""

from __future__ import annotations

import fcntl
import os
import re
import shlex
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import gymnasium
import msgspec
import numpy as np
import pytest

import millrace
from millrace.cli.main import main
from millrace.learner.config.command_line import read_config
from millrace.planning.measurements import Machine, Measurements
from millrace.planning.probe import LEAST_STEPS, ProbedEnv, probe
from millrace.planning.probe_sizes import COPIES_OF_SHORT
from millrace.protocol.errors import RunError, UsageError
from millrace.workers.machine_slots import FILE_VARIABLE, LIMIT_VARIABLE, Slots

TOY = "tests.support.envs.toy"
BRIEF_S = 6.0
ENDS_WITHIN_S = 5.0  # after the time of a probe, its workers have this long to end
NOT_MEASURED = "copies (in one worker|side by side) were not measured, because .*; unless they hang, allow more time.*"
LARGEST = float(np.finfo(np.float32).max)


class Forgets(gymnasium.Env[Any, Any]):
    """Shows random numbers that do not follow from its seed."""

    def __init__(self) -> None:
        self.observation_space = gymnasium.spaces.Box(0, 255, (2,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self._shown(), {}

    def step(self, action: Any) -> Any:
        return self._shown(), 0.0, False, False, {}

    def _shown(self) -> Any:
        return np.frombuffer(os.urandom(2), np.uint8).astype(np.float32)


def failures(measured: Measurements) -> list[str]:
    """The findings, without those of copies for which there was no time."""
    return [line for line in measured.findings if not re.fullmatch(rf"\d+ {NOT_MEASURED}", line)]


def planned(capsys: pytest.CaptureFixture[str], env: str, *flags: str) -> dict[str, Any]:
    """The plan as JSON, and what was shown meanwhile."""
    assert main(["plan", env, "--seconds", str(BRIEF_S), "--json", *flags]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    found: dict[str, Any] = msgspec.json.decode(line)
    return found


def test_the_command_measures_an_environment_that_waits_and_names_a_command_that_trains(
    capsys: pytest.CaptureFixture[str],
) -> None:
    step_s = 0.02
    found = planned(capsys, f"{TOY}:Slow", "--env-kwargs", "seconds", str(step_s), "k", "5", "--max-env-copies", "3")
    alone = found["measured"]["side_by_side"][0]
    assert alone["mean_s"] >= step_s
    assert alone["cpu_s"] < 0.2 * alone["mean_s"]
    assert found["measured"]["deterministic"] is True
    assert found["measured"]["episode_steps"] == 5
    assert found["measured"]["worker_bytes"] > 20 << 20
    chosen = {each["name"]: each["value"] for each in found["chosen"]}
    assert chosen["algo"] == "rainbow"  # 10 ms for each of two copies, and discrete actions
    assert 1 <= chosen["envs"] <= 2  # one is enough if gradient steps are slow here
    assert (chosen["max_env_copies"], chosen["eval_copies"]) == (3, 1)
    program, train, *argv = shlex.split(found["command"])
    assert (program, train) == ("millrace", "train")
    config, _ = read_config("train", argv)
    assert (config.envs, config.workers, config.env_kwargs) == (
        chosen["envs"],
        chosen["workers"],
        {"seconds": step_s, "k": 5},
    )
    assert found["measured"]["slowest_step_s"] >= alone["p95_s"]
    assert config.step_timeout_s == chosen["step_timeout_s"] <= 300
    one, two, ten = (each["steps_per_s"] for each in found["expected"])
    assert 0 < one <= 2 / step_s
    assert one <= two <= ten


def test_an_environment_of_the_script_that_does_not_repeat_itself_is_found_out_from_python() -> None:
    plan = millrace.plan(Forgets, seconds=BRIEF_S)
    assert plan.measured.deterministic is False
    assert any("isn't deterministic" in line for line in plan.advice)
    assert plan.measured.alone.computes
    assert plan.settings["algo"] == "ppo"
    text = str(plan)
    assert plan.command.split()[-1] in text
    assert all(each.why.split()[0] in text for each in plan.chosen)


@pytest.mark.parametrize(("name", "after"), [("Dies", 20), ("Hangs", 20), ("Raises", 20)])
def test_a_crash_is_a_line_and_not_the_end(name: str, after: int) -> None:
    plan = millrace.plan(f"{TOY}:{name}", env_kwargs={"after": after}, seconds=BRIEF_S)
    assert plan.measured.findings
    assert all("\n" not in line for line in plan.measured.findings)
    assert plan.measured.findings[0] in plan.advice
    assert plan.measured.alone.steps >= after // 2
    if plan.measured.copies_failed:
        assert plan.settings["envs"] <= plan.measured.copies_worked


def test_a_single_copy_that_fails_does_not_count_as_a_failure_of_more_copies(tmp_path: Path) -> None:
    env = ProbedEnv(f"{TOY}:Raises", {"after": 20, "once": str(tmp_path / "failed")}, ())
    measured = probe(env, Machine(cores=2), seconds=BRIEF_S).measured
    assert (measured.failures, measured.copies_failed) == (1, 0)
    (line,) = measured.findings
    assert re.match(r"1 failure in [\d,]+ steps and resets \(.*%\), one copy, after \d+ calls: .*the toy is broken", line)


class NowAndThen(gymnasium.Env[Any, Any]):
    """Waits for 20 ms in each step. Of the steps of all copies together, each `every`th one dies or, if `hangs`, hangs."""

    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, steps: str, every: int, hangs: bool) -> None:
        self._steps = os.open(steps, os.O_CREAT | os.O_RDWR)
        self._every = every
        self._hangs = hangs

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        fcntl.flock(self._steps, fcntl.LOCK_EX)
        steps = os.fstat(self._steps).st_size + 1
        os.ftruncate(self._steps, steps)
        fcntl.flock(self._steps, fcntl.LOCK_UN)
        if steps % self._every == 0:
            time.sleep(3600.0 if self._hangs else 0.0)
            os._exit(1)
        time.sleep(0.02)
        return np.zeros(1, np.float32), 0.0, False, False, {}


@pytest.mark.parametrize(("hangs", "says"), [(False, "ended with"), (True, "a call took longer than")])
def test_crashes_and_hangs_now_and_then_limit_nothing_and_are_counted(tmp_path: Path, hangs: bool, says: str) -> None:
    env_kwargs: dict[str, Any] = {"steps": str(tmp_path / "steps"), "every": 150, "hangs": hangs}
    measured = probe(ProbedEnv(NowAndThen, env_kwargs, ()), Machine(cores=2), seconds=2 * BRIEF_S).measured
    assert measured.failures >= 1
    assert (measured.copies_failed, measured.failed_in_one_worker) == (0, 0)
    assert measured.copies_worked >= (2 if hangs else 8)
    assert len(measured.side_by_side) >= 2
    assert says in measured.findings[0]
    assert re.match(rf"{measured.failures} failures? in {measured.calls:,} steps", measured.findings[0])


class DivergesOnce(gymnasium.Env[Any, Any]):
    """Waits for 20 ms in each step. Its first copy fails in its tenth step."""

    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, failed: str) -> None:
        self._failed = Path(failed)
        self._steps = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        time.sleep(0.02)
        self._steps += 1
        if self._steps == 10 and not self._failed.exists():
            self._failed.touch()
            raise RuntimeError("the solver diverged")
        return np.zeros(1, np.float32), 0.0, False, False, {}


def test_a_copy_that_fails_early_is_stepped_again_and_a_time_limit_stands_in_for_the_length_of_episodes(
    tmp_path: Path,
) -> None:
    limit = 10_000  # no episode ends
    spec = gymnasium.envs.registration.EnvSpec("Diverges-v0", f"{__name__}:DivergesOnce", max_episode_steps=limit)
    env = ProbedEnv(spec, {"failed": str(tmp_path / "failed")}, ())
    measured = probe(env, Machine(cores=2), seconds=3 * BRIEF_S).measured
    assert (measured.failures, measured.copies_failed) == (1, 0)
    assert measured.alone.steps > 20
    assert measured.episode_steps == limit


class FailsOnce(gymnasium.Env[Any, Any]):
    """Waits for 5 ms in each step. The first time that a second copy is made, it fails."""

    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, folder: str) -> None:
        self._first = os.open(f"{folder}/first", os.O_CREAT | os.O_RDWR)
        try:
            fcntl.flock(self._first, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            with suppress(FileExistsError):
                os.close(os.open(f"{folder}/failed", os.O_CREAT | os.O_EXCL))
                raise RuntimeError("the server did not start") from None

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        time.sleep(0.005)
        return np.zeros(1, np.float32), 0.0, False, False, {}

    def close(self) -> None:
        os.close(self._first)


def test_a_number_of_copies_that_fails_once_is_tried_again(tmp_path: Path) -> None:
    measured = probe(ProbedEnv(FailsOnce, {"folder": str(tmp_path)}, ()), Machine(cores=2), seconds=2 * BRIEF_S).measured
    assert (tmp_path / "failed").exists()
    assert (measured.failures, measured.copies_failed, measured.failed_in_one_worker) == (1, 0, 0)
    assert measured.copies_worked >= 2
    assert "2 copies side by side, after 0 calls: " in measured.findings[0]
    assert "the server did not start" in measured.findings[0]


@pytest.mark.parametrize("most_copies", [3, 5])
def test_no_more_copies_are_tried_than_are_allowed_even_if_steps_are_short(most_copies: int) -> None:
    measured = probe(ProbedEnv("CartPole-v1", {}, ()), Machine(cores=2, most_copies=most_copies), seconds=BRIEF_S).measured
    assert measured.copies_worked <= most_copies


def limit_copies(monkeypatch: pytest.MonkeyPatch, folder: Path, most: int) -> Path:
    """Limit the env copies on this machine to `most`. Returns the path of the slots file."""
    monkeypatch.setenv(LIMIT_VARIABLE, str(most))
    monkeypatch.setenv(FILE_VARIABLE, str(folder / "slots"))
    return folder / "slots"


def test_a_plan_keeps_within_the_limit_of_copies_on_this_machine_and_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limit_copies(monkeypatch, tmp_path, 3)
    plan = millrace.plan("CartPole-v1", seconds=BRIEF_S)
    assert plan.measured.copies_worked <= 2
    assert failures(plan.measured) == []
    assert plan.settings["envs"] + plan.settings["eval_copies"] <= 3


@pytest.mark.parametrize("free", [0, 1])
def test_a_plan_names_the_limit_of_copies_if_other_programs_have_taken_the_slots(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, free: int
) -> None:
    file = limit_copies(monkeypatch, tmp_path, 3)
    others = Slots(most=3)
    for _ in range(3 - free):
        others.take()
    why = rf"env copies of other programs hold the slots; {LIMIT_VARIABLE} allows 3 on this machine \({file}\)"
    began_s = time.monotonic()
    try:
        if not free:
            with pytest.raises(RunError, match=f"no step could be made: {why}; plan again"):
                millrace.plan("CartPole-v1", seconds=BRIEF_S)
        else:
            measured = probe(ProbedEnv("CartPole-v1", {}, ()), Machine(cores=2, most_copies=2), seconds=BRIEF_S).measured
            assert (measured.copies_worked, measured.copies_failed, measured.failed_in_one_worker) == (1, 0, 0)
            assert [
                re.fullmatch(f"2 copies (side by side|in one worker) were not measured, because {why}", line) is not None
                for line in measured.findings
            ] == [True, True]
    finally:
        os.close(others.fd)
    assert time.monotonic() - began_s < BRIEF_S + ENDS_WITHIN_S


def compute(seconds: float) -> None:
    """Use a core for this long."""
    end_s = time.process_time() + seconds
    while time.process_time() < end_s:
        pass


class Licensed(gymnasium.Env[Any, Any]):
    """Computes for `step_s` in each step. Only `licences` copies may exist on this machine: another one writes what it
    `says` and fails or, if `waits`, hangs.
    """

    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, licence: str, waits: bool = False, licences: int = 1, step_s: float = 0.003, says: str = "") -> None:
        self._step_s = step_s
        for n in range(licences):
            self._licence = os.open(f"{licence}{n}", os.O_CREAT | os.O_RDWR)
            with suppress(BlockingIOError):
                fcntl.flock(self._licence, fcntl.LOCK_EX if waits else fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            os.close(self._licence)
        sys.stderr.write(f"{says}\n")
        raise RuntimeError("no licence is free")

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        compute(self._step_s)
        return np.zeros(1, np.float32), 0.0, False, False, {}

    def close(self) -> None:
        os.close(self._licence)


def test_a_plan_for_an_environment_of_which_a_second_copy_fails_has_one_copy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("millrace.planning.plan.usable_cores", lambda: 2)
    plan = millrace.plan(Licensed, env_kwargs={"licence": str(tmp_path / "licence")}, seconds=2 * BRIEF_S)
    assert (plan.measured.copies_worked, plan.measured.copies_failed, plan.measured.failed_in_one_worker) == (1, 2, 0)
    (line,) = plan.measured.findings
    assert line.startswith("2 copies side by side: ")
    assert "no licence is free (in all 3 tries)" in line
    assert line in plan.advice
    assert (plan.settings["envs"], plan.settings["workers"], plan.settings["lanes"]) == (1, 1, 1)
    assert plan.settings["eval_copies"] == 1
    assert any(line.startswith("evaluations need a second copy, but 2 did not work side by side") for line in plan.advice)
    assert not any("measured at most" in line for line in plan.advice)


def test_a_limit_on_the_number_of_copies_is_not_taken_for_one_copy_in_each_process_if_steps_are_short(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("millrace.planning.plan.usable_cores", lambda: 2)
    env_kwargs: dict[str, Any] = {"licence": str(tmp_path / "licence"), "licences": 3, "step_s": 0.0}
    plan = millrace.plan(Licensed, env_kwargs=env_kwargs, seconds=4 * BRIEF_S)
    measured = plan.measured
    assert 2 <= measured.copies_worked <= 3
    assert measured.worked_in_one_worker == 2
    assert 3 < measured.copies_failed <= measured.failed_in_one_worker <= COPIES_OF_SHORT
    assert plan.settings["envs"] + plan.settings["eval_copies"] <= plan.settings["max_env_copies"] <= 3
    assert not any("OwnProcess" in line for line in plan.advice)


def test_after_a_number_of_copies_failed_numbers_between_it_and_one_that_worked_are_tried(tmp_path: Path) -> None:
    env_kwargs: dict[str, Any] = {"licence": str(tmp_path / "licence"), "licences": 3, "says": "all seats in use"}
    measured = probe(ProbedEnv(Licensed, env_kwargs, ()), Machine(cores=4), seconds=6 * BRIEF_S).measured
    assert (measured.copies_worked, measured.copies_failed, measured.copies_tried) == (3, 4, (1, 2, 3, 4))
    (line,) = measured.findings
    assert re.match(r"4 copies side by side: .*no licence is free; w\d wrote: all seats in use \(in all 3 tries\)", line)


def test_a_plan_with_more_copies_than_were_measured_says_so_and_that_those_that_took_too_long_may_hang(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("millrace.planning.plan.usable_cores", lambda: 2)
    env_kwargs: dict[str, Any] = {"licence": str(tmp_path / "licence"), "waits": True}
    plan = millrace.plan(Licensed, env_kwargs=env_kwargs, seconds=2 * BRIEF_S)
    assert (plan.measured.copies_worked, plan.measured.copies_failed) == (1, 0)
    assert len(plan.measured.findings) == 2  # for two workers, and for two copies in one worker
    assert failures(plan.measured) == []
    has = f"this command has {plan.settings['envs']} env copies, but the plan measured at most 1 copy at the same time: "
    assert any(line.startswith(has) for line in plan.advice)


class Slow(gymnasium.Env[Any, Any]):
    """Making a copy, a reset, a step, or making another copy in the same process takes this many seconds more."""

    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)
    made = 0

    def __init__(self, start_s: float = 0.0, reset_s: float = 0.0, step_s: float = 0.0, another_s: float = 0.0) -> None:
        time.sleep(start_s + (another_s if Slow.made else 0.0))
        Slow.made += 1
        self._reset_s = reset_s
        self._step_s = step_s

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        time.sleep(self._reset_s)
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        time.sleep(self._step_s)
        return np.zeros(1, np.float32), 0.0, False, False, {}


@pytest.mark.parametrize("slow", ["start_s", "reset_s"])
def test_slow_copies_are_measured_only_as_far_as_the_time_allows_and_limit_nothing(slow: str) -> None:
    began_s = time.monotonic()
    measured = probe(ProbedEnv(Slow, {slow: 1.5}, ()), Machine(cores=2), seconds=2 * BRIEF_S).measured
    assert time.monotonic() - began_s < 2 * BRIEF_S + ENDS_WITHIN_S
    assert (measured.copies_failed, measured.failed_in_one_worker) == (0, 0)
    assert failures(measured) == []


def test_copies_in_one_worker_that_take_too_long_are_not_a_failure_and_leave_time_for_several_workers() -> None:
    began_s = time.monotonic()
    measured = probe(ProbedEnv(Slow, {"another_s": 60.0}, ()), Machine(cores=2), seconds=2 * BRIEF_S).measured
    assert time.monotonic() - began_s < 2 * BRIEF_S + ENDS_WITHIN_S
    assert (measured.copies_worked, measured.copies_failed, measured.failed_in_one_worker) == (2, 0, 0)
    assert failures(measured) == []
    assert re.match("[2-8] copies in one worker were not measured", measured.findings[0])


def test_more_workers_are_tried_as_long_as_there_is_time_even_if_they_start_slowly() -> None:
    measured = probe(ProbedEnv(Slow, {"start_s": 1.0, "step_s": 0.01}, ()), Machine(cores=2), seconds=4 * BRIEF_S).measured
    assert measured.copies_worked >= 8
    assert failures(measured) == []


def test_if_steps_take_so_long_that_only_one_copy_is_measured_a_line_says_so() -> None:
    measured = probe(ProbedEnv(Slow, {"step_s": 1.0}, ()), Machine(cores=2), seconds=2 * BRIEF_S).measured
    reported = [match[1] for line in measured.findings if (match := re.fullmatch(rf"2 {NOT_MEASURED}", line))]
    assert reported == ["side by side"] * (2 - measured.copies_worked) + ["in one worker"]
    assert measured.no_more == "time"
    assert all(re.search(r"--seconds \d+$", line) for line in measured.findings)


class FewInEachProcess(gymnasium.Env[Any, Any]):
    """Computes for `step_s` in each step. A process may make only `few` copies."""

    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)
    made = 0

    def __init__(self, step_s: float, few: int = 1) -> None:
        if FewInEachProcess.made >= few:
            raise RuntimeError("cannot create multiple simulators in a process")
        FewInEachProcess.made += 1
        self._step_s = step_s

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        compute(self._step_s)
        return np.zeros(1, np.float32), 0.0, False, False, {}


@pytest.mark.parametrize(("step_s", "cores"), [(0.0, 2), (0.005, 2), (0.005, 1)])
def test_an_environment_that_allows_one_copy_in_each_process_is_found_out(step_s: float, cores: int) -> None:
    machine = Machine(cores=cores)
    measured = probe(ProbedEnv(FewInEachProcess, {"step_s": step_s}, ()), machine, seconds=2 * BRIEF_S).measured
    assert (measured.copies_worked, measured.copies_failed) == (cores, 0)
    assert (measured.worked_in_one_worker, measured.failed_in_one_worker) == (1, 2)
    assert measured.findings[-1].startswith("2 copies in one worker: ")
    assert all(re.match("[2-8] copies in one worker: .*multiple simulators", line) for line in measured.findings)


def plan_of_two_in_each_process(monkeypatch: pytest.MonkeyPatch, tried: int) -> millrace.RunPlan:
    """A plan on three cores, which tries this many copies in one worker, of which only two work."""
    monkeypatch.setattr("millrace.planning.probe_sizes.COPIES_OF_SHORT", tried)
    monkeypatch.setattr("millrace.planning.plan.usable_cores", lambda: 3)
    return millrace.plan(FewInEachProcess, env_kwargs={"step_s": 0.0, "few": 2}, seconds=4 * BRIEF_S)


def test_more_copies_than_a_process_allows_are_no_limit_on_copies_if_as_many_work_side_by_side(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plan = plan_of_two_in_each_process(monkeypatch, tried=3)
    measured = plan.measured
    assert (measured.copies_worked, measured.copies_failed) == (3, 0)
    assert (measured.worked_in_one_worker, measured.failed_in_one_worker) == (2, 3)
    assert plan.settings["workers"] == plan.settings["envs"]
    assert plan.settings["eval_copies"] == 1
    assert not any("OwnProcess" in line for line in plan.advice)


def test_if_more_copies_failed_in_one_worker_than_work_side_by_side_they_are_limited_in_number_and_kept_apart(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plan = plan_of_two_in_each_process(monkeypatch, tried=4)
    measured = plan.measured
    assert (measured.copies_worked, measured.copies_failed) == (3, 4)
    assert (measured.worked_in_one_worker, measured.failed_in_one_worker) == (2, 4)
    assert plan.settings["workers"] == plan.settings["envs"] == 2
    assert (plan.settings["eval_copies"], plan.settings["max_env_copies"]) == (1, 3)


def test_if_no_step_can_be_made_the_error_says_why() -> None:
    with pytest.raises(UsageError, match="Missing"):
        millrace.plan(f"{TOY}:Missing", seconds=BRIEF_S)
    with pytest.raises(RunError, match=r"no step could be made in the 4.2 s .* --seconds 6 .* more time with --seconds 24$"):
        millrace.plan(f"{TOY}:Hangs", env_kwargs={"after": 0}, seconds=BRIEF_S)
    with pytest.raises(UsageError, match="seconds: expected at least 5, got 1"):
        millrace.plan("CartPole-v1", seconds=1)


@pytest.mark.parametrize("name", ["InInfo", "InObservation", "Parts", "PartsInObservation", "Mixed"])
def test_random_actions_are_allowed_ones_in_whichever_form_masks_come(name: str) -> None:
    """The environments raise for any other action."""
    env = ProbedEnv(f"tests.support.users_code.mask_envs:{name}-v0", {}, ())
    measured = probe(env, Machine(cores=1), seconds=3).measured
    assert failures(measured) == []
    assert measured.alone.steps >= LEAST_STEPS
    assert measured.masks_in_info == ("InObservation" not in name)


def test_an_environment_with_a_tuple_of_masks_gets_a_plan_that_trains(tmp_path: Path) -> None:
    env = "tests.support.users_code.mask_envs:{}-v0"
    plan = millrace.plan(env.format("PartsInObservation"), seconds=BRIEF_S)
    assert "action_masks" not in plan.settings
    plan = millrace.plan(env.format("Parts"), seconds=BRIEF_S)
    assert plan.settings["action_masks"] == "info"
    settings: dict[str, Any] = {"steps": 64, "eval_episodes": 1, "max_env_failures": 0, "run_dir": str(tmp_path)}
    millrace.train(plan.env, progress=False, **plan.settings, **settings)


class MasksOfSteps(gymnasium.Env[Any, Any]):
    """Reports masks in the infos of steps, but not of resets."""

    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(3)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        return np.zeros(1, np.float32), 0.0, False, False, {"action_mask": np.ones(3, np.int8)}


def test_masks_that_a_run_would_refuse_are_not_recommended_and_the_plan_says_why() -> None:
    plan = millrace.plan(MasksOfSteps, seconds=BRIEF_S)
    assert "action_masks" not in plan.settings
    (line,) = (line for line in plan.advice if "masks" in line)
    assert line.startswith(
        "its action masks aren't as a run needs them: after a copy's first reset, action_mask: expected 3 "
    )


class Boundless(gymnasium.Env[Any, Any]):
    """Waits for 20 ms in each step. Its bounds are the largest numbers of their dtype, which say nothing.

    `actions`: `discrete`, or the dtype of continuous actions. A large action is an error.
    """

    observation_space = gymnasium.spaces.Box(-LARGEST, LARGEST, (4,), np.float32)

    def __init__(self, actions: str) -> None:
        if actions == "discrete":
            self.action_space: gymnasium.Space[Any] = gymnasium.spaces.Discrete(2)
        else:
            largest = np.finfo(actions).max
            self.action_space = gymnasium.spaces.Box(-largest, largest, (1,), np.dtype(actions).type)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return np.zeros(4, np.float32), {}

    def step(self, action: Any) -> Any:
        if np.abs(action).max() > 1e6:
            raise ValueError(f"the motor breaks at {action}")
        time.sleep(0.02)
        return np.zeros(4, np.float32), 0.0, False, False, {}


@pytest.mark.parametrize(("actions", "algo"), [("discrete", "rainbow"), ("float32", "ppo"), ("float64", "ppo")])
def test_bounds_that_say_nothing_fit_a_plan(actions: str, algo: str) -> None:
    plan = millrace.plan(Boundless, env_kwargs={"actions": actions}, max_env_copies=2, seconds=BRIEF_S)
    assert plan.settings["algo"] == algo, "those for continuous actions need bounds"
    assert any("actions are random" in line for line in plan.advice) == (algo == "rainbow")
    assert plan.steps_per_s > 0
    assert failures(plan.measured) == []
