"""What the use cases need from outside; app/main.py wires it."""

from __future__ import annotations

from datetime import datetime
from typing import Protocol


class Clock(Protocol):
    """The time now."""

    def __call__(self) -> datetime:
        """Aware UTC time."""
