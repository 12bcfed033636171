"""`python -m learner ENV --bind ADDRESS`: the learner alone, as `millrace learner`, with a log line now and then."""

from __future__ import annotations

import logging
import sys
import time

from learner.config.command_line import read_config
from learner.interrupts import stopped_by_signals
from learner.run_folder.json_log import JsonLines
from learner.run_folder.last_line import last_line
from learner.run_folder.progress import Progress
from learner.standard_streams import prepare_streams, unfailing
from protocol.bounds import indented
from protocol.errors import UserFacingError

log = logging.getLogger("millrace.learner")

LINE_EVERY_S = 10.0
RESUME = "python -m learner"


def main(argv: list[str]) -> int:
    """Serve until the run is over. Returns the exit code."""
    prepare_streams()
    with unfailing("stderr"):
        return _serve(argv)


def _serve(argv: list[str]) -> int:
    handler = logging.StreamHandler()
    plain = logging.Formatter("%(asctime)s learner: %(message)s")
    handler.setFormatter(JsonLines() if "--log-json" in argv else plain)
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    said = (-LINE_EVERY_S, "")

    def watch(progress: Progress) -> None:
        nonlocal said
        now, line = time.monotonic(), line_of(progress)
        if now - said[0] > LINE_EVERY_S and line != said[1]:  # the log itself says what a long wait is for
            said = (now, line)
            log.info("%s", line)

    try:
        config, resume = read_config("learner", argv)
        from learner.resumption import unless_finished
        from learner.run import serve  # torch: not before the flags are known to be right

        folder = unless_finished(config, resume, lambda checked: serve(config, checked, watch))
        log.info("run folder: %s", folder)
    except UserFacingError as error:
        sys.stderr.write("\n".join(filter(None, [last_line("learner", error, RESUME), indented(error.detail)])) + "\n")
        return error.exit_code
    except KeyboardInterrupt as interrupt:
        sys.stderr.write(last_line("learner", interrupt, RESUME) + "\n")
        return 130
    return 0


def line_of(progress: Progress) -> str:
    """The progress of the run as a line of the log."""
    mean = "none yet" if progress.return_mean is None else f"{progress.return_mean:.1f}"
    steps = f"{progress.env_steps:,} of {progress.total_steps:,} env steps"
    return f"{steps}, return {mean}, {progress.workers_alive} workers"


if __name__ == "__main__":
    with stopped_by_signals():
        exit_code = main(sys.argv[1:])
    if "learner.imports_ahead" in sys.modules:
        from learner.imports_ahead import exit_if_importing

        exit_if_importing(exit_code)
    sys.exit(exit_code)
