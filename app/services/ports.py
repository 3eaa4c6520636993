"""What the use cases need from outside, decoder processes among it; app/wiring.py wires it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from datetime import UTC, datetime
from pathlib import Path
from typing import Protocol, TypeVar, TypeVarTuple

from app.formats.format import SpooledFile
from app.registry.jobs import JobKind

# === Decoder processes: the use cases submit functions to them, which `app.services.decoder_tasks` describes.


ArgumentsT = TypeVarTuple("ArgumentsT")
ResultT = TypeVar("ResultT")
ResultT_co = TypeVar("ResultT_co", covariant=True)


class Later(Protocol[ResultT_co]):
    """An argument of a task that follows it to the decoder process: in the caller, a `Future` that it sets."""

    def result(self) -> ResultT_co:
        """Wait for the argument."""


class Pending(Protocol[ResultT_co]):
    """A task on its way through a decoder process."""

    def result(self) -> ResultT_co:
        """Wait for the result.

        Raises
        ------
        UnreadableUpload
            The upload is refused, it killed the decoder process, or it took longer than it may.
        Unavailable
            No decoder process is free.
        """

    def cancel(self) -> None:
        """Stop the task, also when it runs already. Every task that was submitted ends in `result` or here."""


class DecoderProcesses(Protocol):
    """Processes with limits on memory and time."""

    def submit(
        self, task: Callable[[*ArgumentsT], ResultT], *arguments: *ArgumentsT, wait_s: float = 0.0
    ) -> Pending[ResultT]:
        """Hand a task over and return.

        Parameters
        ----------
        arguments
            Plain values that can be pickled. A `Future` follows when the caller has set it; until the function asks
            for its result, it works on the others.
        wait_s : float, optional
            How long to wait for a place. [s]

        Raises
        ------
        Unavailable
            Too many tasks are waiting already.
        """

    def run(self, task: Callable[[*ArgumentsT], ResultT], *arguments: *ArgumentsT, wait_s: float = 0.0) -> ResultT:
        """Hand a task over as `submit`, and wait for its result as `Pending.result`."""


# === Time, blobs and queues.


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
