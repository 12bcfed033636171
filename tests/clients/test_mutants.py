"""Each mutant of a client is caught, by a sentence that names the rule it breaks; without a mistake the same checks pass."""

from __future__ import annotations

import sys
from typing import NamedTuple

import pytest

from millrace.extras.conformance import rules
from millrace.extras.conformance.conform import ClientCommand, conform
from millrace.extras.conformance.examiner import CheckResult
from millrace.extras.conformance.learner import Settings
from millrace.extras.conformance.profiles import PROFILES
from millrace.extras.conformance.report import explanation
from millrace.extras.conformance.rules import Rule
from millrace.protocol.env_spec import EnvSpec

pytestmark = [pytest.mark.clients, pytest.mark.timeout(120)]


class Mutant(NamedTuple):
    """A mistake, the check that catches it, and the rule that the report names."""

    name: str
    profile: str
    check: str
    rule: Rule
    got: str
    """part of what the report says was got"""


MUTANTS = [
    Mutant("stale session", "environment", "joins again after Rejoin", rules.SESSION, "session"),
    Mutant("forgotten heartbeat", "environment", "beats as often as", rules.HEARTBEAT, "none for"),
    Mutant("oversized frame", "environment", "says Goodbye after Drain", rules.LIMITS, "head expected at most"),
    Mutant("wrong dtype", "environment", "answers Reset and Step", rules.STEPPED_ARRAYS, "got float32[2]"),
    Mutant("wrong order", "environment", "describes its environment", rules.FRAMES, "Heartbeat.replies"),
    Mutant("wrong shape", "environment", "answers Reset and Step", rules.STEPPED_ARRAYS, "got float32[2, 4, 1]"),
    Mutant("lane not owned", "environment", "serves two lanes", rules.ORDER_ANSWERED, "lane"),
    Mutant("lane not owned", "collector", "collects rollouts", rules.LANES, "lane 1"),
    Mutant("missing truncated", "environment", "truncates an episode", rules.TRUNCATED, "no end after 500 steps"),
    Mutant("missing truncated in rollouts", "collector", "truncates an episode", rules.ROWS, "valid: expected"),
    Mutant("repeated rollout", "collector", "sends a rollout once", rules.ROLLOUT_ONCE, "2 answers"),
    Mutant("wrong episode return", "collector", "keeps the row format", rules.EPISODES, ""),
    Mutant("wrong log-probabilities", "collector", "collects rollouts", rules.LOG_PROB, "-0."),
    Mutant("every row valid", "collector", "keeps the row format", rules.ROWS, "valid: expected False"),
    Mutant("wrong sequence", "collector", "collects rollouts", rules.SEQUENCE, "sequence 1"),
    Mutant("order of arrival", "collector", "in their order", rules.SEQUENCE, "sequence 1"),
    Mutant("acts under the newest weights", "collector", "under the version that", rules.VERSION, "version 5"),
    Mutant("ignores older weights", "collector", "holds two versions", rules.HOLDS_WEIGHTS, "none within"),
    Mutant("lists the newest weights only", "collector", "lists the versions", rules.HEARTBEAT_VERSIONS, "none within"),
    Mutant("keeps only what its tickets name", "collector", "keeps the weights", rules.HOLDS_WEIGHTS, "[2]"),
    Mutant("lists all weights that came", "collector", "keeps the weights", rules.HOLDS_WEIGHTS, "[1, 2, 3]"),
    Mutant("Goodbye without tickets", "collector", "drains while it collects", rules.DRAIN, "[]"),
    Mutant("ignores revoke", "collector", "is released while", rules.RELEASE, "Rollout("),
    Mutant("same attempt after Rejoin", "environment", "joins again after Rejoin", rules.REJOIN, "attempt"),
    Mutant("ignores Rejoin", "environment", "joins again after Rejoin", rules.REJOIN, "none within"),
    Mutant("one Hello only", "environment", "repeats Hello", rules.HELLO_AGAIN, "none within"),
    Mutant("described once", "environment", "describes its environment", rules.DESCRIBE_AGAIN, "none within"),
    Mutant("no new Hello in silence", "environment", "falls silent", rules.SILENT, "none within"),
    Mutant("replies counted wrongly", "environment", "last HeartbeatReply", rules.HEARTBEAT_REPLIES, "2"),
    Mutant("ends on what it cannot read", "environment", "ignores what it cannot read", rules.STAYS, "exit code 3"),
    Mutant("answers before reset", "environment", "nothing without an order", rules.ORDER_ONLY, "Stepped("),
    Mutant("any Welcome", "environment", "newest attempt only", rules.WELCOME_ATTEMPT, "session 77"),
    Mutant("no autoreset", "environment", "ends episodes", rules.NEXT_STEP, "reward 1"),
    Mutant("no drain", "environment", "says Goodbye after Drain", rules.DRAIN, "none within"),
    Mutant("drains after the next Collect", "collector", "no work while it drains", rules.DRAINING_IGNORES, "in Goodbye"),
    Mutant("joins again while it drains", "collector", "join again while it drains", rules.DRAINING_LEAVES, "Hello"),
    Mutant("refusal is no error", "environment", "exit code 2 when it is refused", rules.REFUSE, "exit code 0"),
    Mutant("ignores seeds", "environment", "the same seed", rules.SEEDED, "others"),
    Mutant("any session", "environment", "an order of another session", rules.OTHER_SESSION, "Stepped("),
    Mutant("any session", "collector", "ignores what it cannot read", rules.OTHER_SESSION, "Rollout("),
    Mutant("lists no tickets", "collector", "lists the versions and tickets", rules.HEARTBEAT_TICKETS, "[]"),
    Mutant("no heartbeat while it drains", "collector", "drains while it collects", rules.HEARTBEAT, "none "),
    Mutant("episodes in another order", "collector", "collects two lanes", rules.EPISODE_ORDER, "["),
    Mutant("one activation", "collector", "acts by relu", rules.LOG_PROB, "-"),
    Mutant("does not normalize", "collector", "acts by relu", rules.NORMALIZED, "-"),
    Mutant("reads bfloat16 as numbers", "collector", "takes weights rounded", rules.ROUNDED, ""),
    Mutant("sets no attributes", "collector", "sets attributes", rules.ATTRIBUTES, "its speed changes by up to"),
    Mutant("one seed for all copies", "collector", "collects two lanes", rules.INDEPENDENT, "copy 0 of lane 0 in copy 1"),
    Mutant("one random number for all copies", "collector", "collects two lanes", rules.INDEPENDENT, "copy 0 of lane 0 in"),
    Mutant("evaluates the newest weights", "collector", "under no other version", rules.GREEDY, "others in"),
    Mutant("ignores older weights", "collector", "under no other version", rules.EVALUATE_VERSION, "none within"),
    Mutant("goes on with an evaluation that is over", "collector", "ends an evaluation", rules.EVALUATE_ENDS, "ticket"),
    Mutant("never greedy", "collector", "evaluates with rows", rules.GREEDY, "others in"),
    Mutant("always greedy", "collector", "evaluates with rows", rules.GREEDY, "the most probable one in each of"),
    Mutant("evaluates by other seeds", "collector", "evaluates with rows", rules.EVALUATE_SEEDS, "others"),
    Mutant("cuts nothing", "collector", "evaluates with rows", rules.CUT, "cut False"),
    Mutant("rows after their Evaluated", "collector", "evaluates with rows", rules.ROWS_FIRST, "0 rows"),
    Mutant("rows in float32", "collector", "evaluates with rows", rules.EPISODE_ROWS, "got float32"),
    Mutant("rows without an end", "collector", "evaluates with rows", rules.EPISODE_ROWS, "neither"),
    Mutant("keeps what a session had", "collector", "collects rollouts of a lane", rules.FORGETS, "[]"),
    Mutant("one autoreset mode", "environment", "in the same step", rules.SAME_STEP, "another"),
    Mutant("one autoreset mode", "environment", "resets no copy by itself", rules.DISABLED, "the first observation of"),
    Mutant("resets without options", "environment", "resets with options", rules.OPTIONS, "["),
    Mutant("answers no order again", "environment", "executes an order once", rules.ORDER_ONCE, "none within"),
    Mutant("ignores revoke", "environment", "is released while", rules.RELEASE, "observations of the copies before"),
    Mutant("keeps unlisted lanes", "environment", "does not list", rules.UNLISTED, "observations of the copies before"),
    Mutant("last words after Refuse", "environment", "refused in a session", rules.AFTER_REFUSE, "Goodbye("),
]


