"""Each mutant of a client is caught, by a sentence that names the rule it breaks; without a mistake the same checks pass."""

from __future__ import annotations

import sys
from typing import NamedTuple

import pytest

from millrace.extras.conformance.conform import ClientCommand, conform
from millrace.extras.conformance.examiner import CheckResult
from millrace.extras.conformance.learner import Settings
from millrace.extras.conformance.profiles import PROFILES
from millrace.extras.conformance.report import explanation
from millrace.protocol.env_spec import EnvSpec
from millrace.protocol.rules import Rule

pytestmark = [pytest.mark.clients, pytest.mark.timeout(120)]


class Mutant(NamedTuple):
    """A mistake, the check that catches it, and the rule that the report names."""

    name: str
    profile: str
    check: str
    rule: Rule
    got: str
    """part of what the report says was got"""
    env: str = "CartPole-v1"


CROWD = "tests.support.users_code.seat_envs:ChainCrowd"
GAME = "tests.support.users_code.seat_envs:ChainGame"

MUTANTS = [
    Mutant("stale session", "environment", "joins again after Rejoin", Rule.SESSION, "session"),
    Mutant("forgotten heartbeat", "environment", "beats as often as", Rule.HEARTBEAT, "none for"),
    Mutant("oversized frame", "environment", "says Goodbye after Drain", Rule.LIMITS, "head expected at most"),
    Mutant("wrong dtype", "environment", "answers Reset and Step", Rule.STEPPED_ARRAYS, "got float32[2]"),
    Mutant("wrong order", "environment", "describes its environment", Rule.FRAMES, "Heartbeat.replies"),
    Mutant("wrong shape", "environment", "answers Reset and Step", Rule.STEPPED_ARRAYS, "got float32[2, 4, 1]"),
    Mutant("lane not owned", "environment", "serves two lanes", Rule.ORDER_ANSWERED, "lane"),
    Mutant("lane not owned", "collector", "collects rollouts", Rule.LANES, "lane 1"),
    Mutant("missing truncated", "environment", "truncates an episode", Rule.TRUNCATED, "no end after 500 steps"),
    Mutant("missing truncated in rollouts", "collector", "truncates an episode", Rule.ROWS, "valid: expected"),
    Mutant("repeated rollout", "collector", "sends a rollout once", Rule.ROLLOUT_ONCE, "2 answers"),
    Mutant("wrong episode return", "collector", "keeps the row format", Rule.EPISODES, ""),
    Mutant("wrong log-probabilities", "collector", "collects rollouts", Rule.LOG_PROB, "-0."),
    Mutant("every row valid", "collector", "keeps the row format", Rule.ROWS, "valid: expected False"),
    Mutant("wrong sequence", "collector", "collects rollouts", Rule.SEQUENCE, "sequence 1"),
    Mutant("order of arrival", "collector", "in their order", Rule.SEQUENCE, "sequence 1"),
    Mutant("acts under the newest weights", "collector", "under the version that", Rule.VERSION, "version 5"),
    Mutant("ignores older weights", "collector", "holds two versions", Rule.HOLDS_WEIGHTS, "none within"),
    Mutant("lists the newest weights only", "collector", "lists the versions", Rule.HEARTBEAT_VERSIONS, "none within"),
    Mutant("keeps only what its tickets name", "collector", "keeps the weights", Rule.HOLDS_WEIGHTS, "[2]"),
    Mutant("lists all weights that came", "collector", "keeps the weights", Rule.HOLDS_WEIGHTS, "[1, 2, 3]"),
    Mutant("Goodbye without tickets", "collector", "drains while it collects", Rule.DRAIN, "[]"),
    Mutant("ignores revoke", "collector", "is released while", Rule.RELEASE, "Rollout("),
    Mutant("same attempt after Rejoin", "environment", "joins again after Rejoin", Rule.REJOIN, "attempt"),
    Mutant("ignores Rejoin", "environment", "joins again after Rejoin", Rule.REJOIN, "none within"),
    Mutant("one Hello only", "environment", "repeats Hello", Rule.HELLO_AGAIN, "none within"),
    Mutant("described once", "environment", "describes its environment", Rule.DESCRIBE_AGAIN, "none within"),
    Mutant("describes another order", "environment", "describes its environment", Rule.DESCRIBE, "ticket"),
    Mutant("does not say that it waits", "environment", "describes its environment", Rule.HEARTBEAT_WAITS, "False"),
    Mutant("never begins", "environment", "in which it waited", Rule.HEARTBEAT_WAITS, "True"),
    Mutant("never begins", "collector", "in which it waited", Rule.HEARTBEAT_WAITS, "True"),
    Mutant("counts replies anew when the run begins", "collector", "in which it waited", Rule.HEARTBEAT_REPLIES, "0"),
    Mutant("no new Hello in silence", "environment", "falls silent", Rule.SILENT, "none within"),
    Mutant("replies counted wrongly", "environment", "last HeartbeatReply", Rule.HEARTBEAT_REPLIES, "2"),
    Mutant("ends on what it cannot read", "environment", "ignores what it cannot read", Rule.STAYS, "exit code 3"),
    Mutant("answers before reset", "environment", "nothing without an order", Rule.ORDER_ONLY, "Stepped("),
    Mutant("any Welcome", "environment", "newest attempt only", Rule.WELCOME_ATTEMPT, "session 7"),
    Mutant("no autoreset", "environment", "ends episodes", Rule.NEXT_STEP, "reward 1"),
    Mutant("no drain", "environment", "says Goodbye after Drain", Rule.DRAIN, "none within"),
    Mutant("drains after the next Collect", "collector", "no work while it drains", Rule.DRAINING_IGNORES, "in Goodbye"),
    Mutant("joins again while it drains", "collector", "join again while it drains", Rule.DRAINING_LEAVES, "Hello"),
    Mutant("refusal is no error", "environment", "exit code 2 when it is refused", Rule.REFUSE, "exit code 0"),
    Mutant("ignores seeds", "environment", "the same seed", Rule.SEEDED, "others"),
    Mutant("any session", "environment", "an order of another session", Rule.OTHER_SESSION, "Stepped("),
    Mutant("any session", "collector", "ignores what it cannot read", Rule.OTHER_SESSION, "Rollout("),
    Mutant("lists no tickets", "collector", "lists the versions and tickets", Rule.HEARTBEAT_TICKETS, "[]"),
    Mutant("no heartbeat while it drains", "collector", "drains while it collects", Rule.HEARTBEAT, "none "),
    Mutant("episodes in another order", "collector", "collects two lanes", Rule.EPISODE_ORDER, "["),
    Mutant("one activation", "collector", "acts by relu", Rule.LOG_PROB, "-"),
    Mutant("does not normalize", "collector", "acts by relu", Rule.NORMALIZED, "-"),
    Mutant("reads bfloat16 as numbers", "collector", "takes weights rounded", Rule.ROUNDED, ""),
    Mutant("sets no attributes", "collector", "sets attributes", Rule.ATTRIBUTES, "its speed changes by up to"),
    Mutant("one seed for all copies", "collector", "collects two lanes", Rule.INDEPENDENT, "copy 0 of lane 0 in copy 1"),
    Mutant("one random number for all copies", "collector", "collects two lanes", Rule.INDEPENDENT, "copy 0 of lane 0 in"),
    Mutant("ignores the past of a lane", "collector", "continues the past", Rule.PAST, "another observation"),
    Mutant("continues with other random numbers", "collector", "continues the past", Rule.PAST, "others"),
    Mutant("evaluates the newest weights", "collector", "under no other version", Rule.GREEDY, "others in"),
    Mutant("ignores older weights", "collector", "under no other version", Rule.EVALUATE_VERSION, "none within"),
    Mutant("goes on with an evaluation that is over", "collector", "ends an evaluation", Rule.EVALUATE_ENDS, "ticket"),
    Mutant("never greedy", "collector", "evaluates with rows", Rule.GREEDY, "others in"),
    Mutant("always greedy", "collector", "evaluates with rows", Rule.GREEDY, "the most probable one in each of"),
    Mutant("evaluates by other seeds", "collector", "evaluates with rows", Rule.EVALUATE_SEEDS, "others"),
    Mutant("cuts nothing", "collector", "evaluates with rows", Rule.CUT, "cut False"),
    Mutant("rows after their Evaluated", "collector", "evaluates with rows", Rule.ROWS_FIRST, "0 rows"),
    Mutant("rows in float32", "collector", "evaluates with rows", Rule.EPISODE_ROWS, "got float32"),
    Mutant("rows without an end", "collector", "evaluates with rows", Rule.EPISODE_ROWS, "neither"),
    Mutant("keeps what a session had", "collector", "collects rollouts of a lane", Rule.FORGETS, "[]"),
    Mutant("one autoreset mode", "environment", "in the same step", Rule.SAME_STEP, "another"),
    Mutant("one autoreset mode", "environment", "resets no copy by itself", Rule.DISABLED, "the first observation of"),
    Mutant("resets without options", "environment", "resets with options", Rule.OPTIONS, "["),
    Mutant("answers no order again", "environment", "executes an order once", Rule.ORDER_ONCE, "none within"),
    Mutant("ignores revoke", "environment", "is released while", Rule.RELEASE, "observations of the copies before"),
    Mutant("keeps unlisted lanes", "environment", "does not list", Rule.UNLISTED, "observations of the copies before"),
    Mutant("last words after Refuse", "environment", "refused in a session", Rule.AFTER_REFUSE, "Goodbye("),
    Mutant("one process_nonce for every process", "environment", "draws another", Rule.REAPPEARS, "the same"),
    Mutant("begins again at a repeated Welcome", "environment", "copy of its Welcome", Rule.REPEATED_WELCOME, "another"),
    Mutant("steps counted by session", "environment", "an order of another session", Rule.HEARTBEAT_STEPS, "0"),
    Mutant("lists every ticket that came", "environment", "lists no finished", Rule.HEARTBEAT_TICKETS, "ticket"),
    Mutant("lists every ticket that came", "collector", "a late Collect", Rule.HEARTBEAT_TICKETS, "which was answered"),
    Mutant("lists every ticket that came", "collector", "forgets the session", Rule.HEARTBEAT_TICKETS, "ticket"),
    Mutant("drained is an error", "environment", "says Goodbye after Drain", Rule.DRAIN, "exit code 1"),
    Mutant("leaves without Goodbye", "environment", "says Goodbye after SIGTERM", Rule.STOP, "without Goodbye"),
    Mutant("wrong ticket", "environment", "answers Reset and Step", Rule.ORDER_ONLY, "ticket"),
    Mutant("wrong incarnation", "environment", "starts a lane again", Rule.INCARNATION, "incarnation 0"),
    Mutant("obeys a lower incarnation", "environment", "starts a lane again", Rule.INCARNATION, "incarnation 2"),
    Mutant("obeys a lower incarnation", "collector", "starts a lane again", Rule.INCARNATION, "Rollout("),
    Mutant("executes every order", "environment", "executes an order once", Rule.ORDER_ONCE, ""),
    Mutant("executes every order", "environment", "ignores a late copy of an order", Rule.ORDER_OLD, "Stepped("),
    Mutant("rows in another order", "environment", "own seed and actions", Rule.SEEDED, "another"),
    Mutant("one seed for all copies of a lane", "environment", "own seed and actions", Rule.SEEDED, "another"),
    Mutant("one action for all copies", "environment", "own seed and actions", Rule.OWN_ROW, "another"),
    Mutant("resets all copies", "environment", "only the copies that a Reset lists", Rule.RESET_SOME, "others"),
    Mutant("forgets the last observation of a rollout", "collector", "collects rollouts", Rule.CONTINUES, "another"),
    Mutant("forgets who ended in the last row", "collector", "keeps the row format", Rule.FIRST_VALID, "True"),
    Mutant(
        "resets a copy in the step that ends its episode",
        "collector",
        "keeps the row format",
        Rule.LAST_OBSERVATION,
        "the first one",
    ),
    Mutant("wrong episode length", "collector", "keeps the row format", Rule.EPISODES, ""),
    Mutant("sends no rollout again", "collector", "sends a lost rollout again", Rule.ROLLOUT_ONCE, "none within"),
    Mutant("does not wait for weights", "collector", "waits for the weights", Rule.VERSION, "version 1"),
    Mutant("keeps unlisted lanes", "collector", "does not list", Rule.UNLISTED, "Rollout("),
    Mutant("an episode more", "collector", "evaluates", Rule.EVALUATE, "3"),
    Mutant("evaluates again", "collector", "evaluates", Rule.EVALUATE_ONCE, "another"),
    Mutant("evaluates without end", "collector", "evaluates", Rule.CUT, "steps"),
    Mutant("takes a run of any agents", "collector", "a run of agents", Rule.OTHER_AGENTS, "none within"),
    Mutant("every row valid", "collector", "collects rollouts", Rule.SEATS, "valid: expected", GAME),
    Mutant("forgets who is reset first", "collector", "keeps the row format", Rule.FIRST_RESETS, "False", GAME),
    Mutant("wrong episode return", "collector", "keeps the row format", Rule.EPISODES, "", CROWD),
    Mutant("wrong log-probabilities", "collector", "collects rollouts", Rule.LOG_PROB, "-", GAME),
    Mutant("speaks another protocol", "environment", "says Hello first", Rule.PROTOCOL, "protocol"),
    Mutant("two results for one copy", "environment", "answers a Call", Rule.RETURNED, "[1, 2]"),
    Mutant("goes on after Goodbye", "environment", "says Goodbye after Drain", Rule.AFTER_GOODBYE, "Goodbye("),
    Mutant("observes what is no number", "environment", "answers Reset and Step", Rule.IN_SPACE, "nan"),
    Mutant("rewards a reset", "environment", "answers Reset and Step", Rule.AFTER_RESET, "Stepped("),
    Mutant("wrong ticket", "collector", "collects rollouts of a lane", Rule.TICKETS, "Rollout("),
    Mutant("ignores Drain while it joins", "environment", "when Drain answers its Hello", Rule.DRAIN_JOINING, ""),
]


