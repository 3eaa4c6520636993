"""Markers go out as files for GIS and surveyors."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from datetime import timedelta
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Protocol

from app.errors import InvalidParameter, ReferenceSystemError
from app.families.surveys import RETIRED
from app.formats import exports as write
from app.formats.exports import ExportFrame, WrittenFile
from app.geodesy import normalize_crs, reference_system
from app.geodesy.systems import normalize_vertical_datum
from app.registry import jobs as store
from app.registry import markers
from app.registry.column_types import new_id
from app.registry.database import Database
from app.registry.jobs import JobKind, new_job
from app.registry.markers import MarkerFilter, count_records
from app.registry.spatial import Box
from app.services.access.access import Caller, Scope
from app.services.idempotency import IdempotencyKey, write_once
from app.services.jobs import RunningJob
from app.services.markers.searches import area_of_text
from app.services.ports import Clock, JobQueue
from app.services.progress import JobDocument, JobFiles, job_document
from app.services.request_work import check_deadline
from app.values import JsonObject

STREAMED = {"csv": "text/csv; charset=utf-8", "geojson": "application/geo+json"}
WHOLE = {
    "gpkg": "application/geopackage+sqlite3",
    "geoparquet": "application/vnd.apache.parquet",
    "flatgeobuf": "application/flatgeobuf",
    "shapefile": "application/zip",
    "kml": "application/vnd.google-earth.kml+xml",
    "landxml": "application/xml",
    "dxf": "image/vnd.dxf",
}
KINDS = (*STREAMED, *WHOLE)
MAX_WHOLE = {
    "gpkg": 10_000_000,
    "geoparquet": 10_000_000,
    "flatgeobuf": 1_000_000,  # GDAL holds its spatial index in memory
    "shapefile": 2_000_000,  # 2 GiB of its .dbf
    "kml": 200_000,  # held in memory, as the next two
    "landxml": 200_000,
    "dxf": 200_000,
}
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
    write : callable
        Writes a file of a kind of `WHOLE`, here or in another process.
    """

    def __init__(self, database: Database, write: FileWriter = write.write_file) -> None:
        self._database, self._write = database, write

    def stream(
        self, caller: Caller, kind: str, filtered: MarkerFilter, frame: ExportFrame | None = None
    ) -> Iterator[bytes]:
        """CSV or GeoJSON in the order of the ids, at flat memory.

        Raises
        ------
        ReferenceSystemError
            No marker of the first page has a place in the system.
        """
        pages = self._pages(caller, filtered, frame)
        return write.write_csv(pages, frame) if kind == "csv" else write.write_geojson(pages, frame)

    def whole(
        self, caller: Caller, kind: str, filtered: MarkerFilter, frame: ExportFrame | None = None
    ) -> tuple[Iterator[bytes], tuple[str, ...]]:
        """One file, written before this returns and gone when it has been read; and the ids of markers left out of it.

        Raises
        ------
        InvalidParameter
            There are none, or too many for one file, or none has a place in the system, or a library of the format is
            not installed.
        """
        folder = TemporaryDirectory(prefix="waymark-export-")
        try:
            path, left_out = self.write_file(caller, kind, filtered, Path(folder.name), frame=frame)
        except BaseException:
            folder.cleanup()
            raise
        return _blocks(path, folder), left_out

    def write_file(
        self, caller: Caller, kind: str, filtered: MarkerFilter, folder: Path,
        report: Callable[[int], None] = lambda _markers: None, *, frame: ExportFrame | None = None,
    ) -> WrittenFile:  # fmt: skip
        """One file of any kind, in an empty folder, and the ids of markers left out of it; raises as `whole`.

        `report` is called with the number of markers that were read so far; what it raises stops the export.

        LandXML and DXF have one projected system: without a frame, that in which most of the markers came, or else the
        UTM zone that most lie in. Markers too far from it are left out. They have no status either, so retired markers
        are in them only if the filter asks for these.
        """
        if kind in STREAMED:
            path = folder / f"markers.{kind}"
            with path.open("wb") as file:
                pages = _reported(self._pages(caller, filtered, frame), report)
                file.writelines(write.write_csv(pages, frame) if kind == "csv" else write.write_geojson(pages, frame))
            return WrittenFile(path)
        _check_installed(kind)
        with_retired = kind not in ("landxml", "dxf") or filtered.status is not None
        with self._database.read() as connection:
            count = markers.count_records(connection, caller.agency_id, filtered, with_retired=with_retired)
            all_heights = markers.have_heights(connection, caller.agency_id, filtered, ellipsoidal=frame is None)
            if kind in ("landxml", "dxf") and frame is None:
                frame = _own_frame(markers.origins(connection, caller.agency_id, filtered))
        if kind == "kml" and frame is not None and frame.crs not in ("EPSG:4326", "OGC:CRS84"):
            raise InvalidParameter(
                f"KML is in WGS 84, not in {frame.crs}", field="crs", limit="EPSG:4326", cure="choose another format"
            )
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
        pages = _reported(self._pages(caller, filtered, frame, with_retired=with_retired), report)
        return self._write(kind, pages, folder, all_heights=all_heights)

    def _pages(
        self, caller: Caller, filtered: MarkerFilter, frame: ExportFrame | None, *, with_retired: bool = True
    ) -> Iterator[list[JsonObject]]:
        """Pages of records, framed where a frame is wanted; the first one is read at once, so that it can be refused.

        Raises
        ------
        ReferenceSystemError
            No marker of the first page has a place in the frame.
        """
        pages = self._read_pages(caller, filtered, frame is not None, with_retired=with_retired)
        if frame is None:
            return pages
        first = next(pages, None)
        if first is None:
            return iter(())
        framed, problem = write.frame_records(first, frame)
        if problem is not None and all(record["x"] is None for record in framed):
            raise problem
        return chain([framed], (write.frame_records(page, frame)[0] for page in pages))

    def _read_pages(
        self, caller: Caller, filtered: MarkerFilter, with_origin: bool, *, with_retired: bool
    ) -> Iterator[list[JsonObject]]:
        after: str | None = None
        fields = (*write.FIELDS, *write.ORIGIN_FIELDS) if with_origin else write.FIELDS
        while True:
            check_deadline()
            with self._database.read() as connection:
                page = markers.list_records(connection, caller.agency_id, filtered, fields, after=after, limit=_PAGE)
            if not page:
                return
            after = page[-1]["id"]
            if not with_retired:
                page = [record for record in page if record["status"] != RETIRED]
            for record in page:
                record["updated_at"] = record["updated_at"].isoformat()
            if page:
                yield page


