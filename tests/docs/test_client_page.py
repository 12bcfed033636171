"""The page that writes a client shows the client's files, and names checks that there are."""

from __future__ import annotations

from millrace.extras.conformance.profiles import PROFILES
from tests.clients.client_page import shown_files, steps
from tests.system.stage.processes import ROOT

RUBY = ROOT / "clients" / "ruby"
MOST_LINES = 150


def test_its_blocks_are_the_files() -> None:
    environment, client = shown_files()
    assert environment == (RUBY / "examples" / "grid_world.rb").read_text(encoding="utf-8")
    assert client == (RUBY / "millrace.rb").read_text(encoding="utf-8")


def test_the_client_is_as_short_as_it_says() -> None:
    _, client = shown_files()
    lines = client.count("\n")
    assert lines < MOST_LINES
    for page in ("docs/how-to/write_a_client.md", "clients/ruby/README.md"):
        assert f"{lines} lines" in (ROOT / page).read_text(encoding="utf-8"), page


def test_the_checks_that_it_names_exist() -> None:
    named = [check for step in steps() for check in step.checks]
    assert len(named) == len(set(named)) >= 20
    assert set(named) <= {check.name for check in PROFILES["environment"]}
