"""Runs the checks, one after the other, against one client. Pure: events and `now` in, effects and results out.

Rule: the examiner never waits without a deadline. If a check fails, the examiner ends the client, so that the next check
begins with a new process.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from millrace.extras.conformance.learner import Learner, Settings
from millrace.extras.conformance.script import Broken, ClientEvent, EndClient, LearnerEffect, Script, Skipped, Wait
from millrace.protocol.rules import Rule

CHECK_S = 40.0  # longest time that one check may take


@dataclass(frozen=True)
class Check:
    """A check: its name, and the generator that performs it."""

    name: str
    script: Callable[[Learner], Script[None]]


@dataclass(frozen=True)
class CheckResult:
    """How a check ended."""

    name: str
    outcome: Literal["passed", "failed", "skipped"]
    seconds: float
    rule: Rule | None = None
    """the rule that the client broke; None if the check failed because it took too long"""
    expected: str = ""
    got: str = ""
    note: str = ""
    """why the check was skipped"""


class Examiner:
    """The state of the whole test: the check in progress, and the results so far."""

    def __init__(self, checks: Sequence[Check], settings: Settings, now: float, limit_s: float) -> None:
        """`limit_s`: the whole test ends after this many seconds. Checks that haven't ended by then count as failed."""
        self.learner = Learner(settings)
        self.results: list[CheckResult] = []
        self._checks = list(checks)
        self._deadline_s = now + limit_s
        self._script: Script[None] | None = None
        self._wait = Wait(0.0)
        self._due_s = self._began_s = now

    @property
    def done(self) -> bool:
        """Whether every check has a result."""
        return len(self.results) == len(self._checks)

    def handle(self, event: ClientEvent, now: float) -> list[LearnerEffect]:
        """Handle an event. Returns the effects that it has on the client."""
        self.learner.now = now
        if self._script is not None:
            try:
                if self.learner.take(event, self._wait.wanted):
                    self._resume(event)
            except Broken as broken:
                self._failed(broken.rule, broken.expected, broken.got)
        return self._taken()

    def tick(self, now: float) -> list[LearnerEffect]:
        """Do what is due: begin the next check, or end a wait. Returns the effects."""
        learner = self.learner
        learner.now = now
        if self.done:
            return []
        if now > self._deadline_s:
            self._out_of_time()
        elif self._script is None:
            self._begin()
        elif now - self._began_s > CHECK_S:
            self._failed(None, f"the check to end within {CHECK_S:g} s", "none of that")
        else:
            try:
                learner.check_heartbeats()
                if now >= self._due_s:
                    self._resume(None)
            except Broken as broken:
                self._failed(broken.rule, broken.expected, broken.got)
        return self._taken()

    def next_due_s(self) -> float:
        """The time by which `tick` must be called."""
        return self._due_s

    def _begin(self) -> None:
        check = self._checks[len(self.results)]
        self._began_s = self.learner.now
        self._script = check.script(self.learner)
        self._resume(None)

    def _resume(self, event: ClientEvent | None) -> None:
        """Let the check continue until it waits again or ends."""
        assert self._script is not None
        try:
            self._wait = self._script.send(event)
            self._due_s = self.learner.now + self._wait.for_s
        except StopIteration:
            self._record("passed")
        except Skipped as skipped:
            self._record("skipped", note=str(skipped))
        except Broken as broken:
            self._failed(broken.rule, broken.expected, broken.got)

    def _failed(self, rule: Rule | None, expected: str, got: str) -> None:
        self._record("failed", rule=rule, expected=expected, got=got)
        if self.learner.runs:
            self.learner.do(EndClient())
        while self.learner.is_mute and not self.done:
            self._began_s = self.learner.now
            self._record("skipped", note="the client never said Hello")

    def _record(
        self,
        outcome: Literal["passed", "failed", "skipped"],
        *,
        rule: Rule | None = None,
        expected: str = "",
        got: str = "",
        note: str = "",
    ) -> None:
        name = self._checks[len(self.results)].name
        self.results.append(CheckResult(name, outcome, self.learner.now - self._began_s, rule, expected, got, note))
        self._script = None
        self._due_s = self.learner.now
        if self.done and self.learner.runs:
            self.learner.do(EndClient())

    def _out_of_time(self) -> None:
        while not self.done:
            self._began_s = self.learner.now
            self._record("failed", expected="the whole test within --limit-s", got="no time left")

    def _taken(self) -> list[LearnerEffect]:
        effects = self.learner.effects
        self.learner.effects = []
        return effects
