"""Drives as clients see them."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, NotRequired, cast

from pydantic import Field, JsonValue
from typing_extensions import TypedDict

from app.registry.jobs import JobRow, JobState
from app.services.documents import ErrorDocument, document_of
from app.services.drives.collect import LeftOutMarker
from app.tracks.types import ClockOffset, FixResult, Track

TRACK_FILES = {
    "track.geojson": "application/geo+json",
    "track.csv": "text/csv",
    "track.gpx": "application/gpx+xml",
    "plot.svg": "image/svg+xml",
}
"""Files of a drive with their media types."""
_DOUBTED = 2.5  # times the stated standard deviation of a receiver, above which a warning is given
MAX_MARKERS = 2000
"""Markers in a drive's document; its GeoJSON has all."""


class ClockDocument(TypedDict):
    """The offset of a sensor's clock."""

    clock: str
    state: Annotated[
        str,
        Field(description="`reference`, `estimated`, `not-observable` (by this drive), `declared` as exact."),
    ]
    offset_s: Annotated[float, Field(description="To be added to the sensor's times.")]
    sigma_s: float
    jumped: Annotated[bool, Field(description="The clock was set during the drive; this offset holds from `from` on.")]
    from_time: str | None
    to_time: str | None


class DriveMarker(TypedDict):
    """A marker of a drive: used, or left out and why."""

    marker_id: str | None
    number: Annotated[int | None, Field(description="Of a CERPM.")]
    family: str
    decode_id: str
    place: Annotated[int, Field(description="Frame of an archive, tag of a trace, marker of a packet log.")]
    used: bool
    reason: str | None
    detail: str | None
    time: str | None
    lon_deg: float | None
    lat_deg: float | None
    distance: Annotated[float | None, Field(description="Mahalanobis distance to the track by all others.")]
    along_m: Annotated[float | None, Field(description="From that track, forward positive.")]
    across_m: Annotated[float | None, Field(description="From that track, left positive.")]


class DriveReceiver(TypedDict):
    """Positions of the vehicle's own receiver, of one decode."""

    decode_id: str
    clock: str
    used: int
    left_out: Annotated[int, Field(description="Too far from the track by all others.")]
    stated_m: Annotated[float, Field(description="Median of the standard deviations that the receiver states.")]
    assumed_m: Annotated[float, Field(description="The same, enlarged to what the markers show of it.")]


class DriveGap(TypedDict):
    """A stretch whose positions are worse than `max_sigma_m`, or without data."""

    from_time: str
    to_time: str
    length_m: float
    max_sigma_m: float
    reason: str


class DriveStatistics(TypedDict):
    """A track in numbers."""

    positions: int
    from_time: str
    to_time: str
    duration_s: float
    length_m: float
    sigma_median_m: float
    sigma_max_m: float
    share_in_gaps: float
    markers_used: int
    markers_left_out: int
    left_out_by_reason: dict[str, int]
    path_points: Annotated[int, Field(description="Places where the path of CERPMs was used.")]
    speed_scale: float
    speed_scale_sigma: float
    heading_bias_deg: float
    heading_bias_sigma_deg: float


class DriveReport(TypedDict):
    """What a drive's track rests on."""

    summary: str
    statistics: DriveStatistics
    clocks: list[ClockDocument]
    gaps: list[DriveGap]
    markers: list[DriveMarker]
    receivers: list[DriveReceiver]
    warnings: list[str]


class DriveLinks(TypedDict):
    """Paths of the drive and of its files."""

    self: str
    geojson: NotRequired[str]
    csv: NotRequired[str]
    gpx: NotRequired[str]
    plot: NotRequired[str]


class DriveHead(TypedDict):
    """A drive without its report."""

    id: str
    name: str | None
    vehicle: Annotated[str | None, Field(description="Id of the vehicle.")]
    state: JobState
    progress: Annotated[float, Field(description="0 to 1.")]
    attempts: int
    cancel_requested: bool
    created_at: datetime
    finished_at: datetime | None
    decodes: Annotated[list[dict[str, JsonValue]], Field(description="As they were declared.")]
    options: dict[str, JsonValue]
    error: ErrorDocument | None
    links: DriveLinks


class TrackedDriveDocument(DriveHead):
    """A drive; `report` is null until it is done."""

    report: DriveReport | None


class DrivePage(TypedDict):
    """A page of drives without their reports, newest first; the Link header leads to the next one."""

    items: list[DriveHead]


def drive_document(job: JobRow) -> TrackedDriveDocument:
    """A drive with its report, once there is one."""
    report = (job.result or {}).get("report")
    return {**drive_head(job), "report": cast("DriveReport | None", report)}


def drive_head(job: JobRow) -> DriveHead:
    """A drive without its report."""
    path, given = f"/v1/drives/{job.id}", job.input
    links = DriveLinks(self=path)
    if job.state == "done":
        links |= {"geojson": f"{path}/track.geojson", "csv": f"{path}/track.csv", "gpx": f"{path}/track.gpx"}
        links["plot"] = f"{path}/plot.svg"
    return document_of(
        DriveHead, job, name=given.get("name"), vehicle=job.subject_id, decodes=given["decodes"],
        options=given["options"], links=links,
    )  # fmt: skip


