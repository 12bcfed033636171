"""What a worker is doing, and how long a call to user code may take. Imports neither numpy nor gymnasium. Pure.

Rule: every call to user code has a limit, and a worker that exceeds it is ended (by `WorkerProcess.end_if_hung`). Millrace's
own code has no limit.
"""

from __future__ import annotations

from typing import Literal

import msgspec

Doing = Literal[
    "starting", "waiting", "describing", "making", "preparing", "resetting", "stepping", "repeating", "acting", "evaluating",
    "closing",
]  # fmt: skip
"""What a worker is doing, as its supervisor sees it. User code runs in all of these except `starting` and `waiting`.

`making` is making an env copy. `repeating` is replaying a step of an episode that another worker has lost. `preparing` is
making a policy, including its imports. `acting` is a call to a user-defined policy.
"""
CLOSE_S = 10.0  # limit for closing one env copy; short, because the environment has already done its work
OUR_CODE: frozenset[Doing] = frozenset({"starting", "waiting"})
OF_POLICY: frozenset[Doing] = frozenset({"preparing", "acting"})
CALLS: dict[Doing, str] = {
    "describing": "the construction of its environment",
    "making": "the construction of its environment",
    "preparing": "the construction of the policy",
    "resetting": "a reset of its environment",
    "stepping": "a step of its environment",
    "repeating": "a step of an episode that it replays",
    "acting": "a call of the policy",
    "evaluating": "a step of an evaluation",
    "closing": "close() of its environment",
}
"""The phrase for each kind of call to user code, used in the line that says why a worker was ended."""


class CallTimeouts(msgspec.Struct, frozen=True):
    """How many seconds one call to user code may take before the supervisor ends the worker. 0 means no limit.

    The fields have the names of the flags.
    """

    start_s: float = 600.0
    """making or resetting an env copy, or making the policy"""
    step_s: float = 600.0
    """a step of an env copy, or a call to a user-defined policy"""

    def limit_s(self, doing: Doing) -> float:
        """The limit of this activity; infinite if it has none."""
        match doing:
            case "describing" | "making" | "preparing" | "resetting":
                limit = self.start_s
            case "stepping" | "repeating" | "acting" | "evaluating":
                limit = self.step_s
            case "closing":
                limit = CLOSE_S
            case "starting" | "waiting":
                limit = 0.0
        return limit or float("inf")

    def longest_s(self) -> float:
        """The longest time that a call may take; infinite if one of them may take any time."""
        return max(self.limit_s("making"), self.limit_s("stepping"))

    def limit_in_words(self, doing: Doing) -> str:
        """The limit of this activity, and the flag that sets it."""
        flag = "step" if doing in ("stepping", "repeating", "acting", "evaluating") else "start"
        named = f" (--{flag}-timeout-s)" if doing != "closing" else ""
        return f"{self.limit_s(doing):g} s{named}"

    def reason(self, doing: Doing) -> str:
        """Why a worker that exceeds its limit is ended, in a line that names the flag."""
        return f"was ended: {CALLS[doing]} took longer than {self.limit_in_words(doing)}"
