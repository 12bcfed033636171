"""The command line of `millrace train` and `millrace learner`: flags for all settings, and for where defaults come from."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

from millrace.flags.fields import Flag, fields_of
from millrace.flags.parse import Typed, asks_for_help, first_words, given_values, show_help, typed_flags
from millrace.learner.config.algorithm_names import settings_record
from millrace.learner.config.config import Config
from millrace.learner.config.layers import LowerLayers, SettingsLayer, merged, read_lower_layers, settings_of_run
from millrace.learner.config.other_names import in_place_of
from millrace.learner.config.resume_auto import settings_with_newest_run
from millrace.learner.run_folder.newest_run import AUTO


class RunFlags(Config, frozen=True, kw_only=True):
    """All settings of a run, and the flags that say where their defaults come from."""

    config: Annotated[Path | None, Flag("PATH")] = None
    """TOML file with settings. To repeat a run, use the config.toml in its run folder."""
    preset: str = "auto"
    """Preset to use: the name of a whole run (`millrace presets` lists them), or an environment whose preset to use. auto:
    ENV's preset, if there is one. none: no preset.
    """
    resume: Annotated[Path | None, Flag("PATH")] = None
    """Continue this run from its newest checkpoint. auto: continue the newest run in --run-dir with the same ENV, --algo and
    --seed, or start a new run if there is none. With auto, --config overrides the settings of the run that continues. Some
    settings can't be changed: see docs/how-to/resume.md.
    """
    log_json: bool = False
    """Log to stderr as JSON, one event per line, instead of text."""


BASIC = (
    "env", "algo", "steps", "seed", "workers", "envs", "env_kwargs", "wrappers", "start_from", "from_parts", "device",
    "preset", "config", "resume", "run_dir", "eval_episodes", "eval_every", "target_return", "target_mean_return",
)  # fmt: skip
GROUPS = {
    "evaluation": ("eval_env_kwargs", "eval_workers", "eval_copies", "eval_max_steps", "info_keys"),
    "several agents": (
        "seat_id", "self_play", "self_play_save_steps", "self_play_latest", "opponents", "teams",
    ),
    "workers": (
        "lanes", "max_lag", "vector", "critic_keys", "action_masks", "inference", "acting_dtype", "torch_threads",
        "max_env_copies", "min_workers", "launched_workers",
    ),
    "several learner processes": ("shards", "shard_timeout_s", "insecure_shards"),
    "network": ("transport", "bind", "advertise", "keys", "insecure"),
    "timeouts and failures": (
        "lost_lanes", "replay_limit", "restart_episodes", "worker_timeout_s", "no_workers_timeout_s", "start_timeout_s",
        "step_timeout_s", "grace_s", "max_env_failures",
    ),
    "files and logs": (
        "checkpoint_every_s", "keep_checkpoints", "record", "prior", "callbacks", "tensorboard", "metrics_bind", "dashboard",
        "log_json",
    ),
}  # fmt: skip
"""The settings in each group of the help, by the group's title. `BASIC` and the algorithm's settings precede the groups."""
LAYERS = ("config", "preset", "resume", "log_json")
"""Flags that aren't settings. They say where settings come from, or which format logs have."""
DESCRIPTIONS = {
    "train": "Train a policy on this machine. Flags override --config and presets.",
    "learner": "Listen at --bind and train with the workers that connect. Flags override --config and presets.",
}


def read_config(command: str, argv: list[str]) -> tuple[Config, Path | None]:
    """The settings from all layers, and the run folder to resume, if any.

    Raises `UsageError`, with a one-line message, if a setting or a file is not valid.
    """
    typed = typed_flags(argv)
    words = first_words(typed, "algo", "config", "preset", "resume")
    algo = words.get("algo")
    file = _path(words, "config")
    resume = _path(words, "resume")
    preset = words.get("preset", "auto")
    with_flags = partial(_read_flags, command, argv, typed)
    if resume == AUTO:
        return settings_with_newest_run(read_lower_layers(algo, file=file, resume=None, preset=preset), with_flags)
    return with_flags(read_lower_layers(algo, file=file, resume=resume, preset=preset)), resume


def _read_flags(command: str, argv: list[str], typed: list[Typed], lower: LowerLayers) -> Config:
    """The settings from the flags and the lower layers. The algorithm that the lower layers name adds its own flags."""
    own = fields_of(settings_record(lower.algo))
    fields = fields_of(RunFlags) | own
    given = given_values(fields, typed, command, partial(in_place_of, known=fields, flag=True))
    flags = SettingsLayer("", {name: value for name, value in given.items() if name not in LAYERS})
    if asks_for_help(argv):
        env = SettingsLayer("", {name: given[name] for name in given if name == "env"})
        base = merged(lower.algo, [*lower.below(flags), env])
        shown = RunFlags(**{name: getattr(base, name) for name in Config.__struct_fields__})
        of_algorithm = {base.algo.rpartition(":")[2]: (base.algorithm, list(own))}
        groups = {title: (shown, names) for title, names in GROUPS.items()}
        show_help(command, DESCRIPTIONS[command], {"basics": (shown, BASIC), **of_algorithm, **groups})
    return settings_of_run(lower, flags)


def _path(words: dict[str, str], flag: str) -> Path | None:
    return None if words.get(flag, "none") in ("none", "None") else Path(words[flag])
