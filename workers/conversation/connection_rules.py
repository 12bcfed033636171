"""Whether a worker connects with or without a token, and how long it waits for a learner before `Session.tick` gives up.

Rule: over TCP to another machine, a worker connects without a token only with --insecure. Pure; imports neither numpy nor
gymnasium.
"""

from __future__ import annotations

import math

from millrace.protocol.address import check_address, is_local
from millrace.protocol.errors import UsageError
from millrace.protocol.keys.keys import Token
from millrace.protocol.keys.worker_token import TOKEN_VARIABLE

REJOIN_TIMEOUT_S = 600.0
"""The minimum time for which a worker that has joined waits for its learner to come back."""
LEARNER_STARTED_IT_S = math.inf
"""How long a worker waits if its learner started it: without limit, because the learner may be suspended (Ctrl-Z) or busy,
and the worker ends when the learner does.
"""


def wait_limits_s(join_timeout_s: float, *, stay: bool) -> tuple[float, float]:
    """How many seconds a worker waits for its first learner, and for the return of a learner that it had joined.

    With `stay`, the first limit is infinite, and when the second has passed, the worker waits for another learner.
    """
    return math.inf if stay else join_timeout_s, max(join_timeout_s, REJOIN_TIMEOUT_S)


def checked_token(address: str, token: Token | None, *, insecure: bool) -> Token | None:
    """The token with which to connect, or None to connect without a token. Raises `UsageError` if neither is allowed."""
    check_address(address)
    if not address.startswith("tcp://"):
        return None  # the permissions of the socket determine who may connect
    if token is None and not insecure and not is_local(address):
        raise UsageError(
            f"address {address} is on another machine: expected --token FILE (or {TOKEN_VARIABLE}), made there by "
            "`millrace keys new NAME`; --insecure connects without a token, and trusts anyone who answers"
        )
    if token is not None and insecure:
        raise UsageError("a token or --insecure: expected one, got both")
    return token
