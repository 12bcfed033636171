"""`millrace presets`: settings that are known to work."""

from __future__ import annotations

from learner.config.presets import algorithms_and_environments, named_presets
from millrace.cli.commands import HELP_FLAGS, usage
from protocol.errors import UsageError


def run(argv: list[str]) -> int:
    """List them. Returns the exit code."""
    argv = [flag for flag in argv if flag != "--debug"]
    if argv and argv[0] in HELP_FLAGS:
        print(usage("presets"))
        return 0
    if argv:
        raise UsageError(f"presets: unexpected argument {argv[0]}")
    print("Used unless --preset says otherwise, by environment and algorithm:\n")
    for algo, env in algorithms_and_environments():
        print(f"  millrace train {env} --algo {algo}")
    print("\nComplete runs, by name:\n")
    for name, preset in named_presets().items():
        print(f"  millrace train --preset {name:24}  {preset.about}")
    return 0
