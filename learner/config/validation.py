"""Checks on settings that types can't express. Each error is one line: the setting, what was expected, what was given."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import msgspec

from millrace.flags.values import convert
from millrace.learner.config.config import TABLES, Config
from millrace.learner.config.evaluation_size import evaluation_size
from millrace.learner.config.hyperparameters import WITHOUT_REPLAY
from millrace.learner.config.rollout_config import RolloutConfig
from millrace.learner.run_folder.results import METRICS_BESIDE_FACTS
from millrace.protocol.address import advertised_address, check_address
from millrace.protocol.bounds import LARGEST, MAX_FACTS, MAX_NAME, one_line
from millrace.protocol.env_spec import check_arguments
from millrace.protocol.envs.kinds_of_copies import check_kind
from millrace.protocol.envs.wrappers import wrapper_name
from millrace.protocol.errors import UsageError, safe_repr

MOST_TICKETS = 1 << 15  # limit on outstanding tickets, because one worker may get them all in one message
LARGEST_SEED = 2**64 - 1  # the largest seed that PyTorch accepts


def validate(config: Config) -> None:
    """Raise `UsageError` if these settings, each valid on its own, don't make a valid run together."""
    if not config.env:
        raise UsageError("which environment? expected one that gymnasium.make takes, as in: millrace train CartPole-v1")
    check_rollout_settings(config)
    _check_env_arguments(config)
    config.algorithm.check()
    _check_replay_size(config)
    if config.inference == "learner":
        _check_learner_inference(config)
    _check_prior(config)
    _check_shards(config)
    check_copies(config, "max_env_copies", config.max_env_copies)


def check_table(value: object, origin: str) -> None:
    """Raise `UsageError` unless this is a table of arguments that a message can carry.

    `origin` is how an error refers to the setting.
    """
    if not isinstance(value, Mapping):
        raise UsageError(f"{origin}: expected table, got {value!r:.60}")
    check_arguments(value, origin)


def check_text(name: str, value: object, origin: str) -> None:
    """Raise `UsageError` for text that isn't valid UTF-8, which files and messages can't hold.

    A command line may contain any bytes. `origin` is how an error refers to the setting.
    """
    if name == "run_dir":  # the folder's own check has a better error, which says what to do
        return
    for text in value if isinstance(value, tuple | list) else (value,):
        if isinstance(text, str) and any("\ud800" <= character <= "\udfff" for character in text):
            raise UsageError(f"{origin}: expected text in UTF-8, got {text!r:.60}")


def check_numbers(record: msgspec.Struct, origins: Mapping[str, str]) -> None:
    """Raise `UsageError` for NaN, and for an integer that is too large for a message.

    `origins` says how an error refers to each setting that was given.
    """
    for name, value in msgspec.structs.asdict(record).items():
        most = LARGEST_SEED if name == "seed" else LARGEST
        for each in value if isinstance(value, tuple) else (value,):
            if isinstance(each, int) and each > most:
                raise UsageError(f"{origins.get(name, name)}: expected int <= {most}, got {one_line(str(each))}")
        if isinstance(value, float) and math.isnan(value):
            raise UsageError(f"{origins.get(name, name)}: expected a number, got {value}")


def check_copies(config: Config, limit: str, most: int) -> None:
    """Raise `UsageError` if the run needs more than `most` env copies. 0 allows any number.

    `limit` is the name of the setting or variable that `most` comes from.
    """
    # Each worker that evaluates keeps its env copies. Without eval_workers, one worker evaluates. With them, one more worker
    # must be able to evaluate, in case all of them are lost.
    evaluate = min(config.eval_copies, evaluation_size(config).episodes) * (config.eval_workers + 1)
    if 0 < most < config.envs + evaluate:
        raise UsageError(
            f"{limit} {most}: expected at least {config.envs + evaluate}, for {config.envs} env copies and {evaluate} "
            "that play evaluations; take fewer envs or eval_copies"
        )


def workers_to_wait_for(config: RolloutConfig, local: int | None) -> int:
    """How many workers must have joined before collection starts. Raises `UsageError` if that many can't join.

    If no other workers can join, `local` is the number of workers that this machine starts; otherwise it is None.
    """
    if local is None:
        return config.min_workers or 1
    if config.min_workers > local:
        raise UsageError(
            f"min_workers: expected at most {local}, the number of workers that this run starts, got {config.min_workers}; "
            "take more --workers, or a learner that workers on other machines can join"
        )
    return config.min_workers or local


def unused_setting(config: Config) -> str:
    """A line for the user if a setting has no effect; otherwise empty.

    A setting has no effect if the run ends before the first gradient step, or if the setting needs evaluations during
    training and there are none.
    """
    if config.steps <= config.algorithm.learning_starts:
        return (
            f"learning_starts {config.algorithm.learning_starts:,}: nothing is learned in the {config.steps:,} env steps of "
            f"this run; take --learning-starts {config.steps // 10} or more --steps"
        )
    if config.eval_every:
        return ""
    if config.eval_workers:
        return f"eval_workers {config.eval_workers}: there is nothing to evaluate during training; take --eval-every N too"
    if config.target_return is None:
        return ""
    return f"target_return {config.target_return:g} ends no run without evaluations during training; take --eval-every N too"


