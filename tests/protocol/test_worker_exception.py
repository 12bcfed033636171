"""The exception of a worker is made again from its traceback: Python's own only, and nothing but its text is used."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from typing import Any

import pytest

from millrace.protocol.errors import EnvironmentFailed, WorkerTraceback, worker_exception


def raised(*errors: BaseException) -> str:
    """The traceback of the last one, of which the others are the causes."""
    before: BaseException | None = None
    for error in errors:
        try:
            raise error from before
        except BaseException as caught:
            before = caught
    return "".join(traceback.format_exception(before))


def noted(error: Exception) -> Exception:
    error.add_note("a note")
    return error


class Own(Exception):
    """Of a module that the learner may not have."""


@pytest.mark.parametrize(
    ("errors", "made"),
    [
        ((ValueError("one"),), ValueError("one")),
        ((ValueError("several\n  lines\nOSError: not this"),), ValueError("several\n  lines\nOSError: not this")),
        ((ValueError(),), ValueError()),
        ((KeyError("k"),), KeyError("'k'")),
        ((noted(OSError("no licence")),), OSError("no licence\na note")),
        ((Own("cause"), RuntimeError("effect")), RuntimeError("effect")),
        ((SyntaxError("bad", ("file.py", 1, 1, "1 +")),), SyntaxError("bad")),
    ],
)
def test_an_exception_of_pythons_own_is_made_again(errors: tuple[Exception, ...], made: Exception) -> None:
    error = worker_exception(raised(*errors))
    assert repr(error) == repr(made)
    assert error is not None
    assert isinstance(error.__cause__, WorkerTraceback)


@pytest.mark.parametrize(
    "text",
    [
        raised(Own("mine")),
        raised(SystemExit("no Exception")),
        raised(ExceptionGroup("several", [ValueError("one")])),
        raised(UnicodeDecodeError("utf-8", b"", 0, 1, "takes five arguments")),
        "ValueError: without a frame",
        '  File "x", line 1\nprint: no exception',
        '  File "x", line 1\n__import__("os").abort()',
        '  File "x", line 1',
    ],
)
def test_every_other_is_the_text_of_the_traceback(text: str) -> None:
    error = worker_exception(text)
    assert type(error) is WorkerTraceback
    assert text.strip() in str(error)


def test_without_a_traceback_there_is_no_cause() -> None:
    assert worker_exception("") is None
    assert EnvironmentFailed("its action space changed").__cause__ is None


def test_python_shows_the_traceback_of_the_worker_without_control_characters() -> None:
    def fails() -> None:
        raise EnvironmentFailed("worker w1: broken", raised(ValueError("one \x1b[2J")))

    shown = shown_by_python(fails)
    assert "in raised" in shown
    assert "ValueError: one \\x1b[2J" in shown
    assert "\x1b" not in shown
    assert shown.endswith("EnvironmentFailed: worker w1: broken\n")


def shown_by_python(function: Callable[[], Any]) -> str:
    try:
        function()
    except Exception:
        return traceback.format_exc()
    raise AssertionError("expected an exception")
