"""What happens when an upload takes more memory than its decoder process may have."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager

import cv2

from app.errors import ProcessStopped


@contextmanager
def memory_is_the_limit(what: str, cure: str) -> Iterator[None]:
    """Report an allocation that the process's limit refused as the upload's fault, which it is."""
    try:
        yield
    except (MemoryError, cv2.error) as error:
        if isinstance(error, cv2.error) and error.code != cv2.Error.StsNoMem:
            raise
        raise ProcessStopped(
            f"decoding the {what} takes more memory than a decoder process has",
            field="file",
            limit=f"{resource.getrlimit(resource.RLIMIT_DATA)[0]} bytes",
            cure=cure,
        ) from error
