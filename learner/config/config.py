"""The configuration of a run: one record, whose texts are the help of the command line. Pure but for reading TOML files.

Resolution, weakest first: the defaults here < the preset of (algorithm, environment) < a TOML file < flags or keyword
arguments. A setting has one name: the field `learning_rate` is the TOML key `learning_rate` and the flag `--learning-rate`.
The algorithm's own settings stand in a TOML table named after it, `[ppo]`, and among the other flags.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_type_hints

import msgspec
import tomli_w
from msgspec import Meta
from tyro.conf import Positional

from learner.config.did_you_mean import nearest
from learner.config.hyperparameters import HYPERPARAMETERS, Hyperparameters, PPOConfig, elsewhere
from learner.config.settings import CheckpointPolicy, EvaluationSettings, StopRule
from protocol.address import advertised, check_address
from protocol.errors import UsageError
from protocol.specs import ImagesDtype
from protocol.wire.weight_dtypes import WeightsDtype

PRESETS = Path(__file__).with_name("presets.toml")
Scalar = bool | int | float | str
Count = Annotated[int, Meta(ge=1)]
Natural = Annotated[int, Meta(ge=0)]
Seconds = Annotated[float, Meta(gt=0)]


class Config(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Everything that decides how a run goes."""

    env: Positional[str] = ""
    """anything gymnasium.make takes: CartPole-v1, ALE/Pong-v5, my_package.envs:MyEnv-v0"""
    env_kwargs: dict[str, Scalar] = {}
    """keyword arguments of gymnasium.make: name value name value …"""
    algo: str = "ppo"
    """the algorithm: one of those in learner/config/hyperparameters.py"""
    algorithm: Hyperparameters = PPOConfig()
    """the algorithm's own settings"""

    steps: Count = 100_000
    """env steps to train for, all copies together: it ends when one more update would pass them"""
    seed: Natural = 1
    """everything random follows from it"""
    workers: Count = 2
    """worker processes on this machine"""
    envs: Count = 8
    """env copies, all workers together; a multiple of lanes"""
    lanes: Count = 4
    """groups into which the env copies are divided; workers share out the lanes, and results do not depend on the workers"""
    max_lag: Natural = 0
    """how many versions old the weights behind a rollout may be; 0 is synchronous"""
    vector: Literal["auto", "loop", "native", "envpool"] = "auto"
    """how a lane's env copies are stepped: one after another (loop), or at once by the environment's own vectorised form
    (native) or by envpool's (pip install 'millrace-rl[envpool]'), with other random numbers; auto is loop, wherever it runs
    """

    inference: Literal["workers", "learner"] = "workers"
    """where the policy acts: in each worker, or beside the learner, for all env copies at once, so that workers only step"""

    transport: Literal["inproc", "ipc", "tcp"] = "ipc"
    """how local workers are reached: threads of this process, local sockets, or loopback TCP"""
    compress: Literal["none", "zstd"] = "none"
    """how workers compress their rollouts: not at all, or by Zstandard, which pays for images, on almost any network
    (pip install 'millrace-rl[compress]', here and with every worker)
    """
    weights_dtype: WeightsDtype = "float32"
    """as what weights travel to workers: rounded, as bfloat16 or float16, they are half as many bytes. Workers act under the
    rounded ones, of which their log-probabilities are; the learner's own stay float32
    """
    images_dtype: ImagesDtype = "float32"
    """as what the acting policy looks at images; in bfloat16 half the work on a CPU with matrix units (AMX), more on one
    without. Log-probabilities are those of the actions as they were drawn; the learner's own stay float32
    """
    bind: str = "tcp://127.0.0.1:5555"
    """where `millrace learner` listens for workers; tcp://0.0.0.0:5555 is for other machines, and needs keys"""
    advertise: str = ""
    """the host that workers on other machines are told; if not given, this machine's name"""
    keys: str = ""
    """folder of keys (or MILLRACE_KEYS): then loopback TCP needs keys too; if not given, ~/.config/millrace/keys"""
    insecure: bool = False
    """let other machines connect without keys: whoever reaches the port can read the run, spoil it and stop it"""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """where the learner learns"""
    torch_threads: Count | None = None
    """threads of PyTorch in the learner; none: 1 for a small MLP, else as many as there are cores that no worker needs
    meanwhile (with max_lag 0 all). Their number changes results in the last bits
    """
    run_dir: str = "runs"
    """where run folders go"""

    eval_episodes: Count = 100
    """greedy episodes of an evaluation"""
    eval_every: Natural = 0
    """env steps between greedy evaluations while training; 0: only the one at the end"""
    target_return: float | None = None
    """stop as soon as a greedy evaluation averages at least this"""
    target_mean_return: float | None = None
    """stop as soon as the last 100 training episodes average at least this"""
    checkpoint_every_s: Seconds = 60.0
    """seconds between checkpoints"""
    checkpoint_every_episodes: Natural = 0
    """episodes between checkpoints, besides those by time; 0: by time alone"""
    checkpoint_every_updates: Natural = 0
    """updates between checkpoints, besides those by time; 0: by time alone"""
    keep_checkpoints: Count = 3
    """how many of the newest checkpoints stay"""

    metrics_bind: str = ""
    """where Prometheus finds the metrics, as 127.0.0.1:9464; 0.0.0.0:9464 lets everybody read them; if not given, nowhere"""

    record: str = ""
    """id of a Minari dataset of every whole training episode, as cartpole/ppo-v0 (pip install 'millrace-rl[record]')"""

    min_workers: Natural = 0
    """start when so many workers have joined; 0: all local workers, or the first one"""
    heartbeat_s: Seconds = 1.0
    """seconds between a worker's accounts of itself"""
    worker_timeout_s: Seconds = 5.0
    """a worker silent for so many seconds is given up, and its lanes go elsewhere"""
    no_workers_timeout_s: Seconds = 60.0
    """end the run, after a checkpoint, when no worker has been here for so many seconds"""
    step_timeout_s: Seconds = 120.0
    """a local worker process that takes so many seconds for a step of one env copy is ended, and started again"""
    pin_workers: bool | None = None
    """each local worker process keeps to one core; none: it does where workers and learner take turns (max_lag 0) and there
    are as many workers as cores, or twice as many, ..."""
    stall_timeout_s: Seconds = 600.0
    """end the run, after a checkpoint, when nothing has arrived for so many seconds"""
    max_env_failures: Natural = 3
    """end the run when the environment has raised more often than this"""

    def stop_rule(self) -> StopRule:
        """When training ends."""
        return StopRule(steps=self.steps, target_return=self.target_return, target_mean_return=self.target_mean_return)

    def checkpoint_policy(self) -> CheckpointPolicy:
        """When checkpoints are written, and how many are kept."""
        return CheckpointPolicy(
            every_s=self.checkpoint_every_s,
            every_episodes=self.checkpoint_every_episodes,
            every_updates=self.checkpoint_every_updates,
            keep=self.keep_checkpoints,
        )

    def evaluation_settings(self) -> EvaluationSettings:
        """How often the policy is evaluated, and on which episodes."""
        return EvaluationSettings(episodes=self.eval_episodes, every_env_steps=self.eval_every, seed=self.seed)

    def to_toml(self) -> str:
        """As text that `from_toml` reads: every setting, in the order of the fields; what is not set is "none"."""
        plain: dict[str, Any] = msgspec.to_builtins(self)
        tables = {"env_kwargs": plain.pop("env_kwargs"), self.algo: _without_none(plain.pop("algorithm"))}
        return tomli_w.dumps(_without_none(plain) | tables)

    @staticmethod
    def from_toml(text: str, where: str = "config.toml") -> Config:
        """From text, over the defaults alone (no preset). Raises `UsageError` that names `where`."""
        return checked(_over_toml(Config(), _parse(text, where), where), where)


