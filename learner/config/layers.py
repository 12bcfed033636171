"""The layers that a run's settings come from, merged into one record. Pure except for reading TOML files.

The layers are, from the weakest to the strongest: the records' defaults, the preset for the algorithm and environment, a
named preset, a TOML file, and flags or keyword arguments. When a run is resumed, its config.toml replaces the presets and
the file; with `--resume auto`, the file comes between the config.toml and the flags.

A setting has one name everywhere: the field `learning_rate` is the TOML key `learning_rate` and the flag `--learning-rate`.
The settings of the algorithm are in a TOML table named after it, such as [ppo] or ["my_module:Mine"].

Rule: a layer is a dictionary that knows its source. Layers are merged as dictionaries and converted to a record once, so
each value is checked once, and an error names the layer that the value comes from.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from millrace.flags.fields import FlagField, fields_of
from millrace.flags.values import convert, with_whole_numbers
from millrace.learner.config.algorithm_names import is_own, name_of, settings_record, with_algorithm
from millrace.learner.config.config import TABLES, Config
from millrace.learner.config.hyperparameters import HYPERPARAMETERS
from millrace.learner.config.other_names import in_place_of
from millrace.learner.config.presets import PRESETS, environment_presets, named_presets
from millrace.learner.config.validation import check_numbers, check_table, check_text, validate
from millrace.learner.run_folder.regular_files import MOST_TEXT_BYTES
from millrace.learner.run_folder.run_format import CONFIG_FILE, check_format, parse_toml, read_config
from millrace.protocol.envs.found_names import moved
from millrace.protocol.errors import UsageError, did_you_mean

ALL_BUT_TABLES = {*Config.__struct_fields__} - {"algorithm", *TABLES}


class SettingsLayer(NamedTuple):
    """The settings from one source. The run's and the algorithm's settings are in one mapping."""

    where: str
    """what its errors begin with: a file, `preset NAME` or `train`; empty for flags, whose names say enough"""
    settings: Mapping[str, Any]

    def origin(self, field: FlagField) -> str:
        """How an error refers to a setting of this layer."""
        return f"{self.where}: {field.name}" if self.where else field.written

    def without_tables(self) -> SettingsLayer:
        """The layer without the environment's arguments."""
        return SettingsLayer(self.where, {name: value for name, value in self.settings.items() if name not in TABLES})


NOTHING = SettingsLayer("", {})


class LowerLayers(NamedTuple):
    """The layers below flags and keyword arguments, as they were read, and the algorithm that results from all layers."""

    algo: str
    preset: str
    named: SettingsLayer
    file: SettingsLayer
    """the TOML file, or the config.toml of the run to resume"""
    resume: Path | None
    over_run: SettingsLayer = NOTHING
    """the TOML file of `--resume auto`, whose settings override those of the run to resume"""

    def below(self, given: SettingsLayer) -> list[SettingsLayer]:
        """The layers below `given`, which holds the flags or keyword arguments, and may name the environment.

        Raises `UsageError` if the run to resume has another environment, or if the preset doesn't exist.
        """
        env = str(given.settings.get("env", ""))
        if self.resume is not None and env and not moved(str(self.file.settings.get("env")), env):
            found = self.file.settings.get("env")
            raise UsageError(f"run {self.resume} is of {found}, not of {env}; resume it without naming an environment")
        env = env or str(self.file.settings.get("env", self.named.settings.get("env", "")))
        layers = [self._of_environment(env), self.named]
        if self.file.settings.keys() >= ALL_BUT_TABLES:  # the file holds a whole run, so its tables are complete, too
            layers = [layer.without_tables() for layer in layers]
        return [*layers, self.file, self.over_run]

    def _of_environment(self, env: str) -> SettingsLayer:
        """The preset of this algorithm for this environment, or for the environment that --preset names."""
        if self.preset == "none":
            return NOTHING
        presets = environment_presets(self.algo)
        named = named_presets()
        name = env if self.preset == "auto" or self.preset in named else self.preset
        if name not in presets and name == self.preset:
            hint = did_you_mean(name, [*presets, *named]) or "; millrace presets lists them"
            raise UsageError(f"preset {name}: {self.algo} has none of this name{hint}")
        return SettingsLayer(str(PRESETS), presets.get(name, {}))


def resolve(
    env: str = "", *, file: Path | None = None, resume: Path | None = None, preset: str = "auto", **keywords: Any
) -> Config:
    """The settings of a run from all layers, validated.

    Raises `UsageError`, with a one-line message, if a setting or a file is not valid.

    `file` is a TOML file of settings. `resume` is a run folder, whose config.toml replaces file and preset. `preset` is
    "auto" (the environment's preset, if there is one), "none", the environment whose preset to use, or the name of a whole
    run. `algo` may be a class (`algorithm_names.name_of`).
    """
    return settings_of_run(*layers_of_keywords(env, file=file, resume=resume, preset=preset, **keywords))


