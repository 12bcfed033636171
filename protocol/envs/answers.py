"""Reads what `reset` and `step` of an environment return. Raises `WrongAnswer` for any form other than gymnasium's.

Rule: None as the info means an empty info. If the info is neither None nor a dict, the environment didn't return gymnasium's
tuple, but perhaps an observation with the same number of elements, so none of it is used.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from millrace.protocol.bounds import one_line

RESET = "observation, info"
STEP = "observation, reward, terminated, truncated, info"
"""The values that each method returns."""
OF_RESET = f"expected ({RESET})"
OF_STEP = f"expected ({STEP})"


class WrongAnswer(Exception):
    """An environment returned something that its interface does not allow.

    The text is the line for the error message; the code that catches this adds which env copy it was.
    """


def reset_answer(answer: Any) -> tuple[Any, Mapping[str, Any]]:
    """The observation and the info that `reset` returned. Raises `WrongAnswer` if it returned anything else."""
    if type(answer) is tuple and len(answer) == 2 and type(answer[1]) is dict:  # fast path for nearly all environments
        return answer
    if isinstance(answer, tuple | list) and len(answer) == 2 and (answer[1] is None or isinstance(answer[1], Mapping)):
        return answer[0], answer[1] or {}
    raise WrongAnswer(f"its reset returned {in_words(answer)}; {OF_RESET}: end it with `return observation, {{}}`")


def wrong_step(answer: Any) -> WrongAnswer:
    """The error for a `step` that did not return five values, the last of them a dict."""
    told = f"its step returned {in_words(answer)}; {OF_STEP}"
    if isinstance(answer, tuple | list) and len(answer) == 4:
        return WrongAnswer(f"{told}, not the old form with `done`: truncated is True if a time limit ends the episode")
    return WrongAnswer(told)


def in_words(answer: Any) -> str:
    """The types and number of the returned values, in words."""
    match answer:
        case tuple() | list():
            kinds = ", ".join(_kind(each) for each in answer[:6])
            return one_line(f"{len(answer)} values ({kinds}{', …' if len(answer) > 6 else ''})", 160)
        case _:
            return _kind(answer)


def _kind(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{list(value.shape)}"
    return "None" if value is None else type(value).__name__
