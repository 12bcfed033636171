"""The configuration: its layers in order, its one-line refusals, its file."""

import math
import os
from pathlib import Path
from typing import Any

import msgspec
import pytest

from millrace.learner.algorithms import algorithm_class
from millrace.learner.config.command_line import read_config
from millrace.learner.config.config import Config
from millrace.learner.config.hyperparameters import HYPERPARAMETERS, PPOConfig, algorithms_with
from millrace.learner.config.layers import config_from_toml, resolve
from millrace.learner.config.presets import PRESETS, named_presets
from millrace.learner.config.validation import check_copies, unused_setting, workers_to_wait_for
from millrace.learner.run_folder.run_format import write_format
from millrace.protocol.errors import UsageError


def written(folder: Path, text: str) -> Path:
    path = folder / "my.toml"
    path.write_text(text)
    return path


def refusal(env: str = "CartPole-v1", **keywords: Any) -> str:
    with pytest.raises(UsageError) as caught:
        resolve(env, **keywords)
    text = str(caught.value)
    assert "\n" not in text
    return text


def ppo(config: Config) -> PPOConfig:
    assert isinstance(config.algorithm, PPOConfig)
    return config.algorithm


def test_each_layer_overrides_the_one_below(tmp_path: Path) -> None:
    file = written(tmp_path, "seed = 7\nworkers = 5\n[ppo]\ngamma = 0.5\nclip_range = 0.3\n")
    unknown_env = resolve("MountainCar-v0")
    assert unknown_env.algorithm == PPOConfig()
    preset = resolve("CartPole-v1")
    assert (ppo(preset).gae_lambda, preset.algorithm.gamma) == (0.8, 0.98)
    assert ppo(preset).learning_rate_schedule == "linear"
    config = resolve("CartPole-v1", file=file, workers=3, clip_range=0.1)
    assert ppo(config).gae_lambda == 0.8  # preset over default
    assert (config.seed, config.algorithm.gamma) == (7, 0.5)  # file over preset
    assert (config.workers, ppo(config).clip_range) == (3, 0.1)  # keyword over file


def test_a_preset_can_be_left_out_or_borrowed() -> None:
    assert resolve("CartPole-v1", preset="none").algorithm == PPOConfig()
    assert resolve("my.envs:Cart-v0", preset="CartPole-v1").algorithm == resolve("CartPole-v1").algorithm
    assert "did you mean CartPole-v1?" in refusal(preset="CartPole-v0")


def test_the_environment_may_come_from_the_file_or_above_it(tmp_path: Path) -> None:
    file = written(tmp_path, 'env = "Pendulum-v1"\n')
    from_file = resolve(file=file)
    assert from_file.env == "Pendulum-v1"
    assert from_file.algorithm.gamma == 0.9  # the preset follows the environment, wherever its name stands
    assert resolve("CartPole-v1", file=file).algorithm.gamma == 0.98
    assert "which environment?" in refusal("")


@pytest.mark.parametrize("env", ["CartPole-v1", "Pendulum-v1", "MountainCar-v0"])
def test_a_file_repeats_the_run_to_the_letter(tmp_path: Path, env: str) -> None:
    config = resolve(
        env,
        env_kwargs={"a": True, "b": 2, "c": 2.5, "d": 'quo"ted'},
        target_return=-150.5,
        net=[32, 16],
        normalize_observations=True,
        seed=11,
    )
    assert config_from_toml(config.to_toml()) == config
    assert resolve(file=written(tmp_path, config.to_toml())) == config


def test_what_was_unset_over_a_preset_stays_unset(tmp_path: Path) -> None:
    text = resolve("CartPole-v1", target_return=475.0).to_toml()
    assert config_from_toml(text).target_return == 475.0
    assert resolve(file=written(tmp_path, text), target_return=None).target_return is None
    assert resolve(file=written(tmp_path, text.replace("475.0", '"none"'))).target_return is None


@pytest.mark.parametrize("table", ["env_kwargs", "eval_env_kwargs"])
def test_env_kwargs_are_merged(table: str, tmp_path: Path) -> None:
    file = written(tmp_path, f"[{table}]\ng = 9.0\nmode = 'a'\n")
    given: dict[str, Any] = {table: {"g": 1.0}}
    assert getattr(resolve("Pendulum-v1", file=file, **given), table) == {"g": 1.0, "mode": "a"}


def test_the_file_of_a_run_repeats_it_also_where_the_preset_has_more_arguments(tmp_path: Path) -> None:
    run = resolve("millrace/Atari-v0", preset="none", env_kwargs={"game": "Pong"})
    assert resolve(file=written(tmp_path, run.to_toml())) == run
    merged = resolve(file=written(tmp_path, 'env = "millrace/Atari-v0"\n[env_kwargs]\ngame = "Pong"\n'))
    assert merged.env_kwargs["clip_rewards"] is True
    assert merged.env_kwargs["game"] == "Pong"


