"""The command line: what a user does wrong is one line and exit code 2, and leaves nothing behind."""

import os
import re
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from msgspec.structs import replace

import millrace
from millrace.cli.commands import COMMANDS
from millrace.cli.main import main
from millrace.cli.train_output import next_commands, result
from millrace.learner.callbacks.callbacks import Callbacks
from millrace.learner.config.config import Config
from millrace.learner.config.hyperparameters import HYPERPARAMETERS, algorithms_with
from millrace.learner.config.layers import resolve
from millrace.learner.policy_player import PolicyPlayer
from millrace.learner.rollouts.evaluation_dealer import EvaluationPlan
from millrace.learner.run_folder import checkpoint
from millrace.learner.run_folder.metrics_log import MetricsLog
from millrace.learner.run_folder.progress import Progress
from millrace.learner.run_folder.results import Best, Evaluation, Summary
from millrace.learner.run_folder.run_folder import Interrupted, RunFolder
from millrace.learner.run_folder.run_format import write_format
from millrace.play_flags import EvaluateFlags, PlayFlags, RecordFlags
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.envs.spaces import action_spec, observation_leaves
from millrace.protocol.errors import EnvironmentFailed, NoWorkers
from millrace.protocol.policy.layout import acting_size
from millrace.protocol.specs import PolicySpec
from tests.support.in_process.saved_policies import policy_run

ROOT = Path(__file__).parents[3]
Captured = pytest.CaptureFixture[str]
ALGORITHMS = ", ".join(HYPERPARAMETERS)


def refusal(capsys: Captured, *argv: str, exit_code: int = 2) -> str:
    """The one line on stderr."""
    assert main(list(argv)) == exit_code
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith("millrace: ")
    assert "Traceback" not in err
    return err.removeprefix("millrace: ").rstrip()


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[Any]:
    """Stands in for the run: what it was asked for. The current folder is an empty one."""
    calls: list[Any] = []

    def train(config: Config, resume: Path | None, watch: Any, factory: Any = None, *, elsewhere: bool = False) -> Path:
        calls.append((config, resume, factory))
        Callbacks.of(watch).on_update(Progress(env_steps=5, total_steps=10))
        return Path("runs/a-run")

    monkeypatch.setattr("millrace.launch.training.train", train)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    return calls


