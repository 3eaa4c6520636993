"""Markers -> artwork for the workshop. Nothing is handed out that our own decoder has not read back."""

from __future__ import annotations

import hashlib
import tempfile
import threading
import zipfile
from contextlib import closing
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Annotated

import orjson
from pydantic import Field

from app.encoders.packer import Packer
from app.encoders.plate import ArtworkFormat, ArtworkOptions, BundleOptions, PlateReader, write_artwork, write_bundle
from app.encoders.plate.bundle import NO_QR_CODE, bundle_manifest, plate_names
from app.encoders.plate.writers import DEFAULT_DPI
from app.errors import NotFound, Unavailable
from app.families import FAMILIES, get_family
from app.families.family import AnyFamily, ArtworkProof
from app.families.plate.plates import PLATE, is_unfit, plate_order
from app.inputs import Flag, Number, StrictModel
from app.markers.reading import MarkerRow
from app.registry import jobs as registry_jobs
from app.registry import markers as store
from app.registry.column_types import new_id
from app.registry.database import Database
from app.registry.jobs import JobKind, new_job
from app.services.access.access import Caller
from app.services.idempotency import IdempotencyKey, find_earlier, write_once
from app.services.jobs import RunningJob
from app.services.markers.searches import Selection, select_markers
from app.services.markers.tasks import draw_plate, write_sheets
from app.services.plans.proofs import WAIT_S, results_in_order
from app.services.ports import Clock, DecoderProcesses, JobQueue
from app.services.progress import JobDocument, JobFiles, job_document
from app.values import JsonObject

MAX_PLATES = 5_000
Resolution = Annotated[float, Field(ge=20, le=300, allow_inf_nan=False)]
_BUNDLES_AT_ONCE = 2


@dataclass(frozen=True, slots=True)
class Artwork:
    """Artwork of one marker with its proof."""

    content: bytes
    media_type: str
    file_name: str
    proof: ArtworkProof
    qr_code: str


@dataclass(frozen=True, slots=True)
class Bundle:
    """A ZIP in a temporary file, which is gone when it is closed."""

    file: IO[bytes]
    size: int
    plates: int
    approximate: int
    lowest_confidence: float
    qr_code: str


class Artworks:
    """Use cases on artwork.

    Parameters
    ----------
    public_url : str
        Start of the addresses of public pages, which go into the QR codes; empty: there are no QR codes.
    read : callable
        Decoder of the self-proof.
    """

    def __init__(self, database: Database, *, public_url: str, read: PlateReader) -> None:
        self._database = database
        self._public_url = public_url
        self._read = read
        self._places = threading.BoundedSemaphore(_BUNDLES_AT_ONCE)
        self.qr_code = qr_code_header(public_url)

    def tag(
        self, caller: Caller, marker_id: str, form: ArtworkFormat, options: ArtworkOptions, dpi: float = DEFAULT_DPI
    ) -> str:
        """What the artwork depends on, as a short hash: it changes when the artwork would.

        Raises
        ------
        NotFound
            There is no such marker, or its family has no artwork.
        """
        row, family = self._get(caller, marker_id)
        parts = (family.artwork_version, self._public_url, row.id, row.version, form, options, dpi)
        return hashlib.sha256(repr(parts).encode()).hexdigest()[:32]

    def artwork(
        self, caller: Caller, marker_id: str, form: ArtworkFormat, options: ArtworkOptions, dpi: float = DEFAULT_DPI
    ) -> Artwork:
        """Artwork of one marker at true size, drawn, proved and written.

        Raises
        ------
        NotFound
            There is no such marker, or its family has no artwork.
        ProofFailed
            The drawing did not read back as its own code.
        """
        row, family = self._get(caller, marker_id)
        drawing = family.draw(row, options, record_url=page_url(self._public_url, row.id))
        proof = family.prove(row, drawing, self._read)
        written = write_artwork(drawing, form, dpi=dpi)
        return Artwork(written.content, written.media_type, f"{row.id}-r{row.version}.{form}", proof, self.qr_code)

    def bundle(self, caller: Caller, selection: Selection, options: BundleOptions) -> Bundle:
        """Artwork of a selection in one ZIP, every plate proved.

        Raises
        ------
        InvalidParameter
            No plates or too many, or a sheet that is too small.
        NotFound
            A plate is missing.
        Unavailable
            Other selections are being written.
        """
        with self._database.read() as connection:
            rows = select_markers(connection, caller.agency_id, selection, PLATE.name, most=MAX_PLATES)
        if not self._places.acquire(blocking=False):
            raise Unavailable("other selections are being written", cure="try again in a few seconds")
        file = tempfile.TemporaryFile(prefix="waymark-artwork-")  # noqa: SIM115 - the response reads it
        try:
            manifest = write_bundle(
                [plate_order(row, page_url(self._public_url, row.id)) for row in rows],
                file,
                options=options,
                read=self._read,
            )
        except BaseException:
            file.close()
            raise
        finally:
            self._places.release()
        size = file.tell()
        file.seek(0)
        return Bundle(
            file, size, len(rows), sum(is_unfit(row) for row in rows), _lowest_confidence(manifest), self.qr_code
        )

    def _get(self, caller: Caller, marker_id: str) -> tuple[MarkerRow, AnyFamily]:
        with self._database.read() as connection:
            row = store.get_marker(connection, caller.agency_id, marker_id)
        family = get_family(row.family)
        if family.artwork_version is None:
            raise NotFound(
                f"marker {marker_id} is a {family.label}, which has no artwork",
                field="marker_id",
                limit=", ".join(family.name for family in FAMILIES if family.artwork_version is not None),
            )
        return row, family


