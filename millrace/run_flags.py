"""The flags of `millrace train` and `millrace learner`: all of `Config`, and where it comes from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from learner.config import Config, checked, lower_layers, over
from millrace.flags import parse


class RunFlags(Config, frozen=True, kw_only=True):
    """Train a policy. What is not given here comes from --config, then the preset of the environment, then the defaults."""

    config: Path | None = None
    """a TOML file of settings; a run folder's config.toml repeats that run"""
    preset: str = "auto"
    """the environment whose preset to take, or none"""
    resume: Path | None = None
    """a run folder to go on with, from its newest checkpoint"""
    debug: bool = False
    """show the traceback of an error"""


def configuration(command: str, argv: list[str]) -> tuple[Config, Path | None]:
    """The configuration from all its layers, and the run to resume.

    Flags are read twice, because what lies below them depends on them.
    """
    asked = [flag for flag in argv if flag not in ("-h", "--help")]
    first = parse(RunFlags, asked, command, RunFlags(algo=""), lenient=True)
    base = lower_layers(first.env, algo=first.algo or None, file=first.config, resume=first.resume, preset=first.preset)
    below = {**_fields(base), "env_kwargs": {}}
    flags = parse(RunFlags, argv if asked == argv else ["--help"], command, RunFlags(**below))
    config = Config(**_fields(flags))
    return checked(over(config, {"env_kwargs": base.env_kwargs | config.env_kwargs}, "")), flags.resume


def _fields(config: Config) -> dict[str, Any]:
    return {name: getattr(config, name) for name in Config.__struct_fields__}
