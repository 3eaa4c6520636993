"""Uploads as clients see them."""

from __future__ import annotations

from datetime import datetime
from typing import Literal, NotRequired

from typing_extensions import TypedDict

from app.registry.uploads import UploadRow
from app.services.error_documents import ErrorDocument

UploadState = Literal["open", "done", "refused", "expired"]


class UploadDocument(TypedDict):
    """An upload that arrives in parts. `decode_id` is that of the decode that it became.

    If the parts go to S3, the response to its start has `part_urls`: each part but the last has `part_bytes`, and is
    sent by PUT.
    """

    id: str
    state: UploadState
    method: Literal["tus", "s3-parts"]
    length: int
    received: int
    file_name: str
    created_at: datetime
    expires_at: datetime
    decode_id: NotRequired[str]
    error: NotRequired[ErrorDocument]
    part_bytes: NotRequired[int]
    part_urls: NotRequired[list[str]]


def upload_document(row: UploadRow) -> UploadDocument:
    """An upload as clients see it."""
    document: UploadDocument = {
        "id": row.id,
        "state": row.state,  # type: ignore[typeddict-item]
        "method": row.method,  # type: ignore[typeddict-item]
        "length": row.length,
        "received": row.received,
        "file_name": row.declared["file_name"],
        "created_at": row.created_at,
        "expires_at": row.expires_at,
    }
    if row.decode_id is not None:
        document["decode_id"] = row.decode_id
    if row.error is not None:
        document["error"] = row.error  # type: ignore[typeddict-item]
    return document
