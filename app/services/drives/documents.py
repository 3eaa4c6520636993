"""Drives as clients see them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from datetime import datetime
from typing import Annotated, NotRequired, cast

from pydantic import Field, JsonValue
from typing_extensions import TypedDict

from app.registry.jobs import JobRow, JobState
from app.services.documents import ErrorDocument, document_of, rounded
from app.tracks.files import time_text
from app.tracks.types import ClockOffset, ClockState, DriveMarker, ReceiverResult, Track

TRACK_FILES = {
    "track.geojson": "application/geo+json",
    "track.csv": "text/csv",
    "track.gpx": "application/gpx+xml",
    "plot.svg": "image/svg+xml",
}
"""Files of a drive with their media types."""
_DOUBTED = 2.5  # times the stated standard deviation of a receiver, above which a warning is given
_PLACES = {"length_m": 2, "max_sigma_m": 3, "stated_m": 3, "assumed_m": 3, "offset_s": 4, "sigma_s": 4}
MAX_MARKERS = 2000
"""Markers in a drive's document; its GeoJSON has all."""


class ClockDocument(TypedDict):
    """The offset of a sensor's clock."""

    clock: str
    state: Annotated[
        ClockState,
        Field(description="`reference`, `estimated`, `not-observable` (by this drive), `declared` as exact."),
    ]
    offset_s: Annotated[float, Field(description="To be added to the sensor's times.")]
    sigma_s: float
    jumped: Annotated[bool, Field(description="The clock was set during the drive; this offset holds from `from` on.")]
    from_time: str | None
    to_time: str | None


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
    receivers: list[ReceiverResult]
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
        DriveHead,
        job,
        name=given.get("name"),
        vehicle=job.subject_id,
        decodes=given["decodes"],
        options=given["options"],
        links=links,
    )


def track_report(track: Track, markers: Sequence[DriveMarker], warnings: tuple[str, ...]) -> DriveReport:
    """What is stored of a track besides its files."""
    used = sum(marker.used for marker in markers)
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
        "left_out_by_reason": Counter(marker.reason.value for marker in markers if marker.reason is not None),
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
            document_of(DriveGap, rounded(gap, _PLACES), from_time=time_text(gap.from_s), to_time=time_text(gap.to_s))
            for gap in track.gaps
        ],
        "markers": list(markers[:MAX_MARKERS]),
        "receivers": [rounded(receiver, _PLACES) for receiver in track.receivers],
        "warnings": [*warnings, *track.warnings, *_clock_warnings(track), *_receiver_warnings(track)],
    }


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
        f"the positions of the receiver of decode {entry.decode_id} are further from the markers than their standard "
        f"deviation of {entry.stated_m:.2g} m allows: {entry.assumed_m:.2g} m were assumed"
        for entry in track.receivers
        if entry.assumed_m > _DOUBTED * entry.stated_m
    ]


def _clock(clock: ClockOffset) -> ClockDocument:
    known = clock.from_s == clock.from_s  # not NaN: it has fixes
    return document_of(
        ClockDocument,
        rounded(clock, _PLACES),
        from_time=time_text(clock.from_s) if known else None,
        to_time=time_text(clock.to_s) if known else None,
    )