# ------------------------------------------------------------------------------------------------- bad usage of flags


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        (["trian"], "unknown command trian; did you mean train?"),
        (["export"], "unknown command export; docs/how-to/policies.md shows how to export a policy, for example as ONNX"),
        (["fly"], "unknown command fly; millrace --help lists them"),
        (["train"], "which environment? expected one that gymnasium.make takes, as in: millrace train CartPole-v1"),
        (
            ["train", "CartPole-v1", "--learning-rat", "1e-3"],
            "train: unknown flag --learning-rat; did you mean --learning-rate?",
        ),
        (["train", "--worker", "3", "CartPole-v1"], "train: unknown flag --worker; did you mean --workers?"),
        (["train", "CartPole-v1", "--zzz"], "train: unknown flag --zzz"),
        (
            ["train", "CartPole-v1", "--algo", "reinforce", "--core", "lstm"],
            f"train: unknown flag --core{algorithms_with('core')}",
        ),
        (["train", "--env", "CartPole-v1"], "train: ENV has no flag; expected it as in: millrace train ENV"),
        (["train", "CartPole-v1", "more"], "train: unexpected argument more"),
        (["evaluate", "runs/a", "runs/b", "runs/c"], "evaluate: expected one run, got 3; name one of them"),
        (["record", "runs/a", "runs/b", "--out", "x"], "record: expected one run, got 2; name one of them"),
        (["status", "runs/a", "runs/b", "runs/c", "--json"], "status: expected one run, got 3; name one of them"),
        (["presets", "a"], "presets: unexpected argument a"),
        (["train", "CartPole-v1", "--workers", "0"], "--workers: expected int >= 1, got 0"),
        (["train", "CartPole-v1", "--workers", "two"], '--workers: expected int or "none", got two'),
        (["train", "CartPole-v1", "--learning-rate", "x y"], "--learning-rate: expected float, got 'x y'"),
        (["train", "CartPole-v1", "--transport", "udp"], "--transport: expected one of inproc, ipc, tcp, got udp"),
        (["train", "CartPole-v1", "--core", "rnn"], "--core: expected one of lstm, gru, none, got rnn"),
        (["train", "CartPole-v1", "--net", "64", "x"], "--net: expected int, got 64 x"),
        (
            ["train", "CartPole-v1", "--env-kwargs", "a"],
            "--env-kwargs: expected NAME VALUE NAME VALUE ..., got a; "
            "a text that begins with a dash is written in quotes: a '\"-x\"'",
        ),
        (
            ["train", "CartPole-v1", "--shared-net=1"],
            "train: --shared-net=1: expected --shared-net or --no-shared-net",
        ),
        (["worker", "ipc://x", "--proceses", "2"], "worker: unknown flag --proceses; did you mean --processes?"),
        (["conform", "--copies", "0"], "--copies: expected int >= 1, got 0"),
        (["train", "CartPole-v1", "--envs", "6"], "6 envs cannot be shared evenly among 4 lanes; take 4 or 8, or 3 lanes"),
        (["train", "CartPole-v1", "--algo", "pp0"], f"algo pp0: expected one of {ALGORITHMS}; did you mean ppo?"),
        (
            ["train", "CartPole-v1", "--preset", "CartPole"],
            "preset CartPole: ppo has none of this name; did you mean CartPole-v1?",
        ),
        (
            ["train", "--preset", "cartpole-dqn", "--algo", "ppo"],
            f"preset cartpole-dqn: unknown setting n_step{algorithms_with('n_step')}",
        ),
        (["train", "--config", "/no.toml"], "config file /no.toml cannot be read: No such file or directory"),
        (["plot"], "plot: which runs? expected run folders, as in: millrace plot runs/*"),
        (["plot", "/no"], "run /no: no such folder"),
        (["report"], "report: which runs? expected run folders, as in: millrace report runs/*"),
        (["report", "/no"], "run /no: no such folder"),
        (["record", "/no", "--out", "cartpole/expert-v0"], "run /no: no such folder"),
        (["record", "/no", "--out", "cartpole/expert-v0", "--steps", "0"], "--steps: expected int >= 1, got 0"),
        (["record", "/no", "--out", "cartpole/expert-v0", "--seed", "-1"], "--seed: expected int >= 0, got -1"),
        (
            ["record", "/no", "--out", "cartpole/expert-v0", "--step", "9"],
            "record: unknown flag --step; did you mean --steps?",
        ),
        (["evaluate", "/no", "--episodes", "0"], "--episodes: expected int >= 1, got 0"),
        (["evaluate", "/no", "--video"], "run /no: no such folder"),
        (["evaluate", "/no"], "run /no: no such folder"),
        (["evaluate", "/no", "--episode", "3"], "evaluate: unknown flag --episode; did you mean --episodes?"),
        (["keys"], "keys: which command? expected one of new, show, allow, revoke"),
        (["keys", "nw"], "keys nw: no such command; did you mean new?; expected one of new, show, allow, revoke"),
        (["keys", "show", "--key", "x"], "keys show: unknown flag --key; did you mean --keys?"),
        (
            ["learner", "CartPole-v1", "--bind", "tcp://::1:5555"],
            "address tcp://::1:5555: expected an IPv6 address in brackets, as in tcp://[::1]:5555",
        ),
        (
            ["learner", "CartPole-v1", "--advertise", "tcp://host:5555"],
            "advertise tcp://host:5555: expected a host name or an IP address, without a port",
        ),
    ],
)
def test_bad_usage_is_one_exact_line(asked: list[Any], capsys: Captured, argv: list[str], says: str) -> None:
    assert refusal(capsys, *argv) == says
    assert not asked
    assert not list(Path.cwd().iterdir())


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        (["train", "CartPole-v1", "--seed"], "expected --seed INT, got no value"),
        (["train", "CartPole-v1", "--seed", "--workers", "2"], "expected --seed INT, got no value"),
        (["evaluate"], "missing: RUN"),
        (["record", "runs/a"], "missing: --out"),
        (["record"], "missing: RUN, --out"),
        (["worker"], "missing: ADDRESS"),
    ],
)
def test_what_is_missing_is_named(asked: list[Any], capsys: Captured, argv: list[str], says: str) -> None:
    assert refusal(capsys, *argv) == f"{argv[0]}: {says}; millrace {argv[0]} --help tells more"
    assert not asked


def test_an_unknown_key_names_its_file(asked: list[Any], capsys: Captured) -> None:
    Path("my.toml").write_text("[ppo]\nlearning_rat = 1e-3\n")
    line = refusal(capsys, "train", "CartPole-v1", "--config", "my.toml")
    assert line == "my.toml: unknown setting learning_rat; did you mean learning_rate?"


# ------------------------------------------------------------------------------- bad environments, folders, checkpoints


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        (["NoSuch-v0"], "environment NoSuch-v0 is not registered"),
        (["no_such_module_of_mine:Env-v0"], "no_such_module_of_mine"),
        (["CartPole-v1", "--env-kwargs", "gravitas", "3"], "gravitas"),
        pytest.param(["ALE/Pong-v5"], "ALE/Pong-v5", marks=pytest.mark.skipif(bool(find_spec("ale_py")), reason="is here")),
        pytest.param(["CarRacing-v3"], "box2d", marks=pytest.mark.skipif(bool(find_spec("Box2D")), reason="is here")),
    ],
)
def test_an_environment_that_cannot_be_made_leaves_no_folder(
    tmp_path: Path, capsys: Captured, argv: list[str], says: str
) -> None:
    line = refusal(capsys, "train", *argv, "--run-dir", str(tmp_path / "runs"))
    assert says in line
    assert not (tmp_path / "runs").exists()


