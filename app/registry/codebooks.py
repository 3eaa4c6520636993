"""Queries on codebooks. All see one agency only."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import Any

import sqlalchemy as sa

from app.errors import NotFound, StaleVersion
from app.registry.tables import codebooks

Row = sa.RowMapping


def get_codebook(connection: sa.Connection, agency_id: str, codebook_id: str) -> Row:
    """One codebook.

    Raises
    ------
    NotFound
        There is none with this id, or it belongs to another agency.
    """
    query = sa.select(codebooks).where(codebooks.c.id == codebook_id, codebooks.c.agency_id == agency_id)
    row = connection.execute(query).mappings().one_or_none()
    if row is None:
        raise NotFound(f"there is no codebook {codebook_id}", field="codebook_id")
    return row


def find_codebook(connection: sa.Connection, agency_id: str, name: str) -> str | None:
    """Id of the agency's codebook with a name."""
    query = sa.select(codebooks.c.id).where(codebooks.c.agency_id == agency_id, codebooks.c.name == name)
    return connection.execute(query).scalar_one_or_none()


def list_codebooks(connection: sa.Connection, agency_id: str, *, after: str | None, limit: int) -> list[Row]:
    """Codebooks in the order of their ids, which is the order they were made in."""
    query = sa.select(codebooks).where(codebooks.c.agency_id == agency_id)
    if after is not None:
        query = query.where(codebooks.c.id > after)
    return list(connection.execute(query.order_by(codebooks.c.id).limit(limit)).mappings())


def add_codebook(connection: sa.Connection, agency_id: str, values: Mapping[str, Any]) -> Row:
    """Store a new codebook."""
    connection.execute(sa.insert(codebooks).values(agency_id=agency_id, **values))
    return get_codebook(connection, agency_id, values["id"])


def replace_entries(
    connection: sa.Connection,
    agency_id: str,
    codebook_id: str,
    entries: list[dict[str, Any]],
    *,
    version: int,
    now: datetime,
) -> Row:
    """Store the entries of a book that is still at the version the caller read.

    Raises
    ------
    StaleVersion
        It was changed since.
    """
    statement = (
        sa.update(codebooks)
        .where(codebooks.c.id == codebook_id, codebooks.c.agency_id == agency_id, codebooks.c.version == version)
        .values(entries=entries, version=version + 1, updated_at=now)
    )
    if connection.execute(statement).rowcount != 1:
        raise StaleVersion(f"codebook {codebook_id} is no longer at version {version}", field="codebook_id")
    return get_codebook(connection, agency_id, codebook_id)
