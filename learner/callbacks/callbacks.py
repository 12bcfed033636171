"""All of a run's callbacks as one object. It calls them in order, and remembers whether one of them ended the run.

Rule: callbacks' exceptions propagate, with a note that names the callback. `on_end` is called on every callback that was
started, even if an earlier callback raised. A callback that is a function is called to show the run's progress: after each
update and evaluation, several times a second during an evaluation or a long wait, and at the end.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any, Self

from millrace.learner.callbacks.callback import Callback
from millrace.learner.callbacks.named import named_callback
from millrace.learner.run_folder.progress import Progress
from millrace.protocol.bounds import one_line
from millrace.protocol.envs.found_names import attribute
from millrace.protocol.errors import UsageError, did_you_mean, first_line, safe_repr

log = logging.getLogger("millrace.learner")

MOMENTS = ("on_start", "on_rollouts", "on_update", "on_evaluation", "on_checkpoint", "on_end")
Show = Callable[[Progress], object]


class Callbacks:
    """The callbacks of one run."""

    def __init__(self, callbacks: Sequence[object] = (), passed: Sequence[object] = ()) -> None:
        """Functions, or objects with some of `Callback`'s methods. Raises `UsageError` for anything else.

        `passed` come after the others. The user's program has passed them, so only that program can pass them again.
        """
        self.stop_reason: str | None = None
        """Why a callback ended the run; None if none did."""
        self._callbacks = [_checked(callback) for callback in (*callbacks, *passed)]
        self.passed = tuple(one_line(_name(callback, "__call__"), 100) for callback in passed)
        """The names of the callbacks that the user's program has passed."""
        self._started: list[object] = []  # callbacks whose `on_start` was called, even if it raised

    @staticmethod
    def of(watch: Watch) -> Callbacks:
        """A run's callbacks, from a `Callbacks` object or a single function."""
        return watch if isinstance(watch, Callbacks) else Callbacks([watch])

    def with_named(self, names: Sequence[str]) -> Self:
        """Add the callbacks with these names, `module:factory`. Raises `UsageError` if one of them cannot be created."""
        self._callbacks += [_checked(named_callback(name), name) for name in dict.fromkeys(names)]
        return self

    def add(self, callback: object) -> None:
        """Add a callback that is called after the others. Raises `UsageError` if it isn't a valid callback."""
        self._callbacks.append(_checked(callback))

    def wants(self, moment: str) -> bool:
        """Whether any callback has this method."""
        return any(_method(callback, moment) for callback in self._callbacks)

    def on_start(self, progress: Progress) -> None:
        """Call `on_start` of all callbacks: the run begins, or is resumed."""
        for callback in self._callbacks:
            self._started.append(callback)
            self._call_one(callback, "on_start", progress)

    def on_rollouts(self, progress: Progress) -> bool:
        """Call `on_rollouts` of the callbacks, until one ends the run. Returns whether an update should use the rollouts."""
        for callback in self._callbacks:
            if self.stop_reason is None:
                self._call_one(callback, "on_rollouts", progress)
        return self.stop_reason is None

    def on_update(self, progress: Progress) -> None:
        """Show the progress, and call `on_update` of all callbacks."""
        self._show(progress)
        self._call("on_update", progress)

    def on_evaluation(self, progress: Progress) -> None:
        """Show the progress, and call `on_evaluation` of all callbacks."""
        self._show(progress)
        self._call("on_evaluation", progress)

    def meanwhile(self, progress: Progress) -> None:
        """Show the progress during an evaluation or a long wait. `progress.waiting` says what is awaited, or how far."""
        self._show(progress)

    def on_checkpoint(self, progress: Progress) -> None:
        """Call `on_checkpoint` of all callbacks, unless the checkpoint was written before `on_start`."""
        if self._started:
            self._call("on_checkpoint", progress)

    def on_end(self, progress: Progress) -> None:
        """Call `on_end` of all started callbacks. Raises the first exception from these calls; logs further ones."""
        raised: BaseException | None = None
        calls = [self._show]
        calls += [lambda progress, each=each: _call(each, "on_end", progress) for each in self._started]  # type: ignore[misc]
        for call in calls:
            try:
                call(progress)
            except BaseException as error:
                if raised is None:
                    raised = error
                else:
                    log.warning("on_end raised %s: %s", type(error).__name__, first_line(error))
        if raised is not None:
            raise raised

    def _show(self, progress: Progress) -> None:
        self._call("__call__", progress)

    def _call(self, moment: str, progress: Progress) -> None:
        for callback in self._callbacks:
            self._call_one(callback, moment, progress)

    def _call_one(self, callback: object, moment: str, progress: Progress) -> None:
        if _ends_the_run(_call(callback, moment, progress)) and self.stop_reason is None:
            self.stop_reason = one_line(f"ended by {_name(callback, moment)}", 300)


Watch = Callbacks | Show


def _ends_the_run(answer: object) -> bool:
    return answer is False or (type(answer).__name__ == "bool" and not answer)  # the second case is numpy's bool


def _call(callback: object, moment: str, progress: Progress) -> object:
    method = _method(callback, moment)
    if method is None:
        return None
    try:
        return method(progress)
    except BaseException as error:
        note = one_line(f"raised in {_name(callback, moment)}", 300)
        if note not in getattr(error, "__notes__", ()):  # the same error may be raised again when the run ends
            error.add_note(note)
        raise


def _method(callback: object, moment: str) -> Callable[[Progress], object] | None:
    """The callback's method, or None if it is the empty one of `Callback`. For `__call__`, the function itself."""
    if moment == "__call__":
        return None if not callable(callback) or any(hasattr(callback, each) for each in MOMENTS) else callback
    found: Any = getattr(callback, moment, None)
    return None if getattr(found, "__func__", None) is getattr(Callback, moment) else found


def _name(callback: object, moment: str) -> str:
    named = attribute(callback, "__qualname__")
    name = (named if isinstance(named, str) else type(callback).__qualname__).rpartition("<locals>.")[2]
    return name if moment == "__call__" else f"{name}.{moment}"


def _checked(callback: object, name: str = "") -> object:
    who = one_line(f"callback {name or safe_repr(callback)}", 300)
    if isinstance(callback, type):
        raise UsageError(f"{who}: expected an object, got a class; make one: {callback.__name__}()")
    for name in dir(callback):
        if name.startswith("on_") and name not in MOMENTS and callable(attribute(callback, name)):
            hint = did_you_mean(name, MOMENTS)
            raise UsageError(f"{who}: a run never calls {name}{hint}; expected {', '.join(MOMENTS)}")
    methods = [getattr(callback, moment, None) for moment in MOMENTS]
    if not any(map(callable, methods)) and _method(callback, "__call__") is None:
        raise UsageError(f"{who}: expected a function, or an object with some of the methods {', '.join(MOMENTS)}")
    if wrong := next((m for m, f in zip(MOMENTS, methods, strict=True) if f is not None and not callable(f)), None):
        raise UsageError(f"{who}: {wrong}: expected a method, got {type(getattr(callback, wrong)).__name__}")
    return callback
