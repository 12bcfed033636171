"""Bounds on the texts, numbers and lists in a message, as types for its fields. `millrace.protocol.wire.message_sizes`
bounds the size of the message itself. Pure.

Rule: every text, number and list in a message has a bound, and decoding refuses what exceeds it, so a peer can't fill the
memory or a log, or write control characters to a terminal. A sender shortens its own texts (`one_line`, `text`).
"""

from __future__ import annotations

import re
from textwrap import indent
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

INVALID = (msgspec.MsgspecError, ValueError, RecursionError)
"""The errors that decoding can raise: ValueError for bytes that are not UTF-8 and for numbers with too many digits,
RecursionError for deeply nested lists. Code that decodes what another program wrote catches all of them.
"""

MAX_NAME = 200  # characters
MAX_LINE = 1_000  # characters
MAX_TEXT = 64_000  # characters
LARGEST = 2**53  # every whole number up to here is exact as a float64 too
MAX_TICKETS = 1 << 16  # tickets in one message
MAX_WORKERS = 1_024  # workers that one supervisor speaks for
MAX_COPIES = 1 << 16  # env copies in one lane
MAX_SAVED_BYTES = 1 << 22  # bytes of one env copy's state, as its environment saved it
MAX_SEEDS = 1_024  # seeds in one Evaluate order
MAX_FACTS = 32  # facts about one episode
LONGEST_S = 1e9  # longest time that is reported, in seconds
MOST_OTHER_KEYS = 10_000  # keys of one dict that aren't text: anybody can choose such keys so that each hits all others
MOST_KEYS_SQUARED = MOST_OTHER_KEYS**2  # sum of these squared numbers over all dicts of one value: half a second at most
MOST_WITH_ONE_HASH = 64  # of these keys, those with the same hash: Python compares them, and they can be long
MOST_FRAMES = 1_500  # frames of one episode that are sent: a minute of video at 25 frames per second

_NO_CONTROL = r"^[^\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]*\Z"

Name = Annotated[str, Meta(max_length=MAX_NAME, pattern=_NO_CONTROL)]
Line = Annotated[str, Meta(max_length=MAX_LINE, pattern=_NO_CONTROL)]
Text = Annotated[str, Meta(max_length=MAX_TEXT)]
"""Several lines, such as a traceback. It may contain control characters; `escaped` makes it safe to show."""
Natural = Annotated[int, Meta(ge=0, le=LARGEST)]
Count = Annotated[int, Meta(ge=1, le=LARGEST)]
Whole = Annotated[int, Meta(ge=-LARGEST, le=LARGEST)]
Version = Annotated[int, Meta(ge=-1, le=LARGEST)]
Pid = Annotated[int, Meta(ge=0, le=2**31)]
Seconds = Annotated[float, Meta(ge=0, le=LONGEST_S)]
Moment = Annotated[float, Meta(ge=0, le=1e11)]
"""Seconds since 1970."""
Real = Annotated[float, Meta(ge=-1.7976931348623157e308, le=1.7976931348623157e308)]
"""A finite number."""
Figure = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
"""A time, or a mean, rate or sum of counts: short enough for a table."""
Versions = Annotated[tuple[Natural, ...], Meta(max_length=MAX_TICKETS)]
Tickets = Annotated[tuple[Natural, ...], Meta(max_length=MAX_TICKETS)]

Stage = Literal["open", "act", "step", "evaluate", "wait"]
"""Stages in which a worker spends its time."""
Stages = dict[Stage, Seconds]

# A message may hold marks of text direction (U+202A to U+202E and the like). They are escaped where text is shown, because
# they change the order in which the rest of the line appears.
_HIDDEN = r"\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff"
_CONTROL = re.compile(rf"[\x00-\x0a{_HIDDEN}]")
_CONTROL_EXCEPT_NEWLINE = re.compile(rf"[\x00-\x08{_HIDDEN}]")


def one_line(text: str, most: int = MAX_LINE) -> str:
    """The text as a `Line`, or as a `Name`: control characters are escaped (`\\x1b`), and long texts are cut."""
    return _cut(_CONTROL.sub(_escape, text), most)


def escaped(text: str) -> str:
    """A text of several lines in which control characters are escaped, so that it is safe to show."""
    return _CONTROL_EXCEPT_NEWLINE.sub(_escape, text)


def escaped_json(text: str) -> str:
    """JSON in which control characters are written as JSON escapes, safe to show."""
    return _CONTROL_EXCEPT_NEWLINE.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


def indented(text: str) -> str:
    """A text of several lines, safe to show, each line indented so that none of them looks like a log line."""
    return indent(escaped(text).strip("\n"), "    ", lambda line: True)


def last_text(text: str) -> str:
    """The text, with its beginning cut off if it is too long for a `Text`, because a traceback ends with the exception."""
    return escaped(text)[-MAX_TEXT:]


def _escape(match: re.Match[str]) -> str:
    return match[0].encode("unicode_escape").decode()


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else f"{text[: most - 1]}…"