def resolve(
    env: str = "", *, file: Path | None = None, resume: Path | None = None, preset: str = "auto", **keywords: Any
) -> Config:
    """The configuration of a run from all layers, checked. Raises `UsageError` in one line.

    `preset` is "auto" (that of the environment, if there is one), "none", the environment whose preset to take, or the name
    of a whole run. A run that is resumed has its own file, and no preset.
    """
    base = lower_layers(env, algo=keywords.get("algo"), file=file, resume=resume, preset=preset)
    return checked(over(base, keywords, "keyword argument"))


class Preset(NamedTuple):
    """A whole run by name: environment, algorithm and settings."""

    about: str
    settings: dict[str, Any]


def named_presets() -> dict[str, Preset]:
    """The presets that `--preset NAME` takes besides those of an environment."""
    tables: dict[str, dict[str, Any]] = _presets().get("named", {})
    return {name: Preset(table.pop("about"), table) for name, table in tables.items()}


def presets_of_environments() -> list[tuple[str, str]]:
    """Algorithm and environment of every preset that is taken by itself."""
    return [(algo, env) for algo, envs in _presets().items() if algo != "named" for env in envs]


def _presets() -> dict[str, Any]:
    return tomllib.loads(PRESETS.read_text())


def lower_layers(
    env: str,
    *,
    algo: str | None = None,
    file: Path | None = None,
    resume: Path | None = None,
    preset: str = "auto",
) -> Config:
    """What stands below flags and keyword arguments: defaults, preset, file. Fields fit their types, and no more."""
    if resume is not None:
        if file is not None:
            raise UsageError(f"a config file ({file}) or a run to resume ({resume}): expected one, got both")
        file, preset = resume / "config.toml", "none"
        if not file.is_file():
            raise UsageError(f"run {resume}: expected a run folder with a config.toml to resume, got none")
    where = str(file)
    table: dict[str, Any] = {}
    if file is not None:
        try:
            table = _parse(file.read_text(), where)
        except (OSError, UnicodeDecodeError) as error:
            says = error.strerror if isinstance(error, OSError) else "it is not text"
            raise UsageError(f"config file {where} cannot be read: {says}") from error
    if resume is not None and env not in ("", table.get("env")):
        raise UsageError(f"run {resume} is of {table.get('env')}, not of {env}; resume it without naming an environment")
    named = named_presets()
    whole = named[preset].settings if preset in named else {}
    env = env or str(table.get("env", whole.get("env", "")))
    config = _of_algorithm(algo or str(table.get("algo", whole.get("algo", "ppo"))))
    if preset != "none":
        known = _presets().get(config.algo, {})
        name = env if preset == "auto" or preset in named else preset
        if name not in known and name == preset:
            near = nearest(name, [*known, *named])
            raise UsageError(f"preset {name}: {config.algo} has none of this name{near or '; millrace presets lists them'}")
        config = over(over(config, known.get(name, {}), str(PRESETS)), {**whole, "algo": config.algo}, str(PRESETS))
    config = _over_toml(config, {**table, "algo": config.algo}, where)
    return over(config, {"env": env}, "ENV")