def test_an_environment_that_is_not_for_the_algorithm_leaves_no_folder_and_no_worker(
    tmp_path: Path, capsys: Captured
) -> None:
    line = refusal(capsys, "train", "Pendulum-v1", "--algo", "dqn", "--run-dir", str(tmp_path / "mine" / "runs"))
    assert "dqn" in line.lower()
    assert not (tmp_path / "mine").exists()  # the workers were started before this was known: see conftest.py


def test_a_resume_with_other_fixed_settings_is_one_line_and_changes_nothing(tmp_path: Path, capsys: Captured) -> None:
    run = RunFolder.create(resolve("CartPole-v1", run_dir=str(tmp_path))).path
    before = {file.name: file.read_bytes() for file in run.iterdir()}
    for flags, says in (
        (["--algo", "a2c"], "algo: expected ppo as in its config.toml, got a2c"),
        (["--activation", "relu"], "activation: expected tanh as in its config.toml, got relu"),
        (["--seed", "5"], "seed: expected 1 as in its config.toml, got 5"),
    ):
        for command in ("train", "learner"):
            line = refusal(capsys, command, "--resume", str(run), *flags)
            assert f"run {run}: {says}; a run keeps this setting: resume it without the setting, or start a new run" in line
    assert {file.name: file.read_bytes() for file in run.iterdir()} == before


def test_a_broken_checkpoint_is_not_resumed(tmp_path: Path, capsys: Captured) -> None:
    run = RunFolder.create(resolve("CartPole-v1", run_dir=str(tmp_path))).path
    line = refusal(capsys, "train", "--resume", str(run), exit_code=1)
    assert "expected a checkpoint in checkpoints/, got none" in line
    checkpoint.save(run, {}, 100, keep=3).write_bytes(b"PK broken")
    line = refusal(capsys, "train", "--resume", str(run), exit_code=1)
    assert "expected a whole checkpoint, got 1 broken" in line
    assert "run /nowhere: expected a run folder" in refusal(capsys, "train", "--resume", "/nowhere")


# --------------------------------------------------------------------------------------------------------- good usage


@pytest.mark.parametrize("final", [100, 250])
def test_the_end_of_a_run_names_its_best_policy_unless_it_is_the_final_one(
    final: int, asked: list[Any], capsys: Captured
) -> None:
    found = Evaluation(episodes=2, return_mean=9.5, return_std=0.5, length_mean=9.5)
    Path("runs/a-run").mkdir(parents=True)
    RunFolder(Path("runs/a-run")).write_summary(
        Summary(
            env="CartPole-v1", algo="ppo", seed=1, env_steps=final, updates=1, wall_s=0.5, env_steps_per_s=20.0,
            stop_reason="all steps done", return_mean_100=None, evaluation=found,
            best=Best(env_steps=100, chosen_by=11.0, evaluation=found),
        )
    )  # fmt: skip
    assert main(["train", "CartPole-v1"]) == 0
    named = ["best policy, after 100 env steps: greedy return 9.5 ± 0.5 over 2 episodes"] if final != 100 else []
    assert capsys.readouterr().out.splitlines()[-5 - len(named) :] == [
        "greedy return 9.5 ± 0.5 over 2 episodes", *named, "next:", "  millrace dashboard runs/a-run",
        "  millrace evaluate runs/a-run", f"  millrace train --resume runs/a-run --steps {2 * final}",
    ]  # fmt: skip


def test_the_next_commands_are_for_a_shell_and_more_steps_for_a_run_that_made_all() -> None:
    ended = Summary(
        env="E", algo="ppo", seed=1, env_steps=29_996, updates=1, wall_s=0.5, env_steps_per_s=20.0,
        stop_reason="all steps done", return_mean_100=None, evaluation=None,
    )  # fmt: skip
    commands = next_commands(Path("my runs/a"), ended, "learner")
    assert commands[1] == "  millrace dashboard 'my runs/a'"
    assert commands[-1] == "  millrace learner --resume 'my runs/a' --steps 60000"
    assert len(next_commands(Path("a"), replace(ended, stop_reason="target return 9 reached"), "train")) == 3


@pytest.mark.parametrize(
    ("reason", "ended_by", "said"),
    [
        ("all steps done", None, ""),
        ("target return 9 reached", 9.5, ", on other episodes than those that ended the run"),
        ("target return 9 reached by the policy of 50 env steps", 9.5, ""),
    ],
)
def test_the_end_of_a_run_says_if_the_final_policy_was_evaluated_again(
    reason: str, ended_by: float | None, said: str
) -> None:
    found = Evaluation(episodes=2, return_mean=9.0, return_std=0.5, length_mean=9.5)
    ended = Summary(
        env="E", algo="ppo", seed=1, env_steps=100, updates=1, wall_s=0.5, env_steps_per_s=20.0,
        stop_reason=reason, return_mean_100=None, evaluation=found, ended_by=ended_by,
    )  # fmt: skip
    assert result(ended)[1] == f"greedy return 9.0 ± 0.5 over 2 episodes{said}"


@pytest.mark.parametrize("flag", ["--log-json", "--log_json"])
def test_for_programs_the_last_line_is_the_run_folder(asked: list[Any], capsys: Captured, flag: str) -> None:
    assert main(["train", "CartPole-v1", flag]) == 0
    assert capsys.readouterr().out == "run folder: runs/a-run\n"


