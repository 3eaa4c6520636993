"""The work list: reading it, and deciding on its items. A person approves every change of a marker's status."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal, NamedTuple, NotRequired

import orjson
import sqlalchemy as sa
from typing_extensions import TypedDict

from app.errors import Conflict
from app.families.documents import MarkerDocument
from app.families.surveys import RETIRED
from app.formats.text import TableWriter
from app.health import Displacement, MarkerState, StretchState, Verdict
from app.health.marker_tests import item_priority
from app.health.states import RULES, TESTED, Fault
from app.markers.reading import MarkerRow
from app.registry import audit, health
from app.registry import health as store
from app.registry.column_types import new_id
from app.registry.database import Database
from app.registry.health import ITEM_FIELDS, HealthRow, ItemFilter, ItemRow, NewUnregistered
from app.registry.markers import get_marker
from app.registry.webhooks import add_event
from app.services.access.access import Caller
from app.services.access.audit import author_of
from app.services.documents import document_of
from app.services.markers.markers import MarkerChange, Markers
from app.services.ports import Clock
from app.values import JsonObject

# === The work list and the state of a marker's tests as clients see them.


ItemStatus = Literal["open", "approved", "rejected"]
Outcome = Literal["suspect", "retired", "resurvey", "none"]
What = Literal[
    "missing", "moved", "cloned", "wrong-way", "fading", "unregistered", "shifted", "turned", "wrong-way-driver",
    "reported",
]  # fmt: skip


class UploadLink(TypedDict):
    """An upload that the evidence is of, with the link to its picture: the annotated frame, or the plot."""

    decode_id: str
    at: datetime
    picture: str


class ReportLink(TypedDict):
    """A damage report that was accepted into an item."""

    report_id: str
    kind: str
    at: datetime


class ItemEvidence(TypedDict):
    """Why a fault is suspected. An item that people reported has `reports` instead of figures.

    The likelihood ratio has passed the limit, both as natural logarithms. A healthy marker reaches this ratio with
    `false_alarm_probability` at most. `offset_m` is the estimated displacement of a marker that has moved;
    `elsewhere_lon_deg` and `elsewhere_lat_deg` are where a vehicle was that read the marker far from its place.

    The offset of a stretch is the shift of all its markers, with its standard deviations: of the shift in its own
    direction, to the east and to the north. The last two are large in a direction that drives do not show, as along a
    straight road. `turn_deg` is the turn of the markers about the item's position, anticlockwise; `directions` counts
    the directions of travel that were driven, 1 or 2; `check` names what to check.
    """

    limit: NotRequired[float]
    false_alarm_probability: NotRequired[float]
    month_passes: NotRequired[float]
    offset_m: NotRequired[float]
    offset_east_m: NotRequired[float]
    offset_north_m: NotRequired[float]
    offset_sigma_m: NotRequired[float]
    offset_sigma_east_m: NotRequired[float]
    offset_sigma_north_m: NotRequired[float]
    turn_deg: NotRequired[float]
    turn_sigma_deg: NotRequired[float]
    directions: NotRequired[int]
    check: NotRequired[str]
    elsewhere_lon_deg: NotRequired[float]
    elsewhere_lat_deg: NotRequired[float]
    uploads: list[UploadLink]
    reports: NotRequired[list[ReportLink]]


class MaintenanceItem(TypedDict):
    """A fault that is suspected, and what a person decided."""

    id: str
    what: What
    status: ItemStatus
    outcome: Outcome | None
    priority: float
    marker_id: str | None
    family: str
    code: str | None
    road: str | None
    measure_m: float | None
    lon_deg: float
    lat_deg: float
    height_m: float | None
    ratio: float
    vehicles: int
    passes: int
    first_at: datetime
    last_at: datetime
    evidence: ItemEvidence
    note: str | None
    decided_by: str | None
    decided_at: datetime | None
    version: int
    created_at: datetime
    updated_at: datetime


class MaintenancePage(TypedDict):
    """A page of the work list, the most urgent item first."""

    items: list[MaintenanceItem]


class HealthDocument(TypedDict):
    """Tests of a marker: logarithms of the likelihood ratios of the faults that have evidence, of the limits from which
    each fault is suspected, and its record.

    `quality` is the mean grade or signal less the usual one, in standard deviations of a pass.
    """

    marker_id: str
    passes: int
    reads: int
    last_at: datetime | None
    read_at: datetime | None
    ratios: dict[str, float]
    limits: dict[str, float]
    quality: float | None


def item_document(row: ItemRow) -> MaintenanceItem:
    """An item as clients see it."""
    return document_of(MaintenanceItem, row)


def health_document(marker_id: str, row: HealthRow | None, limits: Mapping[Fault, float]) -> HealthDocument:
    """A marker's tests as clients see them."""
    shown = {str(fault): round(limit, 3) for fault, limit in limits.items()}
    if row is None:
        return {
            "marker_id": marker_id, "passes": 0, "reads": 0, "last_at": None, "read_at": None, "ratios": {},
            "limits": shown, "quality": None,
        }  # fmt: skip
    return {
        "marker_id": marker_id,
        "passes": row.passes,
        "reads": row.reads,
        "last_at": row.last_at,
        "read_at": row.read_at,
        "ratios": {fault: round(ratio, 3) for fault, ratio in row.ratios.items()},
        "limits": shown,
        "quality": None if row.quality is None else round(row.quality, 3),
    }