def layers_of_keywords(
    env: str = "", *, file: Path | None = None, resume: Path | None = None, preset: str = "auto", **keywords: Any
) -> tuple[LowerLayers, SettingsLayer]:
    """The lower layers, and the layer of keyword arguments on top of them. For the arguments and errors, see `resolve`."""
    if isinstance(algo := keywords.get("algo", ""), type):
        keywords["algo"] = name_of(algo)
    elif not isinstance(algo, str):
        raise UsageError(
            f"train: algo: expected one of {', '.join(HYPERPARAMETERS)}, module:Class or a class, got {algo!r:.60}"
        )
    lower = read_lower_layers(keywords.get("algo"), file=file, resume=resume, preset=preset)
    return lower, SettingsLayer("train", keywords | ({"env": env} if env else {}))


def config_from_toml(text: str, where: str = "config.toml") -> Config:
    """Read settings that `Config.to_toml` wrote. Missing settings get their defaults; no preset is used.

    `where` is the file's name for error messages. Raises `UsageError` if the text or a setting is not valid.
    """
    return settings_of_run(_file_alone(parse_toml(text, where), where), NOTHING)


def config_of_run(run: Path, algo: str | None = None) -> Config:
    """The settings of a run folder, from its config.toml. Raises `UsageError` if they are not valid.

    `algo` is the current name of the run's algorithm, if the name may have changed (`algorithm_names.moved`).
    """
    table = with_algorithm(read_config(run), algo)
    return settings_of_run(_file_alone(table, str(run / CONFIG_FILE)), NOTHING)


def read_lower_layers(algo: str | None, *, file: Path | None, resume: Path | None, preset: str) -> LowerLayers:
    """Read the named preset and the file. `algo` is the algorithm that flags or keyword arguments name, or None.

    Raises `UsageError` if the arguments exclude each other, or if a file cannot be read.
    """
    if resume is not None:
        if file is not None:
            raise UsageError(f"a config file ({file}) or a run to resume ({resume}): expected one, got both")
        if preset not in ("auto", "none"):
            raise UsageError(f"a preset ({preset}) or a run to resume ({resume}): expected one, got both")
        return layers_of_run(resume, algo)
    table = {} if file is None else _read_toml(file)
    whole_runs = named_presets()
    named = SettingsLayer(f"preset {preset}", whole_runs[preset].settings if preset in whole_runs else {})
    if algo is None:
        algo = _algorithm_of_file({**named.settings, **table}, str(file))
    _check_tables(table, algo, str(file))
    return LowerLayers(algo, preset, named, _layer_of_file(table, algo, str(file)), None)


def layers_of_run(run: Path, algo: str | None) -> LowerLayers:
    """The lower layers of a run to resume: its config.toml. `algo` is the algorithm that flags or keywords name, or None.

    Raises `UsageError` if the file cannot be read.
    """
    file = run / CONFIG_FILE
    if not file.is_file():
        raise UsageError(f"run {run}: expected a run folder with a {CONFIG_FILE} to resume, got none")
    check_format(run)
    table = with_algorithm(read_config(run), algo)
    if algo is None:
        algo = _algorithm_of_file(table, str(file))
    return LowerLayers(algo, "none", NOTHING, _layer_of_file(table, algo, str(file)), run)


def _file_alone(table: dict[str, Any], where: str) -> LowerLayers:
    """Lower layers that consist only of a file, without a preset."""
    algo = _algorithm_of_file(table, where)
    return LowerLayers(algo, "none", NOTHING, _layer_of_file(table, algo, where), None)


def settings_of_run(lower: LowerLayers, given: SettingsLayer) -> Config:
    """The settings of a run: `given` on top of the lower layers. Raises `UsageError` if they are not valid together."""
    below = lower.below(given)
    config = merged(lower.algo, [*below, given])
    try:
        validate(config)
    except UsageError as error:
        env = SettingsLayer("", {"env": config.env})
        for file, layers in ((lower.file, below[:-1]), (lower.over_run, below)):  # the last layer of `below` is `over_run`
            if file.settings and _is_wrong_alone(lower.algo, [*layers, env], error):
                raise UsageError(f"{file.where}: {error}") from error
        raise
    return config