def over(config: Config, values: Mapping[str, Any], where: str) -> Config:
    """The configuration with these values, named flatly, laid over it; `env_kwargs` are merged. Types are checked."""
    config = _of_algorithm(values["algo"]) if values.get("algo", config.algo) != config.algo else config
    plain: dict[str, Any] = msgspec.to_builtins(config)
    own: dict[str, Any] = plain["algorithm"]
    for name, value in values.items():
        if name in own:
            own[name] = _fitting(config.algorithm, name, value)
        elif name == "env_kwargs" and isinstance(value, Mapping):
            plain[name] |= value
        elif name in plain and name != "algorithm":
            plain[name] = _fitting(config, name, value)
        else:
            raise UsageError(f"{where}: unknown setting {name}{elsewhere(name) or nearest(name, [*plain, *own])}")
    return _typed(plain, where)


def checked(config: Config, where: str = "") -> Config:
    """The configuration, if a run can be made of it. Raises `UsageError` that says what could."""
    at = f"{where}: " if where else ""
    config = _typed(msgspec.to_builtins(config), where)
    if not config.env:
        raise UsageError(f"{at}which environment? expected one that gymnasium.make takes, as in: millrace train CartPole-v1")
    if config.envs % config.lanes:
        fewer = config.envs - config.envs % config.lanes
        near = f"{fewer} or {fewer + config.lanes}" if fewer else f"{config.lanes}"
        divisor = max(n for n in range(1, min(config.lanes, config.envs) + 1) if config.envs % n == 0)
        raise UsageError(
            f"{at}{config.envs} envs cannot be shared evenly among {config.lanes} lanes; take {near}, or {divisor} lanes"
        )
    if config.inference == "learner" and config.compress != "none":
        raise UsageError(
            f"{at}inference learner: compress expected none, got {config.compress}; rollouts are made beside the learner"
        )
    if config.inference == "learner" and config.max_lag:
        raise UsageError(
            f"{at}inference learner: max_lag expected 0, got {config.max_lag}; the policy acts under the newest weights"
        )
    if config.inference == "learner" and config.vector not in {"auto", "loop"}:
        raise UsageError(
            f"{at}inference learner: vector expected auto or loop, got {config.vector}; its workers step copies one by one"
        )
    check_address(config.bind)
    if config.metrics_bind:
        try:
            check_address(f"tcp://{config.metrics_bind}")
        except UsageError:
            expected = "expected HOST:PORT, as in 127.0.0.1:9464"
            raise UsageError(f"{at}metrics_bind {config.metrics_bind}: {expected}") from None
    try:
        check_address(advertised("tcp://*:1", config.advertise, "machine"))
    except UsageError:
        raise UsageError(
            f"{at}advertise {config.advertise}: expected a host name or an IP address, without a port"
        ) from None
    return config