# === Items of the work list: opened by the tests, with the evidence, and announced as events.


WRONG_WAY_DRIVER = "wrong-way-driver"
OPENED, DECIDED = "maintenance.opened", "maintenance.decided"
"""Kinds of events."""
REPORTED = "reported"
"""What an item is that people reported, not a test."""
MAX_REPORTS = 20
"""Reports that an item lists. Source: as `app.services.public_pages.reports.MAX_NEW_OF_MARKER`."""
WRONG_WAY_EVENT = "maintenance.wrong-way-driver"
MAX_UPLOADS = 5
"""Uploads that an item links to. What a person looks at."""
STRETCH_FAMILY = "cerpm"
"""Of the markers whose stretches are tested: their path is compared with the tracks of vehicles."""
_NOT_ON_ROAD = frozenset({"planned", RETIRED})
_SHOWN_DIGITS = 3
_WITH_PLOT = frozenset({"trace", "packets"})


class Stretch(NamedTuple):
    """A stretch of road whose CERPMs are tested together."""

    road: str | None
    measure_m: float | None  # [m] where it begins
    # `lon_deg`, `lat_deg`: [deg] its middle
    lon_deg: float
    lat_deg: float


@dataclass(frozen=True, slots=True)
class Suspicion:
    """A verdict about a marker, about a code that is not registered, or about a stretch."""

    subject: str
    verdict: Verdict
    month_passes: float
    reading: NewUnregistered | None = None
    stretch: Stretch | None = None


@dataclass(frozen=True, slots=True)
class ItemUpload:
    """The upload that makes an item: its decode, whether it has frames, the vehicle's name in the tests, its time."""

    decode_id: str
    has_frames: bool
    vehicle: str
    at: datetime


def open_items(
    connection: sa.Connection,
    agency_id: str,
    upload: ItemUpload,
    suspicions: Sequence[Suspicion],
    wrong_way_marker: str | None,
    now: datetime,
) -> None:
    """Open an item for each fault that is suspected, or add to the one that is open."""
    for suspicion in suspicions:
        _open_or_update(connection, agency_id, upload, suspicion, now)
    if wrong_way_marker is not None:
        _open_wrong_way(connection, agency_id, upload, wrong_way_marker, now)


def _open_or_update(
    connection: sa.Connection, agency_id: str, upload: ItemUpload, suspicion: Suspicion, now: datetime
) -> None:
    verdict, what = suspicion.verdict, str(suspicion.verdict.fault)
    other = suspicion.reading or suspicion.stretch
    marker = get_marker(connection, agency_id, suspicion.subject) if other is None else None
    if marker is not None and marker.status in _NOT_ON_ROAD:
        return
    known = health.find_open(connection, agency_id, suspicion.subject, what)
    figures = {
        "priority": item_priority(
            what, acted_on=_is_acted_on(marker), ratio=verdict.ratio, limit=verdict.limit,
            month_passes=suspicion.month_passes,
        ),
        "ratio": round(verdict.ratio, _SHOWN_DIGITS),
        "vehicles": verdict.vehicles,
        "passes": verdict.passes,
        "first_at": datetime.fromtimestamp(verdict.since_s, UTC),
        "last_at": upload.at,
        "evidence": _evidence(connection, agency_id, suspicion, upload, known),
    }  # fmt: skip
    if known is not None:
        health.change_item(connection, agency_id, known, {**figures, "updated_at": now})
        return
    row = _new_item(suspicion.subject, upload.decode_id, what, marker, other, figures, now)
    health.add_item(connection, agency_id, row)
    add_event(connection, agency_id, OPENED, subject_id=row.id, at=now, detail=_event_detail(row))


