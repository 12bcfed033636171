"""Environments and wrappers that only a script, a prompt or a module of the user has: whole runs, by all commands."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.system.stage import preloaded
from tests.system.stage.processes import ROOT
from tests.system.stage.run_folders import policy_of

OWN = '''
import gymnasium, numpy as np

class Walk(gymnasium.Env):
    """Three steps to the right end it. Its return is the number of steps."""
    observation_space = gymnasium.spaces.Box(-10, 10, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, bonus=0.0):
        self.bonus = bonus

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at = 0
        return np.array([0], np.float32), {}

    def step(self, action):
        self.at += 1
        return np.array([self.at], np.float32), 1.0 + self.bonus, False, False, {}

class Doubled(gymnasium.RewardWrapper):
    def reward(self, reward):
        return 2.0 * reward

def make_walk(bonus=0.0):
    return gymnasium.wrappers.TimeLimit(Walk(bonus), 4)
'''
REGISTERED = OWN + 'gymnasium.register(id="Walk-v0", entry_point=Walk, max_episode_steps=5)\n'
SMALL = {"envs": 2, "lanes": 2, "workers": 1, "rollout_steps": 16, "batch_size": 32, "n_epochs": 1, "eval_episodes": 2}
TRAIN = f"""
import sys, millrace
def train(*args, **keywords):
    return millrace.train(*args, progress=False, run_dir=sys.argv[1], **{{**{SMALL!r}, "steps": 64, **keywords}})
"""
WHOLE = """
if __name__ == "__main__":
    run = train("Walk-v0", wrappers=[Doubled])
    print(run.path, run.summary.evaluation.return_mean)
    print(millrace.train(resume=run.path, steps=128, progress=False).summary.env_steps)
    print(millrace.evaluate(run.path, 2, workers=1, progress=False).return_mean)
    print(millrace.record(run.path, "walk/own-v0", 10, workers=1, progress=False).return_mean)
"""


def python(folder: Path, *words: str, stdin: str | None = None) -> list[str]:
    """The lines that Python prints, run in this folder."""
    paths = {"PYTHONPATH": str(ROOT), "MINARI_DATASETS_PATH": str(folder / "datasets")}
    done = subprocess.run(
        [sys.executable, *words], cwd=folder, env={**os.environ, **paths}, input=stdin, capture_output=True, text=True,
        timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def millrace(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return preloaded.run(
        [sys.executable, "-m", "millrace", *words], cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)}, timeout=120
    )


def refusal(folder: Path, *words: str) -> str:
    done = millrace(folder, *words)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    return done.stderr


def evaluated(folder: Path, *words: str) -> str:
    done = millrace(folder, "evaluate", *words, "--episodes", "2", "--workers", "1")
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("how", ["script", pytest.param("prompt", marks=pytest.mark.soak)])
def test_a_script_trains_resumes_evaluates_and_records_what_it_registers(tmp_path: Path, how: str) -> None:
    pytest.importorskip("minari")
    program = REGISTERED + TRAIN + WHOLE
    if how == "script":
        (tmp_path / "script.py").write_text(program)
        trained, resumed, played, recorded = python(tmp_path, "script.py", str(tmp_path / "runs"))
    else:
        trained, resumed, played, recorded = python(tmp_path, "-", str(tmp_path / "runs"), stdin=program)
    run, greedy = trained.split()
    assert (float(greedy), int(resumed) > 64, float(played), float(recorded)) == (10.0, True, 10.0, 10.0)
    assert Path(run).name.startswith("Walk-v0-ppo-s1-")

    line = refusal(tmp_path, "evaluate", run)
    assert "environment __main__:Walk-v0 was made in a script, a notebook or a function, and cannot be found here" in line
    assert "my_module:Walk-v0 (train: ENV; evaluate, record: --env)" in line
    (tmp_path / "own.py").write_text(REGISTERED)
    line = refusal(tmp_path, "evaluate", run, "--env", "own:Walk-v0")
    assert "wrapper __main__:Doubled was made in a script" in line
    assert "--wrappers my_module:Doubled" in line
    assert "return 10.0 ± 0.0" in evaluated(tmp_path, run, "--env", "own:Walk-v0", "--wrappers", "own:Doubled")

    before = {path: path.read_bytes() for path in Path(run).rglob("*") if path.is_file()}
    assert "Walk-v0" in refusal(tmp_path, "train", "--resume", run, "--steps", "192")
    assert "expected ['__main__:Doubled']" in refusal(tmp_path, "train", "--resume", run, "--wrappers", "own:Walk")
    assert before == {path: path.read_bytes() for path in Path(run).rglob("*") if path.is_file()}
    moved = millrace(tmp_path, "train", "own:Walk-v0", "--resume", run, "--steps", "192", "--wrappers", "own:Doubled")
    assert moved.returncode == 0, moved.stderr
    assert "return 10.0 ± 0.0" in evaluated(tmp_path, run), "the run remembers the names that it has now"


def test_what_the_script_alone_registers_is_made_by_id_by_spec_and_in_a_callable(tmp_path: Path) -> None:
    tries = (
        "def make():\n    return gymnasium.make('Walk-v0')\n"
        "if __name__ == '__main__':\n"
        "    for env in (make, lambda: make(), 'Walk-v0', gymnasium.spec('Walk-v0')):\n"
        "        print(train(env).summary.evaluation.return_mean)\n"
    )
    (tmp_path / "script.py").write_text(REGISTERED + TRAIN + tries)
    assert python(tmp_path, "script.py", str(tmp_path / "runs")) == ["5.0"] * 4


def test_a_run_of_a_function_in_a_module_is_found_again_by_every_command(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(OWN)
    program = (
        "import own\n" + TRAIN + 'print(train(own.make_walk, env_kwargs={"bonus": 0.5}, wrappers=[own.Doubled]).path)\n'
    )
    (run,) = python(tmp_path, "-c", program, str(tmp_path / "runs"))
    assert "return 12.0 ± 0.0" in evaluated(tmp_path, run)
    resumed = millrace(tmp_path, "train", "--resume", run, "--steps", "128")
    assert resumed.returncode == 0, resumed.stderr
    assert "return 12.0 ± 0.0" in evaluated(tmp_path, run)
    flags = [word for name, value in SMALL.items() for word in (f"--{name.replace('_', '-')}", str(value))]
    wrappers = ["--wrappers", "own:Doubled", "gymnasium.wrappers:TimeLimit(max_episode_steps=3)"]
    named = millrace(tmp_path, "train", "own:make_walk", *wrappers, *flags, "--steps", "64", "--run-dir", "named")
    assert named.returncode == 0, named.stderr
    (run_by_name,) = (tmp_path / "named").iterdir()
    assert "return 6.0 ± 0.0" in evaluated(tmp_path, str(run_by_name))
    text = (run_by_name / "config.toml").read_text()
    assert '"own:Doubled",\n    "gymnasium.wrappers:TimeLimit(max_episode_steps=3)",\n' in text
    again = millrace(tmp_path, "train", "--config", str(run_by_name / "config.toml"), "--run-dir", "again")
    assert again.returncode == 0, again.stderr
    (repeated,) = (tmp_path / "again").iterdir()
    assert policy_of(repeated) == policy_of(run_by_name)
