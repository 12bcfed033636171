"""The layers that a run's settings come from, and how one overrides another. Pure but for reading TOML files.

From the weakest to the strongest: the defaults of `Config`, the preset of (algorithm, environment), a TOML file, flags or
keyword arguments. A setting has one name everywhere: the field `learning_rate` is the TOML key `learning_rate` and the flag
`--learning-rate`. The settings of the algorithm stand in a TOML table named after it, as [ppo].
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from millrace.flags.fields import fields_of
from millrace.flags.values import with_whole_numbers
from millrace.learner.config.algorithm_names import is_own, name_of, settings_record, with_algorithm
from millrace.learner.config.config import TABLES, Config
from millrace.learner.config.hyperparameters import HYPERPARAMETERS
from millrace.learner.config.other_names import in_place_of
from millrace.learner.config.presets import PRESETS, environment_presets, named_presets
from millrace.learner.config.validation import convert, validate
from millrace.learner.run_folder.regular_files import MOST_TEXT_BYTES
from millrace.learner.run_folder.run_format import CONFIG_FILE, check_format, parse_toml, read_config
from millrace.protocol.envs.found_names import moved
from millrace.protocol.errors import UsageError, did_you_mean


def resolve(
    env: str = "", *, file: Path | None = None, resume: Path | None = None, preset: str = "auto", **keywords: Any
) -> Config:
    """The settings of a run from all layers, validated.

    Raises `UsageError`, with a one-line message, if a setting or a file is not valid.

    `file`: a TOML file of settings. `resume`: a run folder; its config.toml takes the place of file and preset.
    `preset`: "auto" (that of the environment, if there is one), "none", the environment whose preset to take, or a whole run
    by name. `algo` may be a class (`algorithm_names.name_of`).
    """
    if isinstance(algo := keywords.get("algo", ""), type):
        keywords["algo"] = name_of(algo)
    elif not isinstance(algo, str):
        raise UsageError(
            f"train: algo: expected one of {', '.join(HYPERPARAMETERS)}, module:Class or a class, got {algo!r:.60}"
        )
    below = lower_layers(env, algo=keywords.get("algo"), file=file, resume=resume, preset=preset)
    return validate(override(below, keywords, "train"))


def config_from_toml(text: str, where: str = "config.toml") -> Config:
    """The settings that `Config.to_toml` wrote, over the defaults (no preset). Raises `UsageError`.

    `where`: the file's name for error messages.
    """
    return validate(_override_from_toml(Config(), parse_toml(text, where), where), where)


def config_of_run(run: Path, algo: str | None = None) -> Config:
    """The settings of a run folder, from its config.toml. Raises `UsageError`.

    `algo`: the name that its algorithm has now, if it may be another one (`algorithm_names.moved`).
    """
    where = run / "config.toml"
    table = with_algorithm(read_config(run), algo)
    return validate(_override_from_toml(Config(), table, str(where)), str(where))


def lower_layers(
    env: str,
    *,
    algo: str | None = None,
    file: Path | None = None,
    resume: Path | None = None,
    preset: str = "auto",
) -> Config:
    """The layers below flags and keyword arguments: defaults, preset and file. Only the types are checked yet."""
    if resume is not None:
        if file is not None:
            raise UsageError(f"a config file ({file}) or a run to resume ({resume}): expected one, got both")
        if preset not in ("auto", "none"):
            raise UsageError(f"a preset ({preset}) or a run to resume ({resume}): expected one, got both")
        file, preset = resume / CONFIG_FILE, "none"
        if not file.is_file():
            raise UsageError(f"run {resume}: expected a run folder with a {CONFIG_FILE} to resume, got none")
        check_format(resume)
        table = with_algorithm(read_config(resume), algo)
    else:
        table = {} if file is None else _read_toml(file)
    where = str(file)
    if resume is not None and env and not moved(str(table.get("env")), env):
        raise UsageError(f"run {resume} is of {table.get('env')}, not of {env}; resume it without naming an environment")
    named = named_presets()
    whole_run = named[preset].settings if preset in named else {}
    env = env or str(table.get("env", whole_run.get("env", "")))
    if algo is None and "algo" in table:
        config = _defaults_of(str(table["algo"]), f"{where}: ")
    else:
        config = _defaults_of(algo or str(whole_run.get("algo", "ppo")))
    if preset != "none":
        by_env = environment_presets(config.algo)
        name = env if preset == "auto" or preset in named else preset
        if name not in by_env and name == preset:
            hint = did_you_mean(name, [*by_env, *named]) or "; millrace presets lists them"
            raise UsageError(f"preset {name}: {config.algo} has none of this name{hint}")
        config = override(config, by_env.get(name, {}), str(PRESETS))
        config = override(config, {**whole_run, "algo": config.algo}, f"preset {preset}")
    if table.keys() >= {*Config.__struct_fields__} - {
        "algorithm",
        *TABLES,
    }:  # all settings of a run: its tables are whole, too
        config = msgspec.structs.replace(config, **{name: {} for name in TABLES})
    config = _override_from_toml(config, {**table, "algo": config.algo}, where)
    if resume is not None:
        validate(config, where)  # so that an error names the file, and not what is given beside it
    return override(config, {"env": env}, "ENV")


def override(config: Config, values: Mapping[str, Any], where: str) -> Config:
    """The configuration with these values instead of its own. Types are checked.

    `values` has settings of the run and of the algorithm side by side. `env_kwargs` and `eval_env_kwargs` are merged with
    those that are there.
    """
    config = _defaults_of(values["algo"], f"{where}: ") if values.get("algo", config.algo) != config.algo else config
    settings: dict[str, Any] = msgspec.to_builtins(config)
    algorithm: dict[str, Any] = settings["algorithm"]
    for name, value in values.items():
        if name in algorithm:
            algorithm[name] = _coerce(config.algorithm, name, value)
        elif name in TABLES and isinstance(value, Mapping):
            settings[name] |= value
        elif name in settings and name != "algorithm":
            settings[name] = _coerce(config, name, value)
        else:
            known = [setting for setting in (*settings, *algorithm) if setting != "algorithm"]
            hint = in_place_of(name, known) or did_you_mean(name, known)
            raise UsageError(f"{where}: unknown setting {name}{hint}")
    return convert(settings, where)


def _defaults_of(algo: str, where: str = "") -> Config:
    try:
        return Config(algo=algo, algorithm=settings_record(algo)())
    except UsageError as error:
        raise UsageError(f"{where}{error}", error.detail) from error


def _coerce(record: msgspec.Struct, name: str, value: Any) -> Any:
    """1e5 and "1_000" become integers where the field is one, and "none" becomes None where the default is None."""
    default = getattr(type(record)(), name)
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, str) and value == "none" and default is None:
        return None
    return with_whole_numbers(fields_of(type(record))[name], value)


def _read_toml(file: Path) -> dict[str, Any]:
    """Read a TOML file of settings. It may be a link or a pipe, because the user names it, and a device that never ends."""
    try:
        with file.open("rb") as opened:
            content = opened.read(MOST_TEXT_BYTES + 1)
        if len(content) > MOST_TEXT_BYTES:
            raise UsageError(f"config file {file} cannot be read: expected at most {MOST_TEXT_BYTES:,} bytes, got more")
        return parse_toml(content.decode(), str(file))
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is not text in UTF-8"
        raise UsageError(f"config file {file} cannot be read: {why}") from error


def _override_from_toml(config: Config, table: dict[str, Any], where: str) -> Config:
    """Tables of other algorithms are ignored, so that one file can hold the settings of several."""
    algo = str(table.get("algo", config.algo))
    of_run = {name: value for name, value in table.items() if name not in HYPERPARAMETERS and not is_own(name)}
    of_algorithm = table.get(algo, {})
    if not isinstance(of_algorithm, dict):
        raise UsageError(f"{where}: {algo}: expected a table, {_header(algo)}, got {of_algorithm}")
    if misplaced := of_run.keys() & set(msgspec.structs.asdict(config.algorithm)):
        raise UsageError(f"{where}: {min(misplaced)} is a setting of the algorithm; put it in the table {_header(algo)}")
    if misplaced := of_algorithm.keys() & set(msgspec.structs.asdict(config)):
        raise UsageError(f"{where}: {min(misplaced)} is a setting of the run; put it above the table {_header(algo)}")
    return override(config, of_run | of_algorithm, where)


def _header(algo: str) -> str:
    """The header of an algorithm's table in TOML."""
    return f'["{algo}"]' if is_own(algo) else f"[{algo}]"
