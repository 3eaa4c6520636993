"""What the use cases need from outside; app/main.py wires it."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Protocol


class Clock(Protocol):
    """The time now."""

    def __call__(self) -> datetime:
        """Aware UTC time."""


class Blobs(Protocol):
    """Store of uploads."""

    def put(self, key: str, data: bytes) -> None:
        """Write a blob once, durably."""

    def put_file(self, key: str, path: Path) -> None:
        """Write a blob from a file."""

    def get(self, key: str) -> bytes:
        """Content of a blob."""

    def stream(self, key: str) -> Iterator[bytes]:
        """Content of a blob, part by part."""

    def delete(self, key: str) -> None:
        """Remove a blob."""

    def list_keys(self, before: datetime | None = None) -> Iterator[str]:
        """Keys of all blobs, or of those that were written before a time."""

    def delete_partial(self, before: datetime) -> None:
        """Remove what writes that were cut off before a time have left."""


class JobQueue(Protocol):
    """Where jobs wait for a worker."""

    def submit(self, job_id: str, agency_id: str) -> None:
        """Have ``run_job(job_id)`` called, at least once; agencies take turns."""
