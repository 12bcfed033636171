"""The last line that an environment wrote before it failed, because a simulator often names the reason only on its stderr.

Rule: of a worker's log, the lines that millrace wrote don't count, and neither does what follows the failure.
"""

from __future__ import annotations

import re
from pathlib import Path

from millrace.protocol.bounds import one_line

END = 1 << 16  # at most this many bytes are read, from the end of a log
OF_MILLRACE = r"^\d{4}-\d\d-\d\d [\d:,]+ worker \S+: .*"
FAILURE = re.compile(rf"{OF_MILLRACE}\nTraceback ", re.MULTILINE)


def with_last_output(wrong: str, logs: Path) -> str:
    """What went wrong, and what the worker that it names wrote last; `wrong` itself if the worker wrote nothing else.

    `logs`: the folder of the workers' logs.
    """
    named = re.match(r"worker (\w+) ", wrong)
    log = logs / f"{named[1]}.log" if named else None
    if named is None or log is None or not log.is_file():
        return wrong
    last = one_line(_last_line(log.read_bytes()[-END:].decode(errors="replace")))
    return wrong if last in wrong else f"{wrong}; {named[1]} wrote: {last}"


def _last_line(text: str) -> str:
    """The last line of a worker's output before its failure, apart from millrace's own; empty if there is none."""
    failure = FAILURE.search(text)
    before = text[: failure.start()] if failure else text
    lines = [line for line in before.splitlines() if line.strip() and not re.match(OF_MILLRACE, line)]
    return lines[-1].strip() if lines else ""
