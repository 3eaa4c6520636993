"""What the use cases need from outside; app/wiring.py wires it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager
from datetime import UTC, datetime
from pathlib import Path
from typing import Protocol

from app.formats.spooled_file import SpooledFile
from app.registry.jobs import JobKind


class Clock(Protocol):
    """The time now."""

    def __call__(self) -> datetime:
        """Aware UTC time."""


def utc_now() -> datetime:
    """The system's clock."""
    return datetime.now(UTC)


class Blobs(Protocol):
    """Store of uploads."""

    def put(self, key: str, data: bytes) -> None:
        """Write a blob once, durably."""

    def put_file(self, key: str, path: Path) -> None:
        """Write a blob from a file."""

    def take_file(self, key: str, path: Path) -> None:
        """Write a blob from a file that nobody changes any more."""

    def opened(self, key: str) -> AbstractContextManager[SpooledFile]:
        """A blob as a file of this machine, which has a path; only inside the block."""

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

    def submit(self, job_id: str, agency_id: str, kind: JobKind) -> None:
        """Have ``run_job(job_id)`` called, at least once; agencies take turns in the queue of the kind."""


class DeadLetters(Protocol):
    """Where jobs are reported that stopped the processes that worked on them."""

    def bury(self, job_id: str, kind: JobKind, reason: str) -> None:
        """Report a job that has failed for this reason; its row has both, too."""
