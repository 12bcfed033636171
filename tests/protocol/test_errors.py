"""What errors are made of: the first line of an exception, and the check of a number that the user gave."""

from __future__ import annotations

import errno
import resource

import pytest

from millrace.protocol.errors import UsageError, check_at_least, first_line, usage_error


class WithoutText(Exception):
    """Its `__str__` raises."""

    def __str__(self) -> str:
        raise KeyError("no text")


def test_the_first_line_of_an_exception_is_its_message_or_says_that_there_is_none() -> None:
    assert first_line(ValueError("\n one \n two")) == "one"
    assert first_line(ValueError()) == "no message"
    assert first_line(WithoutText(), "nothing") == "nothing"


def test_what_is_less_is_refused() -> None:
    check_at_least("episodes", 1, 1)
    with pytest.raises(UsageError, match=r"^episodes: expected int >= 1, got 0$"):
        check_at_least("episodes", 0, 1)


def test_an_error_is_one_line_whatever_it_quotes() -> None:
    assert str(UsageError("run a\nb\x1b[2J: no such folder")) == r"run a\nb\x1b[2J: no such folder"


def test_the_limit_of_open_files_is_named() -> None:
    most, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    line = f"a process may have {most} files open here, which is too few: `ulimit -n 4096`, or fewer workers"
    assert str(usage_error(OSError(errno.EMFILE, "Too many open files"))) == line
    assert usage_error(OSError(errno.ENOSPC, "No space left on device")) is None


def test_a_path_that_is_too_long_is_cut_and_what_to_do_is_said() -> None:
    error = usage_error(OSError(errno.ENAMETOOLONG, "File name too long", "x" * 5000))
    assert str(error) == f"path {'x' * 499}…: File name too long; choose a shorter one"
