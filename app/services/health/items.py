"""Items of the work list: opened by the tests, with the evidence, and announced as events."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import sqlalchemy as sa

from app.families.rules import RETIRED
from app.health import Fault, MarkerState, Verdict
from app.health.priority import item_priority
from app.registry import health as store
from app.registry import maintenance
from app.registry.events import add_event
from app.registry.health import NewUnregistered
from app.registry.ids import new_id
from app.registry.maintenance import ItemRow
from app.registry.marker_rows import MarkerRow
from app.registry.markers import get_marker

WRONG_WAY_DRIVER = "wrong-way-driver"
OPENED, DECIDED = "maintenance.opened", "maintenance.decided"
"""Kinds of events."""
REPORTED = "reported"
"""What an item is that people reported, not a test."""
MAX_REPORTS = 20
"""Reports that an item lists. Source: as `app.services.public_pages.reports.MAX_NEW_OF_MARKER`."""
WRONG_WAY_EVENT = "maintenance.wrong-way-driver"
MAX_UPLOADS = 5
"""Uploads that an item links to. Source: chosen by hand, what a person looks at."""
_NOT_ON_ROAD = frozenset({"planned", RETIRED})
_SHOWN_DIGITS = 3
_WITH_PLOT = frozenset({"trace", "packets"})


@dataclass(frozen=True, slots=True)
class Suspicion:
    """A verdict about a marker, or about a code that is not registered."""

    subject: str
    verdict: Verdict
    month_passes: float
    reading: NewUnregistered | None = None


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
    marker = get_marker(connection, agency_id, suspicion.subject) if suspicion.reading is None else None
    if marker is not None and marker.status in _NOT_ON_ROAD:
        return
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
        "evidence": _evidence(connection, agency_id, suspicion, upload),
    }  # fmt: skip
    known = maintenance.find_open(connection, agency_id, suspicion.subject, what)
    if known is not None:
        maintenance.change_item(connection, agency_id, known, {**figures, "updated_at": now})
        return
    row = _new_item(suspicion.subject, upload.decode_id, what, marker, suspicion.reading, figures, now)
    maintenance.add_item(connection, agency_id, row)
    add_event(connection, agency_id, OPENED, subject_id=row.id, at=now, detail=_event_detail(row))


def _open_wrong_way(
    connection: sa.Connection, agency_id: str, upload: ItemUpload, marker_id: str, now: datetime
) -> None:
    """One item for each vehicle and hour: a vehicle may upload each frame by itself."""
    subject = f"drive:{upload.vehicle}:{upload.at:%Y%m%d%H}"
    if maintenance.find_open(connection, agency_id, subject, WRONG_WAY_DRIVER) is not None:
        return
    marker = get_marker(connection, agency_id, marker_id)
    figures = {
        "priority": item_priority(WRONG_WAY_DRIVER, acted_on=True, ratio=0.0, limit=0.0, month_passes=0.0),
        "ratio": 0.0, "vehicles": 1, "passes": 1, "first_at": upload.at, "last_at": upload.at,
        "evidence": {"uploads": [_upload(upload.decode_id, 0, upload.at, has_frames=upload.has_frames)]},
    }  # fmt: skip
    row = _new_item(subject, upload.decode_id, WRONG_WAY_DRIVER, marker, None, figures, now)
    maintenance.add_item(connection, agency_id, row)
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
    known = maintenance.find_open(connection, agency_id, marker.id, REPORTED)
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
        return maintenance.change_item(connection, agency_id, known, changes)
    figures = {
        "priority": priority, "ratio": 0.0, "vehicles": 0, "passes": 0, "first_at": at, "last_at": at,
        "evidence": {"uploads": [], "reports": reports},
    }  # fmt: skip
    row = _new_item(marker.id, None, REPORTED, marker, None, figures, now)
    maintenance.add_item(connection, agency_id, row)
    add_event(connection, agency_id, OPENED, subject_id=row.id, at=now, detail=_event_detail(row))
    return row


def _new_item(
    subject: str, decode_id: str | None, what: str, marker: MarkerRow | None, reading: NewUnregistered | None,
    figures: dict[str, Any], now: datetime,
) -> ItemRow:  # fmt: skip
    place = marker if marker is not None else reading
    assert place is not None
    return ItemRow(
        id=new_id(now),
        subject=subject,
        marker_id=marker.id if marker is not None else None,
        decode_id=decode_id,
        family=place.family,
        code=marker.digits if marker is not None else reading.code if reading is not None else None,
        what=what,
        state="open",
        outcome=None,
        road=marker.road if marker is not None else None,
        measure_m=marker.measure_m if marker is not None else None,
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


def _evidence(connection: sa.Connection, agency_id: str, suspicion: Suspicion, upload: ItemUpload) -> dict[str, Any]:
    verdict = suspicion.verdict
    uploads = [_upload(upload.decode_id, 0, upload.at, has_frames=upload.has_frames)]
    if suspicion.reading is None:
        rows = store.list_evidence(connection, agency_id, suspicion.subject, limit=4 * MAX_UPLOADS)
        by_decode = {row.decode_id: row for row in reversed(rows)}
        uploads = [
            _upload(row.decode_id, row.frame, row.at, has_frames=row.kind not in _WITH_PLOT)
            for row in by_decode.values()
        ]
        uploads = uploads[::-1][:MAX_UPLOADS]
    found: dict[str, Any] = {
        "limit": round(verdict.limit, _SHOWN_DIGITS),
        "false_alarm_probability": math.exp(-min(verdict.ratio, 700.0)),
        "month_passes": round(suspicion.month_passes, 1),
        "uploads": uploads,
    }
    if verdict.offset_m is not None:
        east_m, north_m = verdict.offset_m
        found["offset_east_m"], found["offset_north_m"] = round(east_m, 3), round(north_m, 3)
        found["offset_m"] = round(math.hypot(east_m, north_m), 3)
    if verdict.elsewhere is not None:
        found["elsewhere_lon_deg"], found["elsewhere_lat_deg"] = (round(value, 7) for value in verdict.elsewhere)
    return found


def _upload(decode_id: str, frame: int, at: datetime, *, has_frames: bool) -> dict[str, Any]:
    picture = f"/v1/decodes/{decode_id}/plot.svg"
    if has_frames:
        picture = f"/v1/decodes/{decode_id}/annotated.png" + (f"?frame={frame}" if frame else "")
    return {"decode_id": decode_id, "at": at.isoformat(), "picture": picture}


def _event_detail(row: ItemRow) -> dict[str, Any]:
    return {
        "what": row.what,
        "status": row.state,
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
