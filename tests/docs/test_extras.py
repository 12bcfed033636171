"""The tables of the extras: README's names pip extras that exist, Architecture's what starts each extra."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator

import pytest

import millrace
from millrace.cli.commands import COMMANDS
from millrace.learner.extras import STARTED_BY
from millrace.protocol.envs.kinds_of_copies import KINDS
from tests.docs import pages
from tests.test_border import TAKEN
from website.pages import ROOT

ROW = re.compile(r"^\| `(?:millrace/extras/)?(\w+)/?` \|(.*)\|$", re.MULTILINE)
OF_AN_EXTRA = re.compile(r"millrace\.extras\.(\w+)")


def rows(page: str, title: str) -> dict[str, str]:
    """The table of the extras that is below this heading: extra -> what its row says."""
    section = pages.manuals()[page].partition(f"## {title}\n")[2].partition("\n## ")[0]
    return {extra: text for extra, text in ROW.findall(section) if extra != "learner"}


def what_starts_extras() -> Iterator[tuple[str, str]]:
    """The extra and, as the page names it, what starts it."""
    for setting, place in STARTED_BY.items():
        yield place, f"`{setting}`" if "." in setting else f"`--{setting.replace('_', '-')}`"
    for name, command in COMMANDS.items():
        yield command.runs, f"`millrace {name}`"
    for name, place in KINDS.items():
        yield place, f"`--vector {name}`"
    for name, place in millrace._IMPORTED_WHEN_USED.items():
        yield place, f"`millrace.{name}`"


STARTS = [(found[1], what) for place, what in what_starts_extras() if (found := OF_AN_EXTRA.match(place))]


@pytest.mark.parametrize(
    ("page", "title"),
    [("README.md", "A core and five extras"), ("docs/explanation/architecture.md", "The core and the extras")],
)
def test_a_table_has_each_extra_once(page: str, title: str) -> None:
    assert sorted(rows(page, title)) == sorted(TAKEN)


def test_the_pip_extras_of_the_readme_exist() -> None:
    known = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named = {
        extra
        for row in rows("README.md", "A core and five extras").values()
        for extra in re.findall(r"`(\w+)`", row.split("|")[1])
    }
    assert {"record", "ray"} <= named <= known.keys()


@pytest.mark.parametrize(("extra", "what"), STARTS)
def test_what_starts_an_extra_is_in_its_row(extra: str, what: str) -> None:
    assert what in rows("docs/explanation/architecture.md", "The core and the extras")[extra]
