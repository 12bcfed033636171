"""The flags of `millrace train` and `millrace learner`: all settings of a run, and where their defaults come from."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

from learner.config.config import Config
from learner.config.flag_parser import parse_flags
from learner.config.hyperparameters import algorithms_with
from learner.config.layers import lower_layers, override
from learner.config.validation import validate
from learner.run_folder.resume import AUTO, newest_run


class RunFlags(Config, frozen=True, kw_only=True):
    """Train a policy. Settings that are not given here come from --config, then the preset of ENV, then the defaults."""

    config: Path | None = None
    """a TOML file of settings; a run folder's config.toml repeats that run"""
    preset: str = "auto"
    """a whole run by name (millrace presets lists them), the environment whose preset to take, or none"""
    resume: Path | None = None
    """a run folder to go on with, from its newest checkpoint; auto: the newest of this ENV, algo and seed, or a new one"""
    log_json: bool = False
    """say what happens as JSON, one event a line, on stderr; and nothing else"""
    debug: bool = False
    """show the traceback of an error"""


def read_config(command: str, argv: list[str]) -> tuple[Config, Path | None]:
    """The settings from all layers, and the run folder to resume, if any. Raises `UsageError` in one line."""
    config, resume = _read_layers(command, argv)
    if resume != AUTO:
        return config, resume
    found = newest_run(config)
    return (config, None) if found is None else (_read_layers(command, argv, found)[0], found)


def _read_layers(command: str, argv: list[str], resumed: Path | None = None) -> tuple[Config, Path | None]:
    """The settings, and the value of --resume. `resumed`: the run folder that `--resume auto` chose.

    The settings of a resumed run lie below the flags. The flags are parsed more than once, because the layers below them
    depend on some of them (--config, --preset, --resume, --algo, ENV).
    """
    without_help = [flag for flag in argv if flag not in ("-h", "--help")]
    parse = functools.partial(parse_flags, RunFlags, command=command, hint=algorithms_with)
    first = parse(without_help, default=RunFlags(algo=""), ignore_unknown=True)
    resume = resumed if first.resume == AUTO else first.resume
    file = None if resumed else first.config  # a resumed run already contains the settings of its --config
    below = functools.partial(lower_layers, algo=first.algo or None, file=file, resume=resume, preset=first.preset)
    algorithm = below("").algorithm
    if type(algorithm) is not type(first.algorithm):  # then the values of its own flags may have been mistaken for ENV
        first = parse(without_help, default=RunFlags(algo="", algorithm=algorithm), ignore_unknown=True)
    base = below(first.env)
    default = RunFlags(**{**_fields(base), "env_kwargs": {}})
    flags = parse(argv if without_help == argv else ["--help"], default=default)
    config = Config(**_fields(flags))
    return validate(override(config, {"env_kwargs": base.env_kwargs | config.env_kwargs}, "")), flags.resume


def _fields(config: Config) -> dict[str, Any]:
    return {name: getattr(config, name) for name in Config.__struct_fields__}
