"""The flags of `millrace train` and `millrace learner`: all of `Config`, and where it comes from."""

from __future__ import annotations

from pathlib import Path

import msgspec

from learner.config import Config, checked, lower_layers, over
from millrace.flags import parse


class RunFlags(msgspec.Struct, frozen=True, kw_only=True):
    """Train a policy. What is not given here comes from --config, then the preset of the environment, then the defaults."""

    run: Config = Config()
    """the run"""
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
    unset = RunFlags(run=Config(algo=""))
    early = parse(RunFlags, [flag for flag in argv if flag not in ("-h", "--help")], command, unset, lenient=True)
    base = lower_layers(
        early.run.env, algo=early.run.algo or None, file=early.config, resume=early.resume, preset=early.preset
    )
    flags = parse(RunFlags, argv, command, RunFlags(run=msgspec.structs.replace(base, env_kwargs={})))
    env_kwargs = base.env_kwargs | flags.run.env_kwargs
    return checked(over(flags.run, {"env_kwargs": env_kwargs}, "")), flags.resume
