"""Markers go out as files for GIS and surveyors."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import chain, islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from app.errors import InvalidParameter
from app.families.rules import RETIRED
from app.formats import exports as write
from app.registry import bulk
from app.registry.database import Database
from app.registry.markers import MarkerFilter
from app.services.access.access import Caller

STREAMED = {"csv": "text/csv; charset=utf-8", "geojson": "application/geo+json"}
WHOLE = {
    "gpkg": "application/geopackage+sqlite3",
    "shapefile": "application/zip",
    "kml": "application/vnd.google-earth.kml+xml",
    "landxml": "application/xml",
    "dxf": "image/vnd.dxf",
}
KINDS = (*STREAMED, *WHOLE)
MAX_WHOLE = {"gpkg": 10_000_000, "shapefile": 2_000_000, "kml": 200_000, "landxml": 200_000, "dxf": 200_000}
_PAGE = 5_000
_GIS_PAGE = 50_000
_BLOCK = 2**20


class Exports:
    """Use cases on exports; each page is read by itself, so an export holds no transaction open."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def stream(self, caller: Caller, kind: str, filtered: MarkerFilter) -> Iterator[bytes]:
        """CSV or GeoJSON in the order of the ids, at flat memory."""
        pages = self._pages(caller, filtered)
        return write.write_csv(pages) if kind == "csv" else write.write_geojson(pages)

    def whole(self, caller: Caller, kind: str, filtered: MarkerFilter) -> tuple[Iterator[bytes], tuple[str, ...]]:
        """One file, written before this returns and gone when it has been read; and the ids of markers left out of it.

        Raises
        ------
        InvalidParameter
            There are none, or too many for one file.
        """
        folder = TemporaryDirectory(prefix="waymark-export-")
        try:
            path, left_out = self.write_file(caller, kind, filtered, Path(folder.name))
        except BaseException:
            folder.cleanup()
            raise
        return _blocks(path, folder), left_out

    def write_file(
        self, caller: Caller, kind: str, filtered: MarkerFilter, folder: Path,
        report: Callable[[int], None] = lambda _markers: None,
    ) -> tuple[Path, tuple[str, ...]]:  # fmt: skip
        """One file of any kind, in an empty folder, and the ids of markers left out of it; raises as `whole`.

        `report` is called with the number of markers that were read so far; what it raises stops the export.

        LandXML and DXF have one UTM zone: markers too far from it are left out. They have no status either, so retired
        markers are in them only if the filter asks for these.
        """
        if kind in STREAMED:
            path = folder / f"markers.{kind}"
            with path.open("wb") as file:
                pages = _reported(self._pages(caller, filtered), report)
                file.writelines(write.write_csv(pages) if kind == "csv" else write.write_geojson(pages))
            return path, ()
        in_zone = kind in ("landxml", "dxf")
        pages = _reported(self._pages(caller, filtered, most=MAX_WHOLE[kind], with_retired=not in_zone), report)
        first = next(pages, None)
        if first is None:
            raise InvalidParameter(
                "no marker is in the selection", field="bbox", limit="one at least", cure="widen the filter"
            )
        records = chain.from_iterable(chain((first,), pages))
        if in_zone:
            path = folder / f"markers.{kind}"
            made = (write.write_landxml if kind == "landxml" else write.write_dxf)(list(records))
            path.write_bytes(made.content)
            return path, made.left_out
        with self._database.read() as connection:
            all_heights = bulk.have_ellipsoidal_heights(connection, caller.agency_id, filtered)
        batches = _batched(records, MAX_WHOLE["kml"] if kind == "kml" else _GIS_PAGE)
        return write.write_gis(batches, kind, folder, all_heights=all_heights), ()

    def _pages(
        self, caller: Caller, filtered: MarkerFilter, *, most: int | None = None, with_retired: bool = True
    ) -> Iterator[list[dict[str, Any]]]:
        after: str | None = None
        count = 0
        while True:
            with self._database.read() as connection:
                page = bulk.list_records(connection, caller.agency_id, filtered, write.FIELDS, after=after, limit=_PAGE)
            if not page:
                return
            after = page[-1]["id"]
            if not with_retired and filtered.status is None:
                page = [record for record in page if record["status"] != RETIRED]
                if not page:
                    continue
            count += len(page)
            if most is not None and count > most:
                raise InvalidParameter(
                    "too many markers for one file",
                    field="bbox",
                    limit=f"{most} markers",
                    cure="export a smaller box, or CSV or GeoJSON",
                )
            for record in page:
                record["updated_at"] = record["updated_at"].isoformat()
            yield page


def _reported(pages: Iterator[list[dict[str, Any]]], report: Callable[[int], None]) -> Iterator[list[dict[str, Any]]]:
    count = 0
    for page in pages:
        yield page
        count += len(page)
        report(count)


def _batched(records: Iterator[dict[str, Any]], count: int) -> Iterator[list[dict[str, Any]]]:
    while batch := list(islice(records, count)):
        yield batch


def _blocks(path: Path, folder: TemporaryDirectory[str]) -> Iterator[bytes]:
    with folder, path.open("rb") as file:
        while block := file.read(_BLOCK):
            yield block
