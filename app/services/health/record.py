"""What a decode observed becomes evidence in the tests of its markers, in the transaction that stores the decode."""

from __future__ import annotations

import hashlib
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from statistics import median

import sqlalchemy as sa
from typing_extensions import TypedDict

from app.geodesy.frames import distance_m
from app.health import (
    Fault,
    JudgedDrive,
    MarkerState,
    Pass,
    StretchDrive,
    StretchState,
    VehicleState,
    judge_drive,
    update_marker,
    update_stretch,
    update_unregistered,
)
from app.registry import health as store
from app.registry.decodes import NewObservation
from app.registry.health import HealthRow, NewUnregistered
from app.services.health.maintenance import ItemUpload, Stretch, Suspicion, open_items
from app.values import JsonObject

# === Evidence of an observation on its marker's health: to the stored detail, and back to a pass.


EVIDENCE = "evidence"
"""Member of an observation's detail."""
MISSED = "missed"
STRETCH = "stretch"
"""Member of the detail of one marker's observation: what the drive shows of the stretch of road on which it is."""


class EvidenceDocument(TypedDict, total=False):
    """Measured values of one pass of one marker; `app.health.Pass` describes them."""

    family: str
    place_deg: list[float]
    expected: float
    along: float
    offset_m: list[float]
    sigma_m: float
    position_sigma_m: float
    offset_is_absolute: bool
    survey_m: float
    heading_deg: float
    reversed: bool
    quality: float
    quality_is_relative: bool
    elsewhere_deg: list[float]
    two_places: bool


@dataclass(frozen=True, slots=True)
class FrameHealth:
    """What one frame shows of the health of markers."""

    of_readings: tuple[dict[str, object], ...] = ()  # evidence of each reading; empty where there is none
    # evidence of markers that are in view at a readable size, whether they were read or not
    in_view: Mapping[str, JsonObject] = field(default_factory=dict)
    unregistered: tuple[NewUnregistered, ...] = ()


def passes_of(rows: Iterable[NewObservation]) -> list[tuple[Pass, NewObservation]]:
    """One pass for each marker of a decode that has evidence, with one of its observations."""
    by_marker: dict[str, list[NewObservation]] = defaultdict(list)
    for row in rows:
        if row.detail and row.detail.get(EVIDENCE):
            by_marker[row.marker_id].append(row)
    return [(_pass(marker_id, several), several[0]) for marker_id, several in sorted(by_marker.items())]


def _pass(marker_id: str, rows: Sequence[NewObservation]) -> Pass:
    """The frames of a decode that show a marker share its errors: their values are averaged, sigma stays."""
    found = [row.detail[EVIDENCE] for row in rows]
    read = [row.what != MISSED for row in rows]
    offsets = [one["offset_m"] for one in found if "offset_m" in one]
    position = [one["position_sigma_m"] for one in found if "position_sigma_m" in one]
    directions = [one["reversed"] for one in found if "reversed" in one]
    qualities = [one["quality"] for one in found if "quality" in one]
    headings = [one["heading_deg"] for one in found if "heading_deg" in one]
    elsewhere = next((one["elsewhere_deg"] for one in found if "elsewhere_deg" in one), None)
    return Pass(
        marker_id,
        found[0]["family"],
        any(read),
        expected=max(one.get("expected", 0.0) for one in found),
        along=found[0].get("along", 0.0),
        offset_m=(_mean(offsets, 0), _mean(offsets, 1)) if offsets else None,
        sigma_m=min((one.get("sigma_m", 0.0) for one in found if "offset_m" in one), default=0.0),
        position_sigma_m=min(position) if position else None,
        offset_is_absolute=any(one.get("offset_is_absolute", False) for one in found),
        survey_m=found[0].get("survey_m", 0.0),
        heading_deg=headings[0] if headings else None,
        reversed=2 * sum(directions) > len(directions) if directions else None,
        quality=median(qualities) if qualities else None,
        quality_is_relative=any(one.get("quality_is_relative", False) for one in found),
        elsewhere=None if elsewhere is None else (elsewhere[0], elsewhere[1]),
        two_places=any(one.get("two_places", False) for one in found),
    )


def _mean(values: Sequence[Sequence[float]], axis: int) -> float:
    return math.fsum(value[axis] for value in values) / len(values)


def rounded(evidence: Mapping[str, object]) -> dict[str, object]:
    """Evidence as it is stored: values that no figure of a sensor has are left out."""
    kept: dict[str, object] = {}
    for name, value in evidence.items():
        if value is None:
            continue
        digits = 9 if name.endswith("_deg") and name != "heading_deg" else 4
        kept[name] = _rounded(value, digits)
    return kept