def test_a_whole_number_may_be_written_in_powers_of_ten(tmp_path: Path) -> None:
    assert resolve("CartPole-v1", steps=1e6).steps == 1_000_000
    assert resolve("CartPole-v1", file=written(tmp_path, "steps = 3e5")).steps == 300_000
    assert resolve("CartPole-v1", file=written(tmp_path, "eval_episodes = 1e2")).eval_episodes == 100  # which may be none
    assert isinstance(resolve("CartPole-v1", target_return=5e2).target_return, float)
    assert ppo(resolve("CartPole-v1", steps="1_000", net="32,1e2")).net == (32, 100)
    assert "steps: expected int" in refusal(steps=1.5)
    assert refusal(net=[64, 0]) == "train: net: expected int >= 1, got [64, 0]"


def test_a_run_that_no_other_worker_can_join_waits_for_no_more_workers_than_it_starts() -> None:
    assert workers_to_wait_for(resolve("CartPole-v1", workers=3), 3) == 3
    assert workers_to_wait_for(resolve("CartPole-v1", workers=3, min_workers=2), 3) == 2
    with pytest.raises(
        UsageError, match=r"^min_workers: expected at most 3, the number .* starts, got 4; take more --workers"
    ):
        workers_to_wait_for(resolve("CartPole-v1", workers=3, min_workers=4), 3)
    assert workers_to_wait_for(resolve("CartPole-v1", workers=3), None) == 1
    assert workers_to_wait_for(resolve("CartPole-v1", workers=3, min_workers=4), None) == 4


def test_a_target_that_no_evaluation_can_reach_is_said() -> None:
    assert unused_setting(resolve("CartPole-v1", preset="none", target_return=475.0)) == (
        "target_return 475 ends no run without evaluations during training; take --eval-every N too"
    )
    assert not unused_setting(resolve("CartPole-v1", preset="none", target_return=475.0, eval_every=100))
    assert not unused_setting(resolve("CartPole-v1", preset="none"))


def test_a_run_that_ends_before_it_learns_is_warned_of() -> None:
    assert unused_setting(resolve("Pendulum-v1", algo="xqc", preset="none", steps=1000, learning_starts=1000)) == (
        "learning_starts 1,000: nothing is learned in the 1,000 env steps of this run; take --learning-starts 100 or more "
        "--steps"
    )
    assert not unused_setting(resolve("Pendulum-v1", algo="xqc", preset="none", steps=1001, learning_starts=1000))


