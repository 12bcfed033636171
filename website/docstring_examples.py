"""An extension for Griffe (mkdocstrings): what the pages show in addition to the text of docstrings.

Doctest-style examples become code blocks. For a class, and for a function that isn't a method, the page says where its
source is, because the repository has no public address to link to.
"""

from __future__ import annotations

from typing import Any

import griffe

from website.doctest_fences import with_fences


class DocstringExamples(griffe.Extension):  # type: ignore[misc]  # mypy skips griffe
    """Puts fences around examples, and adds the place of the source."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """See `griffe.Extension`."""
        if obj.docstring is not None:
            text = with_fences(obj.docstring.value)
            is_top = obj.parent is not None and obj.parent.is_module and (obj.is_class or obj.is_function)
            obj.docstring.value = f"{text}\n\nSource: `{obj.relative_filepath}`, line {obj.lineno}." if is_top else text
