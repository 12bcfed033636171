"""`millrace evaluate` and `millrace record`: play episodes of a run's policy."""

from __future__ import annotations

from millrace.flags.parse import parse_flags
from millrace.play_flags import EvaluateFlags, RecordFlags
from millrace.terminal import count_line


def evaluate(argv: list[str]) -> int:
    """Play, and print what the policy reached. Returns the exit code."""
    flags = parse_flags(EvaluateFlags, argv, "evaluate")
    from millrace.playing import play  # takes 0.2 s to import: not before the flags are known to be right

    with count_line("evaluating") as watch:
        evaluation, videos = play(flags, watch)
    print("\n".join(map(str, [evaluation, *videos])))
    return 0


def record(argv: list[str]) -> int:
    """Write the episodes as a Minari dataset. Returns the exit code."""
    flags = parse_flags(RecordFlags, argv, "record")
    from millrace.playing import write_dataset  # takes 0.2 s to import: not before the flags are known to be right

    with count_line("recording") as watch:
        dataset = write_dataset(flags, watch)
    print(dataset)
    if flags.npy is not None:
        print(f"rows of observation and action: {flags.npy}")
    return 0
