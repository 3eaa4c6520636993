"""Markers go out as files for GIS and surveyors."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

from app.errors import InvalidParameter
from app.families.rules import RETIRED
from app.formats import exports as write
from app.formats.exports import WrittenFile
from app.registry import bulk
from app.registry.database import Database
from app.registry.markers import MarkerFilter
from app.services.access.access import Caller
from app.services.request_work import check_deadline

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
_PAGE = 2_000
_BLOCK = 2**20


class FileWriter(Protocol):
    """As `app.formats.exports.write_file`."""

    def __call__(
        self, kind: str, pages: Iterable[Sequence[write.Record]], folder: Path, *, all_heights: bool
    ) -> WrittenFile:
        """Write a file from pages of markers."""


class Exports:
    """Use cases on exports; each page is read by itself, so an export holds no transaction open.

    Parameters
    ----------
    database : Database
    write : callable
        Writes a file of a kind of `WHOLE`, here or in another process.
    """

    def __init__(self, database: Database, write: FileWriter = write.write_file) -> None:
        self._database, self._write = database, write

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
    ) -> WrittenFile:  # fmt: skip
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
            return WrittenFile(path)
        with_retired = kind not in ("landxml", "dxf") or filtered.status is not None
        with self._database.read() as connection:
            count = bulk.count_records(connection, caller.agency_id, filtered, with_retired=with_retired)
            all_heights = bulk.have_ellipsoidal_heights(connection, caller.agency_id, filtered)
        if not count:
            raise InvalidParameter(
                "no marker is in the selection", field="bbox", limit="one at least", cure="widen the filter"
            )
        if count > MAX_WHOLE[kind]:
            raise InvalidParameter(
                f"{count} markers are too many for one file",
                field="bbox",
                limit=f"{MAX_WHOLE[kind]} markers",
                cure="export a smaller box, or CSV or GeoJSON",
            )
        pages = _reported(self._pages(caller, filtered, with_retired=with_retired), report)
        return self._write(kind, pages, folder, all_heights=all_heights)

    def _pages(
        self, caller: Caller, filtered: MarkerFilter, *, with_retired: bool = True
    ) -> Iterator[list[dict[str, Any]]]:
        after: str | None = None
        while True:
            check_deadline()
            with self._database.read() as connection:
                page = bulk.list_records(connection, caller.agency_id, filtered, write.FIELDS, after=after, limit=_PAGE)
            if not page:
                return
            after = page[-1]["id"]
            if not with_retired:
                page = [record for record in page if record["status"] != RETIRED]
            for record in page:
                record["updated_at"] = record["updated_at"].isoformat()
            yield page


def _reported(pages: Iterator[list[dict[str, Any]]], report: Callable[[int], None]) -> Iterator[list[dict[str, Any]]]:
    count = 0
    for page in pages:
        yield page
        count += len(page)
        report(count)


def _blocks(path: Path, folder: TemporaryDirectory[str]) -> Iterator[bytes]:
    with folder, path.open("rb") as file:
        while block := file.read(_BLOCK):
            yield block
