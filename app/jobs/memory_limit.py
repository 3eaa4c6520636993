"""What happens when an upload takes more memory than its decoder process may have, or than is left in it."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager

import cv2

from app.errors import ProcessStopped, is_exhausted


@contextmanager
def memory_is_the_limit(what: str, cure: str) -> Iterator[None]:
    """Report an allocation that the process's limit refused as the upload's fault, which it is."""
    try:
        yield
    except (MemoryError, OSError, cv2.error) as error:
        if not _is_exhausted(error):
            raise
        raise out_of_memory(f"decoding the {what}", cure) from error


def out_of_memory(work: str, cure: str) -> ProcessStopped:
    """The error of work that takes more memory than the process may have."""
    return ProcessStopped(
        f"{work} takes more memory than a decoder process has",
        field="file",
        limit=f"{resource.getrlimit(resource.RLIMIT_DATA)[0]} bytes",
        cure=cure,
    )


def ran_short(error: BaseException) -> bool:
    """Whether an error, or one that it was raised from, is that a process has no memory or no thread left.

    What fills a process need not be the upload at which it shows.
    """
    cause: BaseException | None = error
    while cause is not None:
        if _is_exhausted(cause):
            return True
        cause = cause.__cause__ or (None if cause.__suppress_context__ else cause.__context__)
    return False


def _is_exhausted(error: BaseException) -> bool:
    if isinstance(error, cv2.error):
        return getattr(error, "code", None) == cv2.Error.StsNoMem or "bad_alloc" in str(error)
    return is_exhausted(error) or (isinstance(error, RuntimeError) and "can't start new thread" in str(error))
