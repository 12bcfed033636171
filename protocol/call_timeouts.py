"""What a worker does, and how long a call of the user's code may take. Imports neither numpy nor gymnasium. Pure.

Rule: every call of code of the user has a limit, and a worker that exceeds it is ended (`WorkerProcess.end_if_hung`
does that). Code of ours has none.
"""

from __future__ import annotations

from typing import Literal

import msgspec

Doing = Literal[
    "starting", "waiting", "describing", "making", "preparing", "resetting", "stepping", "repeating", "acting", "evaluating",
    "closing",
]  # fmt: skip
"""What a worker does, as its supervisor sees it. Code of the user runs in all of these except `starting` and `waiting`.

`making`: an env copy. `repeating`: a step of an episode that another worker has lost. `preparing`: a policy, with all that
it imports. `acting`: a call of a policy that is the user's code.
"""
CLOSE_S = 10.0  # for one env copy; what hangs in `close` has done its work
OUR_CODE: frozenset[Doing] = frozenset({"starting", "waiting"})
OF_POLICY: frozenset[Doing] = frozenset({"preparing", "acting"})
CALLS: dict[Doing, str] = {
    "describing": "the construction of its environment",
    "making": "the construction of its environment",
    "preparing": "the construction of the policy",
    "resetting": "a reset of its environment",
    "stepping": "a step of its environment",
    "repeating": "a step of an episode that it repeats",
    "acting": "a call of the policy",
    "evaluating": "a step of an evaluation",
    "closing": "close() of its environment",
}
"""The calls of code of the user, for the reasons why a worker ended."""


class CallTimeouts(msgspec.Struct, frozen=True):
    """How many seconds one call of the user's code may take before the supervisor ends its worker. 0: any time.

    The fields are named as the flags are.
    """

    start_s: float = 600.0
    """making or resetting an env copy, or making the policy"""
    step_s: float = 600.0
    """a step of an env copy, or a call of a policy that the user wrote"""

    def limit_s(self, doing: Doing) -> float:
        """The limit of what a worker does; infinite if it has none."""
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

    def reason(self, doing: Doing) -> str:
        """Why a worker is ended that exceeds its limit. The line names the flag."""
        flag = "step" if doing in ("stepping", "repeating", "acting", "evaluating") else "start"
        named = f" (--{flag}-timeout-s)" if doing != "closing" else ""
        return f"was ended: {CALLS[doing]} took longer than {self.limit_s(doing):g} s{named}"
