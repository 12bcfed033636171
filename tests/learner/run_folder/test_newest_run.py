"""`--resume auto`: one command that starts a run and goes on with it, whatever happened to the learner meanwhile."""

from __future__ import annotations

import os
from pathlib import Path

import msgspec
import pytest

import millrace
from millrace.launch import training
from millrace.learner.config.command_line import read_config
from millrace.learner.config.config import Config
from millrace.learner.config.hyperparameters import PPOConfig
from millrace.learner.config.layers import resolve
from millrace.learner.resume_checks import check_settings
from millrace.learner.run_folder.newest_run import newest_run
from millrace.learner.run_folder.run_folder import RunFolder
from millrace.protocol.errors import UsageError

HOURS = 3_600.0


def a_run(config: Config, started_s: float, checkpoint: bool = True) -> Path:
    folder = RunFolder.create(config, started_s).path
    if checkpoint:
        (folder / "checkpoints").mkdir()
        (folder / "checkpoints" / "000000000512.pt").touch()
    return folder


def test_without_a_run_there_is_nothing_to_go_on_with(tmp_path: Path) -> None:
    assert newest_run(resolve("CartPole-v1", run_dir=str(tmp_path / "not yet"))) is None
    assert newest_run(resolve("CartPole-v1", run_dir=str(tmp_path))) is None


def test_the_newest_with_a_checkpoint_is_taken(tmp_path: Path) -> None:
    config = resolve("CartPole-v1", run_dir=str(tmp_path))
    a_run(config, 1 * HOURS)
    newer = a_run(config, 3 * HOURS)
    a_run(config, 2 * HOURS)
    a_run(config, 4 * HOURS, checkpoint=False)  # killed before its first checkpoint
    (tmp_path / "CartPole-v1-ppo-s1-old-99999999-999999").mkdir()
    assert newest_run(config) == newer


def test_of_several_of_one_second_the_last_is_taken(tmp_path: Path) -> None:
    config = resolve("CartPole-v1", run_dir=str(tmp_path))
    runs = [a_run(config, HOURS) for _ in range(11)]
    assert runs[-1].name.endswith("-11")
    assert newest_run(config) == runs[-1]
    later = a_run(config, 2 * HOURS)
    assert newest_run(config) == later


@pytest.mark.parametrize("other", [{"seed": 2}, {"algo": "a2c"}, {"env": "Pendulum-v1"}, {"env": "CartPole:v1"}])
def test_a_run_of_another_environment_algorithm_or_seed_is_let_be(tmp_path: Path, other: dict[str, object]) -> None:
    mine = resolve("CartPole-v1", run_dir=str(tmp_path))
    a_run(resolve(**{"env": "CartPole-v1", "run_dir": str(tmp_path), **other}), HOURS)  # type: ignore[arg-type]
    assert newest_run(mine) is None
    assert newest_run(resolve("CartPole-v1", run_dir=str(tmp_path), seed=11)) is None


def test_the_first_time_it_starts_and_then_it_goes_on_with_the_settings_of_the_run_file_and_flags(tmp_path: Path) -> None:
    file = tmp_path / "my.toml"
    file.write_text("[ppo]\ngamma = 0.5\n")
    flags = ["CartPole-v1", "--run-dir", str(tmp_path / "runs"), "--resume", "auto", "--config", str(file), "--steps", "9"]
    config, resume = read_config("learner", flags)
    assert (config.algorithm.gamma, config.steps, resume) == (0.5, 9, None)
    run = a_run(config, HOURS)
    assert read_config("learner", flags) == (config, run)
    without_file = [*flags[:5], "--steps", "20"]
    again, _ = read_config("learner", without_file)
    assert (again.algorithm.gamma, again.steps) == (0.5, 20)
    file.write_text("steps = 30\nworkers = 3\n[ppo]\nlearning_rate = 0.125\n")
    again, _ = read_config("learner", flags)
    assert isinstance(again.algorithm, PPOConfig)
    assert (again.steps, again.workers, again.algorithm.gamma, again.algorithm.learning_rate) == (9, 3, 0.5, 0.125)
    assert check_settings(again, run) == []
    file.write_text("[ppo]\ngamma = 0.7\n")
    with pytest.raises(UsageError, match=r"gamma: expected 0.5 as in its config.toml, got 0.7; a run keeps this setting"):
        check_settings(read_config("learner", flags)[0], run)
    file.write_text("[ppo]\nlearning_rate = -1.0\n")
    with pytest.raises(UsageError, match=rf"^{file}: learning_rate: expected "):
        read_config("learner", flags)