def merged(algo: str, layers: Sequence[SettingsLayer]) -> Config:
    """Merge these layers, from the weakest to the strongest, into one record.

    Each setting is checked on its own. Raises `UsageError` for the first setting that is unknown or not valid. `env_kwargs`
    and `eval_env_kwargs` are merged entry by entry.
    """
    record = settings_record(algo)
    fields = fields_of(Config) | fields_of(record)
    values: dict[str, Any] = {}
    origins: dict[str, str] = {}
    for layer in layers:
        for name, value in layer.settings.items():
            if name not in fields:
                hint = in_place_of(name, fields) or did_you_mean(name, fields)
                raise UsageError(f"{layer.where}: unknown setting {name}{hint}")
            origins[name] = layer.origin(fields[name])
            plain = _plain(fields[name], value)
            check_text(name, plain, origins[name])
            if name in TABLES:
                check_table(plain, origins[name])
                plain = {**values.get(name, {}), **plain}
            values[name] = plain
    values["algo"] = algo  # a weaker layer may have named another algorithm
    of_algorithm = {name: values.pop(name) for name in record.__struct_fields__ if name in values}
    algorithm = convert(of_algorithm, record, origins)
    config = convert(values, Config, origins)
    check_numbers(algorithm, origins)
    check_numbers(config, origins)
    return msgspec.structs.replace(config, algorithm=algorithm)


def _plain(field: FlagField, value: Any) -> Any:
    """Convert 1e5 and "1_000" to integers in integer fields, "none" to None where None is allowed, and a path to text."""
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if field.optional and value == "none":
        return None
    return with_whole_numbers(field, value)


def _algorithm_of_file(table: Mapping[str, Any], where: str) -> str:
    """The algorithm that a file names, or ppo. Raises `UsageError` if there is no such algorithm."""
    algo = str(table.get("algo", "ppo"))
    try:
        settings_record(algo)
    except UsageError as error:
        raise UsageError(f"{where}: {error}", error.detail) from error
    return algo


def _is_wrong_alone(algo: str, layers: Sequence[SettingsLayer], why: UsageError) -> bool:
    """Whether these lower layers alone, without the flags or keyword arguments, cause the same error."""
    try:
        validate(merged(algo, layers))
    except UsageError as error:
        return str(error) == str(why)
    return False


def _layer_of_file(table: dict[str, Any], algo: str, where: str) -> SettingsLayer:
    """The settings of a TOML file for this algorithm.

    Tables of other algorithms are left out, because one file may hold the tables of several.
    """
    of_run = {name: value for name, value in table.items() if not _is_algorithm(name)}
    header = _header(algo)
    of_algorithm = table.get(algo, {})
    if not isinstance(of_algorithm, dict):
        raise UsageError(f"{where}: {algo}: expected a table, {header}, got {of_algorithm}")
    if misplaced := of_run.keys() & {*settings_record(algo).__struct_fields__}:
        raise UsageError(f"{where}: {min(misplaced)} is a setting of the algorithm; put it in the table {header}")
    if misplaced := of_algorithm.keys() & {*Config.__struct_fields__}:
        raise UsageError(f"{where}: {min(misplaced)} is a setting of the run; put it above the table {header}")
    return SettingsLayer(where, of_run | of_algorithm)


def _check_tables(table: dict[str, Any], algo: str, where: str) -> None:
    """Raise `UsageError` for a table of an unknown name, or if a file has tables of algorithms, but none of this one.

    A built-in algorithm that a flag or keyword argument has named in place of the file's needs no table.
    """
    header = _header(algo)
    tables = [name for name in table if _is_algorithm(name)]
    if tables and algo not in tables and (is_own(algo) or algo == table.get("algo", "ppo")):
        raise UsageError(
            f"{where}: expected the settings of {algo} in the table {header}, got only {', '.join(map(_header, tables))}; "
            "rename that table, or add an empty one if the defaults are right"
        )
    for name, value in table.items():
        if isinstance(value, dict) and name not in (*tables, *TABLES):
            raise UsageError(f"{where}: unknown table [{name}]; the settings of {algo} are in the table {header}")


def _is_algorithm(name: str) -> bool:
    """Whether an entry of a TOML file is an algorithm's table, by its name."""
    return name in HYPERPARAMETERS or is_own(name)


def _header(algo: str) -> str:
    """The header of an algorithm's table in TOML."""
    return f'["{algo}"]' if is_own(algo) else f"[{algo}]"


def _read_toml(file: Path) -> dict[str, Any]:
    """Read a TOML file of settings. The user names it, so it may be a link, a pipe, or a device that never ends."""
    try:
        with file.open("rb") as opened:
            content = opened.read(MOST_TEXT_BYTES + 1)
        if len(content) > MOST_TEXT_BYTES:
            raise UsageError(f"config file {file} cannot be read: expected at most {MOST_TEXT_BYTES:,} bytes, got more")
        return parse_toml(content.decode(), str(file))
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is not text in UTF-8"
        raise UsageError(f"config file {file} cannot be read: {why}") from error
