"""Markers go out: streamed as CSV and GeoJSON, or as one file for GIS and surveyors."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from app.errors import InvalidParameter
from app.registry import markers as store
from app.registry.database import Database
from app.registry.exchange import write
from app.registry.markers import MarkerFilter, Row
from app.services.access import Caller

STREAMED = {"csv": "text/csv; charset=utf-8", "geojson": "application/geo+json"}
WHOLE = {
    "gpkg": "application/geopackage+sqlite3",
    "shapefile": "application/zip",
    "kml": "application/vnd.google-earth.kml+xml",
    "landxml": "application/xml",
    "dxf": "image/vnd.dxf",
}
MAX_WHOLE = 200_000
_PAGE = 2000


class Exports:
    """Use cases on exports; each page is read by itself, so an export holds no transaction open."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def stream(self, caller: Caller, kind: str, narrowed: MarkerFilter) -> Iterator[bytes]:
        """CSV or GeoJSON in the order of the ids, at flat memory."""
        pages = self._pages(caller, narrowed)
        return write.write_csv(pages) if kind == "csv" else write.write_geojson(pages)

    def whole(self, caller: Caller, kind: str, narrowed: MarkerFilter) -> bytes:
        """One file.

        Raises
        ------
        InvalidParameter
            There are none, too many for one file, or too far apart for one zone.
        """
        records: list[dict[str, Any]] = []
        for page in self._pages(caller, narrowed):
            records += page
            if len(records) > MAX_WHOLE:
                raise InvalidParameter(
                    "too many markers for one file",
                    field="bbox",
                    limit=f"{MAX_WHOLE} markers",
                    cure="export a smaller box, or CSV or GeoJSON",
                )
        if not records:
            raise InvalidParameter(
                "no marker is in the selection", field="bbox", limit="one at least", cure="widen the filter"
            )
        if kind == "landxml":
            return write.write_landxml(records)
        return write.write_dxf(records) if kind == "dxf" else write.write_gis(records, kind)

    def _pages(self, caller: Caller, narrowed: MarkerFilter) -> Iterator[list[dict[str, Any]]]:
        after: str | None = None
        while True:
            with self._database.read() as connection:
                rows = store.list_markers(connection, caller.agency_id, narrowed, after=after, limit=_PAGE)
            if not rows:
                return
            yield [_record(row) for row in rows]
            after = rows[-1]["id"]


def _record(row: Row) -> dict[str, Any]:
    spec = row["spec"] or {}
    own = {"code": row["digits"], "side": spec.get("side"), "updated_at": row["updated_at"].isoformat()}
    return {name: own[name] if name in own else row[name] for name in write.FIELDS}