def _open_wrong_way(
    connection: sa.Connection, agency_id: str, upload: ItemUpload, marker_id: str, now: datetime
) -> None:
    """One item for each vehicle and hour: a vehicle may upload each frame by itself."""
    subject = f"drive:{upload.vehicle}:{upload.at:%Y%m%d%H}"
    if health.find_open(connection, agency_id, subject, WRONG_WAY_DRIVER) is not None:
        return
    marker = get_marker(connection, agency_id, marker_id)
    figures = {
        "priority": item_priority(WRONG_WAY_DRIVER, acted_on=True, ratio=0.0, limit=0.0, month_passes=0.0),
        "ratio": 0.0, "vehicles": 1, "passes": 1, "first_at": upload.at, "last_at": upload.at,
        "evidence": {"uploads": [_upload(upload.decode_id, 0, upload.at, has_frames=upload.has_frames)]},
    }  # fmt: skip
    row = _new_item(subject, upload.decode_id, WRONG_WAY_DRIVER, marker, None, figures, now)
    health.add_item(connection, agency_id, row)
    add_event(connection, agency_id, WRONG_WAY_EVENT, subject_id=row.id, at=now, detail=_event_detail(row))


def open_reported_item(
    connection: sa.Connection, agency_id: str, marker: MarkerRow, report_id: str, kind: str, at: datetime, now: datetime
) -> ItemRow:
    """Open an item for a damage report that was accepted, or add the report to the one that is open.

    Parameters
    ----------
    kind : str
        Of damage, which decides the priority.
    at : datetime
        When the report was sent.
    """
    known = health.find_open(connection, agency_id, marker.id, REPORTED)
    stored = store.find_marker_health(connection, agency_id, marker.id)
    month_passes = 0.0 if stored is None else MarkerState.from_document(stored.state).month_passes
    priority = item_priority(kind, acted_on=_is_acted_on(marker), ratio=0.0, limit=0.0, month_passes=month_passes)
    reports = [{"report_id": report_id, "kind": kind, "at": at.isoformat()}]
    if known is not None:
        reports = [*known.evidence["reports"], *reports][-MAX_REPORTS:]
        changes = {
            "priority": max(priority, known.priority), "first_at": min(at, known.first_at),
            "last_at": max(at, known.last_at), "evidence": {"uploads": [], "reports": reports}, "updated_at": now,
        }  # fmt: skip
        return health.change_item(connection, agency_id, known, changes)
    figures = {
        "priority": priority, "ratio": 0.0, "vehicles": 0, "passes": 0, "first_at": at, "last_at": at,
        "evidence": {"uploads": [], "reports": reports},
    }  # fmt: skip
    row = _new_item(marker.id, None, REPORTED, marker, None, figures, now)
    health.add_item(connection, agency_id, row)
    add_event(connection, agency_id, OPENED, subject_id=row.id, at=now, detail=_event_detail(row))
    return row


def _new_item(
    subject: str, decode_id: str | None, what: str, marker: MarkerRow | None,
    other: NewUnregistered | Stretch | None, figures: JsonObject, now: datetime,
) -> ItemRow:  # fmt: skip
    place = marker if marker is not None else other
    assert place is not None
    on_road = place if isinstance(place, MarkerRow | Stretch) else None
    code = marker.digits if marker is not None else other.code if isinstance(other, NewUnregistered) else None
    return ItemRow(
        id=new_id(now),
        subject=subject,
        marker_id=marker.id if marker is not None else None,
        decode_id=decode_id,
        family=STRETCH_FAMILY if isinstance(place, Stretch) else place.family,
        code=code,
        what=what,
        status="open",
        outcome=None,
        road=on_road.road if on_road is not None else None,
        measure_m=on_road.measure_m if on_road is not None else None,
        lon_deg=place.lon_deg,
        lat_deg=place.lat_deg,
        height_m=marker.height_m if marker is not None else None,
        note=None,
        decided_by=None,
        decided_at=None,
        version=1,
        created_at=now,
        updated_at=now,
        **figures,
    )


