"""Texts of a controller, as the database takes them."""

from __future__ import annotations


def cut(text: str, most_characters: int) -> str:
    """The text, or its beginning and how long it was."""
    if len(text) <= most_characters:
        return text
    return f"{text[:most_characters]}... (cut: it had {len(text)} characters)"


def storable(text: str) -> str:
    """No encoding has surrogates, and SQLite's shell would end the text at a NUL."""
    return text.encode("utf-8", "replace").decode().replace("\0", "\\0")
