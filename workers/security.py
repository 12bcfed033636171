"""Security rules of a worker: to which learner it connects, and which code it runs for that learner. Pure.

Rule: a learner that is authenticated by its key, or that only this user can be (ipc, inproc), is trusted. A learner on
this machine is trusted a little. Any other is not trusted, and the worker connects to it only with --insecure.
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
