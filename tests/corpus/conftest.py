"""The counts of the corpus after the tests, so that a change shows what it costs."""

from __future__ import annotations

from typing import Any


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """One line a group and way of reading it."""
    reports = [one for found in terminalreporter.stats.values() for one in found if hasattr(one, "user_properties")]
    lines = [
        str(text)
        for one in reports
        if getattr(one, "when", "") == "call"
        for name, text in one.user_properties
        if name == "corpus"
    ]
    if lines:
        terminalreporter.section("corpus")
        terminalreporter.write("\n".join(lines) + "\n")