def page_url(public_url: str, marker_id: str) -> str:
    """Address of a marker's public page, as QR codes contain it; empty if the server has no public address."""
    return f"{public_url}/m/{marker_id}" if public_url else ""


def qr_code_header(public_url: str) -> str:
    """Value of the header Waymark-QR-Code of artwork."""
    return "public-page" if public_url else f'none; reason="{NO_QR_CODE}"'


def _lowest_confidence(manifest: JsonObject) -> float:
    return float(min(plate["proof"]["confidence"] for plate in manifest["plates"]))


# === Artwork of many plates as a job: each is drawn and read back in a decoder process, and the ZIP is written to disk.


class SheetSize(StrictModel):
    """A sheet that plates are nested on."""

    width_mm: Number = Field(description="Width, up to 5000. [mm]")
    height_mm: Number = Field(description="Height, up to 5000. [mm]")


class ArtworkTerms(StrictModel):
    """How plates are made."""

    formats: list[ArtworkFormat] = Field([ArtworkFormat.PDF, ArtworkFormat.SVG], min_length=1, max_length=4)
    heaters: Flag = Field(False, description="Heating tracks under dark units.")
    leds: Flag = Field(False, description="Light sources under light units.")
    resolution_dpi: Resolution = Field(DEFAULT_DPI, description="Of PNG files. [1/inch]")
    sheet: SheetSize | None = Field(None, description="Also nest the plates on sheets of this size.")

    @property
    def options(self) -> BundleOptions:
        """The same for the writers."""
        return BundleOptions(
            formats=tuple(dict.fromkeys(self.formats)),
            artwork=ArtworkOptions(heaters=self.heaters, leds=self.leds),
            sheet_mm=(self.sheet.width_mm, self.sheet.height_mm) if self.sheet else None,
            dpi=self.resolution_dpi,
        )


IMMEDIATE_PLATES = 10
"""More plates become a job. Source: half a second each, drawn and read back; a client waits for five."""


