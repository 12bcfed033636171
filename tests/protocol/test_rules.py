"""Each rule of the wire document has a name, and its words stand there once."""

from __future__ import annotations

import re

from millrace.protocol.rules import Rule, in_document


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
