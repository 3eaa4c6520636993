"""Stored uploads are decoded again by the present decoders, and compared reading by reading."""

from __future__ import annotations

import io
import re
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from datetime import datetime
from typing import Annotated, Any, Literal, NamedTuple, NotRequired

import sqlalchemy as sa
from pydantic import ConfigDict, Field, JsonValue
from pyproj import Geod
from typing_extensions import TypedDict

from app.errors import Conflict, InvalidParameter, NotFound, Unavailable, WaymarkError
from app.formats.text import TableWriter
from app.inputs import Identifier, Number, StrictModel, Text, Time
from app.registry import decodes as decode_store
from app.registry import jobs as job_store
from app.registry import reprocessings as store
from app.registry.column_types import new_id, new_ids
from app.registry.database import Database
from app.registry.engines import across_agencies
from app.registry.jobs import JobKind, new_job
from app.registry.reprocessings import REPROCESSINGS, ReprocessedRow, ReprocessingRow
from app.registry.spatial import Box
from app.services.access.access import Caller
from app.services.access.audit import log_change
from app.services.blobs import staged
from app.services.decodes.context import DecodeKind
from app.services.decodes.decodes import Decodes
from app.services.decodes.upload_path import PICTURES
from app.services.documents import ErrorDocument, error_document
from app.services.jobs import QueueName, RunningJob, kinds_in
from app.services.markers.searches import checked_box
from app.services.ports import Blobs, Clock, JobQueue

# === Two results of one upload, reading by reading.


MIN_MOVED_M = 0.01
"""A reading whose position moved less is the same. [m] Source: below what any of the sensors resolves."""
MIN_CONFIDENCE_STEP = 0.01
SAME_TAG_S = 1.0
"""Tags of a trace whose middles are no farther apart are the same one. [s] Source: at 30 m/s, a tag's length."""
_WGS84 = Geod(ellps="WGS84")


class Change(TypedDict):
    """How a reading differs. Members that do not apply are left out."""

    change: Literal["gained", "lost", "changed"]
    family: str
    frame: NotRequired[int]
    at_s: NotRequired[float]
    code_before: str | None
    code: str | None
    confidence_before: NotRequired[float | None]
    confidence: NotRequired[float | None]
    moved_m: NotRequired[float]


class Comparison(NamedTuple):
    """The changes, and the number of readings that are the same."""

    changes: list[Change]
    same: int


class _Reading(NamedTuple):
    family: str
    code: str
    frame: int | None = None
    at_s: float | None = None
    confidence: float | None = None
    place: tuple[float, float] | None = None


def compare_results(before: Mapping[str, object], after: Mapping[str, object]) -> Comparison:
    """How the readings of a result differ from those of an earlier one, whatever the kind of upload.

    A reading is the same if its family, its frame or time, and its code are; what is left over at the same place of
    the upload is a changed code; the rest was gained or lost.
    """
    changes: list[Change] = []
    same = 0
    olds, news = _by_place(before), _by_place(after)
    for place in sorted(set(olds) | set(news), key=str):
        old, new = list(olds[place]), list(news[place])
        for reading in list(old):
            twin = _find(new, reading)
            if twin is None:
                continue
            old.remove(reading)
            new.remove(twin)
            change = _difference(reading, twin)
            if change is None:
                same += 1
            else:
                changes.append(change)
        while old and new:
            one = old.pop(0)
            other = _at_the_same_time(one, new)
            if other is None:
                changes.append(_change("lost", one, None))
            else:
                new.remove(other)
                changes.append(_change("changed", one, other))
        changes += [_change("lost", one, None) for one in old]
        changes += [_change("gained", None, one) for one in new]
    return Comparison(changes, same)


def _find(candidates: list[_Reading], wanted: _Reading) -> _Reading | None:
    same = [one for one in candidates if one.code == wanted.code]
    if wanted.at_s is None:
        return same[0] if same else None
    return _at_the_same_time(wanted, same)


def _at_the_same_time(wanted: _Reading, candidates: list[_Reading]) -> _Reading | None:
    if wanted.at_s is None:
        return candidates[0] if candidates else None
    near = [one for one in candidates if abs((one.at_s or 0.0) - wanted.at_s) <= SAME_TAG_S]
    return min(near, key=lambda one: abs((one.at_s or 0.0) - (wanted.at_s or 0.0)), default=None)


def _difference(one: _Reading, other: _Reading) -> Change | None:
    moved_m = _distance_m(one, other)
    step = abs((one.confidence or 0.0) - (other.confidence or 0.0))
    if (moved_m or 0.0) < MIN_MOVED_M and step < MIN_CONFIDENCE_STEP:
        return None
    return _change("changed", one, other)


