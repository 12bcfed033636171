"""Errors of an environment, as a worker reports them: the lane and the copy, and what the copy did. Pure.

Rule: the line of an error names the lane, or the evaluation, once, at its beginning. The learner puts the worker's name
before it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from traceback import extract_tb, format_exception

from millrace.protocol.envs.answers import OF_RESET, OF_STEP, WrongAnswer
from millrace.protocol.errors import EnvironmentFailed, first_line


class CopyFailed(Exception):
    """An env copy raised (the environment's own exception is the `__cause__`), or returned something invalid.

    `copy` is the copy's number within the lane, or None if a vector environment doesn't say which copy it was. `doing` is
    the call that failed, such as "make", "reset" or a step. If the copy did not raise, `line` says what was expected and
    what it returned.
    """

    def __init__(self, copy: int | None, doing: str = "reset", line: str = "") -> None:
        super().__init__(copy, doing, line)
        self.copy = copy
        self.doing = doing
        self.line = line


def environment_failed(lane: int | None, what: CopyFailed | str, doing: str = "") -> EnvironmentFailed:
    """The error for a lane, or for an evaluation if `lane` is None: one line, and the traceback as its detail if a copy
    raised.

    `doing` is the call that failed, if the caller knows it more precisely than the `CopyFailed`.
    """
    whose = "while the policy was evaluated: " if lane is None else f"lane {lane}, "
    detail = ""
    if isinstance(what, str):
        return EnvironmentFailed(whose + what, detail, lane)
    copy = "" if what.copy is None else f"copy {what.copy}, "
    if not (line := what.line):
        cause = what.__cause__ or what
        line = _what_it_did(cause)
        detail = "" if isinstance(cause, WrongAnswer) else "".join(format_exception(cause))
    return EnvironmentFailed(f"{whose}{copy}{doing or what.doing}: {line}", detail, lane)


@contextmanager
def environment_failures(lane: int | None, doing: str = "") -> Iterator[None]:
    """A context in which a `CopyFailed` of this lane, or of an evaluation, is raised as the error of
    `environment_failed`.
    """
    try:
        yield
    except CopyFailed as error:
        raise environment_failed(lane, error, doing) from error


def _what_it_did(cause: BaseException) -> str:
    """What the environment did wrong, in one line; for some exceptions, with advice."""
    if isinstance(cause, WrongAnswer):
        return str(cause)
    frames = extract_tb(cause.__traceback__)
    raised_by = (frames[-1].line or "") if frames else ""
    says = first_line(cause, "")
    advice = _about_action(says, raised_by) or _about_answer(says, raised_by)
    return f"its environment raised {type(cause).__name__}: {says or 'no message'}{advice}"


def _about_action(says: str, raised_by: str) -> str:
    """Advice at the end of an error's line if the environment needs a Python int as its action; else empty.

    Environments get a numpy integer as the action, just as from gymnasium's vector environments and `Discrete.sample`.
    """
    if not re.search(r"isinstance\(.*\bint\b", raised_by) and "np.int64(" not in says:
        return ""
    return (
        "; its action is a numpy integer: write int(action) there, or --wrappers my_module:MyWrapper, a "
        "gymnasium.ActionWrapper of yours whose action() returns int(action)"
    )


def _about_answer(says: str, raised_by: str) -> str:
    """Advice at the end of an error's line if a wrapper could not unpack the result of `reset` or `step`: the form that it
    expected. Else empty.
    """
    called = re.search(r"= .*\b(reset|step)\(", raised_by) if "unpack" in says else None
    if called is None:
        return ""
    return f"; {called[1]} below this wrapper returned another form: {OF_RESET if called[1] == 'reset' else OF_STEP}"
