"""Readings of a decode as one list in the order of their times, whatever was uploaded; as CSV and GeoJSON."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from typing import Any, Literal

from typing_extensions import TypedDict

from app.formats.spreadsheet import TableWriter
from app.registry.decodes import DecodeRow
from app.services.decodes.decode_clock import DecodeTimes, clock_of, stamp
from app.services.decodes.decode_track import TrackGeometry
from app.services.decodes.kinds import DecodeKind

CSV_COLUMNS = (
    "time", "time_s", "frame", "family", "outcome", "code", "confidence", "reason", "marker_id", "registered",
    "distance_m", "lon_deg", "lat_deg",
)  # fmt: skip


class ReadingRow(TypedDict):
    """One reading of any family.

    `time` is UTC, `time_s` seconds since 1970 where the clock is `utc`, else of the recording. `outcome` is that of the
    reading: of a plate or sign whether it was read, of a tag its direction, of a CERPM `received` or `left-out`.
    The place is that of the marker: of the registered one, else of what was read.
    """

    time: str | None
    time_s: float | None
    frame: int | None
    family: str
    outcome: str
    code: str | None
    confidence: float | None
    reason: str | None
    marker_id: str | None
    registered: bool
    distance_m: float | None
    lon_deg: float | None
    lat_deg: float | None


class ReadingFeature(TypedDict):
    """A reading at its marker's place; without a geometry where that is not known."""

    type: Literal["Feature"]
    geometry: TrackGeometry | None
    properties: ReadingRow


class ReadingCollection(TypedDict):
    """Readings, RFC 7946."""

    type: Literal["FeatureCollection"]
    features: list[ReadingFeature]


def reading_rows(row: DecodeRow) -> list[ReadingRow]:
    """The readings of a decode that has a result; those without a time come last."""
    result, clock = row.result or {}, clock_of(row)
    if row.kind == DecodeKind.TRACE:
        rows = [_tag(tag, clock) for tag in result.get("tags", ())]
    elif row.kind == DecodeKind.PACKETS:
        rows = [_cerpm(marker) for marker in result.get("markers", ())]
    else:
        rows = list(_frame_readings(result, clock))
    return sorted(rows, key=lambda found: (found["time_s"] is None, found["time_s"] or 0.0))


def readings_csv(row: DecodeRow) -> str:
    """One row for each reading."""
    out = io.StringIO()
    table = TableWriter(out)
    table.write_row(CSV_COLUMNS)
    for found in reading_rows(row):
        cells: dict[str, object] = {**found}
        table.write_row(_cell(cells[name]) for name in CSV_COLUMNS)
    return out.getvalue()


def readings_geojson(row: DecodeRow) -> ReadingCollection:
    """One feature for each reading."""
    return {"type": "FeatureCollection", "features": [_feature(found) for found in reading_rows(row)]}


def _feature(found: ReadingRow) -> ReadingFeature:
    lon_deg, lat_deg = found["lon_deg"], found["lat_deg"]
    place: TrackGeometry | None = None
    if lon_deg is not None and lat_deg is not None:
        place = {"type": "Point", "coordinates": [lon_deg, lat_deg]}
    return {"type": "Feature", "geometry": place, "properties": found}


def _cell(value: object) -> object:
    return str(value).lower() if isinstance(value, bool) else value


def _frame_readings(result: Mapping[str, Any], clock: DecodeTimes) -> Iterator[ReadingRow]:
    times = {frame["frame"]: clock.frame_s(frame) for frame in result.get("frames", ())}
    for reading in result.get("readings", ()):
        match, time_s = reading.get("match") or {}, times.get(reading["frame"])
        yield {
            "time": stamp(time_s, clock),
            "time_s": time_s,
            "frame": reading["frame"],
            "family": reading.get("family", "plate"),
            "outcome": reading["outcome"],
            "code": reading.get("digits") or reading.get("likely_digits"),
            "confidence": reading.get("confidence"),
            "reason": reading.get("reason") or match.get("note"),
            "marker_id": match.get("marker_id"),
            "registered": bool(match.get("registered")),
            "distance_m": match.get("distance_m"),
            "lon_deg": match.get("lon_deg"),
            "lat_deg": match.get("lat_deg"),
        }


def _tag(tag: Mapping[str, Any], clock: DecodeTimes) -> ReadingRow:
    match, fix = tag.get("match") or {}, tag.get("fix") or {}
    time_s = clock.trace_s(tag["end_s"])
    return {
        "time": stamp(time_s, clock),
        "time_s": time_s,
        "frame": None,
        "family": "magnet",
        "outcome": tag["direction"],
        "code": tag.get("tag") or tag.get("polarities"),
        "confidence": tag.get("confidence"),
        "reason": match.get("note"),
        "marker_id": match.get("marker_id"),
        "registered": bool(match.get("registered")),
        "distance_m": None,
        "lon_deg": fix.get("lon_deg"),
        "lat_deg": fix.get("lat_deg"),
    }


def _cerpm(marker: Mapping[str, Any]) -> ReadingRow:
    return {
        "time": None,
        "time_s": None,
        "frame": None,
        "family": "cerpm",
        "outcome": "left-out" if marker.get("left_out") else "received",
        "code": str(marker["number"]),
        "confidence": None,
        "reason": marker.get("left_out") or "; ".join(marker.get("notes", ())) or None,
        "marker_id": marker.get("marker_id"),
        "registered": bool(marker.get("registered")),
        "distance_m": marker.get("off_registered_m"),
        "lon_deg": marker.get("lon_deg"),
        "lat_deg": marker.get("lat_deg"),
    }