def _change(kind: Literal["gained", "lost", "changed"], before: _Reading | None, after: _Reading | None) -> Change:
    known = after or before
    assert known is not None
    change: Change = {
        "change": kind,
        "family": known.family,
        "code_before": before.code if before else None,
        "code": after.code if after else None,
    }
    if known.frame is not None:
        change["frame"] = known.frame
    if known.at_s is not None:
        change["at_s"] = round(known.at_s, 3)
    if before is not None:
        change["confidence_before"] = before.confidence
    if after is not None:
        change["confidence"] = after.confidence
    if before is not None and after is not None and (moved_m := _distance_m(before, after)) is not None:
        change["moved_m"] = round(moved_m, 3)
    return change


def _distance_m(one: _Reading, other: _Reading) -> float | None:
    if one.place is None or other.place is None:
        return None
    return float(_WGS84.inv(*one.place, *other.place)[2])


def _by_place(result: Mapping[str, object]) -> dict[tuple[str, int | None], list[_Reading]]:
    found: dict[tuple[str, int | None], list[_Reading]] = defaultdict(list)
    for reading in _readings(result):
        found[reading.family, reading.frame].append(reading)
    return found


def _readings(result: Mapping[str, Any]) -> Iterator[_Reading]:
    """The readings of a result of any kind: plates and fiducials of frames, tags of traces, CERPMs of packet logs."""
    for one in result.get("readings") or ():
        code = one.get("digits") or one.get("code") or one.get("id")
        if one.get("outcome", "read") == "read" and code is not None:
            yield _Reading(
                one["family"], str(code), frame=one.get("frame"), confidence=one.get("confidence"),
                place=_place(one.get("fix")),
            )  # fmt: skip
    for one in result.get("tags") or ():
        yield _Reading(
            "magnet", one.get("tag") or "unreadable", at_s=(one["start_s"] + one["end_s"]) / 2,
            confidence=one.get("confidence"), place=_place(one.get("fix")),
        )  # fmt: skip
    for one in result.get("markers") or ():
        if "number" in one:
            yield _Reading("cerpm", str(one["number"]), place=_place(one))


def _place(fix: Mapping[str, Any] | None) -> tuple[float, float] | None:
    if fix is None or fix.get("lon_deg") is None or fix.get("lat_deg") is None:
        return None
    return fix["lon_deg"], fix["lat_deg"]


# === Reprocessings as clients see them.


State = Literal["running", "ready", "cancelled", "failed", "approved"]


class ReprocessingSummary(TypedDict):
    """What was decoded again, in numbers of readings, and of uploads that failed."""

    gained: int
    lost: int
    changed: int
    same: int
    failed: int


class ReprocessingLinks(TypedDict):
    """Paths of the reprocessing and of its reports."""

    self: str
    report: str
    csv: str


class ReprocessingDocument(TypedDict):
    """A reprocessing: its results are beside the current ones until it is approved."""

    id: str
    state: State
    who: str
    criteria: dict[str, JsonValue]
    done: Annotated[int, Field(description="Uploads that were decoded again.")]
    total: int
    shards: Annotated[dict[str, int], Field(description="Number of its jobs by state.")]
    summary: ReprocessingSummary
    created_at: datetime
    approved_at: datetime | None
    approved_by: str | None
    links: ReprocessingLinks


class ReprocessingPage(TypedDict):
    """A page of reprocessings, oldest first; the Link header leads to the next one."""

    items: list[ReprocessingDocument]


class ReprocessedDecode(TypedDict):
    """An upload whose readings differ, or that could not be decoded again."""

    decode_id: str
    decoder_before: str | None
    decoder: str | None
    error: ErrorDocument | None
    gained: int
    lost: int
    changed: int
    same: int
    changes: list[Change]


class ReprocessingReport(TypedDict):
    """A page of uploads whose readings differ; the Link header leads to the next one."""

    items: list[ReprocessedDecode]


class DecodeVersion(TypedDict):
    """A result that was current before."""

    reprocessing_id: Annotated[str, Field(description="That replaced it.")]
    decoder: str | None
    finished_at: datetime | None
    replaced_at: datetime
    result: dict[str, JsonValue]


class DecodeVersions(TypedDict):
    """Results of a decode that were current before, newest first."""

    items: list[DecodeVersion]


