"""Reads the string under each field of a record from the source code. This string is the help text of the field's flag."""

from __future__ import annotations

import ast
import inspect
import itertools

import msgspec


def field_texts(record: type) -> dict[str, str]:
    """The string under each field of a record, by the field's name; empty if there is none. Inherited fields come first."""
    texts: dict[str, str] = {}
    for base in reversed(record.__mro__):
        if base is msgspec.Struct or not issubclass(base, msgspec.Struct):
            continue
        texts |= {name: "" for name in base.__struct_fields__ if name not in texts}
        body = _class_body(base)
        for statement, following in itertools.pairwise(body):
            match statement, following:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))) if name in texts:
                    texts[name] = " ".join(text.split())
    return texts


def _class_body(record: type) -> list[ast.stmt]:
    """The statements of a class; none if its source can't be read, for example because it was typed at a Python prompt."""
    try:
        source = inspect.getsource(record)
        # The source of a nested class is indented.
        tree = ast.parse(f"if True:\n{source}" if source[:1].isspace() else source)
    except (OSError, TypeError, SyntaxError):
        return []
    return next((node.body for node in ast.walk(tree) if isinstance(node, ast.ClassDef)), [])