def _rounded(value: object, digits: int) -> object:
    if isinstance(value, float):
        return round(value, digits)
    if isinstance(value, tuple | list):
        return [round(float(part), digits) for part in value]
    return value


# === What a decode observed becomes evidence in the tests of its markers, in the transaction that stores the decode.


SAME_CODE_M = 30.0
"""[m] readings of an unregistered code that are as near to each other are of one marker. What positions of vehicles
without RTK are good to."""
_SAME_PLACE_DEG = 1e-7  # a centimetre: the registered position is the same
CAMERA, BAR, RADIO = "camera", "bar", "radio"
"""Sensors: each of a vehicle has errors of its own."""


@dataclass(frozen=True, slots=True)
class ObservedDrive:
    """What one decode observed."""

    decode_id: str
    sensor: str  # `CAMERA`, `BAR` or `RADIO`
    vehicle: str  # id of the vehicle, else of the holder of the key
    observations: Sequence[NewObservation]
    unregistered: Sequence[NewUnregistered] = ()


def record_drive(
    connection: sa.Connection, agency_id: str, drive: ObservedDrive, now: datetime, *, opens_items: bool = True
) -> None:
    """Add what a decode observed to the tests of its markers, and open items of the work list.

    Parameters
    ----------
    opens_items : bool
        False where the states are computed again: people have decided on the items.
    """
    passes = passes_of(drive.observations)
    driven = {row.detail[STRETCH]["subject"]: row for row in drive.observations if row.detail and STRETCH in row.detail}
    if not passes and not drive.unregistered and not driven:
        return
    vehicle = _short(agency_id, drive.vehicle)
    own = f"vehicle:{vehicle}:{drive.sensor}"
    stored = store.find_health(connection, agency_id, [own, *(one.marker_id for one, _row in passes)])
    record = VehicleState(**stored[own].state) if own in stored else VehicleState()
    times = [row.at for _one, row in passes] + [reading.at for reading in drive.unregistered]
    at = [*times, *(row.at for row in driven.values())][0]
    judged = judge_drive([one for one, _row in passes], record, at.timestamp())
    rows = [_vehicle_row(own, record, at, now)]
    suspicions = []
    for (one, row), evidence in zip(passes, judged.evidence, strict=True):
        state = _state_of(stored.get(one.marker_id), one, row)
        verdicts = update_marker(state, evidence, vehicle, row.at.timestamp())
        rows.append(_marker_row(one.marker_id, state, row, now))
        suspicions += [Suspicion(one.marker_id, verdict, state.month_passes) for verdict in verdicts]
    unknown_rows, unknown = _add_unregistered(connection, agency_id, drive, vehicle, now)
    stretch_rows, displaced = _add_stretches(connection, agency_id, driven, vehicle, now)
    store.store_health(connection, agency_id, [*rows, *unknown_rows, *stretch_rows])
    if opens_items:
        wrong_way = _wrong_way_marker(judged, passes, {row.subject: row for row in rows})
        upload = ItemUpload(drive.decode_id, drive.sensor == CAMERA, vehicle, at)
        open_items(connection, agency_id, upload, [*suspicions, *unknown, *displaced], wrong_way, now)


def recompute_health(connection: sa.Connection, agency_id: str, now: datetime) -> int:
    """Compute the states of all tests of an agency from its stored observations; returns the number of decodes.

    Items of the work list stay as they are. Decodes are taken in the order of their uploads, so a state differs from
    the one that grew with the uploads where these were stored in another order, and where people have decided.
    """
    store.delete_health(connection, agency_id)
    count = 0
    for decode in store.iterate_decodes(connection, agency_id):
        observed, unknown = store.list_of_decode(connection, agency_id, decode.id)
        sensor = {"trace": BAR, "packets": RADIO}.get(decode.kind, CAMERA)
        drive = ObservedDrive(decode.id, sensor, decode.vehicle_id or decode.holder_id or "", observed, unknown)
        record_drive(connection, agency_id, drive, now, opens_items=False)
        count += 1
    return count


def _short(agency_id: str, vehicle: str) -> str:
    """A vehicle in the states: enough to distinguish vehicles, and not its id."""
    return hashlib.blake2s(f"{agency_id} {vehicle}".encode(), digest_size=8).hexdigest()


def _state_of(stored: HealthRow | None, one: Pass, row: NewObservation) -> MarkerState:
    """The marker's state; where its registered position has changed, the evidence against the old one is forgotten."""
    place = _place(row)
    if stored is None:
        return MarkerState.new(one.family)
    state = MarkerState.from_document(stored.state)
    if place and stored.lon_deg is not None and stored.lat_deg is not None:
        same = abs(place[0] - stored.lon_deg) < _SAME_PLACE_DEG and abs(place[1] - stored.lat_deg) < _SAME_PLACE_DEG
        if not same:
            for fault in list(state.ratios):
                state.reset(fault)
    return state


