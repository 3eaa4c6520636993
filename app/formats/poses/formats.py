"""Formats of tracks: how each is detected and read."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from app.formats.format import Confidence, Format, Sample, Use
from app.formats.poses.csv_track import NEEDED, read_csv
from app.formats.poses.declaration import ALIASES, PoseSource
from app.formats.poses.gpx import read_gpx
from app.formats.poses.nmea import looks_like_nmea, read_nmea
from app.formats.poses.points import PosePoint

PoseReader = Callable[[PoseSource], Iterable[PosePoint]]


def _detect_gpx(sample: Sample) -> Confidence:
    found = sample.is_text and sample.start.startswith("<")
    return Confidence.CERTAIN if found else Confidence.NONE


def _detect_nmea(sample: Sample) -> Confidence:
    if not sample.is_text:
        return Confidence.NONE
    if looks_like_nmea(sample.text):
        return Confidence.CERTAIN
    return Confidence.LIKELY if sample.start.startswith(("$G", "$P", "!")) else Confidence.NONE


def _detect_csv(sample: Sample) -> Confidence:
    if not sample.is_text:
        return Confidence.NONE
    places = sample.log.places(ALIASES, sample.declared)
    if "lon" in places and "lat" in places:
        return Confidence.LIKELY
    return Confidence.POSSIBLE if sample.declared or any(name in places for name in NEEDED) else Confidence.NONE


POSE_FORMATS: tuple[Format[PoseReader], ...] = (
    Format("gpx", Use.POSES, "GPX with times", _detect_gpx, read_gpx),
    Format("nmea", Use.POSES, "NMEA 0183", _detect_nmea, read_nmea),
    Format(
        "csv", Use.POSES, "CSV with a header line (time, longitude, latitude, heading, accuracy)", _detect_csv, read_csv
    ),
)
