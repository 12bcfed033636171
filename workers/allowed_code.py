"""Which code a worker runs for its learner. Pure.

Rule: a worker runs pickled callables only for a learner that is authenticated by a token, or reached over ipc or inproc.
Over TCP without a token, it imports modules for a learner on this machine. For a learner on another machine, it runs only
environments that are registered here.
"""

from __future__ import annotations

from millrace.protocol.address import is_local
from millrace.protocol.env_spec import AllowedCode
from millrace.protocol.keys.keys import Token


def allowed_code(address: str, token: Token | None) -> AllowedCode:
    """How much code the learner at this address may make this worker run."""
    if token is not None or not address.startswith("tcp://"):
        return AllowedCode.CALLABLES
    return AllowedCode.MODULES if is_local(address) else AllowedCode.REGISTERED