def test_flags_stand_above_the_file_and_the_preset(asked: list[Any], capsys: Captured) -> None:
    Path("my.toml").write_text('env = "CartPole-v1"\nseed = 7\n[ppo]\ngamma = 0.5\nnet = [8]\n[env_kwargs]\na = 1\nb = 1\n')
    argv = "--config my.toml --net 32 16 --target-return -150 --no-normalize-advantage --env-kwargs b 2.5 c true --workers 3"
    assert main(["train", *argv.split()]) == 0
    assert capsys.readouterr().out.splitlines()[-2:] == [
        "  millrace dashboard runs/a-run",
        "  millrace evaluate runs/a-run",
    ]
    ((config, resume, _),) = asked
    assert resume is None
    assert config == resolve(
        "CartPole-v1", seed=7, gamma=0.5, net=(32, 16), target_return=-150.0, normalize_advantage=False, workers=3,
        env_kwargs={"a": 1, "b": 2.5, "c": True},
    )  # fmt: skip
    assert config.algorithm.gae_lambda == 0.8  # of the preset


def test_the_environment_may_stand_anywhere_among_the_flags(asked: list[Any]) -> None:
    assert main(["train", "--workers", "3", "Pendulum-v1", "--seed", "4"]) == 0
    assert asked[0][0] == resolve("Pendulum-v1", workers=3, seed=4)


@pytest.mark.parametrize(
    "argv",
    [
        ["--algo", "a2c", "--optimizer", "adam", "CartPole-v1"],
        ["CartPole-v1", "--algo", "a2c", "--optimizer", "adam"],
        ["--config", "my.toml", "--optimizer", "adam"],
    ],
)
def test_the_value_of_an_algorithms_own_flag_is_not_the_environment(asked: list[Any], argv: list[str]) -> None:
    Path("my.toml").write_text('env = "CartPole-v1"\nalgo = "a2c"\n')
    assert main(["train", *argv]) == 0
    assert asked[0][0] == resolve("CartPole-v1", algo="a2c", optimizer="adam")


def test_a_named_run_takes_its_algorithms_own_flags(asked: list[Any]) -> None:
    assert main(["train", "--preset", "cartpole-dqn", "--target-every", "9", "--tau", "0.5"]) == 0
    assert asked[0][0] == resolve(preset="cartpole-dqn", target_every=9, tau=0.5)


def test_a_resumed_run_reads_its_own_file(asked: list[Any], capsys: Captured) -> None:
    run = RunFolder.create(resolve("CartPole-v1", gamma=0.5)).path
    assert main(["train", "--resume", str(run), "--steps", "9"]) == 0
    config, resume, _ = asked[0]
    assert (config, resume) == (resolve("CartPole-v1", gamma=0.5, steps=9), run)
    capsys.readouterr()
    assert "is of CartPole-v1, not of Pendulum-v1" in refusal(capsys, "train", "Pendulum-v1", "--resume", str(run))


def test_the_python_face_takes_the_same_names(asked: list[Any]) -> None:
    seen: list[Progress] = []
    assert millrace.train("CartPole-v1", seed=3, learning_rate=1e-4, callbacks=[seen.append]).path == Path("runs/a-run")
    assert asked == [(resolve("CartPole-v1", seed=3, learning_rate=1e-4), None, None)]
    assert [progress.env_steps for progress in seen] == [5]


def test_the_python_face_takes_a_callable(asked: list[Any]) -> None:
    def my_env() -> None: ...

    millrace.train(my_env, workers=1)
    ((config, _, factory),) = asked
    assert (config.env, config.workers) == ("<my_env>", 1)
    assert (factory.id, factory.wrappers) == ("<my_env>", ())


# ------------------------------------------------------------------------------------------------ how a run can go wrong