def convert_rollout_settings(settings: dict[str, Any], where: str) -> RolloutConfig:
    """The record of these settings. Raises `UsageError` if they are not valid; its message begins with `where`."""
    origins = {name: f"{where}: {name}" for name in settings}
    for name, value in settings.items():
        check_text(name, value, origins[name])
        if name in TABLES:
            check_table(value, origins[name])
    config = convert(settings, RolloutConfig, origins)
    check_numbers(config, origins)
    try:
        check_rollout_settings(config)
    except UsageError as error:
        raise UsageError(f"{where}: {error}") from error
    return config


def check_rollout_settings(config: RolloutConfig) -> None:
    """Raise `UsageError` if rollouts cannot be collected with these settings."""
    if config.envs % config.lanes:
        fewer = config.envs - config.envs % config.lanes
        near = f"{fewer} or {fewer + config.lanes}" if fewer else f"{config.lanes}"
        divisor = max(n for n in range(1, min(config.lanes, config.envs) + 1) if config.envs % n == 0)
        raise UsageError(
            f"{config.envs} envs cannot be shared evenly among {config.lanes} lanes; take {near}, or {divisor} lanes"
        )
    if (tickets := config.lanes * (1 + config.max_lag)) > MOST_TICKETS:
        expected = f"expected lanes * (1 + max_lag) of at most {MOST_TICKETS}"
        raise UsageError(f"{config.lanes} lanes with max_lag {config.max_lag}: {expected}, got {tickets}")
    names = config.info_keys
    if len(names) > MAX_FACTS or len(set(names)) < len(names):
        raise UsageError(f"info_keys: expected at most {MAX_FACTS} different names, got {len(names)}")
    if wrong := [name for name in names if not name or name != one_line(name, MAX_NAME)]:
        raise UsageError(
            f"info_keys: expected non-empty names without tabs or line breaks, got {one_line(safe_repr(wrong[0]), MAX_NAME)}"
        )
    if taken := METRICS_BESIDE_FACTS.union(f"{name}_missing" for name in names).intersection(names):
        raise UsageError(f"info_keys: expected another name than {min(taken)}, which is the name of another logged value")
    if config.wrappers and config.vector != "loop":
        raise UsageError(
            f"vector {config.vector}: wrappers are applied to single env copies; expected loop, which is the default"
        )
    if config.restart_episodes and config.vector != "loop":
        raise UsageError(f"vector {config.vector}: restart_episodes makes single env copies anew; expected loop")
    check_kind(config.vector)
    for wrapper in config.wrappers:
        wrapper_name(wrapper)
    check_address(config.bind)
    if config.metrics_bind:
        try:
            check_address(f"tcp://{config.metrics_bind}")
        except UsageError:
            expected = "expected HOST:PORT, as in 127.0.0.1:9464"
            raise UsageError(f"metrics_bind {config.metrics_bind}: {expected}") from None
    try:
        check_address(advertised_address("tcp://*:1", config.advertise, "machine"))
    except UsageError:
        raise UsageError(f"advertise {config.advertise}: expected a host name or an IP address, without a port") from None


def _check_env_arguments(config: Config) -> None:
    """Raise `UsageError` for an infinite number or NaN among the environment's arguments, which policy.json can't hold."""
    for table in TABLES:
        for name, value in getattr(config, table).items():
            if isinstance(value, float) and not math.isfinite(value):
                expected = "expected a finite number"
                raise UsageError(f"{table} {name}: {expected}, got {value}; leave it out, or take a large one")


def _check_replay_size(config: Config) -> None:
    size = config.algorithm.replay_size
    most = (config.algorithm.rollout_steps + 1) * config.envs // config.lanes
    if 0 < size < most:
        raise UsageError(f"replay_size {size}: a rollout takes up to {most}; take --replay-size {most} or more")


def _check_learner_inference(config: Config) -> None:
    if config.vector != "loop":
        wrong = f"vector: expected loop, got {config.vector}; its workers step copies one by one"
    elif config.restart_episodes:
        wrong = f"restart_episodes: expected 0, got {config.restart_episodes}; its workers make no copy anew"
    elif config.eval_workers:
        wrong = f"eval_workers: expected 0, got {config.eval_workers}; its workers step copies, and cannot evaluate alone"
    else:
        return
    raise UsageError(f"inference learner: {wrong}")


def _check_shards(config: Config) -> None:
    if config.lanes % config.shards:
        raise UsageError(f"shards: expected a divisor of lanes {config.lanes}, got {config.shards}")
    if config.algorithm.replays and config.shards > 1:
        *names, last = WITHOUT_REPLAY
        expected = f"expected {', '.join(names)} or {last}"
        raise UsageError(f"shards {config.shards}: {config.algo} learns in one process; {expected}")


def _check_prior(config: Config) -> None:
    algorithm = config.algorithm
    if not config.prior:
        for name, number in (("prior_steps", algorithm.prior_steps), ("clone_epochs", algorithm.clone_epochs)):
            if number:
                raise UsageError(f"{name}: expected 0 without prior data, got {number}; name it by --prior")
    elif algorithm.only_clones and not algorithm.clone_epochs:
        raise UsageError(f"prior {config.prior}: {config.algo} can only clone it; add --clone-epochs 50")
    elif algorithm.replays and algorithm.core is not None:
        raise UsageError(f"prior {config.prior}: expected core none, because datasets have no states of a core; drop --core")