@pytest.mark.parametrize(
    ("keywords", "says"),
    [
        ({"workers": 0}, "workers: expected int >= 1, got 0"),
        ({"workers": "two"}, "workers: expected int or \"none\", got 'two'"),
        ({"steps": 0}, "steps: expected int >= 1, got 0"),
        ({"max_lag": -1}, "max_lag: expected int >= 0, got -1"),
        ({"max_lag": 8192}, "4 lanes with max_lag 8192: expected lanes * (1 + max_lag) of at most 32768, got 32772"),
        ({"envs": 6}, "6 envs cannot be shared evenly among 4 lanes; take 4 or 8, or 3 lanes"),
        ({"envs": 2}, "2 envs cannot be shared evenly among 4 lanes; take 4, or 2 lanes"),
        ({"vector": "native", "restart_episodes": 5}, "vector native: restart_episodes makes single env copies anew"),
        ({"inference": "learner", "max_lag": 0, "restart_episodes": 5}, "restart_episodes: expected 0, got 5"),
        ({"transport": "udp"}, "transport: expected one of inproc, ipc, tcp, got 'udp'"),
        ({"activation": "gelu"}, "activation: expected one of tanh, relu, got 'gelu'"),
        ({"learning_rate": -1.0}, "learning_rate: expected float > 0.0, got -1.0"),
        ({"target_return": "high"}, "target_return: expected float or \"none\", got 'high'"),
        ({"learning_rat": 1.0}, "unknown setting learning_rat; did you mean learning_rate?"),
        ({"algo": "reinforce", "core": "gru"}, f"unknown setting core{algorithms_with('core')}"),
        ({"core": "rnn"}, "core: expected one of lstm, gru, none, got 'rnn'"),
        ({"algo": "pp0"}, "algo pp0: expected one of ppo"),
        ({"seed": 2**64}, "seed: expected int <= 18446744073709551615, got 18446744073709551616"),
        ({"steps": 2**53 + 1}, "steps: expected int <= 9007199254740992, got 9007199254740993"),
        ({"net": (4, 10**30)}, "net: expected int <= 9007199254740992, got [4, 1" + "0" * 30),
        ({"n_epochs": 10**30}, "n_epochs: expected int <= 9007199254740992, got 1" + "0" * 30),
        ({"target_return": math.nan}, "target_return: expected a number, got nan"),
        ({"log_std_init": math.inf}, "log_std_init: expected float <= 20.0, got inf"),
        ({"log_std_init": math.nan}, "log_std_init: expected float >= -20.0, got nan"),
        ({"algo": "sac", "target_entropy": math.nan}, "target_entropy: expected a number, got nan"),
        ({"algo": "sac", "updates_per_step": math.inf}, "updates_per_step: expected float <= 1000000.0, got inf"),
        ({"env": "caf\udce9"}, "env: expected text in UTF-8, got 'caf\\udce9'"),
        ({"env": "Any-v0", "wrappers": ("a:B", "caf\udce9")}, "wrappers: expected text in UTF-8, got 'caf\\udce9'"),
        ({"encoder": "caf\udce9:x"}, "encoder: expected text in UTF-8, got 'caf\\udce9:x'"),
        ({"opponents": Path("caf\udce9")}, "opponents: expected text in UTF-8, got 'caf\\udce9'"),
        ({"bind": "0.0.0.0:5555"}, "address 0.0.0.0:5555: expected inproc://NAME, ipc://PATH or tcp://HOST:PORT"),
        ({"file": Path("/no/such.toml")}, "config file /no/such.toml cannot be read: No such file or directory"),
        ({"file": Path("/dev/zero")}, "config file /dev/zero cannot be read: expected at most 4,194,304 bytes, got more"),
    ],
)
def test_bad_values_are_refused_in_one_line(keywords: dict[str, Any], says: str) -> None:
    assert says in refusal(**keywords)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("stepps = 3", "unknown setting stepps; did you mean steps?"),
        ("[ppo]\nlearning_rat = 3", "unknown setting learning_rat; did you mean learning_rate?"),
        ("learning_rate = 3", "learning_rate is a setting of the algorithm; put it in the table [ppo]"),
        ("[ppo]\nsteps = 3", "steps is a setting of the run; put it above the table [ppo]"),
        ("ppo = 3", "ppo: expected a table, [ppo], got 3"),
        ("seed = -1", "seed: expected int >= 0, got -1"),
        ("env_kwargs = 3", "env_kwargs: expected table, got 3"),
        (
            "[env_kwargs]\nx = [1]",
            "env_kwargs: argument x: expected a number of at most 64 bits, text, True or False, got list [1]",
        ),
        ("algorithm = 3", "unknown setting algorithm; did you mean algo?"),
        ("[algorithm]\ngamma = 0.9", "unknown table [algorithm]; the settings of ppo are in the table [ppo]"),
        ("a =", "is not TOML"),
    ],
)
def test_a_bad_file_is_named(tmp_path: Path, text: str, says: str) -> None:
    file = written(tmp_path, text)
    line = refusal(file=file)
    assert says in line
    assert str(file) in line


def test_the_file_may_be_a_pipe_which_can_be_read_once() -> None:
    """As in `--config <(generate)`."""
    reading, writing = os.pipe()
    os.write(writing, b"env = 'CartPole-v1'\nalgo = 'dqn'\nmax_lag = 2\n[dqn]\nn_step = 3\n")
    os.close(writing)
    config, _ = read_config("train", ["--config", f"/dev/fd/{reading}", "--tau", "0.5"])
    os.close(reading)
    assert config == resolve("CartPole-v1", algo="dqn", max_lag=2, n_step=3, tau=0.5)


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (["--max-lag", "-1"], "--max-lag: expected int >= 0, got -1"),
        (["--seed", str(2**64)], "--seed: expected int <= 18446744073709551615, got 18446744073709551616"),
        (["--config", "FILE"], "FILE: gamma: expected float <= 1.0, got 2"),
        (["--config", "FILE", "--gamma", "0.5"], ""),
    ],
)
def test_what_is_wrong_is_said_of_the_layer_that_counts(tmp_path: Path, flags: list[str], says: str) -> None:
    file = str(written(tmp_path, "[ppo]\ngamma = 2\n"))
    argv = ["CartPole-v1", *(flag.replace("FILE", file) for flag in flags)]
    if not says:
        assert read_config("train", argv)[0].algorithm.gamma == 0.5
        return
    with pytest.raises(UsageError) as caught:
        read_config("train", argv)
    assert str(caught.value) == says.replace("FILE", file)


def test_a_file_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    """Editors of Windows write it."""
    file = tmp_path / "my.toml"
    file.write_text("env = 'CartPole-v1'\nseed = 7\n", "utf-8-sig")
    assert resolve(file=file).seed == 7


