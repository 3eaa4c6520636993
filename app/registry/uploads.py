"""Queries on uploads that arrive in parts, and on how much each key has stored."""

from __future__ import annotations

from datetime import datetime
from typing import NamedTuple

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from app.errors import NotFound
from app.registry.column_types import ID, UtcTime, agency_column, fetch_all, find_one, metadata, one_of, select_rows
from app.values import JsonObject

UPLOAD_STATES = ("open", "done", "refused", "expired")

UPLOAD_METHODS = ("tus", "s3-parts")

# an upload that arrives in parts; what was received is what its parts hold, and both are written in one transaction
uploads = sa.Table(
    "uploads",
    metadata,
    sa.Column("id", ID, primary_key=True),
    agency_column(),
    sa.Column("holder_id", sa.String(200), nullable=False),  # of the key that uploads
    sa.Column("label", sa.String(200), nullable=False),
    sa.Column("scope", sa.String(16), nullable=False),
    sa.Column("method", sa.String(16), nullable=False),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("length", sa.BigInteger, nullable=False),  # of the whole file [byte]
    sa.Column("received", sa.BigInteger, nullable=False),  # [byte]
    sa.Column("declared", sa.JSON, nullable=False),  # name of the file, context and vehicle
    sa.Column("lock_id", ID),  # of the request that writes
    sa.Column("locked_until", UtcTime),
    sa.Column("store_key", sa.String(200)),  # of the object that an upload to S3 becomes
    sa.Column("store_upload_id", sa.String(1024)),
    sa.Column("decode_id", ID),
    sa.Column("error", sa.JSON(none_as_null=True)),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("expires_at", UtcTime, nullable=False),
    one_of("state", UPLOAD_STATES),
    one_of("method", UPLOAD_METHODS),
    sa.Index("ix_uploads_agency_id_state", "agency_id", "state"),
    sa.Index("ix_uploads_state_expires_at", "state", "expires_at"),
)

upload_parts = sa.Table(
    "upload_parts",
    metadata,
    sa.Column("upload_id", ID, sa.ForeignKey("uploads.id"), primary_key=True),
    sa.Column("start", sa.BigInteger, primary_key=True),  # its first byte in the file
    agency_column(),
    sa.Column("size", sa.BigInteger, nullable=False),  # [byte]
    sa.Column("sha256", sa.String(64), nullable=False),
    sa.Column("blob_key", sa.String(200), nullable=False),
)

# bytes of stored uploads, a row for each key: quotas need no sum over all decodes
stored_bytes = sa.Table(
    "stored_bytes",
    metadata,
    sa.Column("agency_id", ID, sa.ForeignKey("agencies.id"), primary_key=True),
    sa.Column("holder_id", sa.String(200), primary_key=True),
    sa.Column("bytes", sa.BigInteger, nullable=False),
)

_U, _P = uploads.c, upload_parts.c


class UploadRow(NamedTuple):
    """An upload that arrives in parts."""

    id: str
    agency_id: str
    # `holder_id`, `label`, `scope`: of the key that uploads
    holder_id: str
    label: str
    scope: str
    method: str  # ``tus`` or ``s3-parts``
    state: str  # ``open``, then ``done`` (there is a decode), ``refused`` (there is an error) or ``expired``
    # `length`, `received`: [byte] of the whole file, and of what is stored durably
    length: int
    received: int
    declared: JsonObject  # ``file_name``, ``context`` (its members that were stated) and ``vehicle``
    created_at: datetime
    expires_at: datetime
    # `lock_id`, `locked_until`: the request that writes, and until when nobody else may
    lock_id: str | None = None
    locked_until: datetime | None = None
    # `store_key`, `store_upload_id`: of an upload whose parts go to S3 directly
    store_key: str | None = None
    store_upload_id: str | None = None
    decode_id: str | None = None
    error: dict[str, str] | None = None


class PartRow(NamedTuple):
    """A part of an upload, stored as a blob."""

    start: int
    size: int
    sha256: str
    blob_key: str


class Open(NamedTuple):
    """Uploads that are not complete: how many, and the bytes that they will have."""

    number: int
    bytes: int


def add_upload(connection: sa.Connection, row: UploadRow) -> None:
    """Store a new upload."""
    connection.execute(sa.insert(uploads), row._asdict())


def get_upload(connection: sa.Connection, agency_id: str, upload_id: str, *, holder_id: str | None = None) -> UploadRow:
    """One upload, of anybody in the agency or of one holder of a key.

    Raises
    ------
    NotFound
        There is none with this id, or it belongs to another.
    """
    query = select_rows(UploadRow, uploads).where(_U.id == upload_id, _U.agency_id == agency_id)
    if holder_id is not None:
        query = query.where(_U.holder_id == holder_id)
    row = find_one(connection, query, UploadRow)
    if row is None:
        raise NotFound(f"there is no upload {upload_id}", field="upload_id", cure="POST /v1/uploads starts one")
    return row


def lock_upload(
    connection: sa.Connection, agency_id: str, upload_id: str, lock_id: str, now: datetime, until: datetime
) -> bool:
    """Let one request write an open upload; False if another one does."""
    query = sa.update(uploads).where(
        _U.id == upload_id,
        _U.agency_id == agency_id,
        _U.state == "open",
        sa.or_(_U.lock_id.is_(None), _U.lock_id == lock_id, _U.locked_until < now),
    )
    return connection.execute(query.values(lock_id=lock_id, locked_until=until)).rowcount == 1


