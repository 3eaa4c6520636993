"""Resources of agencies: rows with an id, read, listed, changed at a version, and kept in a history."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Generic, NamedTuple, TypeVar

import sqlalchemy as sa

from app.errors import Conflict, NotFound, StaleVersion
from app.registry.column_types import AnySelect, fetch_all, find_one, new_id, select_rows

RowT = TypeVar("RowT", bound=tuple[object, ...])


class VersionRow(NamedTuple):
    """One entry of a resource's history; `stored` is the resource as JSON."""

    version: int
    at: datetime
    who: str
    why: str | None
    stored: object


@dataclass(frozen=True)
class Resource(Generic[RowT]):
    """The queries on one kind of resource. All see one agency only."""

    name: str  # in errors, and of its columns in the history
    row: type[RowT]  # a NamedTuple of the columns that are read
    table: sa.Table  # with the columns `id` and `agency_id`
    cure: str | None = None  # where the agency's own are listed
    versions: sa.Table | None = None  # the history. Its columns `{name}_id` and `{name}` have the id and the resource.
    unversioned: tuple[str, ...] = ()  # columns that no version keeps

    def find(self, connection: sa.Connection, agency_id: str, **equal: object) -> RowT | None:
        """The only resource whose columns have these values."""
        return find_one(connection, self._select(agency_id, equal), self.row)

    def get(self, connection: sa.Connection, agency_id: str, resource_id: str, field: str | None = None) -> RowT:
        """One resource.

        Raises
        ------
        NotFound
            There is none with this id, or it belongs to another agency.
        """
        row = self.find(connection, agency_id, id=resource_id)
        if row is None:
            raise NotFound(f"there is no {self.name} {resource_id}", field=field or f"{self.name}_id", cure=self.cure)
        return row

    def get_at(self, connection: sa.Connection, agency_id: str, resource_id: str, version: int | None) -> RowT:
        """One resource that is still at a version; None is whatever version it is at.

        Raises
        ------
        NotFound
            There is none with this id, or it belongs to another agency.
        StaleVersion
            It is at another version.
        """
        row: Any = self.get(connection, agency_id, resource_id)
        check_version(self.name, resource_id, row.version, version)
        return row  # type: ignore[no-any-return]

    def check_name(self, connection: sa.Connection, agency_id: str, name: str) -> None:
        """Refuse a name that another resource of the agency has.

        Raises
        ------
        Conflict
            One has it.
        """
        other: Any = self.find(connection, agency_id, name=name)
        if other is not None:
            raise Conflict(
                f"{self.name} {other.id} has the name {name}",
                field="name",
                limit="each name once in an agency",
                cure=f"choose another name, or change that {self.name}",
            )

    def page(
        self,
        connection: sa.Connection,
        agency_id: str,
        *,
        beyond: str | None = None,
        limit: int,
        newest_first: bool = False,
        where: Sequence[sa.ColumnElement[bool]] = (),
        **equal: object,
    ) -> tuple[list[RowT], str | None]:
        """Resources in the order of their ids, which is the order they were made in, or newest first.

        Parameters
        ----------
        beyond : str, optional
            The id to continue after.
        **equal
            Values of columns; None does not narrow.

        Returns
        -------
        rows : list
            At most `limit`.
        last : str or None
            The id to continue after if there are more.
        """
        key = self.table.c.id
        query = self._select(agency_id, {name: value for name, value in equal.items() if value is not None})
        query = query.where(*where)
        if beyond is not None:
            query = query.where(key < beyond if newest_first else key > beyond)
        query = query.order_by(key.desc() if newest_first else key).limit(limit + 1)
        rows: list[Any] = fetch_all(connection, query, self.row)
        return rows[:limit], rows[limit - 1].id if len(rows) > limit else None

    def add(
        self,
        connection: sa.Connection,
        agency_id: str,
        values: Mapping[str, Any],
        *,
        who: str = "",
        why: str | None = None,
    ) -> RowT:
        """Store a new resource, with the first entry of its history."""
        connection.execute(sa.insert(self.table).values(agency_id=agency_id, **values))
        return self._recorded(connection, agency_id, values["id"], who, why)

    def update(
        self,
        connection: sa.Connection,
        agency_id: str,
        resource_id: str,
        changes: Mapping[str, object],
        *,
        version: int,
        now: datetime,
        who: str = "",
        why: str | None = None,
    ) -> RowT:
        """Change a resource that is still at the version the caller read, and add to its history.

        Raises
        ------
        StaleVersion
            It was changed since.
        """
        c = self.table.c
        statement = sa.update(self.table).where(c.id == resource_id, c.agency_id == agency_id, c.version == version)
        statement = statement.values(**changes, version=version + 1, updated_at=now)
        if connection.execute(statement).rowcount != 1:
            raise StaleVersion(f"{self.name} {resource_id} is no longer at version {version}", field="If-Match")
        return self._recorded(connection, agency_id, resource_id, who, why)

    def history(
        self, connection: sa.Connection, agency_id: str, resource_id: str, *, after: int, limit: int
    ) -> tuple[list[VersionRow], int | None]:
        """The versions of a resource, oldest first, and the one to continue after if there are more.

        Raises
        ------
        NotFound
            There is none with this id, or it belongs to another agency.
        """
        self.get(connection, agency_id, resource_id)
        query = self._versions(agency_id, resource_id).where(self._kept.c.version > after)
        query = query.order_by(self._kept.c.version).limit(limit + 1)
        rows = fetch_all(connection, query, VersionRow)
        return rows[:limit], rows[limit - 1].version if len(rows) > limit else None

    def get_version(self, connection: sa.Connection, agency_id: str, resource_id: str, version: int) -> VersionRow:
        """One version of a resource.

        Raises
        ------
        NotFound
            It had no such version.
        """
        query = self._versions(agency_id, resource_id).where(self._kept.c.version == version)
        found = find_one(connection, query, VersionRow)
        if found is None:
            message = f"{self.name} {resource_id} has no version {version}"
            raise NotFound(message, field="version", cure="GET its versions")
        return found

    @property
    def _kept(self) -> sa.Table:
        assert self.versions is not None, f"no history is kept of a {self.name}"
        return self.versions

    def _select(self, agency_id: str, equal: Mapping[str, object]) -> AnySelect:
        c = self.table.c
        return select_rows(self.row, self.table).where(
            c.agency_id == agency_id, *(c[name] == value for name, value in equal.items())
        )

    def _versions(self, agency_id: str, resource_id: str) -> AnySelect:
        c = self._kept.c
        query = sa.select(c.version, c.at, c.who, c.why, c[self.name])
        return query.where(c[f"{self.name}_id"] == resource_id, c.agency_id == agency_id)

    def _recorded(self, connection: sa.Connection, agency_id: str, resource_id: str, who: str, why: str | None) -> RowT:
        row: Any = self.get(connection, agency_id, resource_id)
        if self.versions is not None:
            stored = {name: value for name, value in row._asdict().items() if name not in self.unversioned}
            about = {f"{self.name}_id": resource_id, "agency_id": agency_id, "version": row.version}
            entry = {**about, "at": row.updated_at, "who": who, "why": why, self.name: stored}
            connection.execute(sa.insert(self.versions).values(entry))
        return row  # type: ignore[no-any-return]


def first_version(now: datetime) -> dict[str, object]:
    """Columns of a new resource: its id, its version and its times."""
    return {"id": new_id(now), "version": 1, "created_at": now, "updated_at": now}


def check_version(name: str, resource_id: str, found: int, wanted: int | None) -> None:
    """Refuse a change that is based on another version; None is any version.

    Raises
    ------
    StaleVersion
        It is based on another one.
    """
    if wanted is not None and found != wanted:
        raise StaleVersion(
            f"{name} {resource_id} is at version {found}, the change is based on version {wanted}",
            field="If-Match",
            limit=f'"{found}"',
            cure=f"read the {name} again and repeat the change on what it is now",
        )