def test_a_file_of_bytes_is_not_text(tmp_path: Path) -> None:
    file = tmp_path / "my.toml"
    file.write_bytes(b"\xff\xfe\x00")
    assert f"config file {file} cannot be read: it is not text" in refusal(file=file)


def test_a_layer_may_repair_what_the_one_below_it_would_break(tmp_path: Path) -> None:
    file = written(tmp_path, "lanes = 3\nsteps = 0\n")
    assert resolve("CartPole-v1", file=file, envs=9, steps=5).lanes == 3


def test_what_is_wrong_together_is_said_of_the_file_if_the_file_is_wrong_alone(tmp_path: Path) -> None:
    file = written(tmp_path, "lanes = 3\n")
    says = "8 envs cannot be shared evenly among 3 lanes; take 6 or 9, or 2 lanes"
    assert refusal(file=file) == refusal(file=file, seed=5) == f"{file}: {says}"
    assert refusal(file=file, lanes=5).startswith("8 envs cannot be shared evenly among 5 lanes")
    assert refusal(lanes=3) == says


def test_a_resumed_run_keeps_its_settings_but_for_those_given(tmp_path: Path) -> None:
    config = resolve("CartPole-v1", preset="none", gamma=0.5)
    (tmp_path / "config.toml").write_text(config.to_toml())
    write_format(tmp_path)
    assert resolve(resume=tmp_path) == resolve("CartPole-v1", resume=tmp_path) == config
    assert resolve(resume=tmp_path, steps=5).steps == 5
    assert f"run {tmp_path} is of CartPole-v1, not of Pendulum-v1" in refusal("Pendulum-v1", resume=tmp_path)
    assert "expected one, got both" in refusal(resume=tmp_path, file=tmp_path / "config.toml")
    assert "nowhere: expected a run folder with a config.toml to resume, got none" in refusal(resume=tmp_path / "nowhere")


def test_every_preset_makes_a_configuration_of_its_own() -> None:
    import tomllib

    for algo, presets in tomllib.loads(PRESETS.read_text()).items():
        if algo == "named":
            continue
        assert algo in HYPERPARAMETERS
        for env in presets:
            assert resolve(env, algo=algo) != resolve(env, algo=algo, preset="none")


def test_every_named_preset_is_a_whole_run() -> None:
    assert named_presets()
    for name, preset in named_presets().items():
        config = resolve(preset=name)
        assert (config.env, config.algo) == (preset.settings["env"], preset.settings["algo"])
        assert preset.about


def test_every_algorithm_and_its_settings_are_public() -> None:
    import millrace.algorithms

    for name, record in HYPERPARAMETERS.items():
        assert algorithm_class(name).__name__.lower() == name
        for public in (algorithm_class(name), record):
            assert public.__name__ in millrace.algorithms.__all__
            assert getattr(millrace.algorithms, public.__name__) is public


def test_no_setting_of_an_algorithm_hides_one_of_the_run() -> None:
    """They share the flags' namespace."""
    own = {field.name for field in msgspec.structs.fields(Config)}
    for kind in HYPERPARAMETERS.values():
        assert not own & {field.name for field in msgspec.structs.fields(kind)}


def test_a_replay_buffer_that_holds_no_rollout_is_refused() -> None:
    """Before a run begins, and before one is resumed with larger lanes."""
    fits: dict[str, Any] = {"algo": "dqn", "rollout_steps": 15, "lanes": 2}
    line = refusal(**fits, envs=14, replay_size=100)
    assert line == "replay_size 100: a rollout takes up to 112; take --replay-size 112 or more"
    assert resolve("CartPole-v1", **fits, envs=14, replay_size=112).envs == 14


@pytest.mark.parametrize("table", ["env_kwargs", "eval_env_kwargs"])
def test_arguments_of_the_environment_that_policy_json_cannot_hold_are_refused(table: str) -> None:
    settings: dict[str, Any] = {table: {"limit": float("inf")}}
    with pytest.raises(UsageError, match=f"^{table} limit: expected a finite number, got inf"):
        resolve("CartPole-v1", **settings)


def test_a_limit_of_copies_that_a_run_cannot_keep_is_refused() -> None:
    sizes: dict[str, Any] = {"preset": "none", "envs": 6, "lanes": 3, "workers": 3, "eval_copies": 4, "eval_episodes": 10}
    expected = "expected at least 10, for 6 env copies and 4 that play evaluations; take fewer envs or eval_copies"
    assert refusal(**sizes, max_env_copies=9) == f"max_env_copies 9: {expected}"
    run = resolve("CartPole-v1", **sizes, max_env_copies=10)  # one worker at a time plays evaluations
    check_copies(run, "MACHINE", 10)
    with pytest.raises(UsageError, match=r"^MACHINE 9: expected at least 10, "):
        check_copies(run, "MACHINE", 9)