@pytest.mark.parametrize(
    ("envs", "edited", "wrong"),
    [
        (7, None, "{run}/config.toml: 7 envs cannot be shared evenly among 2 lanes"),
        (7, "steps = 30\n", "{run}/config.toml: 7 envs cannot be shared evenly among 2 lanes"),
        (6, "lanes = 4\n", "{file}: 6 envs cannot be shared evenly among 4 lanes"),
    ],
)
def test_what_is_wrong_together_is_said_of_the_file_that_makes_it_wrong(
    tmp_path: Path, envs: int, edited: str | None, wrong: str
) -> None:
    """The user may edit both the run's config.toml and the file that is given in addition."""
    run = a_run(resolve("CartPole-v1", run_dir=str(tmp_path), envs=4, lanes=2), HOURS)
    settings = run / "config.toml"
    settings.write_text(settings.read_text().replace("envs = 4\n", f"envs = {envs}\n"))
    flags = ["CartPole-v1", "--run-dir", str(tmp_path), "--resume", "auto"]
    file = tmp_path / "my.toml"
    if edited is not None:
        file.write_text(edited)
        flags += ["--config", str(file)]
    with pytest.raises(UsageError) as caught:
        read_config("train", flags)
    assert str(caught.value).startswith(wrong.format(run=run, file=file))


def test_the_file_of_the_settings_may_be_a_pipe(tmp_path: Path) -> None:
    a_run(resolve("CartPole-v1", run_dir=str(tmp_path)), HOURS)
    reading, writing = os.pipe()
    os.write(writing, b"steps = 30\n")
    os.close(writing)
    try:
        flags = ["CartPole-v1", "--run-dir", str(tmp_path), "--resume", "auto", "--config", f"/dev/fd/{reading}"]
        config, run = read_config("train", flags)
    finally:
        os.close(reading)
    assert run is not None
    assert config.steps == 30


def test_a_run_by_name_is_found_again(tmp_path: Path) -> None:
    flags = ["--preset", "cartpole-dqn", "--run-dir", str(tmp_path), "--resume", "auto"]
    config, resume = read_config("train", flags)
    assert (config.algo, resume) == ("dqn", None)
    run = a_run(config, HOURS)
    assert read_config("train", flags) == (config, run)
    with pytest.raises(UsageError, match=r"a preset \(cartpole-dqn\) or a run to resume \(.*\): expected one, got both"):
        read_config("train", [*flags[:-1], str(run)])


def test_in_python_it_is_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[Config, Path | None]] = []

    def train(config: Config, resume: Path | None, watch: object, factory: object = None) -> Path:
        asked.append((config, resume))
        return tmp_path

    monkeypatch.setattr(training, "train", train)
    millrace.train("CartPole-v1", resume="auto", run_dir=str(tmp_path), gamma=0.5)
    run = a_run(asked[0][0], HOURS)
    millrace.train("CartPole-v1", resume="auto", run_dir=str(tmp_path))
    millrace.train("CartPole-v1", resume="auto", run_dir=str(tmp_path), preset="CartPole-v1")
    file = tmp_path / "my.toml"
    file.write_text("steps = 30\n")
    millrace.train("CartPole-v1", resume="auto", run_dir=str(tmp_path), config=file)
    assert [resume for _, resume in asked] == [None, run, run, run]
    assert asked[2][0] == asked[1][0] == asked[0][0]
    assert asked[3][0] == msgspec.structs.replace(asked[0][0], steps=30)