def reprocessing_document(row: ReprocessingRow, shards: dict[str, int], sums: dict[str, int]) -> ReprocessingDocument:
    """A reprocessing as clients see it."""
    path = f"/v1/reprocessings/{row.id}"
    return {
        "id": row.id,
        "state": state_of(row, shards),
        "who": row.who,
        "criteria": row.criteria,
        "done": sums["done"],
        "total": row.decodes,
        "shards": shards,
        "summary": {
            "gained": sums["gained"],
            "lost": sums["lost"],
            "changed": sums["changed"],
            "same": sums["same"],
            "failed": sums["failed"],
        },
        "created_at": row.created_at,
        "approved_at": row.approved_at,
        "approved_by": row.approved_by,
        "links": {"self": path, "report": f"{path}/report", "csv": f"{path}/report.csv"},
    }


def state_of(row: ReprocessingRow, shards: dict[str, int]) -> State:
    """The state of a reprocessing, from those of its jobs."""
    if row.approved_at is not None:
        return "approved"
    if shards.get("queued") or shards.get("running"):
        return "running"
    if shards.get("cancelled"):
        return "cancelled"
    return "failed" if shards.get("failed") else "ready"


def reprocessed_document(row: ReprocessedRow) -> ReprocessedDecode:
    """An upload that was decoded again as clients see it."""
    names: Any = ReprocessedDecode.__annotations__
    return {name: value for name, value in row._asdict().items() if name in names}  # type: ignore[return-value]


# === Reprocessings: chosen, carried out in shards on the queue for archive work, reported, and approved by a person.


SHARD = 100
"""Uploads of one job. A job of frames takes a minute, and many workers share the work."""
MAX_DECODES = 1_000_000
_MAX_WAIT_S, _STEP_S = 30.0, 0.2
"""How long an upload gives way to jobs that somebody waits for, and how often it looks. [s]"""
_RELEASE = re.compile(r"[0-9]+(\.[0-9]+){1,2}")
_CSV = (
    "decode_id", "change", "family", "frame", "at_s", "code_before", "code", "confidence_before", "confidence",
    "moved_m", "decoder_before", "decoder", "error",
)  # fmt: skip


