"""What Ray places and restarts for `millrace launch ray`: the worker program, in an actor. Imports neither Ray nor torch."""

from __future__ import annotations

import os

from protocol.keys.key_folder import TOKEN_VARIABLE
from workers.__main__ import main as work

STAYS_AWAY = (0, 2)  # it was told to leave, or refused; any other is run again


class WorkerHost:
    """The actor."""

    def run(self, address: str, token: str, processes: int) -> int:
        """The worker program until it leaves; its exit code. `token` may be empty. Raises where Ray shall run it again."""
        os.environ[TOKEN_VARIABLE] = token  # it forgets the variable when it has read it
        code = work([address, "--processes", str(processes), "--join-timeout-s", "600"])
        if code not in STAYS_AWAY:
            raise RuntimeError(f"the worker program ended with exit code {code}")
        return code
