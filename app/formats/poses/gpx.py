"""Tracks as GPX 1.0 and 1.1."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from app.errors import UnreadableUpload, UnsupportedUpload
from app.formats.delimited import read_number
from app.formats.poses.declaration import FIELD, PoseSource, too_many_points
from app.formats.poses.points import PosePoint

if TYPE_CHECKING:
    import gpxpy.gpx

_HEAD_CHARS = 1 << 14  # [character] in which the root element stands; chosen by hand


def is_gpx(text: str) -> bool:
    """Whether XML has the root element of GPX."""
    return re.search(r"<(?:\w+:)?gpx[\s>]", text[:_HEAD_CHARS]) is not None


def read_gpx(source: PoseSource) -> Iterator[PosePoint]:
    """Points of all tracks, in the order of the file.

    Raises
    ------
    UnreadableUpload
        It has a document type or entities, or is not well-formed.
    UnsupportedUpload
        It is other XML.
    UploadTooLarge
        It has more points than the limit.
    """
    name, text, report = source.sample.name, source.sample.text, source.report
    if re.search(r"<!(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise UnreadableUpload(
            f"{name} has a document type or entities", field=FIELD, limit="plain GPX", cure="export the track again"
        )
    if text.count("<trkpt") > source.limits.points:
        raise too_many_points(name, source.limits)
    if not is_gpx(text):
        raise UnsupportedUpload(
            f"{name} is XML, but no GPX", field=FIELD, limit="GPX 1.0 or 1.1", cure="export the track as GPX"
        )
    import gpxpy  # here: only a decoder process reads files
    import gpxpy.gpx

    try:
        gpx = gpxpy.parse(re.sub(r"\A\s*<\?xml[^>]*\?>", "", text.lstrip("\ufeff")))
    except (gpxpy.gpx.GPXException, ValueError, TypeError, LookupError, RecursionError) as error:
        raise UnreadableUpload(
            f"{name} is broken: {str(error)[:160]}", field=FIELD, limit="GPX 1.0 or 1.1", cure="export the track again"
        ) from error
    points = (point for track in gpx.tracks for segment in track.segments for point in segment.points)
    for entry, point in enumerate(points):
        report.entries += 1
        at = point.time
        written = None if at is None else at.isoformat()
        yield PosePoint(
            entry, source.declaration.clock.read(written), float(point.longitude), float(point.latitude), _course(point)
        )


def _course(point: gpxpy.gpx.GPXTrackPoint) -> float:
    """Of GPX 1.0, or of the extensions that receivers write in 1.1."""
    course: float | None = getattr(point, "course", None)
    if course is not None:
        return float(course)
    nodes: list[Any] = list(point.extensions or ())
    for node in nodes[:20]:
        nodes += list(node)[:20]
    for node in nodes[:200]:
        if str(node.tag).rsplit("}", 1)[-1].lower() in ("heading", "course", "bearing"):
            try:
                return read_number(node.text)
            except ValueError:
                return math.nan
    return math.nan
