"""Evaluations beside training find what evaluations for which training waits find, whoever plays them, and however slowly.

Real workers. The environments are CartPole and Pendulum in short episodes: their returns tell one policy from another.
"""

from __future__ import annotations

import json
import os
import re
import signal
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium
import pytest

import millrace
from millrace.learner.run_folder import checkpoint
from millrace.learner.run_folder.metrics_log import read_rows
from millrace.learner.run_folder.progress import Progress
from millrace.protocol.errors import EnvironmentFailed
from tests.system.stage import preloaded
from tests.system.stage.local_runs import run, worker_processes
from tests.system.stage.processes import START_S, Stage, crowding, free_port, wait_for
from tests.system.stage.run_folders import folder_of, policy_of, summary
from tests.system.stage.runs import finish

ENVS = "tests.system.environments.slow_envs:"
COMMON: dict[str, Any] = {
    "preset": "none", "lanes": 2, "envs": 4, "net": (8,), "seed": 9, "workers": 1, "eval_episodes": 4, "eval_copies": 2,
}  # fmt: skip
PPO: dict[str, Any] = {
    **COMMON, "env": f"{ENVS}SlowCartPole-v0", "rollout_steps": 16, "n_epochs": 2, "batch_size": 32, "steps": 1000,
    "learning_rate": 0.01, "eval_every": 150,
}  # fmt: skip
SAC: dict[str, Any] = {
    **COMMON, "env": f"{ENVS}SlowPendulum-v0", "algo": "sac", "rollout_steps": 4, "learning_starts": 50,
    "batch_size": 16, "replay_size": 1000, "steps": 400, "eval_every": 60,
}  # fmt: skip
SLOW = {"step_s": 0.005}
"""An evaluation takes half a second: several updates, and longer than from one evaluation to the next."""


def results(folder: Path) -> dict[str, Any]:
    """All that evaluations have to do with."""
    of_run = summary(folder)
    rows = [row for row in read_rows(folder / "metrics.jsonl") if "eval/mean_reward" in row]
    at = [row.get("eval/env_steps", row["time/total_timesteps"]) for row in rows]
    returns = {steps: row["eval/mean_reward"] for steps, row in zip(at, rows, strict=True)}
    returns[of_run["env_steps"]] = of_run["evaluation"]["return_mean"]
    assert len(set(returns.values())) > 2, "policies cannot be told from each other by their returns"
    return {
        "returns": returns, "final": of_run["evaluation"], "best": of_run["best"], "policy": policy_of(folder),
        "best policy": (folder / "best.safetensors").read_bytes(),
    }  # fmt: skip


@pytest.fixture(scope="module")
def barriers(tmp_path_factory: pytest.TempPathFactory) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """The results of a run of these settings, whose training waits for each evaluation. Each is made once."""
    made: dict[str, dict[str, Any]] = {}

    def of(settings: dict[str, Any]) -> dict[str, Any]:
        if settings["env"] not in made:
            made[settings["env"]] = results(run(tmp_path_factory.mktemp("barriers"), **settings))
        return made[settings["env"]]

    return of


Barriers = Callable[[dict[str, Any]], dict[str, Any]]


@pytest.mark.parametrize(
    ("settings", "workers", "evaluators", "kwargs"),
    [
        (PPO, 1, 2, SLOW),
        (PPO, 2, 1, {}),
        (SAC, 1, 1, SLOW),
        (SAC, 2, 2, {}),
    ],
)
def test_it_finds_what_it_finds_while_training_waits(
    settings: dict[str, Any], workers: int, evaluators: int, kwargs: dict[str, Any], barriers: Barriers, tmp_path: Path
) -> None:
    beside: dict[str, Any] = {"workers": workers, "eval_workers": evaluators, "eval_env_kwargs": kwargs}
    assert results(run(tmp_path, **{**settings, **beside})) == barriers(settings)


def test_so_it_does_if_those_that_play_it_are_killed_again_and_again(barriers: Barriers, tmp_path: Path) -> None:
    """The learner sees that none is left when it waits; or the supervisor has started another one by then."""
    killed: set[int] = set()

    def kill(progress: Progress) -> None:
        if progress.env_steps > 200 and len(killed) < 3:
            for process in worker_processes():
                if "--evaluate" in preloaded.command_line(process):
                    process.kill()
                    killed.add(process.pid)

    beside: dict[str, Any] = {"env_kwargs": SLOW, "eval_workers": 1, "max_env_failures": 1000}
    folder = run(tmp_path, watch=kill, **{**PPO, **beside})
    assert results(folder) == barriers(PPO)
    assert len(killed) == 3


def settings_of(learner: Mapping[str, Any]) -> dict[str, object]:
    """These settings as `Stage.learner` takes them; those that it sets otherwise are left as they are."""
    words = {name.replace("_", "-"): value for name, value in learner.items() if name not in ("env", "workers")}
    words = {name: " ".join(map(str, value)) if isinstance(value, tuple) else value for name, value in words.items()}
    return {"env-kwargs": "", **words}


def test_so_it_does_if_nobody_comes_who_only_evaluates(barriers: Barriers, stage: Stage) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    learner = stage.learner(address, {**settings_of(PPO), "eval-workers": 1}, env=PPO["env"])
    worker = stage.worker(address, "w0")
    assert learner.ends(START_S) == 0, learner.said()
    assert worker.ends() == 0
    assert results(learner.folder) == barriers(PPO)


# ---------------------------------------------------------------- workers elsewhere


