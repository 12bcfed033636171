"""Presets (presets.toml): settings that are known to work for an algorithm and an environment, and named whole runs."""

from __future__ import annotations

import shlex
import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from millrace.flags.toml_words import written
from millrace.learner.config.update_size import rollout_with

if TYPE_CHECKING:
    from millrace.learner.config.config import Config

PRESETS = Path(__file__).with_name("presets.toml")
NAMED = "named"  # the table of presets.toml that holds the whole runs


class Preset(NamedTuple):
    """A whole run that has a name: environment, algorithm and settings."""

    about: str
    """the line that `millrace presets` shows"""
    settings: dict[str, Any]


def named_presets() -> dict[str, Preset]:
    """The whole runs that `--preset NAME` accepts, by name."""
    tables: dict[str, dict[str, Any]] = _tables().get(NAMED, {})
    return {name: Preset(table["about"], {k: v for k, v in table.items() if k != "about"}) for name, table in tables.items()}


def environment_presets(algo: str) -> dict[str, dict[str, Any]]:
    """The preset's settings, for each environment that this algorithm has a preset for."""
    presets: dict[str, dict[str, Any]] = _tables().get(algo, {})
    return presets


def algorithms_and_environments() -> list[tuple[str, str]]:
    """The algorithm and environment of every preset that applies without --preset."""
    return [(algo, env) for algo, envs in _tables().items() if algo != NAMED for env in envs]


def environment_name(env: str, env_kwargs: Mapping[str, Any], algo: str) -> str:
    """The environment's id and the keyword arguments that differ from its preset, such as `millrace/Atari-v0 game Pong`."""
    preset: dict[str, Any] = environment_presets(algo).get(env, {}).get("env_kwargs", {})
    return " ".join([env, *map(shlex.quote, added(env_kwargs, preset))])


def added(table: Mapping[str, object], default: Mapping[str, object]) -> list[str]:
    """The entries of a table that differ from its default: names and values alternate, as in a flag's words."""
    return [word for key, value in table.items() if default.get(key) != value for word in (key, written(value))]


def origin(config: Config) -> str:
    """Where the settings of a new run come from, as one line for the user.

    The preset counts as used if at least one setting has the preset's value and that value differs from the default. Without
    a preset, the line names the algorithm's settings that differ from the defaults as changed: the user gave them, or they
    come from a file or from another environment's preset.
    """
    preset = environment_presets(config.algo).get(config.env)
    mine = _settings(config)
    defaults = _settings(type(config)(algorithm=type(config.algorithm)()))
    if preset is None:
        given = [name for name in config.algorithm.__struct_fields__ if mine[name] != defaults[name]]
        which = f"settings: defaults, because {config.algo} has no preset for {config.env}"
        return f"{which}; changed: {', '.join(given)}" if given else which
    changed = [name for name, value in preset.items() if not _agrees(mine[name], value)]
    if all(defaults[name] == preset[name] for name in preset.keys() - changed):
        return f"settings: without the preset of {config.algo} for {config.env}"
    which = f"settings: preset of {config.algo} for {config.env}"
    excepted = f", except {', '.join(changed)}" if changed else ""
    return which + excepted + _other_update_size(config, defaults | preset)


def _other_update_size(config: Config, preset: Mapping[str, Any]) -> str:
    """The end of the line if updates have another number of env steps only because the preset has other `envs`.

    That number matters as much as the learning rate, but not with a replay buffer, from which each update samples.
    """
    rollout_steps = preset["rollout_steps"]
    envs = preset["envs"]
    if "replay_size" in preset or config.envs == envs or config.algorithm.rollout_steps != rollout_steps:
        return ""
    size = envs * rollout_steps
    kept = rollout_with(config.envs, size, config.algorithm.least_rollout)
    keep = f"; --rollout-steps {kept} keeps them" if config.envs * kept == size else ""
    return f"; an update has {config.envs * rollout_steps:,} env steps instead of the preset's {size:,}{keep}"


def _agrees(mine: Any, preset: Any) -> bool:
    """Whether a setting has the preset's value. A table agrees if it has all of the preset's entries."""
    return mine | preset == mine if isinstance(preset, dict) else bool(mine == preset)


def _settings(config: Config) -> dict[str, Any]:
    """The settings of the run and the algorithm, converted to TOML types."""
    settings: dict[str, Any] = msgspec.to_builtins(config)
    algorithm: dict[str, Any] = settings.pop("algorithm")
    return {name: list(value) if isinstance(value, tuple) else value for name, value in (settings | algorithm).items()}


@cache
def _tables() -> dict[str, Any]:
    return tomllib.loads(PRESETS.read_text())
