"""Anchors in the Markdown of the reference pages. Pure."""

from __future__ import annotations


def anchored(anchor: str, markdown: str) -> str:
    """Markdown that a link can lead to."""
    return f'<span id="{anchor}">{markdown}</span>'