def _without_none(plain: dict[str, Any]) -> dict[str, Any]:
    return {name: "none" if value is None else value for name, value in plain.items()}


def _of_algorithm(algo: str) -> Config:
    if algo not in HYPERPARAMETERS:
        raise UsageError(f"algo {algo}: expected one of {', '.join(HYPERPARAMETERS)}{nearest(algo, HYPERPARAMETERS)}")
    return Config(algo=algo, algorithm=HYPERPARAMETERS[algo]())


def _parse(text: str, where: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise UsageError(f"{where} is not TOML: {error}") from error


def _over_toml(config: Config, table: dict[str, Any], where: str) -> Config:
    """Tables of other algorithms are let be, so that one file can hold the settings of several."""
    algo = str(table.get("algo", config.algo))
    top = {name: value for name, value in table.items() if name not in HYPERPARAMETERS}
    own = table.get(algo, {})
    if not isinstance(own, dict):
        raise UsageError(f"{where}: {algo} expected a table, [{algo}], got {own}")
    if strays := top.keys() & set(msgspec.structs.asdict(config.algorithm)):
        raise UsageError(f"{where}: {min(strays)} is a setting of the algorithm; put it in the table [{algo}]")
    if strays := own.keys() & set(msgspec.structs.asdict(config)):
        raise UsageError(f"{where}: {min(strays)} is a setting of the run; put it above the table [{algo}]")
    return over(config, top | own, where)


def _fitting(record: msgspec.Struct, name: str, value: Any) -> Any:
    """The value as its field wants it: 1e5 for a whole number is a whole number, and "none" is None where that may be."""
    default = getattr(type(record)(), name)
    if value == "none" and default is None:
        return None
    if isinstance(value, float) and type(default) is int and value.is_integer():
        return int(value)
    return value


def _typed(plain: dict[str, Any], where: str) -> Config:
    """The record of these values. Raises `UsageError` that names the setting, what was expected and what was got."""
    try:
        kind: type[msgspec.Struct] = HYPERPARAMETERS[plain["algo"]]
        own = msgspec.convert(plain["algorithm"], kind)
        return msgspec.structs.replace(msgspec.convert({**plain, "algorithm": {}}, Config), algorithm=own)
    except msgspec.ValidationError as error:
        raise UsageError(f"{where}: {_what_is_wrong(plain, str(error))}".removeprefix(": ")) from error


def _what_is_wrong(plain: dict[str, Any], says: str) -> str:
    """Of msgspec's text: the setting, what was expected and what was got."""
    expected, _, path = says.replace(" | null", ' or "none"').replace("`object`", "table").partition(" - at `$.")
    name = re.split(r"[.\[`]", path)[0]
    record = HYPERPARAMETERS[plain["algo"]] if name in plain["algorithm"] else Config
    got = plain["algorithm"].get(name, plain.get(name))
    if expected.startswith("Invalid enum value"):
        return f"{name} expected one of {', '.join(_choices(get_type_hints(record)[name]))}, got {got!r}"
    return f"{name} {expected.replace('`', '').replace('Expected', 'expected').partition(', got ')[0]}, got {got!r}"


def _choices(hint: Any) -> list[str]:
    """What a Literal allows, or a Literal or None."""
    found = [_choices(part) if get_args(part) else ["none" if part is type(None) else str(part)] for part in get_args(hint)]
    return [choice for choices in found for choice in choices]
