"""`millrace evaluate`: plays greedy episodes of a run's policy."""

from __future__ import annotations

from millrace.flags.parse import parse_flags
from millrace.play_flags import EvaluateFlags
from millrace.terminal import count_line


def evaluate(argv: list[str]) -> int:
    """Play the episodes, and print the evaluation. Returns the exit code."""
    flags = parse_flags(EvaluateFlags, argv, "evaluate")
    from millrace.playing import play  # takes 0.2 s, so imported only once the flags are valid

    with count_line("evaluating") as watch:
        evaluation, videos = play(flags, watch)
    print("\n".join(map(str, [evaluation, *videos])))
    return 0
