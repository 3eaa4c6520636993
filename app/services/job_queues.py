"""The queue that each kind of job waits in, on both engines."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum

from app.registry.jobs import JobKind


class QueueName(StrEnum):
    """Queues of jobs; workers can be started for some of them only."""

    ONLINE = "online"
    """A vehicle or a person waits for the result within seconds."""
    PROOF = "proof"
    """Plans and what is computed from them, up to hours."""
    ARCHIVE = "archive"
    """Work over what is stored, which gives way to all other."""


QUEUES: Mapping[JobKind, QueueName] = {
    JobKind.DECODE: QueueName.ONLINE,
    JobKind.IMPORT: QueueName.ONLINE,
    JobKind.PLAN: QueueName.PROOF,
    JobKind.PROOF: QueueName.PROOF,
    JobKind.PACKAGE: QueueName.PROOF,
    JobKind.ARTWORK: QueueName.PROOF,
    JobKind.EXPORT: QueueName.PROOF,
    JobKind.REPROCESS: QueueName.ARCHIVE,
    JobKind.DRIVE: QueueName.ONLINE,
    JobKind.AUDIT: QueueName.ARCHIVE,
}


def kinds_in(queue: QueueName) -> tuple[JobKind, ...]:
    """Kinds of the jobs that wait in a queue."""
    return tuple(kind for kind, name in QUEUES.items() if name is queue)