def failing(monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    def train(*_: Any, **__: Any) -> Path:
        raise error

    monkeypatch.setattr("millrace.launch.training.train", train)


def test_errors_of_ours_are_one_line_with_their_exit_code(capsys: Captured, monkeypatch: pytest.MonkeyPatch) -> None:
    failing(monkeypatch, NoWorkers("nobody has been here for 60 s"))
    assert refusal(capsys, "train", "CartPole-v1", exit_code=1) == "nobody has been here for 60 s"


def test_the_workers_own_traceback_stands_beneath(capsys: Captured, monkeypatch: pytest.MonkeyPatch) -> None:
    failing(monkeypatch, EnvironmentFailed("lane 2 raised too often", "Traceback of worker w1:\n  step\nKeyError: 3\n"))
    assert main(["train", "CartPole-v1"]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["millrace: lane 2 raised too often", "    Traceback of worker w1:", "      step", "    KeyError: 3"]


def test_a_command_without_errors_takes_debug_too(capsys: Captured) -> None:
    assert main(["presets", "--debug"]) == 0
    assert "--preset cartpole-dqn" in capsys.readouterr().out


@pytest.mark.parametrize("flag", ["--run-dir", "--resume"])
def test_a_path_that_is_too_long_is_bad_usage(capsys: Captured, flag: str) -> None:
    path = "x" * 300
    words = ["CartPole-v1", flag, path] if flag == "--run-dir" else [flag, path]
    line = refusal(capsys, "train", *words)
    assert line.startswith(f"path {path}")
    assert line.endswith(": File name too long; choose a shorter one")


def test_an_error_in_millrace_hides_its_traceback_until_asked(capsys: Captured, monkeypatch: pytest.MonkeyPatch) -> None:
    failing(monkeypatch, ZeroDivisionError("division\nby zero"))
    line = refusal(capsys, "train", "CartPole-v1", exit_code=1)
    assert line == "internal error: ZeroDivisionError: division; --debug shows the traceback"
    for argv in (["train", "CartPole-v1", "--debug"], ["--debug", "train", "CartPole-v1"]):
        assert main(argv) == 1
        lines = capsys.readouterr().err.splitlines()
        assert lines[:2] == ["millrace: internal error: ZeroDivisionError: division", "Traceback (most recent call last):"]


def test_an_interrupted_run_says_how_to_go_on(tmp_path: Path, capsys: Captured, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine").mkdir()
    failing(monkeypatch, Interrupted(Path("mine")))
    write_format(Path("mine"))
    line = refusal(capsys, "train", "CartPole-v1", exit_code=130)
    assert line == "interrupted; continue with: millrace train --resume mine"
    write_format(Path("mine"), workers_elsewhere=True)
    line = refusal(capsys, "learner", "CartPole-v1", exit_code=130)
    assert line == "interrupted; continue with: millrace learner --resume mine", "`train` would start workers of its own"
    failing(monkeypatch, KeyboardInterrupt())
    assert refusal(capsys, "train", "CartPole-v1", exit_code=130) == "interrupted"


@pytest.mark.parametrize("command", ["train", "learner"])
def test_a_signal_after_training_says_that_the_run_is_complete(
    command: str, capsys: Captured, monkeypatch: pytest.MonkeyPatch
) -> None:
    failing(monkeypatch, Interrupted(Path("runs/mine"), complete=True))
    line = refusal(capsys, command, "CartPole-v1", exit_code=130)
    assert line == "interrupted after training; the run is complete: runs/mine"


# --------------------------------------------------------------------------------------------------------------- keys


def test_keys_are_made_shown_allowed_and_revoked(tmp_path: Path, capsys: Captured) -> None:
    here, there = ["--keys", str(tmp_path / "here")], ["--keys", str(tmp_path / "there")]

    def says(*argv: str) -> list[str]:
        assert main(["keys", *argv]) == 0
        return capsys.readouterr().out.splitlines()

    assert says("new", "lab", *here)[0] == f"token: {tmp_path}/here/lab.token"
    folder, learner, lab = says("show", *here)
    assert folder == f"key folder: {tmp_path}/here"
    assert re.fullmatch(r"learner: [0-9a-f]{64}", learner)
    assert re.fullmatch(r"lab  [0-9a-f]{64}  made \d{4}-\d\d-\d\d \d\d:\d\d  may connect", lab)

    _, allow = says("new", "home", "--server", learner.split()[1], *there)
    advice = allow.removeprefix("on the learner's machine: millrace ").split()
    assert advice[:2] == ["keys", "allow"]
    assert says(*advice[1:], *here) == ["home may connect"]

    assert "is revoked" in says("revoke", "lab", *here)[0]
    shown = says("show", *here)
    assert re.search(r"^lab .* revoked \d{4}", shown[2])
    assert re.search(r"^home .* may connect$", shown[3])
    line = refusal(capsys, "keys", "revoke", "lab", *here)
    assert line == "key lab: it is revoked already; those that may connect: home"
    assert "expected a public key of 64 hexadecimal digits, got 1 characters" in refusal(
        capsys, "keys", "allow", "x", "y", *here
    )

    secrets = [
        (tmp_path / "here" / "server.key").read_text().strip(),
        (tmp_path / "there" / "home.token").read_text().strip(),
    ]
    assert not [secret for secret in secrets for line in (*shown, allow) if secret in line]


def test_a_token_is_printed_only_when_asked_for(tmp_path: Path, capsys: Captured) -> None:
    assert main(["keys", "new", "quiet", "--keys", str(tmp_path / "k")]) == 0
    assert "millrace1." not in capsys.readouterr().out
    assert main(["keys", "new", "loud", "--print-token", "--keys", str(tmp_path / "k")]) == 0
    assert capsys.readouterr().out == (tmp_path / "k" / "loud.token").read_text()


def worker_says(capsys: Captured, *argv: str) -> str:
    """A worker's one line before it has connected anywhere."""
    assert main(["worker", *argv]) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    return err


def test_a_worker_without_a_token_does_not_go_to_another_machine(tmp_path: Path, capsys: Captured) -> None:
    assert "expected --token FILE (or MILLRACE_TOKEN)" in worker_says(capsys, "tcp://192.0.2.1:5555")
    (tmp_path / "open.token").touch(mode=0o644)
    (tmp_path / "open.token").chmod(0o644)
    line = worker_says(capsys, "tcp://192.0.2.1:5555", "--token", str(tmp_path / "open.token"))
    assert "can be read by others (mode 0644); chmod 600" in line
    (tmp_path / "open.token").chmod(0o600)
    assert "is empty" in worker_says(capsys, "tcp://192.0.2.1:5555", "--token", str(tmp_path / "open.token"))
    assert "got the token itself" in worker_says(capsys, "tcp://192.0.2.1:5555", "--token", "millrace1.abc")


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (["--name", "\udcff"], r"worker name '\udcff': expected 1 to 200 bytes without control characters, got 1 bytes"),
        (["--name", "x" * 198, "--processes", "2"], "expected 1 to 200 bytes without control characters, got 201 bytes"),
        (["--core", "-1"], "core: expected one that this process may use, of ["),
        (["--join-timeout-s", "-5"], "--join-timeout-s: expected float >= 0.0, got -5"),
        (["--join-timeout-s", "nan"], "--join-timeout-s: expected float >= 0.0, got nan"),
        (["--processes", "0"], "processes: expected int >= 1, got 0"),
        (["inproc://x"], "address inproc://x: expected ipc://PATH or tcp://HOST:PORT; inproc reaches no other process"),
    ],
)
def test_a_flag_that_no_worker_can_follow_is_refused_before_one_starts(
    flags: list[str], expected: str, capsys: Captured
) -> None:
    assert expected in worker_says(capsys, *(flags if flags[0][:2] != "--" else ["ipc:///nobody/listens/here", *flags]))


def test_a_command_runs_in_a_folder_that_was_deleted(
    tmp_path: Path, capsys: Captured, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("millrace ")


@pytest.mark.parametrize("seconds", ["-1", "0", "nan"])
def test_a_status_needs_time_for_the_answer(capsys: Captured, seconds: str) -> None:
    says = refusal(capsys, "status", "tcp://127.0.0.1:5", "--timeout-s", seconds)
    assert says == f"--timeout-s: expected float > 0.0, got {seconds}"


# ------------------------------------------------------------------------------------------------- evaluate, plot, help


def a_run_that_acts(tmp_path: Path, env_id: str = "CartPole-v1", info_keys: tuple[str, ...] = ()) -> Path:
    """Its policy is all zeros: always left, in CartPole, where it falls after nine steps."""
    run = RunFolder.create(resolve(env_id, run_dir=str(tmp_path)))
    env = EnvSpec(env_id)
    made = env.make()
    spec = PolicySpec(observation_leaves(made.observation_space), action_spec(made.action_space), net=(4,))
    run.write_policy(
        policy_run(spec, env, info_keys=info_keys), np.zeros(acting_size(spec), np.float32), np.zeros(0, np.float32)
    )
    return run.path


def test_evaluate_says_mean_and_deviation(tmp_path: Path, capsys: Captured) -> None:
    run = a_run_that_acts(tmp_path)
    assert main(["evaluate", str(run), "--episodes", "30"]) == 0
    first = capsys.readouterr().out
    assert re.fullmatch(r"return 9\.\d ± 0\.\d over 30 episodes\n", first)
    assert main(["evaluate", str(run), "--episodes", "30", "--seed", "1000000"]) == 0
    assert capsys.readouterr().out == first
    assert main(["evaluate", str(run)]) == 0
    assert "over 100 episodes" in capsys.readouterr().out
    assert not (run / "videos").exists()


def test_evaluate_gives_up_after_the_number_of_failures_that_its_flag_says(tmp_path: Path, capsys: Captured) -> None:
    run = a_run_that_acts(tmp_path, "tests.support.envs.toy:Raises-v0")
    options = ("--transport", "inproc", "--workers", "1", "--max-env-failures", "0")
    assert main(["evaluate", str(run), *options]) == 1
    assert "; failure 1 in a row; max_env_failures allows 0 in a row" in capsys.readouterr().err


def test_a_run_without_a_best_policy_is_told_how_one_is_kept(tmp_path: Path, capsys: Captured) -> None:
    run = a_run_that_acts(tmp_path)
    why = "expected the best policy, best.safetensors, got none; only a run with eval_every has one: take the final policy"
    assert refusal(capsys, "evaluate", str(run), "--best") == f"run {run}: {why}"


@pytest.mark.rest
def test_evaluate_films_a_few_episodes(tmp_path: Path, capsys: Captured) -> None:
    run = a_run_that_acts(tmp_path)
    for _ in range(2):  # the same films, over again
        assert main(["evaluate", str(run), "--video", "--episodes", "2", "--seed", "7"]) == 0
        said, *films = capsys.readouterr().out.splitlines()
        assert re.fullmatch(r"return \d+\.\d ± \d\.\d over 2 episodes", said)
        assert films == [f"{run}/videos/seed-7-episode-{i}.mp4" for i in range(2)]
        assert sorted(path.name for path in (run / "videos").iterdir()) == [Path(film).name for film in films]
    assert all(b"ftyp" in Path(film).read_bytes()[:12] for film in films)
    run = a_run_that_acts(tmp_path, info_keys=("score",))
    assert main(["evaluate", str(run), "--video", "--episodes", "2", "--max-steps", "11"]) == 0
    said, *_ = capsys.readouterr().out.splitlines()
    assert said == "return 5.0 ± 0.0 over 2 episodes, 2 of them cut short, score missing"


def test_the_films_are_of_the_first_episodes_that_are_evaluated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    played: list[int] = []
    play = PolicyPlayer.play

    def noted(self: PolicyPlayer, plan: EvaluationPlan, *rest: Any, **more: Any) -> Any:
        played.extend(plan.seeds)
        return play(self, plan, *rest, **more)

    monkeypatch.setattr(PolicyPlayer, "play", noted)
    run, options = str(a_run_that_acts(tmp_path)), ("--seed", "7", "--transport", "inproc", "--workers", "1")
    assert main(["evaluate", run, "--video", "--episodes", "3", *options]) == 0
    filmed = played.copy()
    played.clear()
    assert main(["evaluate", run, "--episodes", "5", *options]) == 0
    assert len(set(played)) == 5
    assert filmed == played[:3]


def test_what_cannot_be_filmed_is_said(tmp_path: Path, capsys: Captured, monkeypatch: pytest.MonkeyPatch) -> None:
    run = a_run_that_acts(tmp_path, "millrace-tests/Blind-v0")
    line = refusal(capsys, "evaluate", str(run), "--video", "--transport", "inproc")
    assert line == "environment millrace-tests/Blind-v0 cannot be filmed: expected it to render rgb_array, got ['ansi']"
    assert not (run / "videos").exists()
    monkeypatch.setattr("gymnasium.envs.classic_control.cartpole.CartPoleEnv.render", no_pygame)
    line = refusal(capsys, "evaluate", str(a_run_that_acts(tmp_path)), "--video", "--transport", "inproc")
    assert line == "environment CartPole-v1 cannot be filmed: pygame is not installed; pip install moviepy pygame-ce"
    monkeypatch.setitem(sys.modules, "moviepy", None)
    line = refusal(capsys, "evaluate", str(run), "--video", "--transport", "inproc")
    assert line == "videos need moviepy; pip install moviepy pygame-ce"


def test_what_a_worker_says_cannot_control_the_terminal(capsys: Captured, monkeypatch: pytest.MonkeyPatch) -> None:
    def train(*_: Any, **__: Any) -> Path:
        raise EnvironmentFailed("got \x1b[31mred\u202e", "its\x1b[2Jtraceback")

    monkeypatch.setattr("millrace.launch.training.train", train)
    assert main(["train", "CartPole-v1"]) == 1
    said = capsys.readouterr().err
    assert "got \\x1b[31mred\\u202e" in said
    assert "\x1b" not in said


def no_pygame(*_: Any) -> None:
    raise gymnasium.error.DependencyNotInstalled("pygame is not installed")


class Blind(gymnasium.Env[Any, Any]):
    """Has no pictures."""

    metadata = {"render_modes": ["ansi"]}
    observation_space = gymnasium.spaces.Discrete(2)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode


gymnasium.register("millrace-tests/Blind-v0", entry_point=lambda **kwargs: Blind(**kwargs))


def test_record_says_what_stands_in_the_dataset(tmp_path: Path, capsys: Captured, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    run, rows = a_run_that_acts(tmp_path), tmp_path / "rows.npy"
    flags = ["--out", "cartpole/left-v0", "--steps", "50", "--npy", str(rows)]
    assert main(["record", str(run), *flags]) == 0
    first, second = capsys.readouterr().out.splitlines()
    said = re.fullmatch(r"dataset cartpole/left-v0: (\d+) steps, 6 episodes, return 9\.\d ± 0\.\d", first)
    assert said is not None
    assert second == f"rows of observation and action: {rows}"
    assert np.load(rows, allow_pickle=False).shape == (int(said[1]), 5)
    assert (tmp_path / "datasets" / "cartpole" / "left-v0" / "data" / "main_data.hdf5").is_file()
    assert "dataset cartpole/left-v0 is there already" in refusal(capsys, "record", str(run), *flags)


def test_report_writes_into_the_run_folder_or_where_it_is_told(tmp_path: Path, capsys: Captured) -> None:
    run = RunFolder.create(resolve("CartPole-v1", run_dir=str(tmp_path))).path
    MetricsLog(run).close()
    assert main(["report", str(run)]) == 0
    assert capsys.readouterr().out == f"{run}/report.html\n"
    assert (run / "report.html").read_text().startswith("<!doctype html>")
    assert main(["report", str(run), "--out", str(tmp_path / "both.html")]) == 0
    assert (tmp_path / "both.html").read_bytes() == (run / "report.html").read_bytes()


def test_plot_draws_into_the_run_folder_or_where_it_is_told(tmp_path: Path, capsys: Captured) -> None:
    run = RunFolder.create(resolve("CartPole-v1", run_dir=str(tmp_path))).path
    log = MetricsLog(run)
    for steps in (100, 200):
        log.write(Progress(env_steps=steps, return_mean=float(steps)), {})
    log.close()
    assert main(["plot", str(run)]) == 0
    assert capsys.readouterr().out == f"{run}/curves.svg\n"
    assert (run / "curves.svg").read_text().startswith("<svg ")
    assert main(["plot", str(run), str(run), "--out", str(tmp_path / "both.png")]) == 0
    assert (tmp_path / "both.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "both.png").stat().st_size > 10_000


def test_the_overview_lists_what_there_is(capsys: Captured) -> None:
    assert main(["--help"]) == 0
    out = capsys.readouterr().out
    assert all(f"millrace {name} " in out for name in COMMANDS)
    assert main([]) == 0
    assert capsys.readouterr().out == out


def test_what_evaluate_and_record_have_in_common_is_declared_once() -> None:
    """`seed` has another default in each."""
    both = set(EvaluateFlags.__struct_fields__) & set(RecordFlags.__struct_fields__)
    assert both == {*PlayFlags.__struct_fields__, "seed"}
    assert issubclass(EvaluateFlags, PlayFlags)
    assert issubclass(RecordFlags, PlayFlags)


def test_the_help_is_the_text_under_each_field_with_the_presets_defaults(capsys: Captured) -> None:
    for argv in (["train", "CartPole-v1", "--help"], ["train", "--help"]):
        with pytest.raises(SystemExit) as stop:
            main(argv)
        assert stop.value.code == 0
    both = " ".join(capsys.readouterr().out.split())
    assert "--gae-lambda FLOAT λ of generalized advantage estimation" in both
    assert both.count("(default: 0.8)") == 1  # of the preset, once the environment is named
    assert both.count("[ENV] Environment id for gymnasium.make") == 2
    assert both.count("(default: CartPole-v1)") == 1
    assert "--env " not in both


ALL_COMMANDS = [
    *COMMANDS,
    *(f"keys {name}" for name in ("new", "show", "allow", "revoke")),
    *(f"launch {name}" for name in ("kubernetes", "slurm", "ray")),
]


def test_every_command_has_help_that_begins_with_its_usage_and_imports_no_torch() -> None:
    asks = (
        "import sys; from millrace.cli.main import main\n"
        "for command in sys.argv[1:]:\n"
        "    try: code = main([*command.split(), '--help'])\n"
        "    except SystemExit as stop: code = stop.code\n"
        "    print(f'\\0{code}', 'torch' in sys.modules, end='\\0')"
    )
    done = subprocess.run(
        [sys.executable, "-c", asks, *ALL_COMMANDS],
        cwd=ROOT, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    *said, last = done.stdout.split("\0")
    assert last == ""
    for command, text, how in zip(ALL_COMMANDS, said[::2], said[1::2], strict=True):
        assert text.startswith(f"usage: millrace {command}")
        assert how == "0 False", f"{command}: exit code, and whether torch is imported"


def test_a_reader_that_goes_away_is_no_error() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing) as pipe:
        command = [sys.executable, "-m", "millrace", "--help"]
        done = subprocess.run(command, cwd=ROOT, stdout=pipe, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (1, "")


def test_help_answers_at_once() -> None:
    """Less than 0.3 s on a quiet machine; a busy one gets more, and torch alone would take longer."""
    took_s = []
    for _ in range(3):
        began_s = time.monotonic()
        done = subprocess.run(
            [sys.executable, "-X", "importtime", "-m", "millrace", "--help"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=False,
        )
        took_s.append(time.monotonic() - began_s)
        assert done.returncode == 0
        assert not re.search(r"\| +(torch|numpy|gymnasium|rich|argparse)$", done.stderr, re.M)
    assert min(took_s) < 0.3 + 0.1 * os.getloadavg()[0]


def test_an_encoder_does_not_travel_over_tcp_without_keys(capsys: Captured, tmp_path: Path) -> None:
    argv = ("--encoder", "mine:encoder", "--transport", "tcp", "--run-dir", str(tmp_path / "runs"))
    assert "an encoder is code: it travels over ipc" in refusal(capsys, "train", "CartPole-v1", *argv)
    assert not (tmp_path / "runs").exists()


def test_modules_of_the_users_own_are_found_where_the_command_is_given(tmp_path: Path) -> None:
    """An environment and an encoder that lie in the working directory, which an installed command does not search."""
    (tmp_path / "mine.py").write_text(
        "import gymnasium, torch\n"
        "from gymnasium.envs.classic_control import CartPoleEnv\n"
        "gymnasium.register('Mine-v0', CartPoleEnv, max_episode_steps=20)\n"
        "def encoder(features, images):\n    return torch.nn.Linear(features, 8)\n"
    )
    argv = ["train", "mine:Mine-v0", "--encoder", "mine:encoder", "--steps", "300", "--workers", "1", "--eval-episodes", "1"]
    root = Path(__file__).parents[3]
    found = subprocess.run(
        [sys.executable, "-P", "-m", "millrace", *argv],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(root)}, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert found.returncode == 0, found.stderr
    assert "all steps done" in found.stdout