def _is_acted_on(marker: MarkerRow | None) -> bool:
    """Whether vehicles act on the marker's message: a meaning of its code, or a speed limit."""
    if marker is None:
        return False
    spec = marker.spec if isinstance(marker.spec, dict) else {}
    return bool(spec.get("meaning") or spec.get("speed_limit"))


def _evidence(
    connection: sa.Connection, agency_id: str, suspicion: Suspicion, upload: ItemUpload, known: ItemRow | None
) -> dict[str, object]:
    verdict = suspicion.verdict
    uploads = [_upload(upload.decode_id, 0, upload.at, has_frames=upload.has_frames)]
    if suspicion.stretch is not None and known is not None:
        uploads = [*uploads, *known.evidence["uploads"]][:MAX_UPLOADS]
    elif suspicion.stretch is None and suspicion.reading is None:
        rows = store.list_evidence(connection, agency_id, suspicion.subject, limit=4 * MAX_UPLOADS)
        by_decode = {row.decode_id: row for row in reversed(rows)}
        uploads = [
            _upload(row.decode_id, row.frame, row.at, has_frames=row.kind not in _WITH_PLOT)
            for row in by_decode.values()
        ]
        uploads = uploads[::-1][:MAX_UPLOADS]
    found: dict[str, object] = {
        "limit": round(verdict.limit, _SHOWN_DIGITS),
        "false_alarm_probability": math.exp(-min(verdict.ratio, 700.0)),
        "month_passes": round(suspicion.month_passes, 1),
        "uploads": uploads,
    }
    if verdict.offset_m is not None:
        east_m, north_m = verdict.offset_m
        found["offset_east_m"], found["offset_north_m"] = round(east_m, 3), round(north_m, 3)
        found["offset_m"] = round(math.hypot(east_m, north_m), 3)
    if verdict.displacement is not None:
        found |= _displacement(verdict.displacement, is_turned=verdict.fault is Fault.TURNED)
    if verdict.elsewhere is not None:
        found["elsewhere_lon_deg"], found["elsewhere_lat_deg"] = (round(value, 7) for value in verdict.elsewhere)
    return found


def _displacement(found: Displacement, *, is_turned: bool) -> dict[str, object]:
    """Figures of a displaced stretch, and what to check."""
    turned = f", and turned by {found.turn_deg:+.3f} degrees (± {found.turn_sigma_deg:.3f})" if is_turned else ""
    shift_m = math.hypot(found.east_m, found.north_m)
    check = (
        f"All CERPMs of the stretch are displaced against the lane as vehicles drive it: by {shift_m:.2f} m across the "
        f"road (± {found.sigma_m:.2f} m), {found.east_m:+.2f} m east and {found.north_m:+.2f} m north{turned}. "
        "Check the datum, realization and epoch that were declared for their survey, the control points of the survey, "
        "and the positions that were programmed into the markers."
    )
    if found.directions == 1:
        check += (
            " Only one direction of travel was driven: up to 0.2 m of the shift may be a habit that its drivers have "
            "in common. Drives in the other direction show which it is."
        )
    shown = {
        "offset_sigma_m": found.sigma_m, "offset_sigma_east_m": found.east_sigma_m,
        "offset_sigma_north_m": found.north_sigma_m,
    }  # fmt: skip
    return {
        **{name: round(value, _SHOWN_DIGITS) for name, value in shown.items()},
        "turn_deg": round(found.turn_deg, 4),
        "turn_sigma_deg": round(found.turn_sigma_deg, 4),
        "directions": found.directions,
        "check": check,
    }


