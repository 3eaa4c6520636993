"""What the use cases need from outside; app/main.py wires it."""

from __future__ import annotations

from datetime import datetime
from typing import Protocol


class Clock(Protocol):
    """The time now."""

    def __call__(self) -> datetime:
        """Aware UTC time."""


class Blobs(Protocol):
    """Store of uploads."""

    def put(self, key: str, data: bytes, *, durable: bool = False) -> None:
        """Write a blob once."""

    def get(self, key: str) -> bytes:
        """Content of a blob."""

    def delete(self, key: str) -> None:
        """Remove a blob."""


class JobQueue(Protocol):
    """Where jobs wait for a worker."""

    def submit(self, job_id: str) -> None:
        """Have ``run_job(job_id)`` called, at least once."""
