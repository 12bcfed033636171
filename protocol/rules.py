"""The rules of the conversation between worker and learner, by name.

The text of a rule is written once, in README.md, after a marker with the rule's name:

    <!-- rule ORDER_ONCE -->An order that comes again is not executed again: the same answer is sent again.

Rule: all code that follows, checks or breaks a rule names it. State tables and other code name it in a comment (`rule
ORDER_ONCE`). The model's invariants and mutations, the checks of clients, and the mutants of a client name it as
`Rule.ORDER_ONCE`. `tests/protocol/test_rules.py` lists all of them, and checks that none is missing.

The text of a rule ends at the next marker, which may have no name, or at the end of its paragraph, list item or table cell.
A rule with several markers has several parts. The docstring of a message or a field is a rule if it ends with `(rule CUT)`.
"""

from __future__ import annotations

import re
from enum import Enum, auto
from functools import cache
from pathlib import Path
from typing import NamedTuple

_TEXT = Path(__file__).with_name("README.md")
_MARKER = re.compile(r"<!-- rule ?([A-Z_, ]*?) ?-->")
_HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)
_END = re.compile(r"\n\s*\n|\n(?=\s*(?:- |\d+\. |\|))| \|(?=\s)|\Z")


class Words(NamedTuple):
    """The text of a rule in the document."""

    section: str
    """the heading above it"""
    text: str
    """the text in one line; an ellipsis stands for omitted text between two parts"""

    @property
    def where(self) -> str:
        """The document and its section, as an error shows them."""
        return f"protocol/README.md, “{self.section}”"


class Rule(Enum):
    """A rule of the conversation."""

    # Transport
    ROUTING_ID = auto()

    # Frames
    FRAMES = auto()

    # Words
    SESSION = auto()
    TICKETS = auto()
    TICKET_NUMBERS = auto()
    LANES = auto()
    SEQUENCE = auto()

    # Hello
    HELLO_AGAIN = auto()
    HELLO = auto()
    REAPPEARS = auto()
    EVALUATES = auto()

    # Rollout
    EPISODE_ORDER = auto()

    # Heartbeat
    HEARTBEAT_REPLIES = auto()
    HEARTBEAT_VERSIONS = auto()
    HEARTBEAT_TICKETS = auto()
    HEARTBEAT_STEPS = auto()
    HEARTBEAT_WAITS = auto()

    # EpisodeRows
    EPISODE_ROWS = auto()

    # Evaluated
    CUT = auto()

    # Stepped
    STEPPED_ARRAYS = auto()

    # Weights
    ATTRIBUTES = auto()

    # Evaluate
    EVALUATE = auto()
    GREEDY = auto()

    # Reset
    OPTIONS = auto()

    # Permit
    OPPONENT = auto()
    PAST = auto()

    # Episode
    EPISODES = auto()

    # What a worker does in a session
    DECLINED = auto()
    IN_SPACE = auto()
    TRUNCATED = auto()

    # Environment profile
    ORDER_ANSWERED = auto()
    ORDER_ONLY = auto()
    RETURNED = auto()
    RESET_SOME = auto()
    SEEDED = auto()
    AFTER_RESET = auto()
    OWN_ROW = auto()
    NEXT_STEP = auto()
    SAME_STEP = auto()
    DISABLED = auto()
    ORDER_ONCE = auto()

    # Collector profile
    ROWS = auto()
    LAST_OBSERVATION = auto()
    FIRST_VALID = auto()
    CONTINUES = auto()
    INDEPENDENT = auto()
    SEATS = auto()
    FIRST_RESETS = auto()
    OTHER_AGENTS = auto()
    ROUNDED = auto()
    NORMALIZED = auto()
    LOG_PROB = auto()
    EVALUATE_VERSION = auto()
    EVALUATE_ENDS = auto()
    EVALUATIONS_FIRST = auto()
    EVALUATE_SEEDS = auto()
    ROWS_FIRST = auto()
    EVALUATE_ONCE = auto()
    OPPONENTS = auto()

    # The worker's half
    DRAIN_JOINING = auto()
    JOINING_IGNORES = auto()
    REPEATED_WELCOME = auto()
    REJOIN = auto()
    DRAINING_LEAVES = auto()
    REFUSE = auto()
    DRAIN = auto()
    STOP = auto()
    DRAINING_IGNORES = auto()
    STAYS = auto()
    OTHER_SESSION = auto()
    WELCOME_ATTEMPT = auto()
    ROLLOUT_ONCE = auto()
    RECEIVED = auto()
    VERSION = auto()
    IN_ORDER = auto()
    LOWEST_VERSION_FIRST = auto()
    HOLDS_WEIGHTS = auto()
    KEEP = auto()
    HELD_ALREADY = auto()
    INCARNATION = auto()
    RELEASE = auto()
    UNLISTED = auto()
    LATE_REPLY = auto()
    FORGETS = auto()
    IGNORE_UNREADABLE = auto()
    HEARTBEAT = auto()
    CONNECTION = auto()
    ORDER_OLD = auto()
    AFTER_GOODBYE = auto()
    AFTER_REFUSE = auto()

    # The learner's half
    UNKNOWN_SESSION = auto()
    HELLO_WHILE_DRAINING = auto()
    OTHER_PROTOCOL = auto()
    REPEATED_HELLO = auto()
    LATER_HELLO = auto()

    # Describe
    ONE_DESCRIBES = auto()
    DESCRIBE = auto()
    DESCRIBE_AGAIN = auto()
    BEGINS = auto()
    FIRST_DESCRIPTION = auto()

    # The ticket law
    ROUND = auto()
    ROUND_VERSION = auto()
    OPEN_ROUNDS = auto()
    LANE_MOVES = auto()
    LOST_TICKETS = auto()
    WRONG_ROLLOUT = auto()
    WEIGHTS_AFTER = auto()

    # Weights once for each machine
    SHARED_WEIGHTS = auto()
    SHARED_OF_LEARNER = auto()

    # The heartbeat repairs
    SENT_BEFORE = auto()
    WEIGHTS_AGAIN = auto()
    ORDER_AGAIN = auto()
    WELCOME_AGAIN = auto()
    DRAIN_AGAIN = auto()
    ARRIVED = auto()
    SILENT = auto()
    WORKER_TIMEOUT = auto()

    # Limits
    LIMITS = auto()

    # How it may evolve
    PROTOCOL = auto()

    def __str__(self) -> str:
        return self.name

    @property
    def words(self) -> Words:
        """The rule's text in the document."""
        return in_document()[self.name]


@cache
def in_document() -> dict[str, Words]:
    """The rules that the document marks, by name."""
    text = _TEXT.read_text(encoding="utf-8")
    headings = [(heading.start(), heading[1].replace("`", "")) for heading in _HEADING.finditer(text)]
    markers = list(_MARKER.finditer(text))
    parts: dict[str, Words] = {}
    for number, marker in enumerate(markers):
        following = markers[number + 1].start() if number + 1 < len(markers) else len(text)
        end = _END.search(text, marker.end())
        assert end is not None
        part = _plain(text[marker.end() : min(following, end.start())])
        section = [name for start, name in headings if start < marker.start()][-1]
        for name in re.findall(r"\w+", marker[1]):
            before = parts.get(name)
            parts[name] = Words(section, part) if before is None else Words(before.section, f"{before.text} … {part}")
    return parts


def _plain(text: str) -> str:
    """A part of the document in one line, without bold markers, links or punctuation at its end."""
    unlinked = re.sub(r"\[([^]]+)\]\(#[^)]*\)", r"\1", text.replace("**", ""))
    return " ".join(unlinked.split()).rstrip(".;,:")
