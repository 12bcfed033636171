"""The flags of `millrace train` and `millrace learner`: all settings of a run, and where their defaults come from."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

from learner.config.config import TABLES, Config
from learner.config.flag_help import show_help
from learner.config.flag_parser import parse_flags
from learner.config.hyperparameters import HYPERPARAMETERS, AlgorithmConfig, PPOConfig, algorithms_with
from learner.config.layers import lower_layers, override
from learner.config.validation import validate
from learner.run_folder.newest_run import AUTO, newest_run
from protocol.errors import UsageError


class RunFlags(Config, frozen=True, kw_only=True):
    """All settings of a run, and where their defaults come from."""

    config: Path | None = None
    """TOML file of settings. The config.toml of a run folder repeats that run."""
    preset: str = "auto"
    """Preset to use: the name of a whole run (`millrace presets` lists them), or an environment, for the preset of that
    environment. auto: the preset of ENV, if there is one. none: no preset.
    """
    resume: Path | None = None
    """Continue this run folder from its newest checkpoint. auto: continue the newest run in --run-dir with the same ENV,
    --algo and --seed, or start a new run if there is none. Some settings cannot change then: see docs/how-to/resume.md.
    """
    log_json: bool = False
    """Log to stderr as JSON, one event per line, instead of text."""
    debug: bool = False
    """Show the traceback of an error."""


def read_config(command: str, argv: list[str]) -> tuple[Config, Path | None]:
    """The settings from all layers, and the run folder to resume, if any.

    Raises `UsageError`, with a one-line message, if a setting or a file is not valid.
    """
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
    argv = _none_for_tyro(argv, PPOConfig())
    without_help = [flag for flag in argv if flag not in ("-h", "--help")]
    parse = functools.partial(parse_flags, RunFlags, command=command, hint=algorithms_with)
    try:
        first = parse(without_help, default=RunFlags(algo=""), ignore_unknown=True)
    except UsageError:  # perhaps because another algorithm has a flag of the same name and another type
        first = parse(without_help, default=RunFlags(algo="", algorithm=AlgorithmConfig()), ignore_unknown=True)
    resume = resumed if first.resume == AUTO else first.resume
    # A run that `--resume auto` found already contains the settings of its --config and --preset.
    file, preset = (None, "none") if resumed else (first.config, first.preset)
    below = functools.partial(lower_layers, algo=first.algo or None, file=file, resume=resume, preset=preset)
    algorithm = below("").algorithm
    argv, without_help = _none_for_tyro(argv, algorithm), _none_for_tyro(without_help, algorithm)
    if type(algorithm) is not type(first.algorithm):  # then the values of its own flags may have been mistaken for ENV
        first = parse(without_help, default=RunFlags(algo="", algorithm=algorithm), ignore_unknown=True)
    base = below(first.env)
    default = RunFlags(**{**_fields(base), **{name: {} for name in TABLES}, "wrapper": ()})
    if without_help != argv:
        show_help(default, command)
    flags = parse(argv, default=default)
    config = Config(**_fields(flags))
    merged = {name: getattr(base, name) | getattr(config, name) for name in TABLES}
    return validate(override(config, {**merged, "wrapper": config.wrapper or base.wrapper}, "")), flags.resume


def _none_for_tyro(argv: list[str], algorithm: AlgorithmConfig) -> list[str]:
    """`--core none`, as it stands in a TOML file, becomes `--core None`; likewise all settings whose default may be None.

    Also if they are written with a sign: `--core=none` becomes `--core=None`.
    """
    records = [Config(), *(kind() for kind in (*HYPERPARAMETERS.values(), type(algorithm)))]
    optional = {f"--{name}" for record in records for name in record.__struct_fields__ if getattr(record, name) is None}

    def for_tyro(before: str, word: str) -> str:
        flag, _, value = f"{before}={word}".rpartition("=") if word == "none" else word.rpartition("=")
        if value != "none" or flag.replace("-", "_").replace("__", "--", 1) not in optional:
            return word
        return f"{word.removesuffix('none')}None"

    return [for_tyro(before, word) for before, word in zip(["", *argv], argv, strict=False)]


def _fields(config: Config) -> dict[str, Any]:
    return {name: getattr(config, name) for name in Config.__struct_fields__}
