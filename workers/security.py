"""Security rules of a worker: to which learner it connects, and which code it runs for that learner. Pure.

Rule: a worker runs pickled callables only for a learner that a token authenticates, or that is reached over ipc or inproc.
Over TCP without a token, it imports modules for a learner on this machine. For a learner on another machine it runs only
environments that are registered here, and it connects to it without a token only with --insecure.
"""

from __future__ import annotations

from protocol.address import check_address, is_local
from protocol.env_spec import AllowedCode
from protocol.errors import UsageError
from protocol.keys.key_folder import TOKEN_VARIABLE
from protocol.keys.keys import Token


def checked_token(address: str, token: Token | None, *, insecure: bool) -> Token | None:
    """The token with which to connect, or None to connect without. Raises `UsageError` if neither is allowed."""
    check_address(address)
    if not address.startswith("tcp://"):
        return None  # the permissions of the socket decide who may open it
    if token is None and not insecure and not is_local(address):
        raise UsageError(
            f"address {address} is on another machine: expected --token FILE (or {TOKEN_VARIABLE}), made there by "
            "`millrace keys new NAME`; --insecure connects without, and trusts whoever answers"
        )
    if token is not None and insecure:
        raise UsageError("a token or --insecure: expected one, got both")
    return token


def allowed_code(address: str, token: Token | None) -> AllowedCode:
    """How much code the learner at this address may make this worker run."""
    if token is not None or not address.startswith("tcp://"):
        return AllowedCode.CALLABLES
    return AllowedCode.MODULES if is_local(address) else AllowedCode.REGISTERED
