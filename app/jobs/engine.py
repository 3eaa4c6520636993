"""The two engines that run jobs, as the wiring sees them: `LocalQueue` and `CeleryQueue`."""

from __future__ import annotations

from typing import Protocol

from app.services.jobs import Jobs
from app.services.ports import DeadLetters, JobQueue


class JobEngine(JobQueue, DeadLetters, Protocol):
    """A queue of jobs that is opened and closed with the process."""

    def open(self, jobs: Jobs) -> None:
        """Start; `jobs` runs them, and lists those that wait."""

    def close(self) -> None:
        """Stop; close the decoder processes first to interrupt running jobs."""
