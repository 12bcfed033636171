"""The page that writes a client: its checks exist, and its client is as short as it says and needs nothing of millrace."""

from __future__ import annotations

import ast
import sys

from millrace.extras.conformance.profiles import PROFILES
from tests.clients.client_page import PAGE, client, steps

MOST_LINES = 300


def test_the_client_is_as_short_as_it_says() -> None:
    lines = client().count("\n")
    assert lines < MOST_LINES
    assert f"The example has {lines} lines" in PAGE.read_text(encoding="utf-8")


def test_the_client_imports_a_zeromq_library_and_a_msgpack_library_and_nothing_of_millrace() -> None:
    imports = [node for node in ast.parse(client()).body if isinstance(node, ast.Import)]
    names = {alias.name for node in imports for alias in node.names}
    assert names - sys.stdlib_module_names == {"msgpack", "zmq"}
    assert "import" not in client().partition("\nclass ")[2]


def test_the_checks_that_it_names_exist() -> None:
    named = [check for step in steps() for check in step.checks]
    assert len(named) == len(set(named)) >= 20
    assert set(named) <= {check.name for check in PROFILES["environment"]}
