"""Drives: made of decodes as a job, listed, read, cancelled and deleted. A drive is the row of its job."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from datetime import timedelta
from typing import Annotated

import sqlalchemy as sa
from pydantic import ConfigDict, Field, model_validator

from app.errors import Conflict, InvalidParameter, NotFound
from app.inputs import Declaration, Flag, Text
from app.markers.reading import horizontal_rmse_m
from app.registry import decodes as decode_store
from app.registry import jobs as store
from app.registry.column_types import new_id
from app.registry.database import Database
from app.registry.decodes import DecodeRow
from app.registry.jobs import UNFINISHED, JobKind, JobRow, new_job
from app.registry.markers import find_markers
from app.services.access.access import Caller
from app.services.blobs import delete_unused, staged
from app.services.drives.collect import Collected, DriveDecode, collect
from app.services.drives.documents import DrivePage, TrackedDriveDocument, drive_document, drive_head
from app.services.drives.tasks import write_track
from app.services.fleet.vehicles import find_vehicle
from app.services.idempotency import IdempotencyKey, find_earlier, write_once
from app.services.jobs import RunningJob
from app.services.ports import Blobs, Clock, DecoderProcesses, JobQueue
from app.tracks.time_base import check_times
from app.tracks.types import TrackRules

MAX_DECODES = 100
"""Decodes of a drive at most. A day of a test fleet's vehicle."""
_FOLDER = "tracks"
_WAIT_S = 60.0
_COLLECTED, _WRITTEN = 0.1, 0.9


class DriveOptions(TrackRules):
    """How the track is estimated, and from what."""

    use_unfit: Flag = Field(False, description="Use positions that are not for localization, too.")


