"""A vehicle's own track, with its positions over time: CSV, GPX or NMEA 0183, detected by content."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import islice

import numpy as np

from app.errors import UnreadableUpload, UnsupportedUpload, UploadTooLarge
from app.formats.format import Sample, detect_format, list_accepted
from app.formats.log_report import LogReport
from app.formats.poses.datum import check_datum
from app.formats.poses.declaration import FIELD, PoseDeclaration, PoseLimits, PoseSource, too_many_points
from app.formats.poses.formats import POSE_FORMATS
from app.formats.poses.points import PosePoint, track_of
from app.formats.text import clean_text
from app.sensors.pose_track import PoseTrack

EXPECTED = list_accepted(POSE_FORMATS)


def read_poses(
    name: str, data: bytes, declaration: PoseDeclaration | None = None, limits: PoseLimits | None = None
) -> tuple[PoseTrack, LogReport]:
    """Read a track of any known format.

    Parameters
    ----------
    name : str
        Of the file, for messages only.
    data : bytes
    declaration : PoseDeclaration, optional
    limits : PoseLimits, optional

    Returns
    -------
    PoseTrack
        In the order of time. Headings of NMEA and GPX without a compass are courses over ground.
    LogReport
        What was left out, and why.

    Raises
    ------
    UploadTooLarge
        More bytes or positions than the limits.
    UnsupportedUpload
        The format is unknown; the message lists the accepted ones.
    UnreadableUpload
        Empty, broken, with a document type or entities (GPX), or without a single position that has a time.
    ReferenceSystemError
        Positions of another datum.
    InvalidParameter
        Longitude and latitude are swapped, no date is known, or a declared column is not there.
    """
    declaration, limits = declaration or PoseDeclaration(), limits or PoseLimits()
    name = clean_text(name) or "the track"
    if not data.strip(b" \t\r\n"):
        raise UnreadableUpload(f"{name} is empty", field=FIELD, limit=EXPECTED, cure="send the track whole")
    if len(data) > limits.file_bytes:
        raise UploadTooLarge(f"{name} has {len(data)} bytes", field=FIELD, limit=f"{limits.file_bytes} bytes")
    report = LogReport()
    source = PoseSource(Sample(name, data, declaration.columns), declaration, limits, report)
    points = list(islice(_read_any(source), limits.points + 1))
    if len(points) > limits.points:
        raise too_many_points(name, limits)
    if declaration.crs and points:
        check_datum(declaration.crs, points[0].lon_deg, points[0].lat_deg)
    track = track_of(name, points, report)
    if declaration.accuracy_m is not None:
        known = np.isfinite(track.accuracy_m)
        track = replace(track, accuracy_m=np.where(known, track.accuracy_m, declaration.accuracy_m))
    if declaration.forward_m or declaration.left_m:
        if not np.isfinite(track.heading_deg).any():
            report.warn("there is no heading: positions stay where they were measured, off the vehicle's reference")
        track = track.moved(-declaration.forward_m, -declaration.left_m)
    return track, report


def _read_any(source: PoseSource) -> Iterable[PosePoint]:
    sample = source.sample
    if not sample.is_text:
        raise _unsupported(sample.name)
    if sample.decoded[1] is not None:
        source.report.warn(sample.decoded[1])
    found = detect_format(sample, POSE_FORMATS)
    if found is None:
        raise _unsupported(sample.name)
    source.report.format = found.name
    return found.read(source)


def _unsupported(name: str) -> UnsupportedUpload:
    return UnsupportedUpload(
        f"{name} has no format that tracks are read in",
        field=FIELD,
        limit=EXPECTED,
        cure="export it in one of these formats",
    )