def checked(mutant: str, profile: str, env: str, names: set[str]) -> list[CheckResult]:
    """The results of the checks whose names contain one of these."""
    checks = [check for check in PROFILES[profile] if any(name in check.name for name in names)]
    assert checks, names
    client = ClientCommand((sys.executable, "-m", "tests.clients.mutant_client", mutant, "{address}"))
    return conform(client, checks, Settings(EnvSpec(env), patience_s=3.0), 100.0, lambda result: None)


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: f"{mutant.name}, {mutant.profile}")
def test_the_report_names_the_rule_that_a_mutant_breaks(mutant: Mutant) -> None:
    found = [each for each in checked(mutant.name, mutant.profile, mutant.env, {mutant.check}) if each.outcome == "failed"]
    assert found, f"{mutant.name} was not caught"
    assert found[0].rule == mutant.rule, explanation(found[0])
    assert mutant.got in found[0].got, explanation(found[0])
    assert mutant.rule.words.section in " ".join(" ".join(explanation(found[0])).split())


@pytest.mark.parametrize(("profile", "env"), sorted({(mutant.profile, mutant.env) for mutant in MUTANTS}))
def test_without_a_mistake_the_same_checks_pass(profile: str, env: str) -> None:
    names = {mutant.check for mutant in MUTANTS if (mutant.profile, mutant.env) == (profile, env)}
    found = checked("none", profile, env, names)
    assert [each.outcome for each in found] == ["passed"] * len(found), [explanation(each) for each in found]