@pytest.mark.parametrize("beside", [True, False])
def test_a_worker_elsewhere_that_only_evaluates_gets_no_lane_and_plays(beside: bool, stage: Stage) -> None:
    """Also for a learner whose training waits for evaluations."""
    address = f"tcp://127.0.0.1:{free_port()}"
    learner = stage.learner(address, {"eval-every": 64, "eval-episodes": 4, "eval-workers": int(beside)})
    evaluator = stage.worker(address, "e", "--evaluate")
    learner.hears(r"worker e \(.*\) joined", START_S)
    worker = stage.worker(address, "w")
    learner.trains()

    def status(*flags: str) -> str:
        asked = preloaded.run([sys.executable, "-m", "millrace", "status", address, *flags], timeout=60)
        assert asked.returncode == 0, asked.stderr
        return asked.stdout

    def played() -> bool:
        of_evaluator, of_worker = json.loads(status("--json"))["workers"]
        assert (of_evaluator["worker"], of_evaluator["state"], of_evaluator["lanes"]) == ("e", "evaluating", [])
        assert of_worker["state"] == "active"
        return bool(of_evaluator["steps"] > 0)

    wait_for(played, START_S, "an env step of the one that only evaluates")
    (line,) = [line for line in status().splitlines() if line.startswith("e ")]
    assert "evaluating" in line
    finish(learner, [evaluator, worker])


def test_a_worker_that_only_evaluates_is_of_no_use_for_a_vector_environment(stage: Stage) -> None:
    address = f"tcp://127.0.0.1:{free_port()}"
    evaluator, worker = stage.worker(address, "e", "--evaluate"), stage.worker(address, "w")
    with millrace.make_vec("CartPole-v1", 2, workers=None, lanes=1, bind=address, timeout=START_S) as env:
        env.reset(seed=1)

        def steps() -> bool:
            env.step(env.action_space.sample())  # the learner listens while it steps
            return not evaluator.alive()

        wait_for(steps, START_S, "the end of the evaluator")
        assert evaluator.ends() == 2
    (line,) = evaluator.said().splitlines()
    assert "the workers of this learner only step, and play no evaluations; start this worker without --evaluate" in line
    assert worker.ends() == 0


# ---------------------------------------------------------------- ends


@pytest.mark.parametrize(
    ("number", "step_s", "flags", "within_s"),
    [(signal.SIGINT, 0.2, [], 2.0), (signal.SIGTERM, 0.2, [], 2.0), (signal.SIGTERM, 600.0, ["--grace-s", "1.5"], 3.0)],
)
def test_a_signal_while_the_learner_waits_for_it_ends_the_run_in_time(
    number: int, step_s: float, flags: list[str], within_s: float, stage: Stage
) -> None:
    """The run can be resumed: its newest checkpoint has the policy that is evaluated."""
    command = [sys.executable, "-m", "millrace", "train", f"{ENVS}SlowCartPole-v0", "--run-dir", str(stage.runs)]
    command += ["--eval-workers", "1", "--eval-env-kwargs", "step_s", str(step_s), "--workers", "1", "--rollout-steps", "16"]
    command += ["--eval-every", "64", "--steps", "100000", "--n-epochs", "1", *flags]
    started = stage.start(command, "train")
    started.hears("evaluating for ", START_S)
    began_s = time.monotonic()
    started.signal(number)
    assert started.ends() == 130, started.said()
    seconds = time.monotonic() - began_s
    sys.stdout.write(f"\nsignal {number}, a step of {step_s:g} s, {flags}: it ended after {seconds:.2f} s\n")
    assert seconds <= within_s * crowding()
    said = started.said()
    assert re.search("interrupted; continue with: .*millrace train --resume", said)
    assert "Traceback" not in said
    saved = checkpoint.newest(folder_of(stage.runs))[0].state["past"]["state"]
    assert 0 < saved["pending"]["version"] < saved["version"]


@pytest.mark.parametrize("dies", [False, True])
def test_too_many_failures_of_one_that_plays_it_end_the_run(dies: bool, tmp_path: Path) -> None:
    failures = tmp_path / "failures"
    failures.touch()

    class FailsInEvaluations(gymnasium.Wrapper[Any, Any, Any, Any]):
        """In training, the 40th step waits until two steps in evaluations have failed: the first one is due by then."""

        def __init__(self, env: Any) -> None:
            super().__init__(env)
            self.evaluates, self.steps = millrace.env_copy().evaluation, 0

        def step(self, action: Any) -> Any:
            if self.evaluates:
                with failures.open("a") as file:
                    file.write("x")
                if dies:
                    os._exit(9)
                raise RuntimeError("this copy fails, as it was asked to")
            self.steps += 1
            if self.steps == 40:
                wait_for(lambda: failures.stat().st_size >= 2, START_S)
            return self.env.step(action)

    settings = {name: value for name, value in PPO.items() if name != "env"} | {"eval_every": 64, "steps": 10**6}
    says = "its process ended with exit code 9" if dies else "RuntimeError: this copy fails, as it was asked to"
    with pytest.raises(EnvironmentFailed, match=f"^worker w1 .*{says}.*max_env_failures allows 1") as caught:
        millrace.train(
            lambda: FailsInEvaluations(gymnasium.make("CartPole-v1")), run_dir=str(tmp_path / "runs"), progress=False,
            eval_workers=1, max_env_failures=1, **settings,
        )  # fmt: skip
    assert "\n" not in str(caught.value)