class NewDrive(Declaration):
    """A drive to make of decodes that are done."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "name": "L 560, Monday morning",
                    "decodes": [
                        {"id": "019cb624-0000-7000-8000-0000000000aa", "clock": "bar", "clock_sigma_s": 0.1},
                        {"id": "019cb624-0000-7000-8000-0000000000ab", "clock": "camera", "offset_s": -0.2},
                    ],
                    "options": {"rate_hz": 5, "max_sigma_m": 1.0},
                }
            ]
        }
    )

    name: Annotated[Text, Field(min_length=1, max_length=80)] | None = None
    vehicle: Annotated[Text, Field(max_length=80)] | None = Field(None, description="Name or id of the vehicle.")
    decodes: tuple[DriveDecode, ...] = Field(min_length=1, max_length=MAX_DECODES)
    options: DriveOptions = DriveOptions()

    @model_validator(mode="after")
    def _each_decode_once(self) -> NewDrive:
        ids = [entry.id for entry in self.decodes]
        twice = next((k for k, name in enumerate(ids) if name in ids[:k]), None)
        if twice is not None:
            raise InvalidParameter(
                f"decode {ids[twice]} is named twice", field=f"decodes.{twice}.id", limit="each decode once"
            )
        return self


class Drives:
    """Use cases on drives."""

    def __init__(
        self, database: Database, clock: Clock, blobs: Blobs, processes: DecoderProcesses, queue: JobQueue,
        *, idempotency_ttl: timedelta = timedelta(hours=24),
    ) -> None:  # fmt: skip
        self._database, self._clock, self._blobs = database, clock, blobs
        self._processes, self._queue, self._ttl = processes, queue, idempotency_ttl

    def make(self, caller: Caller, drive: NewDrive, key: IdempotencyKey | None) -> tuple[TrackedDriveDocument, bool]:
        """Queue a drive.

        Returns
        -------
        drive : TrackedDriveDocument
        replayed : bool
            The request had been made before under the same Idempotency-Key.

        Raises
        ------
        NotFound
            A decode or the vehicle does not exist, or is another's.
        Conflict
            A decode is not done, or of another vehicle.
        InvalidParameter
            A decode has no times, nothing places the drive, its sensors do not overlap in time, or it is too long.
        """
        now, agency_id = self._clock(), caller.agency_id
        if earlier := find_earlier(self._database, agency_id, key, now):
            return earlier, True
        with self._database.read() as connection:
            rows = _decodes(connection, caller.agency_id, drive.decodes, caller.own_key_id)
            vehicle_id = _vehicle(connection, caller, drive.vehicle, rows)
        found = collect(rows, use_unfit=drive.options.use_unfit)
        if not found.fixes:
            raise _nothing(rows)
        check_times(found.track_input({}))
        job_input = {**drive.model_dump(mode="json", exclude={"vehicle"}), "label": caller.label}
        job = new_job(
            JobKind.DRIVE, new_id(now), agency_id, caller.key_id, now, job_input=job_input, subject_id=vehicle_id
        )
        with write_once(self._database, agency_id, key, now, self._ttl) as (connection, answer):
            if answer.replayed:
                return answer.response, True
            store.add_job(connection, job)
            document = answer.store(drive_document(job))
        self._queue.submit(job.id, job.agency_id, JobKind.DRIVE)
        return document, False

    def run(self, job: RunningJob) -> None:
        """Estimate the track of a drive; the handler of jobs of the kind `JobKind.DRIVE`."""
        agency_id = job.row.agency_id
        drive = NewDrive.model_validate({name: job.row.input[name] for name in ("name", "decodes", "options")})
        with self._database.read() as connection:
            rows = _decodes(connection, agency_id, drive.decodes, None)
            found = collect(rows, use_unfit=drive.options.use_unfit)
            survey = _survey_m2(connection, agency_id, found)
        job.report_progress(_COLLECTED)
        written = self._processes.run(
            write_track,
            drive.name or f"drive {job.row.id}",
            found.track_input(survey),
            drive.options,
            tuple(found.left_out),
            tuple(found.on_lane),
            tuple(found.warnings),
            wait_s=_WAIT_S,
        )
        job.report_progress(_WRITTEN)
        with staged(self._blobs) as stage:
            keys = {name: stage.put(_FOLDER, data) for name, data in written.files.items()}
            with self._database.write() as connection:
                if job.finish(connection, {"report": written.report, "keys": keys}):
                    stage.keep()

    # --- stored drives ------------------------------------------------------------------------------------------------

    def get(self, caller: Caller, drive_id: str) -> TrackedDriveDocument:
        """A drive with its report, once there is one.

        Raises
        ------
        NotFound
            There is none with this id, or it belongs to another.
        """
        return drive_document(self._get(caller, drive_id))

    def page(
        self, caller: Caller, *, vehicle: str | None = None, state: str | None = None, before: str | None = None,
        limit: int = 100,
    ) -> tuple[DrivePage, str | None]:  # fmt: skip
        """A page of drives without their reports, newest first, and the id to continue before."""
        with self._database.read() as connection:
            rows = store.list_jobs(
                connection, caller.agency_id, JobKind.DRIVE, state=state, before=before, limit=limit + 1,
                subject_id=vehicle, holder_id=caller.own_key_id,
            )  # fmt: skip
        page = DrivePage(items=[drive_head(row) for row in rows[:limit]])
        return page, rows[limit - 1].id if len(rows) > limit else None

    def file(self, caller: Caller, drive_id: str, name: str) -> bytes:
        """A file of a drive: one of `TRACK_FILES`.

        Raises
        ------
        NotFound
            There is no such drive, or it is not done.
        """
        row = self._get(caller, drive_id)
        keys = (row.result or {}).get("keys")
        if keys is None:
            raise NotFound(
                f"drive {drive_id} has no track: it is {row.state}",
                field="drive_id",
                limit="drives that are done",
                cure="wait until it is done" if row.state in UNFINISHED else f"GET /v1/drives/{drive_id} has the error",
            )
        return zlib.decompress(self._blobs.get(keys[name]))

    def delete(self, caller: Caller, drive_id: str) -> None:
        """Delete a drive and its files; its decodes stay.

        Raises
        ------
        NotFound
        Conflict
            It is not finished.
        """
        row = self._get(caller, drive_id)
        with self._database.write() as connection:
            deleted = store.delete_job(connection, caller.agency_id, drive_id)
        if not deleted:
            raise Conflict(
                f"drive {drive_id} is {row.state}",
                field="drive_id",
                limit="drives that are finished",
                cure=f"cancel it first: POST /v1/jobs/{drive_id}/cancel",
            )
        delete_unused(self._blobs, (row.result or {}).get("keys", {}).values())

    def _get(self, caller: Caller, drive_id: str) -> JobRow:
        with self._database.read() as connection:
            row = store.get_job(connection, caller.agency_id, JobKind.DRIVE, drive_id)
        if caller.own_key_id not in (None, row.holder_id):
            raise NotFound(f"there is no drive {drive_id}", field="drive_id", cure="GET /v1/drives lists yours")
        return row


def _decodes(
    connection: sa.Connection, agency_id: str, declared: Sequence[DriveDecode], holder_id: str | None
) -> list[tuple[DriveDecode, DecodeRow]]:
    rows = []
    for k, entry in enumerate(declared):
        try:
            row = decode_store.get_decode(connection, agency_id, entry.id, holder_id=holder_id)
        except NotFound as error:
            error.field = f"decodes.{k}.id"
            raise
        rows.append((entry, row))
    return rows


def _vehicle(
    connection: sa.Connection, caller: Caller, named: str | None, rows: Sequence[tuple[DriveDecode, DecodeRow]]
) -> str | None:
    """Id of the vehicle that drove.

    Raises
    ------
    Conflict
        A decode is of another vehicle.
    """
    vehicle = find_vehicle(connection, caller, named)
    vehicle_id = vehicle.id if vehicle is not None else None
    for k, (_clock, row) in enumerate(rows):
        own = (row.context.get("vehicle") or {}).get("id")
        if own is None:
            continue
        if vehicle_id is not None and own != vehicle_id:
            raise Conflict(
                f"decode {row.id} is of vehicle {row.context['vehicle'].get('name', own)}",
                field=f"decodes.{k}.id",
                limit="decodes of one vehicle",
                cure="leave it out, or make a drive of the other vehicle's decodes",
            )
        vehicle_id = own
    return vehicle_id


def _survey_m2(connection: sa.Connection, agency_id: str, found: Collected) -> dict[str, float]:
    """Variance of the survey of each marker that gives a fix, one axis. [m2]"""
    ids = sorted({fix.marker_id for fix in found.fixes if fix.marker_id is not None})
    variances = {}
    for row in find_markers(connection, agency_id, ids):
        rmse_m = horizontal_rmse_m(row)
        if rmse_m is not None:
            variances[str(row.id)] = rmse_m**2 / 2
    return variances


def _nothing(rows: Sequence[tuple[DriveDecode, DecodeRow]]) -> InvalidParameter:
    found = collect(rows, use_unfit=True)
    cure = "register the markers that were passed with their accuracy, and decode with coarse_position"
    if found.fixes:
        cure = "survey the markers with their accuracy, or set options.use_unfit for an approximate track"
    return InvalidParameter(
        "no decode has a fix that is for localization",
        field="decodes",
        limit="one fix of a registered marker or more",
        cure=cure,
    )
