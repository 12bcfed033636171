"""Callbacks without a run: which objects are callbacks, in which order they are called, what ends a run."""

from __future__ import annotations

import logging
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from millrace.learner.callbacks.callback import Callback
from millrace.learner.callbacks.callbacks import MOMENTS, Callbacks
from millrace.learner.run_folder.callback_requests import MOST_LOGGED, Requests
from millrace.learner.run_folder.progress import Progress
from millrace.protocol.errors import UsageError

NOW = Progress(env_steps=7)


class Told(Callback):
    """Keeps the moments at which it is called, and answers with `answer`."""

    def __init__(self, answer: object = None) -> None:
        self.answer = answer
        self.told: list[str] = []

    def on_start(self, progress: Progress) -> object:
        self.told.append("on_start")
        return self.answer

    def on_update(self, progress: Progress) -> object:
        self.told.append(f"on_update {progress.env_steps}")
        return self.answer

    def on_end(self, progress: Progress) -> object:
        self.told.append("on_end")
        return self.answer


def tell_all(callbacks: Callbacks) -> None:
    for moment in MOMENTS:
        getattr(callbacks, moment)(NOW)


def test_a_callback_gets_what_it_wants_in_order() -> None:
    one = Told()
    shown: list[Progress] = []
    callbacks = Callbacks([one, shown.append])
    assert (callbacks.wants("on_update"), callbacks.wants("on_rollouts")) == (True, False)
    tell_all(callbacks)
    callbacks.meanwhile(NOW)
    assert one.told == ["on_start", "on_update 7", "on_end"]
    assert shown == [NOW] * 4, "update, evaluation, end, and during an evaluation"
    assert callbacks.stop_reason is None


def test_an_object_that_is_no_callback_by_class_will_do() -> None:
    class Plain:
        def on_checkpoint(self, progress: Progress) -> bool:
            return False

    callbacks = Callbacks([Plain()])
    tell_all(callbacks)
    assert callbacks.stop_reason == "ended by Plain.on_checkpoint"


@pytest.mark.parametrize("answer", [False, np.False_, np.bool_(False)])
def test_false_ends_the_run_and_the_first_counts(answer: object) -> None:
    first, second = Told(answer), Told(answer)
    callbacks = Callbacks([first, second])
    callbacks.on_start(NOW)
    assert callbacks.stop_reason == "ended by Told.on_start"
    assert second.told == ["on_start"], "the others hear of the same moment"
    callbacks.on_update(NOW)
    assert callbacks.stop_reason == "ended by Told.on_start"


def test_rollouts_of_which_no_update_is_made_are_told_to_no_further_callback() -> None:
    class Counts(Callback):
        def __init__(self, answer: object) -> None:
            self.answer = answer
            self.told = 0

        def on_rollouts(self, progress: Progress) -> object:
            self.told += 1
            return self.answer

    first, refuses, last = Counts(None), Counts(False), Counts(None)
    callbacks = Callbacks([first, refuses])
    callbacks.add(last)
    assert not callbacks.on_rollouts(NOW)
    assert (first.told, refuses.told, last.told) == (1, 1, 0)
    refuses.answer = None
    assert not callbacks.on_rollouts(NOW), "the run has been ended"
    assert Callbacks([first, refuses, last]).on_rollouts(NOW)
    assert (first.told, refuses.told, last.told) == (2, 2, 1)


@pytest.mark.parametrize("answer", [None, True, 0, 0.0, "", [], np.array([])])
def test_nothing_else_ends_it(answer: object) -> None:
    callbacks = Callbacks([Told(answer), lambda progress: answer])
    tell_all(callbacks)
    assert callbacks.stop_reason is None


def test_a_function_that_returns_false_ends_the_run() -> None:
    def enough(progress: Progress) -> bool:
        return False

    callbacks = Callbacks([enough])
    callbacks.on_update(NOW)
    assert callbacks.stop_reason == "ended by enough"


def test_what_a_callback_raises_names_it() -> None:
    class Broken(Callback):
        def on_update(self, progress: Progress) -> None:
            raise ValueError("no\nmore")

    with pytest.raises(ValueError, match="no") as caught:
        Callbacks([Broken()]).on_update(NOW)
    assert caught.value.__notes__ == ["raised in Broken.on_update"]


def test_every_callback_hears_of_the_end(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING, "millrace")

    class Broken(Callback):
        def __init__(self, line: str) -> None:
            self.line = line

        def on_end(self, progress: Progress) -> None:
            raise ValueError(self.line)

    last = Told()
    callbacks = Callbacks([Broken("first"), Broken("second"), last])
    callbacks.on_start(NOW)
    with pytest.raises(ValueError, match="first"):
        callbacks.on_end(NOW)
    assert last.told == ["on_start", "on_end"]
    assert [record.getMessage() for record in caplog.records] == ["on_end raised ValueError: second"]