def _place(row: NewObservation) -> list[float] | None:
    found: list[float] | None = row.detail.get(EVIDENCE, {}).get("place_deg")
    return found


def _marker_row(marker_id: str, state: MarkerState, row: NewObservation, now: datetime) -> HealthRow:
    lon_deg, lat_deg = _place(row) or (None, None)
    document = state.document()
    return HealthRow(
        marker_id, marker_id, lon_deg, lat_deg, state.passes, state.reads,
        datetime.fromtimestamp(state.read_s, UTC) if state.reads else None, datetime.fromtimestamp(state.last_s, UTC),
        document["ratios"], state.quality if state.quality_passes else None, document, now,
    )  # fmt: skip


def _vehicle_row(subject: str, record: VehicleState, at: datetime, now: datetime) -> HealthRow:
    return HealthRow(subject, None, None, None, 0, 0, None, at, {}, None, record.document(), now)


def _add_stretches(
    connection: sa.Connection, agency_id: str, driven: Mapping[str, NewObservation], vehicle: str, now: datetime
) -> tuple[list[HealthRow], list[Suspicion]]:
    """Add a drive to the tests of the stretches that it shows."""
    stored = store.find_health(connection, agency_id, list(driven)) if driven else {}
    rows, found = [], []
    for subject, row in driven.items():
        document = row.detail[STRETCH]
        one = StretchDrive.from_document(document["drive"])
        known = stored.get(subject)
        state = (
            StretchState(one.lon_deg, one.lat_deg, one.heading_deg)
            if known is None
            else StretchState.from_document(known.state)
        )
        verdict = update_stretch(state, one, vehicle, row.at.timestamp())
        written = state.document()
        last_at = datetime.fromtimestamp(state.last_s, UTC)
        rows.append(
            HealthRow(
                subject, None, state.lon_deg, state.lat_deg, state.passes, 0, None, last_at, written["ratios"], None,
                written, now,
            )
        )  # fmt: skip
        if verdict is not None:
            place = Stretch(document["road"], document["measure_m"], state.lon_deg, state.lat_deg)
            found.append(Suspicion(subject, verdict, state.month_passes, stretch=place))
    return rows, found


def _add_unregistered(
    connection: sa.Connection, agency_id: str, drive: ObservedDrive, vehicle: str, now: datetime
) -> tuple[list[HealthRow], list[Suspicion]]:
    rows: dict[str, HealthRow] = {}
    found = []
    for reading in drive.unregistered:
        known = [*rows.values(), *store.list_codes(connection, agency_id, reading.family, reading.code)]
        near = next((row for row in known if _is_near(row, reading)), None)
        state = MarkerState.from_document(near.state) if near is not None else MarkerState.new(reading.family)
        subject = near.subject if near is not None else _subject(reading)
        verdicts = update_unregistered(state, reading.confidence, vehicle, reading.at.timestamp())
        lon_deg, lat_deg = (near.lon_deg, near.lat_deg) if near is not None else (reading.lon_deg, reading.lat_deg)
        document = state.document()
        rows[subject] = HealthRow(
            subject, None, lon_deg, lat_deg, state.passes, state.reads, reading.at, reading.at, document["ratios"],
            None, document, now,
        )  # fmt: skip
        found += [Suspicion(subject, verdict, state.month_passes, reading) for verdict in verdicts]
    return list(rows.values()), found


def _is_near(row: HealthRow, reading: NewUnregistered) -> bool:
    if not row.subject.startswith(f"code:{reading.family}:{reading.code}:"):
        return False
    if row.lon_deg is None or row.lat_deg is None:
        return False
    return distance_m(row.lon_deg, row.lat_deg, reading.lon_deg, reading.lat_deg) <= SAME_CODE_M


def _subject(reading: NewUnregistered) -> str:
    return f"code:{reading.family}:{reading.code}:{reading.lon_deg:.5f},{reading.lat_deg:.5f}"


def _wrong_way_marker(
    judged: JudgedDrive, passes: Sequence[tuple[Pass, NewObservation]], rows: dict[str, HealthRow]
) -> str | None:
    """The first reversed marker of a driver on the wrong way; None where there is none, or where the only marker that
    shows it is itself suspected to be reversed.
    """
    if not judged.wrong_way:
        return None
    first = min((one for one, _row in passes if one.reversed), key=lambda one: one.along).marker_id
    if judged.only_one and _others_reversed(rows[first]):
        return None
    return first


def _others_reversed(row: HealthRow) -> bool:
    """Whether several vehicles met the marker reversed."""
    shares: dict[str, float] = row.state["shares"].get(Fault.WRONG_WAY, {})
    return sum(share > 0.0 for share in shares.values()) > 1