def _check_installed(kind: str) -> None:
    if kind == "geoparquet" and find_spec("pyarrow") is None:  # not imported: only the process that writes needs it
        raise InvalidParameter(
            "this server writes no GeoParquet: pyarrow is not installed",
            field="format",
            limit=", ".join(name for name in KINDS if name != kind),
            cure="export GeoPackage, or ask the operator to install waymark-roads[parquet]",
        )


def _own_frame(origins: Sequence[tuple[str, str | None]]) -> ExportFrame | None:
    """The projected system in which most markers came, with the vertical datum of most heights in it."""
    for crs, _datum in origins:
        try:
            if not reference_system(crs).is_projected:
                continue
        except ReferenceSystemError:
            continue
        datum = next((datum for name, datum in origins if name == crs and datum is not None), None)
        return ExportFrame(crs, vertical_datum=datum, needs_heights=False)
    return None


def _reported(pages: Iterator[list[JsonObject]], report: Callable[[int], None]) -> Iterator[list[JsonObject]]:
    count = 0
    for page in pages:
        yield page
        count += len(page)
        report(count)


def _blocks(path: Path, folder: TemporaryDirectory[str]) -> Iterator[bytes]:
    with folder, path.open("rb") as file:
        while block := file.read(_BLOCK):
            yield block


# === Exports as jobs: the file is written to disk, stored, and sent when it is asked for.


SUFFIXES = {"geoparquet": "parquet", "flatgeobuf": "fgb", "shapefile": "shp.zip", "landxml": "xml"}
MAX_LEFT_OUT_IDS = 20
"""Ids in the header Waymark-Left-Out. 1 kB."""
_WRITING = 0.95
"""Progress when all markers are read; GDAL then closes the file."""