def _upload(decode_id: str, frame: int, at: datetime, *, has_frames: bool) -> dict[str, object]:
    picture = f"/v1/decodes/{decode_id}/plot.svg"
    if has_frames:
        picture = f"/v1/decodes/{decode_id}/annotated.png" + (f"?frame={frame}" if frame else "")
    return {"decode_id": decode_id, "at": at.isoformat(), "picture": picture}


def _event_detail(row: ItemRow) -> dict[str, object]:
    return {
        "what": row.what,
        "status": row.status,
        "marker_id": row.marker_id,
        "road": row.road,
        "measure_m": row.measure_m,
        "lon_deg": row.lon_deg,
        "lat_deg": row.lat_deg,
        "priority": row.priority,
    }


def fault_of(row: ItemRow) -> Fault | None:
    """The fault whose test an item is of; None for a driver on the wrong way, and for what people reported."""
    return None if row.what in (WRONG_WAY_DRIVER, REPORTED) else Fault(row.what)


def decided_event(connection: sa.Connection, agency_id: str, row: ItemRow, now: datetime) -> None:
    """Announce what a person decided."""
    detail = {**_event_detail(row), "outcome": row.outcome}
    add_event(connection, agency_id, DECIDED, subject_id=row.id, at=now, detail=detail)


# === The work list.


_STATUS_OF: dict[str, str] = {"suspect": "suspect", "retired": "retired", "resurvey": "suspect"}
CSV_COLUMNS = ("id", *(field.name for field in ITEM_FIELDS), "lon_deg", "lat_deg", "note")


class Maintenance:
    """Use cases on the work list, one transaction each.

    Parameters
    ----------
    markers : Markers
        Changes the status of a marker, with its history and the audit log.
    """

    def __init__(self, database: Database, clock: Clock, markers: Markers) -> None:
        self._database, self._clock, self._markers = database, clock, markers

    def page(
        self, caller: Caller, filtered: ItemFilter, *, after: tuple[float, str] | None, limit: int
    ) -> tuple[MaintenancePage, str | None]:
        """A page, the most urgent item first, and where it ended if there is more."""
        with self._database.read() as connection:
            rows = health.list_items(connection, caller.agency_id, filtered, after=after, limit=limit + 1)
        last = rows[limit - 1] if len(rows) > limit else None
        items = [item_document(row) for row in rows[:limit]]
        return {"items": items}, None if last is None else f"{last.priority},{last.id}"

    def get(self, caller: Caller, item_id: str) -> MaintenanceItem:
        """One item."""
        with self._database.read() as connection:
            return item_document(health.get_item(connection, caller.agency_id, item_id))

    def stream(self, caller: Caller, form: str, filtered: ItemFilter) -> Iterator[bytes]:
        """All items of a filter as GeoJSON or CSV, the most urgent first."""
        with self._database.read() as connection:
            rows = health.iterate_items(connection, caller.agency_id, filtered)
            yield from _csv_lines(rows) if form == "csv" else _geojson_parts(rows)

    def health(self, caller: Caller, marker_id: str) -> HealthDocument:
        """The tests of a marker.

        Raises
        ------
        NotFound
            There is no such marker, or it belongs to another agency.
        """
        with self._database.read() as connection:
            get_marker(connection, caller.agency_id, marker_id)
            row = store.find_marker_health(connection, caller.agency_id, marker_id)
        month_passes = 0.0 if row is None else MarkerState.from_document(row.state).month_passes
        limits = {fault: RULES.upper(fault, month_passes) for fault in TESTED}
        return health_document(marker_id, row, limits)

    def approve(
        self, caller: Caller, item_id: str, outcome: Outcome, note: str | None, version: int | None
    ) -> MaintenanceItem:
        """Accept a suspicion, and change the marker as chosen.

        Parameters
        ----------
        outcome : str
            ``suspect`` or ``retired`` is the marker's new status; ``resurvey`` makes it suspect until it is surveyed
            again; ``none`` leaves it.
        version : int or None
            The marker's version that the decision is based on; None for any.

        Raises
        ------
        Conflict
            The item was decided before, or it has no marker that could be changed.
        StaleVersion
            The marker was changed since the caller read it.
        """
        now, status = self._clock(), _STATUS_OF.get(outcome)
        with self._database.read() as connection:
            found = health.get_item(connection, caller.agency_id, item_id)
        change: Callable[[sa.Connection], MarkerDocument] | None = None
        if status is not None:
            if found.marker_id is None:
                raise Conflict(
                    f"a finding of kind {found.what} has no registered marker",
                    field="outcome",
                    limit="none",
                    cure="approve it with the outcome none, and register the marker if it is yours",
                )
            reason = f"{'resurvey wanted' if outcome == 'resurvey' else 'maintenance'}: {found.what}"
            values = MarkerChange({"status": status}, reason=f"{reason}; {note}"[:500] if note else reason)
            change = self._markers.prepare_change(caller, found.marker_id, values, version, now)
        with self._database.write() as connection:
            row = _open_item(connection, caller, item_id)
            if change is not None:
                change(connection)
            return self._decide(connection, caller, row, "approved", outcome, note, now)

    def reject(self, caller: Caller, item_id: str, reason: str) -> MaintenanceItem:
        """Reject a suspicion with a reason: its test starts again, and the item stays in the list of those decided.

        Raises
        ------
        Conflict
            The item was decided before.
        """
        now = self._clock()
        with self._database.write() as connection:
            row = _open_item(connection, caller, item_id)
            return self._decide(connection, caller, row, "rejected", None, reason, now)

    def _decide(
        self,
        connection: sa.Connection,
        caller: Caller,
        row: ItemRow,
        status: Literal["approved", "rejected"],
        outcome: Outcome | None,
        note: str | None,
        now: datetime,
    ) -> MaintenanceItem:
        author = author_of(caller)
        decided = health.change_item(
            connection, caller.agency_id, row,
            {
                "status": status, "outcome": outcome, "note": note, "decided_by": author.who, "decided_at": now,
                "version": row.version + 1, "updated_at": now,
            },
        )  # fmt: skip
        _reset_test(connection, caller.agency_id, row, now)
        detail = {"what": row.what, "marker_id": row.marker_id, "outcome": outcome, "note": note}
        audit.record(
            connection, caller.agency_id, author, f"maintenance.{status}", now=now, subject=row.id, detail=detail
        )
        decided_event(connection, caller.agency_id, decided, now)
        return item_document(decided)


