"""Whom a worker may believe: before it connects, and when a learner asks it to run code. Pure.

The law: a learner that pinned itself by its key, or that only this user can be, is believed; one on this machine a little;
anybody else not at all, and it is spoken to only if somebody has spelt that out.
"""

from __future__ import annotations

from protocol.address import check_address, is_local
from protocol.errors import UsageError
from protocol.keys.key_folder import TOKEN_VARIABLE
from protocol.keys.keys import Token
from protocol.specs import Code


def entry(address: str, token: Token | None, *, insecure: bool) -> Token | None:
    """The token with which to connect; None without. Raises `UsageError` if it must not connect so."""
    check_address(address)
    if not address.startswith("tcp://"):
        return None  # the operating system decides who may open it
    if token is None and not insecure and not is_local(address):
        raise UsageError(
            f"address {address} is on another machine: expected --token FILE (or {TOKEN_VARIABLE}), made there by "
            "`millrace keys new NAME`; --insecure does without, and believes whoever answers"
        )
    if token is not None and insecure:
        raise UsageError("a token or --insecure: expected one, got both")
    return token


def trusted(address: str, token: Token | None) -> Code:
    """How much code the learner at this address may have this worker run."""
    if token is not None or not address.startswith("tcp://"):
        return Code.CALLABLES
    return Code.MODULES if is_local(address) else Code.REGISTERED