def test_one_that_was_not_started_hears_of_no_end() -> None:
    one = Told()
    Callbacks([one]).on_end(NOW)
    assert one.told == []


def test_after_an_on_start_that_raises_those_behind_it_hear_of_no_end() -> None:
    class Broken(Told):
        def on_start(self, progress: Progress) -> object:
            super().on_start(progress)
            raise ValueError("no")

    before, broken, behind = Told(), Broken(), Told()
    callbacks = Callbacks([before, broken, behind])
    with pytest.raises(ValueError, match="no"):
        callbacks.on_start(NOW)
    callbacks.on_end(NOW)
    assert (before.told, broken.told, behind.told) == (["on_start", "on_end"], ["on_start", "on_end"], [])


@pytest.mark.parametrize(
    ("callback", "line"),
    [
        (3, "expected a function, or an object with some of the methods on_start, on_rollouts"),
        (Told, "expected an object, got a class; make one: Told()"),
        (
            type("Typo", (), {"on_updte": lambda self, progress: None})(),
            "a run never calls on_updte; did you mean on_update?",
        ),
        (type("Not", (), {"on_update": 3})(), "or an object with some of the methods"),
        (type("Half", (Told,), {"on_checkpoint": 3})(), "on_checkpoint: expected a method, got int"),
    ],
)
def test_an_object_that_is_no_callback_is_refused(callback: object, line: str) -> None:
    with pytest.raises(UsageError) as caught:
        Callbacks([callback])
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)


MODULE = """
from millrace import Callback

class Stop(Callback):
    def on_update(self, progress):
        return False

def broken():
    raise ValueError("no such file")

def nothing():
    return None

number = 3
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    (tmp_path / "mine_of_callbacks.py").write_text(MODULE)
    (tmp_path / "wrong_of_callbacks.py").write_text("import no_such_module_of_mine")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield "mine_of_callbacks"
    sys.modules.pop("mine_of_callbacks", None)


def test_a_callback_by_its_name_is_made_once(module: str) -> None:
    callbacks = Callbacks().with_named([f"{module}:Stop", f"{module}:Stop"])
    callbacks.on_update(NOW)
    assert callbacks.stop_reason == "ended by Stop.on_update"
    assert len(callbacks._callbacks) == 1, "a resumed run may name it again"


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("Stop", "callback Stop: expected module:factory, as in mine:EarlyStop"),
        (
            "no_such_module_of_mine:Stop",
            "no module named no_such_module_of_mine; is it installed, or its folder on PYTH",
        ),
        ("wrong_of_callbacks:Stop", "the import of wrong_of_callbacks failed: ModuleNotFoundError"),
        ("mine_of_callbacks:Stp", "module mine_of_callbacks has no Stp; did you mean mine_of_callbacks:Stop?"),
        ("mine_of_callbacks:number", "expected a function or class to call, got int"),
        ("mine_of_callbacks:broken", "broken() failed: ValueError: no such file"),
        ("mine_of_callbacks:nothing", "or an object with some of the methods"),
    ],
)
def test_a_name_that_gives_no_callback_is_one_line(module: str, name: str, line: str) -> None:
    with pytest.raises(UsageError) as caught:
        Callbacks().with_named([name])
    assert line in str(caught.value)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_numbers_that_are_logged() -> None:
    requests = Requests()
    progress = Progress(requests=requests)
    progress.log("entropy", np.float32(0.5))
    progress.log("mine/steps", 3)
    progress.log("tensor", torch.tensor([2.0]))
    progress.log("missing", math.nan)
    progress.log("far", -math.inf)
    expected = {"custom/entropy": 0.5, "mine/steps": 3.0, "custom/tensor": 2.0, "custom/missing": None, "custom/far": None}
    assert requests.take_logged() == expected
    assert requests.take_logged() == {}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("", 1),
        ("a\nb", 1),
        (3, 1),
        ("x" * 201, 1),
        ("a", "1"),
        ("a", None),
        ("a", [1]),
        ("a", np.ones(2)),
        ("a", torch.ones(2)),
    ],
)
def test_what_cannot_be_logged_is_refused(name: Any, value: Any) -> None:
    with pytest.raises(UsageError, match="log") as caught:
        Requests().log(name, value)
    assert "\n" not in str(caught.value)


def test_a_row_has_a_bound() -> None:
    requests = Requests()
    for n in range(MOST_LOGGED):
        requests.log(f"n{n}", n)
    requests.log("n0", 1)
    with pytest.raises(UsageError, match="expected at most 1000 names in one row"):
        requests.log("more", 1)


def test_a_progress_of_no_run_takes_no_numbers() -> None:
    with pytest.raises(UsageError, match="this is not the progress of a run"):
        NOW.log("a", 1)