class ArtworkJobs:
    """Use cases on artwork that is a job.

    Parameters
    ----------
    public_url : str
        Start of the addresses of public pages, which go into the QR codes; empty: there are no QR codes.
    in_flight : int
        Plates that are drawn at the same time.
    """

    def __init__(
        self,
        database: Database,
        clock: Clock,
        processes: DecoderProcesses,
        queue: JobQueue,
        files: JobFiles,
        *,
        public_url: str,
        in_flight: int = 2,
        idempotency_ttl: timedelta = timedelta(hours=24),
    ) -> None:
        self._database, self._clock, self._processes, self._queue = database, clock, processes, queue
        self._files, self._public_url = files, public_url
        self._in_flight, self._ttl = in_flight, idempotency_ttl

    def is_job(self, caller: Caller, selection: Selection) -> bool:
        """Whether a selection has so many plates that nobody should wait for them; raises as `submit`."""
        return len(self._select(caller, selection)) > IMMEDIATE_PLATES

    def submit(
        self, caller: Caller, selection: Selection, terms: ArtworkTerms, key: IdempotencyKey | None = None
    ) -> tuple[JobDocument, bool]:
        """Queue the artwork of the plates that are selected now; returns whether it was queued before.

        Raises
        ------
        InvalidParameter
            No plates or too many.
        NotFound
            A plate is missing.
        """
        now, agency_id = self._clock(), caller.agency_id
        if earlier := find_earlier(self._database, agency_id, key, now):
            return earlier, True
        job_input = {
            "marker_ids": self._select(caller, selection),
            "options": terms.model_dump(mode="json", include=set(ArtworkTerms.model_fields)),
            "label": caller.label,
        }
        job = new_job(JobKind.ARTWORK, new_id(now), agency_id, caller.key_id, now, job_input=job_input)
        with write_once(self._database, agency_id, key, now, self._ttl) as (connection, answer):
            if answer.replayed:
                return answer.response, True
            registry_jobs.add_job(connection, job)
            document = answer.store(job_document(job, now))
        self._queue.submit(job.id, agency_id, JobKind.ARTWORK)
        return document, False

    def run(self, job: RunningJob) -> None:
        """Write the ZIP; the handler of jobs of the kind `JobKind.ARTWORK`."""
        options = ArtworkTerms(**job.row.input["options"]).options
        selection = Selection(tuple(job.row.input["marker_ids"]))
        with self._database.read() as connection:
            rows = select_markers(connection, job.row.agency_id, selection, PLATE.name, most=MAX_PLATES)
        orders = tuple(plate_order(row, page_url(self._public_url, row.id)) for row in rows)
        plates_to_draw = ((*one, options) for one in zip(orders, plate_names(orders), strict=True))
        total, plates = len(orders), []
        job.report_progress(0.0, steps=(0, total))
        with TemporaryDirectory(prefix="waymark-artwork-") as folder:
            path = Path(folder) / "artwork.zip"
            with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
                packer = Packer(archive)
                with closing(results_in_order(self._processes, draw_plate, plates_to_draw, self._in_flight)) as drawn:
                    for done, (files, entry) in enumerate(drawn, 1):
                        for name, content in files:
                            packer.add(name, content)
                        plates.append(entry)
                        job.report_progress(done / (total + 1), steps=(done, total))
                sheets = self._processes.run(write_sheets, orders, options, wait_s=WAIT_S)
                for name, content in sheets:
                    packer.add(name, content)
                manifest = bundle_manifest(plates, list(packer.entries), options, proved=True)
                packer.add("manifest.json", orjson.dumps(manifest, option=orjson.OPT_INDENT_2))
            lowest = min(plate["proof"]["confidence"] for plate in plates)
            headers = {
                "Waymark-Proof": f"read-back plates={total} lowest-confidence={lowest:.6f}",
                "Waymark-QR-Code": qr_code_header(self._public_url),
            }
            if approximate := sum(is_unfit(row) for row in rows):
                headers["Waymark-Note"] = (
                    f"{approximate} of {total} plates have a position that is not for localization"
                )
            self._files.finish(job, path, name="waymark-artwork.zip", media_type="application/zip", headers=headers)

    def _select(self, caller: Caller, selection: Selection) -> list[str]:
        with self._database.read() as connection:
            rows = select_markers(connection, caller.agency_id, selection, PLATE.name, most=MAX_PLATES)
        return [row.id for row in rows]