def checked(mutant: str, profile: str, names: set[str]) -> list[CheckResult]:
    """The results of the checks whose names contain one of these."""
    checks = [check for check in PROFILES[profile] if any(name in check.name for name in names)]
    assert checks, names
    client = ClientCommand((sys.executable, "-m", "tests.clients.mutant_client", mutant, "{address}"))
    return conform(client, checks, Settings(EnvSpec("CartPole-v1"), patience_s=3.0), 100.0, lambda result: None)


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: f"{mutant.name}, {mutant.profile}")
def test_the_report_names_the_rule_that_a_mutant_breaks(mutant: Mutant) -> None:
    found = [each for each in checked(mutant.name, mutant.profile, {mutant.check}) if each.outcome == "failed"]
    assert found, f"{mutant.name} was not caught"
    assert found[0].rule == mutant.rule, explanation(found[0])
    assert mutant.got in found[0].got, explanation(found[0])
    assert mutant.rule.section in " ".join(" ".join(explanation(found[0])).split())


@pytest.mark.parametrize("profile", PROFILES)
def test_without_a_mistake_the_same_checks_pass(profile: str) -> None:
    names = {mutant.check for mutant in MUTANTS if mutant.profile == profile}
    found = checked("none", profile, names)
    assert [each.outcome for each in found] == ["passed"] * len(found), [explanation(each) for each in found]
