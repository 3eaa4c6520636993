"""The life of a plan."""

from __future__ import annotations

DRAFT, CHECKED, PROVED, APPROVED, COMMITTED = "draft", "checked", "proved", "approved", "committed"
