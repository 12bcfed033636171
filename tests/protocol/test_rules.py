"""Each rule of the wire document has a name; its words stand there once; code keeps it, and a mistake shows that it is held.

`python -m tests.protocol.test_rules` shows for each rule who keeps it, and how many invariants and mutations of the model,
checks of clients and mutants of a client name it. Rules without any are listed here. The lists may only become shorter.
"""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import pytest

from millrace.protocol.rules import Rule, in_document
from tests.clients.test_mutants import MUTANTS
from tests.model import mutations
from tests.model.describing import mutations as of_describing
from tests.model.evaluation import mutations as of_evaluation
from tests.model.vector_env import mutations as of_vector_env

ROOT = Path(__file__).parents[2]
HOMES = {"protocol/rules.py", "protocol/messages.py", "protocol/rollout.py"}
"""where names and words are; code elsewhere keeps the rules"""
IN_COMMENT = re.compile(r"\brules? ([A-Z][A-Z_]+(?:, [A-Z][A-Z_]+)*)")
IN_PYTHON = re.compile(r"\bRule\.([A-Z_]+)")
MUTATIONS = [
    mutation for module in (mutations, of_describing, of_evaluation, of_vector_env) for mutation in module.MUTATIONS.values()
]
KEPT_BY_NOBODY = {Rule.TRUNCATED}
"""Rules that no code of the product names: gymnasium's `TimeLimit` keeps this one."""
WITHOUT_INVARIANT_OR_CHECK = {
    Rule.EVALUATIONS_FIRST,
    Rule.HELD_ALREADY,
    Rule.UNKNOWN_SESSION,
    Rule.HELLO_WHILE_DRAINING,
    Rule.OTHER_PROTOCOL,
    Rule.REPEATED_HELLO,
    Rule.LATER_HELLO,
    Rule.FIRST_DESCRIPTION,
    Rule.SHARED_WEIGHTS,
    Rule.SHARED_OF_LEARNER,
    Rule.WELCOME_AGAIN,
    Rule.DRAIN_AGAIN,
}
"""Rules that neither an invariant of the model nor a check of clients names."""
WITHOUT_MISTAKE = {
    Rule.ROUTING_ID,
    Rule.DECLINED,
    Rule.EVALUATIONS_FIRST,
    Rule.JOINING_IGNORES,
    Rule.HELD_ALREADY,
    Rule.LATE_REPLY,
    Rule.IGNORE_UNREADABLE,
    Rule.CONNECTION,
    Rule.UNKNOWN_SESSION,
    Rule.HELLO_WHILE_DRAINING,
    Rule.OTHER_PROTOCOL,
    Rule.REPEATED_HELLO,
    Rule.LATER_HELLO,
    Rule.WRONG_ROLLOUT,
    Rule.SHARED_WEIGHTS,
    Rule.SHARED_OF_LEARNER,
    Rule.DRAIN_AGAIN,
}
"""Rules that no mutation of the model and no mutant of a client breaks."""


def sources(*folders: str) -> dict[str, str]:
    """The text of the Python files in these folders, by path."""
    paths = (path for folder in folders for path in (ROOT / folder).rglob("*.py"))
    return {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in paths}


def named(pattern: re.Pattern[str], texts: Iterable[str]) -> Counter[Rule]:
    """How often these texts name each rule. Raises KeyError if they name one that there is not."""
    return Counter(Rule[name] for text in texts for names in pattern.findall(text) for name in names.split(", "))


def keepers() -> dict[Rule, list[str]]:
    """The files of the product that keep each rule: they name it, or are where a mutation breaks it."""
    files = {path: text for path, text in sources("protocol", "workers", "learner").items() if path not in HOMES}
    pairs = {(rule, path) for path, text in files.items() for rule in named(IN_COMMENT, [text])}
    for mutation in MUTATIONS:
        if mutation.breaks is not None:
            pairs.add((mutation.breaks, mutation.module.removeprefix("millrace.").replace(".", "/") + ".py"))
    return {rule: sorted(path for each, path in pairs if each is rule) for rule in Rule}


def invariants() -> Counter[Rule]:
    texts = sources("tests/model", "tests/support/conversation")
    texts = {path: text for path, text in texts.items() if not path.endswith("mutations.py")}
    return named(IN_PYTHON, texts.values()) + named(IN_COMMENT, texts.values())


def checks() -> Counter[Rule]:
    texts = sources("millrace/extras/conformance")
    return named(IN_PYTHON, (text for path, text in texts.items() if not path.endswith("mends.py")))


def broken_by_mutations() -> Counter[Rule]:
    return Counter(mutation.breaks for mutation in MUTATIONS if mutation.breaks is not None)


def broken_by_mutants() -> Counter[Rule]:
    return Counter(mutant.rule for mutant in MUTANTS)


def test_the_document_marks_each_rule_and_no_other() -> None:
    assert in_document().keys() == {rule.name for rule in Rule}


def test_the_words_of_a_rule_are_whole_sentences_or_parts_of_them() -> None:
    for rule in Rule:
        for part in rule.words.text.split(" … "):
            assert len(part) > 5, f"{rule}: a part of its words is missing"
            assert not re.search(r"<!--|\*\*|\]\(#|^[.;,]", part), f"{rule}: {part}"


def test_a_rule_of_a_field_is_what_the_field_means() -> None:
    assert Rule.HEARTBEAT_VERSIONS.words == ("Heartbeat", "of the weights held, ascending")
    assert Rule.EPISODES.words.text == "the return: undiscounted sum of raw rewards … number of steps"


def test_rules_may_share_words_and_have_several_parts() -> None:
    assert Rule.ORDER_ONLY.words == Rule.ORDER_ANSWERED.words
    assert Rule.RETURNED.words.text.startswith(f"{Rule.ORDER_ANSWERED.words.text} … A worker without attributes")


def test_code_of_the_product_keeps_each_rule() -> None:
    assert {rule for rule, files in keepers().items() if not files} == KEPT_BY_NOBODY


def test_an_invariant_or_a_check_holds_each_rule() -> None:
    assert {*Rule} - {*invariants(), *checks()} == WITHOUT_INVARIANT_OR_CHECK


def test_a_mistake_shows_that_each_rule_is_held() -> None:
    assert {*Rule} - {*broken_by_mutations(), *broken_by_mutants()} == WITHOUT_MISTAKE


def test_a_rule_that_does_not_exist_cannot_be_named() -> None:
    with pytest.raises(KeyError, match="ORDER_TWICE"):
        named(IN_COMMENT, ["# rules ORDER_ONCE, ORDER_TWICE"])


if __name__ == "__main__":
    columns = [invariants(), broken_by_mutations(), checks(), broken_by_mutants()]
    lines = [f"{'rule':22}{'invariants':>11}{'mutations':>10}{'checks':>7}{'mutants':>8}  kept by"]
    for rule, files in keepers().items():
        counts = [each[rule] or "-" for each in columns]
        lines.append("{!s:22}{:>11}{:>10}{:>7}{:>8}  {}".format(rule, *counts, ", ".join(files) or "-"))
    sys.stdout.write("\n".join([*lines, ""]))
