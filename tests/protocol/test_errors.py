"""What errors are made of: the first line of an exception, and the check of a number that the user gave."""

from __future__ import annotations

import numpy as np
import pytest

from protocol.errors import UsageError, check_at_least, first_line


class WithoutText(Exception):
    """Its `__str__` raises."""

    def __str__(self) -> str:
        raise KeyError("no text")


def test_the_first_line_of_an_exception_is_its_message_or_says_that_there_is_none() -> None:
    assert first_line(ValueError("\n one \n two")) == "one"
    assert first_line(ValueError()) == "no message"
    assert first_line(WithoutText(), "nothing") == "nothing"


@pytest.mark.parametrize("value", [0, -1, "4", 2.5, None, float("nan"), np.float64(3)])
def test_what_is_less_or_no_whole_number_is_refused(value: object) -> None:
    with pytest.raises(UsageError, match=r"^episodes: expected int >= 1, got "):
        check_at_least("episodes", value, 1)


def test_whole_numbers_of_any_type_pass() -> None:
    check_at_least("episodes", np.int32(1), 1)
    check_at_least("episodes", 2**70, 1)
