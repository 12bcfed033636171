"""Where a worker's join token comes from: a file that `--token` names, or an environment variable.

Rule: a token is never on a command line, which other users of the machine can see, and environments that a worker starts
don't inherit it.
"""

from __future__ import annotations

import os

from millrace.protocol.errors import UsageError
from millrace.protocol.home_folder import expanded
from millrace.protocol.keys.key_folder import read_secret
from millrace.protocol.keys.keys import Token

TOKEN_VARIABLE = "MILLRACE_TOKEN"


def read_token(flag: str) -> Token | None:
    """The token from the flag's file, or else from the environment variable; None if neither is set.

    The environment variable holds a file name or the token itself. It is removed, so that processes that an environment
    starts do not inherit it. Raises `UsageError` if the file can't be read or its text isn't a token.
    """
    given = os.environ.pop(TOKEN_VARIABLE, "").strip()
    if flag.startswith("millrace1."):
        raise UsageError(
            f"--token: expected a file, got the token itself, which others can now see; put it in a file or {TOKEN_VARIABLE}"
        )
    if flag:
        return Token.from_text(read_secret(expanded(flag, "token"), "token"), f"token {flag}")
    if not given:
        return None
    text = (
        given
        if given.startswith("millrace") and not os.path.exists(given)  # Path.exists raises if a name is too long
        else read_secret(expanded(given, "token"), "token")
    )
    return Token.from_text(text, TOKEN_VARIABLE)
