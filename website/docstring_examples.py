"""An extension of Griffe (mkdocstrings): what the pages show of docstrings beyond their text.

Examples in doctest's style become blocks of code. A class or function that is no method says where its source is, because
the repository has no public address to link to.
"""

from __future__ import annotations

from typing import Any

import griffe

from website.doctest_fences import with_fences


class DocstringExamples(griffe.Extension):  # type: ignore[misc]  # mypy skips griffe
    """Puts fences around examples, and the place of the source behind them."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """See `griffe.Extension`."""
        if obj.docstring is not None:
            text = with_fences(obj.docstring.value)
            is_top = obj.parent is not None and obj.parent.is_module and (obj.is_class or obj.is_function)
            obj.docstring.value = f"{text}\n\nSource: `{obj.relative_filepath}`, line {obj.lineno}." if is_top else text