def unlock_upload(connection: sa.Connection, agency_id: str, upload_id: str, lock_id: str) -> None:
    """Let others write; a lock that was lost meanwhile stays with its holder."""
    query = sa.update(uploads).where(_U.id == upload_id, _U.agency_id == agency_id, _U.lock_id == lock_id)
    connection.execute(query.values(lock_id=None, locked_until=None))


def unlock_all(connection: sa.Connection) -> None:
    """Remove all locks, where no other process uses the database: their requests ended with the process before."""
    connection.execute(sa.update(uploads).where(_U.lock_id.is_not(None)).values(lock_id=None, locked_until=None))


def add_part(
    connection: sa.Connection,
    row: UploadRow,
    part: PartRow,
    *,
    lock_id: str,
    locked_until: datetime,
    expires_at: datetime,
) -> bool:
    """Append a part, in the transaction that makes it count; False if the lock or the place was lost."""
    query = sa.update(uploads).where(
        _U.id == row.id,
        _U.agency_id == row.agency_id,
        _U.state == "open",
        _U.lock_id == lock_id,
        _U.received == part.start,
    )
    received = part.start + part.size
    found = connection.execute(query.values(received=received, locked_until=locked_until, expires_at=expires_at))
    if found.rowcount != 1:
        return False
    connection.execute(sa.insert(upload_parts), {"upload_id": row.id, "agency_id": row.agency_id, **part._asdict()})
    return True


def list_parts(connection: sa.Connection, agency_id: str, upload_id: str) -> list[PartRow]:
    """The parts of an upload, in their order."""
    query = select_rows(PartRow, upload_parts).where(_P.upload_id == upload_id, _P.agency_id == agency_id)
    return fetch_all(connection, query.order_by(_P.start), PartRow)


def delete_parts(connection: sa.Connection, agency_id: str, upload_id: str) -> None:
    """Forget the parts of an upload; their blobs are deleted afterwards."""
    connection.execute(sa.delete(upload_parts).where(_P.upload_id == upload_id, _P.agency_id == agency_id))


def end_upload(connection: sa.Connection, agency_id: str, upload_id: str, state: str, **values: object) -> None:
    """Give an upload its last state, and forget its parts."""
    query = sa.update(uploads).where(_U.id == upload_id, _U.agency_id == agency_id)
    connection.execute(query.values(state=state, lock_id=None, locked_until=None, **values))
    delete_parts(connection, agency_id, upload_id)


def delete_upload(connection: sa.Connection, agency_id: str, upload_id: str) -> None:
    """Delete an upload."""
    delete_parts(connection, agency_id, upload_id)
    connection.execute(sa.delete(uploads).where(_U.id == upload_id, _U.agency_id == agency_id))


def list_complete(connection: sa.Connection, now: datetime) -> list[UploadRow]:
    """Open uploads of all agencies that are complete and that nobody works on."""
    query = select_rows(UploadRow, uploads).where(
        _U.state == "open",
        _U.method == "tus",
        _U.received == _U.length,
        sa.or_(_U.lock_id.is_(None), _U.locked_until < now),
    )
    return fetch_all(connection, query, UploadRow)


def list_expired(connection: sa.Connection, now: datetime) -> list[UploadRow]:
    """Open uploads of all agencies whose time is over and that nobody works on."""
    query = select_rows(UploadRow, uploads).where(
        _U.state == "open", _U.expires_at < now, sa.or_(_U.lock_id.is_(None), _U.locked_until < now)
    )
    return fetch_all(connection, query, UploadRow)


def delete_ended(connection: sa.Connection, before: datetime) -> None:
    """Delete uploads of all agencies that ended before a time; their decodes stay."""
    connection.execute(sa.delete(uploads).where(_U.state != "open", _U.expires_at < before))


# --- quotas -----------------------------------------------------------------------------------------------------------


def count_open(connection: sa.Connection, agency_id: str, holder_id: str | None = None) -> Open:
    """Open uploads of an agency, or of one of its keys."""
    query = sa.select(sa.func.count(), sa.func.coalesce(sa.func.sum(_U.length), 0)).where(
        _U.agency_id == agency_id, _U.state == "open"
    )
    if holder_id is not None:
        query = query.where(_U.holder_id == holder_id)
    count, size = connection.execute(query).one()
    return Open(int(count), int(size))


def sum_stored(connection: sa.Connection, agency_id: str, holder_id: str | None = None) -> int:
    """Bytes that an agency has stored, or one of its keys. [byte]"""
    query = sa.select(sa.func.coalesce(sa.func.sum(stored_bytes.c.bytes), 0)).where(
        stored_bytes.c.agency_id == agency_id
    )
    if holder_id is not None:
        query = query.where(stored_bytes.c.holder_id == holder_id)
    return int(connection.execute(query).scalar_one())


def add_stored(connection: sa.Connection, agency_id: str, holder_id: str, size: int) -> None:
    """Count bytes that a key stores, in the transaction that stores them."""
    insert = sqlite.insert if connection.dialect.name == "sqlite" else postgresql.insert
    query = insert(stored_bytes).values(agency_id=agency_id, holder_id=holder_id, bytes=size)
    connection.execute(
        query.on_conflict_do_update(
            index_elements=["agency_id", "holder_id"], set_={"bytes": stored_bytes.c.bytes + size}
        )
    )
