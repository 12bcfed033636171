"""Editors and type checkers know each public name, though most of them are imported only when they are used."""

from __future__ import annotations

import ast
import inspect

import millrace


def test_every_public_name_is_there_for_a_type_checker() -> None:
    known = set()
    for node in ast.walk(ast.parse(inspect.getsource(millrace))):
        if isinstance(node, ast.ImportFrom):
            known |= {alias.name for alias in node.names}
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            known.add(node.target.id)
    assert {*millrace.__all__} - known == set()


def test_every_public_name_is_found_when_it_is_used() -> None:
    assert [name for name in millrace.__all__ if getattr(millrace, name, None) is None] == []