def _open_item(connection: sa.Connection, caller: Caller, item_id: str) -> ItemRow:
    row = health.get_item(connection, caller.agency_id, item_id)
    if row.status != "open":
        raise Conflict(
            f"the item was {row.status} before", field="item_id", limit="open items", cure="read it: GET it by its id"
        )
    return row


def _reset_test(connection: sa.Connection, agency_id: str, row: ItemRow, now: datetime) -> None:
    """Forget the evidence of the fault that was decided: new evidence of several vehicles may raise it again."""
    fault = fault_of(row)
    stored = store.find_health(connection, agency_id, [row.subject]).get(row.subject)
    if fault is None or stored is None:
        return
    if fault in (Fault.SHIFTED, Fault.TURNED):
        stretch = StretchState.from_document(stored.state)
        stretch.reset()
        document = stretch.document()
    else:
        state = MarkerState.from_document(stored.state)
        state.reset(fault)
        document = state.document()
    changed = stored._replace(state=document, ratios=document["ratios"], updated_at=now)
    store.store_health(connection, agency_id, [changed])


def _geojson_parts(rows: Iterator[ItemRow]) -> Iterator[bytes]:
    yield b'{"type":"FeatureCollection","features":['
    for number, row in enumerate(rows):
        document = dict(item_document(row))
        place = [document.pop("lon_deg"), document.pop("lat_deg")]
        feature = {
            "type": "Feature", "id": document.pop("id"), "geometry": {"type": "Point", "coordinates": place},
            "properties": document,
        }  # fmt: skip
        yield (b"," if number else b"") + orjson.dumps(feature)
    yield b"]}"


def _csv_lines(rows: Iterator[ItemRow]) -> Iterator[bytes]:
    yield _csv_line(CSV_COLUMNS)
    for row in rows:
        document = dict(item_document(row))
        yield _csv_line(tuple(document[name] for name in CSV_COLUMNS))


def _csv_line(values: tuple[object, ...]) -> bytes:
    text = io.StringIO()
    TableWriter(text).write_row(value.isoformat() if isinstance(value, datetime) else value for value in values)
    return text.getvalue().encode()