def track_report(
    track: Track, left_out: tuple[LeftOutMarker, ...], on_lane: tuple[LeftOutMarker, ...], warnings: tuple[str, ...]
) -> DriveReport:
    """What is stored of a track besides its files."""
    markers = [_fix_marker(result) for result in track.fixes]
    markers += [_other_marker(entry, used=False) for entry in left_out]
    markers += [_other_marker(entry, used=track.path_points > 0) for entry in on_lane]
    by_reason: dict[str, int] = {}
    for marker in markers:
        if marker["reason"] is not None:
            by_reason[marker["reason"]] = by_reason.get(marker["reason"], 0) + 1
    used = sum(marker["used"] for marker in markers)
    sigma = sorted(track.sigma_m.tolist())
    statistics: DriveStatistics = {
        "positions": len(track.time_s),
        "from_time": time_text(track.time_s[0]),
        "to_time": time_text(track.time_s[-1]),
        "duration_s": round(float(track.time_s[-1] - track.time_s[0]), 3),
        "length_m": round(track.length_m, 2),
        "sigma_median_m": round(sigma[len(sigma) // 2], 4),
        "sigma_max_m": round(sigma[-1], 4),
        "share_in_gaps": round(float(track.in_gap.mean()), 4),
        "markers_used": used,
        "markers_left_out": len(markers) - used,
        "left_out_by_reason": by_reason,
        "path_points": track.path_points,
        "speed_scale": round(track.speed_scale[0], 6),
        "speed_scale_sigma": round(track.speed_scale[1], 6),
        "heading_bias_deg": round(track.heading_bias_deg[0], 4),
        "heading_bias_sigma_deg": round(track.heading_bias_deg[1], 4),
    }
    return {
        "summary": _summary(statistics, track),
        "statistics": statistics,
        "clocks": [_clock(clock) for clock in track.clocks],
        "gaps": [
            {
                "from_time": time_text(gap.from_s), "to_time": time_text(gap.to_s), "length_m": round(gap.length_m, 2),
                "max_sigma_m": round(gap.max_sigma_m, 3), "reason": gap.reason,
            }
            for gap in track.gaps
        ],
        "markers": markers[:MAX_MARKERS],
        "receivers": [
            {
                "decode_id": entry.source, "clock": entry.clock, "used": entry.used, "left_out": entry.left_out,
                "stated_m": round(entry.stated_m, 3), "assumed_m": round(entry.assumed_m, 3),
            }
            for entry in track.receivers
        ],
        "warnings": [*warnings, *track.warnings, *_clock_warnings(track), *_receiver_warnings(track)],
    }  # fmt: skip


def _summary(statistics: DriveStatistics, track: Track) -> str:
    text = f"{statistics['length_m']:.0f} m in {statistics['duration_s']:.0f} s, "
    text += f"± {statistics['sigma_median_m']:.2f} m (median); "
    text += f"{statistics['markers_used']} markers used, {statistics['markers_left_out']} left out"
    if track.gaps:
        text += f"; {len(track.gaps)} gap{'s' * (len(track.gaps) > 1)}"
    return text


def _clock_warnings(track: Track) -> list[str]:
    jumped = [clock for clock in track.clocks if clock.jumped]
    return [
        f"the clock {clock.clock} was set before {time_text(clock.from_s)}: another offset holds from there on"
        for clock in jumped
        if clock.from_s == clock.from_s
    ]


def _receiver_warnings(track: Track) -> list[str]:
    return [
        f"the positions of the receiver of decode {entry.source} are further from the markers than their standard "
        f"deviation of {entry.stated_m:.2g} m allows: {entry.assumed_m:.2g} m were assumed"
        for entry in track.receivers
        if entry.assumed_m > _DOUBTED * entry.stated_m
    ]


def _clock(clock: ClockOffset) -> ClockDocument:
    known = clock.from_s == clock.from_s  # not NaN: it has fixes
    return {
        "clock": clock.clock,
        "state": str(clock.state),
        "offset_s": round(clock.offset_s, 4),
        "sigma_s": round(clock.sigma_s, 4),
        "jumped": clock.jumped,
        "from_time": time_text(clock.from_s) if known else None,
        "to_time": time_text(clock.to_s) if known else None,
    }


def _fix_marker(result: FixResult) -> DriveMarker:
    fix = result.fix
    return {
        "marker_id": fix.marker_id,
        "number": None,
        "family": fix.family,
        "decode_id": fix.source,
        "place": fix.place,
        "used": result.used,
        "reason": str(result.reason) if result.reason is not None else None,
        "detail": None if result.used else f"{result.distance:.1f} standard deviations from the track by all others",
        "time": time_text(result.time_s),
        "lon_deg": fix.lon_deg,
        "lat_deg": fix.lat_deg,
        "distance": round(result.distance, 3),
        "along_m": round(result.along_m, 3),
        "across_m": round(result.across_m, 3),
    }


def _other_marker(entry: LeftOutMarker, *, used: bool) -> DriveMarker:
    why = None if used else entry.detail or "the vehicle did not drive along its path"
    return {
        "marker_id": entry.marker_id,
        "number": entry.number,
        "family": entry.family,
        "decode_id": entry.decode_id,
        "place": entry.place,
        "used": used,
        "reason": None if used else str(entry.reason),
        "detail": why,
        "time": None,
        "lon_deg": None,
        "lat_deg": None,
        "distance": None,
        "along_m": None,
        "across_m": None,
    }


def time_text(seconds: float) -> str:
    """A time in UTC, to the millisecond, RFC 3339."""
    return datetime.fromtimestamp(round(seconds, 3), UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