class ExportJobs:
    """Use cases on exports that are jobs.

    Parameters
    ----------
    exports : Exports
        Writes the files.
    """

    def __init__(
        self, database: Database, clock: Clock, queue: JobQueue, exports: Exports, files: JobFiles,
        idempotency_ttl: timedelta,
    ) -> None:  # fmt: skip
        self._database, self._clock, self._queue = database, clock, queue
        self._exports, self._files, self._ttl = exports, files, idempotency_ttl

    def submit(self, caller: Caller, wanted: JsonObject, key: IdempotencyKey | None = None) -> tuple[JobDocument, bool]:
        """Queue an export; returns whether it was queued before.

        Parameters
        ----------
        wanted : mapping
            ``format`` and what `filter_of` and `frame_of` read.
        """
        _check_installed(wanted["format"])
        filter_of(wanted)
        frame_of(wanted)
        now, agency_id = self._clock(), caller.agency_id
        job_input = {"wanted": dict(wanted), "label": caller.label}
        job = new_job(JobKind.EXPORT, new_id(now), agency_id, caller.key_id, now, job_input=job_input)
        with write_once(self._database, agency_id, key, now, self._ttl) as (connection, answer):
            if answer.replayed:
                return answer.response, True
            store.add_job(connection, job)
            document = answer.store(job_document(job, now))
        self._queue.submit(job.id, agency_id, JobKind.EXPORT)
        return document, False

    def run(self, job: RunningJob) -> None:
        """Write the file; the handler of jobs of the kind `JobKind.EXPORT`."""
        wanted = job.row.input["wanted"]
        kind, filtered, frame = wanted["format"], filter_of(wanted), frame_of(wanted)
        caller = Caller(job.row.agency_id, job.row.holder_id or "", job.row.input["label"], Scope.VIEWER)
        with self._database.read() as connection:
            total = count_records(connection, caller.agency_id, filtered)
        job.report_progress(0.0, steps=(0, total))

        def report(done: int) -> None:
            job.report_progress(min(1.0, done / max(1, total)) * _WRITING, steps=(min(done, total), total))

        with TemporaryDirectory(prefix="waymark-export-") as folder:
            path, left_out = self._exports.write_file(caller, kind, filtered, Path(folder), report, frame=frame)
            headers = {}
            if left_out:
                headers["Waymark-Left-Out"] = f"{len(left_out)}; {' '.join(left_out[:MAX_LEFT_OUT_IDS])}"
            name, media_type = f"markers.{SUFFIXES.get(kind, kind)}", (STREAMED | WHOLE)[kind]
            self._files.finish(job, path, name=name, media_type=media_type, headers=headers)


def filter_of(wanted: JsonObject) -> MarkerFilter:
    """The filter of an export.

    Parameters
    ----------
    wanted : mapping
        ``bbox`` (west, south, east, north), ``polygon`` (WKT), ``road``, ``from_m``, ``to_m``, ``status``, ``family``;
        all optional.

    Raises
    ------
    InvalidParameter
        The polygon cannot be read.
    """
    box, polygon = wanted.get("bbox"), wanted.get("polygon")
    names = ("road", "from_m", "to_m", "status", "family")
    plain = MarkerFilter(**{name: wanted.get(name) for name in names})
    return replace(
        plain,
        box=Box(*box) if box is not None else None,
        area=area_of_text(polygon) if polygon is not None else None,
    )


def frame_of(wanted: JsonObject) -> ExportFrame | None:
    """The reference system of an export; None without ``crs``.

    Raises
    ------
    ReferenceSystemError
        ``crs`` or ``vertical_datum`` is unknown.
    InvalidParameter
        ``realization``, ``epoch`` or ``vertical_datum`` comes without ``crs``.
    """
    crs, datum = wanted.get("crs"), wanted.get("vertical_datum")
    realization, epoch = wanted.get("realization"), wanted.get("epoch")
    if crs is None:
        if alone := next((n for n in ("realization", "epoch", "vertical_datum") if wanted.get(n) is not None), None):
            raise InvalidParameter(f"{alone} without crs", field="crs", limit="with crs", cure="state the crs, too")
        return None
    name = normalize_crs(crs)
    reference_system(name)
    return ExportFrame(name, realization, epoch, normalize_vertical_datum(datum) if datum is not None else None)
