"""Sentences about results."""

from __future__ import annotations


def count_of(number: int, what: str) -> str:
    """A number with its noun, in the plural where it has to be."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
