"""Records every call of the coordinators and of the session of this process, with times and results, in a trace file.

Rule: the program does not know of it. When one of its modules is imported, its class is replaced by a subclass that writes
each call, after it returned and before anything of its result is sent. A call that another one makes is not written. Without
MILLRACE_TRACE nothing of this is imported.
"""

from __future__ import annotations

import os
import pickle
import sys
import time
from collections.abc import Callable, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from importlib.util import spec_from_loader
from pathlib import Path
from types import ModuleType
from typing import Any

FOLDER = "MILLRACE_TRACE"
OPEN_HUB = "millrace.learner.open_hub"
COORDINATOR = "millrace.learner.rollouts.ticket_coordinator"
DESCRIBE = "millrace.learner.members.describe_coordinator"
SESSION = "millrace.workers.conversation.session"
COMMON = ("receive", "reject_message", "revoke", "process_ended", "remove_silent")
METHODS = {
    "TicketCoordinator": (
        *COMMON,
        *("refuse", "publish", "begin_update", "begin_evaluation", "await_evaluation"),
        *("share_evaluation", "drain", "take_over", "keep"),
    ),
    "RolloutDealer": ("take", "not_used", "incarnations"),
    "EvaluationDealer": ("end",),
    "DescribeCoordinator": (*COMMON, "ask", "ask_more"),
    "Membership": ("refuse", "record_activity"),
    "Session": (
        *("handle", "tick", "heartbeat_if_due", "update_statistics", "stop", "fail", "decline", "refused"),
        *("next_work", "work_ended"),
    ),
}
NOT_RECORDED = {  # it changes nothing, or nobody calls it
    "TicketCoordinator": {"collected", "steps_of_update", "past"},
    "DescribeCoordinator": {"drain", "status", "take_over"},
    "Session": {"is_unwanted", "missing_versions"},
}
PARTS_OF_THE_COORDINATOR = ("Membership", "RolloutDealer", "EvaluationDealer")
CHANGE_NOTHING_IF_EMPTY = ("tick", "heartbeat_if_due")


class Recorder:
    """The trace file of this process."""

    def __init__(self, name: str) -> None:
        from tests.model.traces.record import SUFFIX, Digests

        self.inside = False  # whether a call that is written is under way
        self.digests = Digests()
        self._fd = os.open(Path(os.environ[FOLDER]) / f"{name}{SUFFIX}", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        self._statistics: tuple[Any, ...] | None = None

    def call(self, part: str, method: str, function: Callable[..., Any], *given: Any, **named: Any) -> Any:
        """Call the function, and write the call."""
        if self.inside:
            return function(*given, **named)
        from tests.model.traces.record import Record, argument

        arguments = tuple(argument(each) for each in given[1:])
        keywords = {name: argument(each) for name, each in named.items()}
        if method == "publish":
            arguments = self._published(given[1:])
        if part == "TicketCoordinator" and method == "receive":
            arguments = self._checked(given[0], given[2], arguments)
        self.inside = True
        try:
            result = function(*given, **named)
        except BaseException as error:
            self._write(Record(time.monotonic(), part, method, arguments, keywords, f"raised {type(error).__name__}"))
            raise
        finally:
            self.inside = False
        if method == "update_statistics":
            self._statistics = arguments  # written when they may matter
        elif result or method not in CHANGE_NOTHING_IF_EMPTY:
            if self._statistics is not None:
                self._write(Record(time.monotonic(), part, "update_statistics", self._statistics, {}, None))
                self._statistics = None
            written = self._snapshot(given[0], result) if method == "incarnations" else self.digests.result(result)
            self._write(Record(time.monotonic(), part, method, arguments, keywords, written))
        return result

    def _published(self, given: Sequence[Any]) -> tuple[Any, ...]:
        from millrace.protocol.messages import Weights
        from tests.model.traces.record import digest_of

        version, parameters, buffers = given
        digest = digest_of(Weights(version, parameters, buffers))
        self.digests.published(version, digest)
        return version, digest

    @staticmethod
    def _checked(coordinator: Any, message: Any, arguments: tuple[Any, ...]) -> tuple[Any, ...]:
        """With what is wrong with the rows of a rollout: a replay does not have them."""
        from millrace.protocol.errors import BadRollout
        from millrace.protocol.messages import Rollout

        if not isinstance(message, Rollout):
            return arguments
        peer, said, now = arguments
        try:
            coordinator._check_rows(message, coordinator.run)
        except BadRollout as error:
            said = said._replace(wrong=str(error))
        return peer, said, now

    @staticmethod
    def _snapshot(rollouts: Any, incarnations: list[int]) -> tuple[Any, ...]:
        """What a checkpoint may take of the tickets."""
        return tuple(incarnations), rollouts.ledger.issued, rollouts.ledger.used

    def _write(self, record: tuple[Any, ...]) -> None:
        os.write(self._fd, pickle.dumps(tuple(record), 5))


_recorder: Recorder | None = None


def _recorder_of(part: str, given: Sequence[Any]) -> Recorder:
    """The recorder of this process; it is named when the first object is made."""
    global _recorder
    if _recorder is None:
        name = f"worker-{given[0].worker}-{given[0].process_nonce}" if part == "Session" else f"learner-{os.getpid()}"
        _recorder = Recorder(name)
    return _recorder


def recorded(original: type[Any]) -> type[Any]:
    """A subclass whose calls are written."""
    part = original.__name__

    def wrapped(method: str) -> Callable[..., Any]:
        function = getattr(original, method)

        def call(self: Any, *given: Any, **named: Any) -> Any:
            assert _recorder is not None
            return _recorder.call(part, method, function, self, *given, **named)

        return call

    def make(self: Any, *given: Any, **named: Any) -> None:
        if part in PARTS_OF_THE_COORDINATOR:
            original.__init__(self, *given, **named)
        else:
            _recorder_of(part, given).call(part, "__init__", original.__init__, self, *given, **named)

    methods: dict[str, Any] = {method: wrapped(method) for method in METHODS[part]}
    return type(part, (original,), {**methods, "__init__": make})


class _Finder(MetaPathFinder):
    """Imports some modules with recorded classes."""

    classes = {
        OPEN_HUB: ("RolloutDealer",),
        COORDINATOR: ("TicketCoordinator", "Membership", "EvaluationDealer"),
        DESCRIBE: ("DescribeCoordinator", "Membership"),
        SESSION: ("Session",),
    }

    def find_spec(self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> ModuleSpec | None:
        if name not in self.classes:
            return None
        found = PathFinder.find_spec(name, path, target)
        assert found is not None
        assert found.origin is not None
        return spec_from_loader(name, _Loader(name, found.origin))


class _Loader(SourceFileLoader):
    def exec_module(self, module: ModuleType) -> None:
        super().exec_module(module)
        for name in _Finder.classes[module.__name__]:
            setattr(module, name, recorded(getattr(module, name)))


def install() -> None:
    """Record this process, and the processes that it starts."""
    sys.meta_path.insert(0, _Finder())
