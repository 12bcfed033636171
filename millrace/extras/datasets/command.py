"""`millrace record`: write episodes of a run's policy as a Minari dataset."""

from __future__ import annotations

from millrace.flags.parse import parse_flags
from millrace.play_flags import RecordFlags
from millrace.terminal import count_line


def run(argv: list[str]) -> int:
    """Write the dataset, and print its size. Returns the exit code."""
    flags = parse_flags(RecordFlags, argv, "record")
    from millrace.extras.datasets.record import write_dataset  # takes 0.2 s, so imported only once the flags are valid

    with count_line("recording") as watch:
        dataset = write_dataset(flags, watch)
    print(dataset)
    if flags.npy is not None:
        print(f"rows of observation and action: {flags.npy}")
    return 0