class Criteria(StrictModel):
    """Which uploads are decoded again; without criteria, all that are stored."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"kinds": ["frame", "archive"], "older_than": "0.3.0"}]})

    kinds: list[DecodeKind] | None = Field(None, min_length=1, max_length=20)
    since: Time | None = Field(None, description="Uploaded at this time or later.")
    until: Time | None = Field(None, description="Uploaded before this time.")
    vehicle_id: Identifier | None = None
    bbox: Annotated[list[Number], Field(min_length=4, max_length=4)] | None = Field(
        None, description="west, south, east, north of the coarse positions. [deg]"
    )
    decoder: Text | None = Field(None, max_length=200, description="Results of this decoder, as they name it.")
    older_than: Text | None = Field(None, max_length=40, description="Results of earlier releases: 0.3.0.")


class Reprocessings:
    """Use cases on reprocessings.

    Parameters
    ----------
    decodes : Decodes
        Decodes stored uploads again.
    """

    def __init__(self, database: Database, clock: Clock, blobs: Blobs, queue: JobQueue, decodes: Decodes) -> None:
        self._database, self._clock = database, clock
        self._blobs, self._queue, self._decodes = blobs, queue, decodes

    def create(self, caller: Caller, criteria: Criteria) -> ReprocessingDocument:
        """Queue the uploads that meet some criteria.

        Raises
        ------
        InvalidParameter
            None or too many do.
        """
        if criteria.older_than is not None and _RELEASE.fullmatch(criteria.older_than) is None:
            raise InvalidParameter(f"{criteria.older_than[:40]!r} is no release", field="older_than", limit="0.3.0")
        box = None if criteria.bbox is None else checked_box(*criteria.bbox)
        now, agency_id = self._clock(), caller.agency_id
        with self._database.read(long=True) as connection:
            found = store.stream_decodes(
                connection, agency_id, kinds=criteria.kinds, since=criteria.since, until=criteria.until,
                vehicle_id=criteria.vehicle_id,
            )  # fmt: skip
            ids = [row.id for row in found if _is_meant(row.context, row.decoder, criteria, box)]
        if not 1 <= len(ids) <= MAX_DECODES:
            raise InvalidParameter(
                f"{len(ids)} uploads meet the criteria",
                field="body",
                limit=f"1 to {MAX_DECODES}",
                cure="change the criteria",
            )
        stored = criteria.model_dump(mode="json", exclude_none=True)
        row = ReprocessingRow(new_id(now), agency_id, caller.label, stored, len(ids), now)
        shards = [ids[start : start + SHARD] for start in range(0, len(ids), SHARD)]
        jobs = [
            new_job(
                JobKind.REPROCESS, job_id, agency_id, caller.key_id, now,
                job_input={"decode_ids": shard, "label": caller.label}, subject_id=row.id,
            )
            for job_id, shard in zip(new_ids(now, len(shards)), shards, strict=True)
        ]  # fmt: skip
        with self._database.write() as connection:
            store.add_reprocessing(connection, row)
            for job in jobs:
                job_store.add_job(connection, job)
            log_change(connection, caller, "reprocessing.started", now=now, subject=row.id, decodes=len(ids))
            document = self._document(connection, row)
        for job in jobs:
            self._queue.submit(job.id, agency_id, JobKind.REPROCESS)
        return document

    def get(self, caller: Caller, reprocessing_id: str) -> ReprocessingDocument:
        """A reprocessing with its numbers."""
        with self._database.read() as connection:
            return self._document(connection, REPROCESSINGS.get(connection, caller.agency_id, reprocessing_id))

    def page(self, caller: Caller, *, after: str | None, limit: int) -> tuple[ReprocessingPage, str | None]:
        """A page of reprocessings, oldest first, and the id to continue after."""
        with self._database.read() as connection:
            rows, last = REPROCESSINGS.page(connection, caller.agency_id, beyond=after, limit=limit)
            return ReprocessingPage(items=[self._document(connection, row) for row in rows]), last

    def report(
        self, caller: Caller, reprocessing_id: str, *, after: str | None = None, limit: int = 100
    ) -> tuple[ReprocessingReport, str | None]:
        """A page of uploads whose readings differ, and the id to continue after."""
        with self._database.read() as connection:
            REPROCESSINGS.get(connection, caller.agency_id, reprocessing_id)
            rows = store.list_reprocessed(connection, reprocessing_id, after=after, limit=limit + 1)
        items = [reprocessed_document(row) for row in rows[:limit]]
        return ReprocessingReport(items=items), rows[limit - 1].decode_id if len(rows) > limit else None

    def report_csv(self, caller: Caller, reprocessing_id: str) -> Iterator[bytes]:
        """The report as CSV, a line for each reading that differs and each upload that failed."""
        self.get(caller, reprocessing_id)
        return self._csv_lines(caller, reprocessing_id)

    def _csv_lines(self, caller: Caller, reprocessing_id: str) -> Iterator[bytes]:
        yield _line(dict(zip(_CSV, _CSV, strict=True)))
        after: str | None = None
        while True:
            page, after = self.report(caller, reprocessing_id, after=after, limit=1000)
            for item in page["items"]:
                same = {"decode_id": item["decode_id"], "decoder_before": item["decoder_before"]}
                same["decoder"] = item["decoder"]
                if item["error"] is not None:
                    yield _line({**same, "change": "failed", "error": item["error"]["detail"]})
                for change in item["changes"]:
                    yield _line({**same, **change})
            if after is None:
                return

    def cancel(self, caller: Caller, reprocessing_id: str) -> ReprocessingDocument:
        """Stop a reprocessing; what was decoded again stays in its report and is never made current."""
        with self._database.write() as connection:
            row = REPROCESSINGS.get(connection, caller.agency_id, reprocessing_id)
            store.cancel_jobs(connection, caller.agency_id, reprocessing_id, self._clock())
            return self._document(connection, row)

    def approve(self, caller: Caller, reprocessing_id: str) -> ReprocessingDocument:
        """Make the new results current; those of before are kept as versions of their decodes.

        Raises
        ------
        Conflict
            It is not ready, it was approved before, or a decode was reprocessed by another one since.
        """
        now = self._clock()
        with self._database.write(long=True) as connection:
            row = REPROCESSINGS.get(connection, caller.agency_id, reprocessing_id)
            state = state_of(row, store.count_jobs(connection, reprocessing_id))
            if state != "ready":
                raise Conflict(
                    f"the reprocessing is {state}", field="reprocessing_id", limit="reprocessings that are ready",
                    cure="wait until it is ready, or start another one",
                )  # fmt: skip
            if store.is_outdated(connection, reprocessing_id):
                raise Conflict(
                    "some of these decodes were changed by another reprocessing since",
                    field="reprocessing_id",
                    cure="start another one",
                )
            count = store.approve(connection, reprocessing_id, caller.label, now)
            log_change(connection, caller, "reprocessing.approved", now=now, subject=reprocessing_id, decodes=count)
            return self._document(connection, REPROCESSINGS.get(connection, caller.agency_id, reprocessing_id))

    def versions(self, caller: Caller, decode_id: str) -> DecodeVersions:
        """Results of a decode that were current before."""
        with self._database.read() as connection:
            decode_store.get_decode(connection, caller.agency_id, decode_id, holder_id=caller.own_key_id)
            rows = store.list_versions(connection, decode_id)
        return {
            "items": [
                {
                    "reprocessing_id": row.reprocessing_id, "decoder": row.decoder, "finished_at": row.finished_at,
                    "replaced_at": row.replaced_at, "result": row.result,
                }
                for row in rows
            ]
        }  # fmt: skip

    # --- the work -----------------------------------------------------------------------------------------------------

    def run(self, job: RunningJob) -> None:
        """Decode the uploads of a shard again; the handler of jobs of the kind `JobKind.REPROCESS`."""
        reprocessing_id, ids = job.row.subject_id, job.row.input["decode_ids"]
        assert reprocessing_id is not None
        with self._database.read() as connection:
            done = store.done_ids(connection, reprocessing_id, ids)
        for count, decode_id in enumerate(ids, 1):
            if decode_id in done:
                continue
            self._give_way()
            self._decode_again(job, reprocessing_id, decode_id, (count, len(ids)))
        with self._database.write() as connection:
            job.finish(connection, {"decodes": len(ids)})

    def _give_way(self) -> None:
        """Wait while jobs wait for whose results somebody waits; not for ever, or a busy server would never finish."""
        online, waited_s = kinds_in(QueueName.ONLINE), 0.0
        while waited_s < _MAX_WAIT_S:
            with across_agencies(), self._database.read() as connection:
                if not store.online_jobs_wait(connection, online):
                    return
            time.sleep(_STEP_S)
            waited_s += _STEP_S

    def _decode_again(self, job: RunningJob, reprocessing_id: str, decode_id: str, steps: tuple[int, int]) -> None:
        agency_id = job.row.agency_id
        with self._database.read() as connection:
            before = decode_store.get_decode(connection, agency_id, decode_id)
        old = before.result or {}
        made = ReprocessedRow(
            reprocessing_id, decode_id, agency_id, old.get("decoder"), None, None, None, None, [], 0, 0, 0, 0
        )
        with staged(self._blobs) as stage:
            try:
                document, plot = self._decodes.decode_again(agency_id, decode_id)
            except Unavailable:
                raise
            except (WaymarkError, NotFound) as error:
                made = made._replace(error=dict(error_document(error)))
            else:
                changes, same = compare_results(old, document)
                kinds = [change["change"] for change in changes]
                made = made._replace(
                    decoder=document.get("decoder"), result=document, same=same,
                    changes=[dict(change) for change in changes], gained=kinds.count("gained"),
                    lost=kinds.count("lost"), changed=kinds.count("changed"),
                    picture_key=stage.put(PICTURES, plot) if plot is not None else None,
                )  # fmt: skip
            job.report_progress(
                steps[0] / (steps[1] + 1), steps=steps, keep=lambda connection: store.add_reprocessed(connection, made)
            )
            stage.keep()

    def _document(self, connection: sa.Connection, row: ReprocessingRow) -> ReprocessingDocument:
        return reprocessing_document(row, store.count_jobs(connection, row.id), store.sums(connection, row.id))


def _is_meant(context: Mapping[str, Any], decoder: str | None, criteria: Criteria, box: Box | None) -> bool:
    if criteria.decoder is not None and decoder != criteria.decoder:
        return False
    if criteria.older_than is not None and not _is_older(decoder, criteria.older_than):
        return False
    if box is None:
        return True
    position = context.get("coarse_position")
    return position is not None and box.contains(position["lon_deg"], position["lat_deg"])


def _is_older(decoder: str | None, release: str) -> bool:
    """Whether a decoder, such as ``waymark 0.2.0 plate/3``, is of an earlier release; one that is unknown is."""
    found = re.match(r"waymark ([0-9.]+)", decoder or "")
    if found is None:
        return True
    return _numbers(found[1]) < _numbers(release)


def _numbers(release: str) -> tuple[int, ...]:
    numbers = [int(part) for part in release.split(".") if part]
    return tuple(numbers + [0] * (3 - len(numbers)))


def _line(values: Mapping[str, object]) -> bytes:
    text = io.StringIO()
    TableWriter(text).write_row(values.get(name) for name in _CSV)
    return text.getvalue().encode()
