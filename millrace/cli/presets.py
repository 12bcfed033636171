"""`millrace presets`: lists settings that are known to work."""

from __future__ import annotations

import msgspec

from millrace.flags.parse import parse_flags
from millrace.flags.program_name import typed_name
from millrace.learner.config.presets import algorithms_and_environments, named_presets


class PresetsFlags(msgspec.Struct, frozen=True):
    """List settings that are known to work."""


def run(argv: list[str]) -> int:
    """List the presets. Returns the exit code."""
    parse_flags(PresetsFlags, argv, "presets")
    print("Used unless --preset says otherwise, by environment and algorithm:\n")
    for algo, env in algorithms_and_environments():
        print(f"  {typed_name()} train {env} --algo {algo}")
    print("\nComplete runs, by name:\n")
    for name, preset in named_presets().items():
        print(f"  {typed_name()} train --preset {name:24}  {preset.about}")
    return 0
