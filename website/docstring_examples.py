"""An extension of Griffe (mkdocstrings): examples in doctest's style become blocks of code in the pages."""

from __future__ import annotations

from typing import Any

import griffe

from website.doctest_fences import with_fences


class DocstringExamples(griffe.Extension):  # type: ignore[misc]  # mypy skips griffe
    """Puts fences around examples in docstrings."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """See `griffe.Extension`."""
        if obj.docstring is not None:
            obj.docstring.value = with_fences(obj.docstring.value)
