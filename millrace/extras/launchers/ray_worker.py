"""The worker program in a Ray actor, for `millrace launch ray`. Imports neither Ray nor torch."""

from __future__ import annotations

import os

from millrace.protocol.keys.worker_token import TOKEN_VARIABLE
from millrace.workers.__main__ import main as run_worker

FINAL_EXIT_CODES = (0, 2)  # the learner asked the worker to leave, or refused it; after other codes, Ray restarts it


class WorkerHost:
    """The Ray actor that runs a worker."""

    def run(self, address: str, token: str, processes: int) -> int:
        """Run the worker program until it leaves the learner. Returns its exit code.

        `token`: the join token as text; empty if the learner needs no keys. Raises `RuntimeError` if the program failed, so
        that Ray runs it again.
        """
        os.environ[TOKEN_VARIABLE] = token  # the program removes the variable after reading it
        code = run_worker([address, "--processes", str(processes), "--join-timeout-s", "600"])
        if code not in FINAL_EXIT_CODES:
            raise RuntimeError(f"the worker program ended with exit code {code}")
        return code
