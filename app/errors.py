"""The domain's errors. They know no HTTP: app/api/http/problems.py maps them in one table."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager


class WaymarkError(Exception):
    """Root of every error that Waymark raises on purpose.

    Parameters
    ----------
    message : str
        What is wrong, in one sentence.
    field : str, optional
        Path of the input at fault, e.g. ``position.lon_deg``.
    limit : str, optional
        The bound or rule that was broken, with its unit.
    cure : str, optional
        What the caller can do about it.
    """

    def __init__(
        self, message: str, *, field: str | None = None, limit: str | None = None, cure: str | None = None
    ) -> None:
        super().__init__(message)
        self.message = message
        self.field = field
        self.limit = limit
        self.cure = cure
        self.parts: tuple[WaymarkError, ...] = ()
        """What is wrong with parts of the input, where more than one thing is."""


class InvalidParameter(WaymarkError, ValueError):
    """A value is outside what the function or the marker's definition allows."""


class CodeMismatch(InvalidParameter):
    """Digits do not fit the scheme: wrong length, wrong alphabet or a failing check."""


class ReferenceSystemError(InvalidParameter):
    """A coordinate reference system is unknown or cannot be transformed with a stated accuracy."""


class UnreadableUpload(WaymarkError):
    """An upload is not what it claims to be, is damaged, or would not fit the limits when decoded."""


class UploadTooLarge(UnreadableUpload):
    """An upload exceeds the limit on bytes or pixels."""


class UnsupportedUpload(UnreadableUpload):
    """An upload is of a kind that no decoder reads."""


class ProcessStopped(UnreadableUpload):
    """The process that worked on an upload ended, or met its limit of time or memory, before it was done with it.

    The cause may lie in the upload or in the server; the message names it where it is known.
    """


class CalibrationRefused(UnreadableUpload):
    """Photos do not calibrate a camera well enough; begins with the name of the reason, `parts` has the photos."""


class PrintNotGraded(UnreadableUpload):
    """A photo does not show a printed plate well enough to grade it."""


class NotFound(WaymarkError):
    """No such thing, or not one that this caller may see."""


class Conflict(WaymarkError):
    """The request contradicts what is stored."""


class CodeTaken(Conflict):
    """Another marker nearby already carries this code."""


class IdempotencyConflict(Conflict):
    """An Idempotency-Key was used before for a different request."""


class StaleVersion(Conflict):
    """The stored row changed since the caller read it."""


class VersionRequired(WaymarkError):
    """A change was asked for without saying which version of the row it is based on."""


class MalformedRequest(WaymarkError):
    """A body or header cannot be read as what it claims to be."""


class NotAuthenticated(WaymarkError):
    """No key, or a key that is unknown, expired or revoked."""


class NotAllowed(WaymarkError):
    """The key is valid, but its scope does not cover this."""


class TooManyRequests(WaymarkError):
    """More was asked for in a time than is allowed.

    Parameters
    ----------
    retry_after_s : int
        When asking again can work, > 0. [s]
    """

    def __init__(
        self, message: str, *, limit: str | None = None, cure: str | None = None, retry_after_s: int = 1
    ) -> None:
        super().__init__(message, limit=limit, cure=cure)
        self.retry_after_s = retry_after_s


class QuotaExceeded(TooManyRequests):
    """A key or its agency would store more than its quota, or has too many uploads in progress."""


class UploadLocked(TooManyRequests):
    """Another request writes the same upload at this moment."""


class UploadExpired(NotFound):
    """An upload was not completed in time; what had arrived of it was deleted."""


class WrongOffset(Conflict):
    """A part of an upload does not begin where the parts before it end."""


class WrongChecksum(MalformedRequest):
    """The bytes that arrived are not those that were sent."""


class UnsupportedVersion(WaymarkError):
    """The request is of a version of a protocol that is not spoken here."""


class Unavailable(WaymarkError):
    """A part the request needs is busy or down; trying again later can work."""


class ClientLeft(Unavailable):
    """The client has closed its connection, so nobody waits for the answer."""

    def __init__(self) -> None:
        super().__init__("the client has left", cure="send the request again and wait for its answer")


class StorageFull(Unavailable):
    """There is no room for what the request wants to store; nothing of it was stored."""

    def __init__(self, where: str) -> None:
        super().__init__(
            f"there is no room in {where}, or it is read-only", cure="try again when the operator has made room"
        )


class CommitUnknown(Unavailable):
    """The database failed while it committed: whether the change was stored shows only when it works again."""


class ProofFailed(WaymarkError):
    """An artwork was rendered and did not read back as its own code."""


def is_disk_full(error: BaseException) -> bool:
    """Whether an error of the operating system is that of a full or read-only disk, or of a quota."""
    return isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


def is_exhausted(error: BaseException) -> bool:
    """Whether a call failed because its process has no memory left, or may start no further thread."""
    return isinstance(error, MemoryError) or (
        isinstance(error, OSError) and error.errno in (errno.EAGAIN, errno.ENOMEM)
    )


@contextmanager
def naming(part: str) -> Iterator[None]:
    """Complete the field of an error that a part of the request caused."""
    try:
        yield
    except InvalidParameter as error:
        if error.field is not None and not error.field.startswith(f"{part}."):
            error.field = f"{part}.{error.field}"
        raise
