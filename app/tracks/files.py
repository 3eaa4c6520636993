"""A track as GeoJSON (RFC 7946), CSV and GPX 1.1. Lines are broken at gaps and at the antimeridian."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from xml.sax.saxutils import escape

import numpy as np

from app.tracks.types import DriveMarker, FixResult, Track
from app.values import Floats, Ints

CSV_COLUMNS = (
    "time", "lon_deg", "lat_deg", "heading_deg", "speed_m_s", "variance_east_m2", "covariance_east_north_m2",
    "variance_north_m2", "sigma_m", "heading_sigma_deg", "in_gap",
)  # fmt: skip


def write_csv(track: Track) -> str:
    """One row for each position, with its covariance."""
    rows = [",".join(CSV_COLUMNS)]
    stamps = time_texts(track.time_s)
    columns = zip(
        stamps,
        track.lon_deg.tolist(),
        track.lat_deg.tolist(),
        track.heading_deg.tolist(),
        track.speed_m_s.tolist(),
        track.covariance_m2.tolist(),
        track.sigma_m.tolist(),
        track.heading_sigma_deg.tolist(),
        track.in_gap.tolist(),
        strict=True,
    )
    for time, lon, lat, heading, speed, (east, cross, north), sigma, heading_sigma, gap in columns:
        rows.append(
            f"{time},{lon:.9f},{lat:.9f},{heading:.4f},{speed:.3f},{east:.6g},{cross:.6g},{north:.6g},{sigma:.4f},"
            f"{heading_sigma:.4f},{'true' if gap else 'false'}"
        )
    return "\r\n".join(rows) + "\r\n"


def write_geojson(track: Track, name: str, markers: Sequence[DriveMarker] = ()) -> str:
    """The track as lines, its markers as points; those that gave no fix have no geometry."""
    features: list[dict[str, object]] = []
    stamps = time_texts(track.time_s)
    for part in stretches(track):
        if len(part) < 2:
            continue
        features.append(
            {
                "type": "Feature",
                "geometry": {
                    "type": "LineString",
                    "coordinates": _coordinates(track.lon_deg[part], track.lat_deg[part]),
                },
                "properties": {
                    "kind": "gap" if bool(track.in_gap[part[1:]].all()) else "track",
                    "name": name,
                    "times": [stamps[k] for k in part],
                    "heading_deg": np.round(track.heading_deg[part], 4).tolist(),
                    "speed_m_s": np.round(track.speed_m_s[part], 3).tolist(),
                    "covariance_m2": np.round(track.covariance_m2[part], 8).tolist(),
                    "heading_sigma_deg": np.round(track.heading_sigma_deg[part], 4).tolist(),
                },
            }
        )
    features += [_marker_feature(marker) for marker in markers]
    return json.dumps({"type": "FeatureCollection", "features": features}, separators=(",", ":"), allow_nan=False)


def write_gpx(track: Track, name: str) -> str:
    """One segment for each stretch without a gap; markers that were used are waypoints."""
    waypoints = [
        f'<wpt lat="{result.fix.lat_deg:.9f}" lon="{result.fix.lon_deg:.9f}"><time>{time_text(result.time_s)}</time>'
        f"<name>{escape(result.fix.marker_id or result.fix.clock)}</name><type>{escape(result.fix.family)}</type></wpt>"
        for result in track.fixes
        if result.used
    ]
    stamps, lon, lat = time_texts(track.time_s), track.lon_deg, track.lat_deg
    segments = (
        [(lat[k], lon[k], stamps[k]) for k in part if not track.in_gap[k]]
        for part in stretches(track)
        if len(part) < 2 or not bool(track.in_gap[part[1:]].all())
    )
    return gpx_document(name, segments, waypoints)


def gpx_document(
    name: str, segments: Iterable[Iterable[tuple[float, float, str | None]]], waypoints: Sequence[str] = ()
) -> str:
    """A GPX 1.1 document with one track.

    Parameters
    ----------
    name : str
        Of the track.
    segments : iterable of iterables of (latitude, longitude, time)
        [deg, deg, RFC 3339]; the time may be missing.
    waypoints : sequence of str
        Elements before the track.
    """
    parts = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<gpx version="1.1" creator="Waymark" xmlns="http://www.topografix.com/GPX/1/1">',
        *waypoints,
        f"<trk><name>{escape(name)}</name>",
    ]
    for segment in segments:
        points = (
            f'<trkpt lat="{lat_deg:.9f}" lon="{lon_deg:.9f}">{f"<time>{time}</time>" if time else ""}</trkpt>'
            for lat_deg, lon_deg, time in segment
        )
        parts += ["<trkseg>", *points, "</trkseg>"]
    parts.append("</trk></gpx>\n")
    return "\n".join(parts)


def stretches(track: Track) -> Iterator[Ints]:
    """Indices of connected positions: inside a gap or outside, and on one side of the antimeridian."""
    count = len(track.time_s)
    if not count:
        return
    changed = np.diff(track.in_gap.astype(np.int8)) != 0
    crossed = np.abs(np.diff(track.lon_deg)) > 180.0
    edges = np.flatnonzero(changed | crossed)
    start = 0
    for edge in [*edges.tolist(), count - 1]:
        yield np.arange(start, edge + 1)
        # stretches share the position between them, but for the antimeridian
        start = edge + 1 if edge < count - 1 and crossed[edge] else max(edge, start)


def time_texts(time_s: Floats) -> list[str]:
    """Times in UTC, RFC 3339 with milliseconds."""
    stamps = np.datetime_as_string(np.round(time_s * 1000.0).astype("datetime64[ms]"), unit="ms")
    return [f"{stamp}Z" for stamp in stamps.tolist()]


def time_text(seconds: float) -> str:
    """A time in UTC, RFC 3339 with milliseconds."""
    return datetime.fromtimestamp(round(seconds, 3), UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _coordinates(lon_deg: Floats, lat_deg: Floats) -> list[list[float]]:
    pairs: list[list[float]] = np.round(np.column_stack([lon_deg, lat_deg]), 9).tolist()
    return pairs


def fix_marker(result: FixResult) -> DriveMarker:
    """A marker that gave a fix."""
    fix = result.fix
    return DriveMarker(
        fix.marker_id,
        fix.family,
        fix.decode_id,
        fix.place,
        result.used,
        result.reason,
        None if result.used else f"{result.distance:.1f} standard deviations from the track by all others",
        time=time_text(result.time_s),
        lon_deg=fix.lon_deg,
        lat_deg=fix.lat_deg,
        distance=_rounded(result.distance),
        along_m=_rounded(result.along_m),
        across_m=_rounded(result.across_m),
    )


def _rounded(value: float) -> float | None:
    """To three decimals; None where no other fix gives a track."""
    return round(value, 3) if math.isfinite(value) else None


def _marker_feature(marker: DriveMarker) -> dict[str, object]:
    properties = asdict(marker)
    lon_deg, lat_deg = properties.pop("lon_deg"), properties.pop("lat_deg")
    point = None if lon_deg is None else {"type": "Point", "coordinates": [round(lon_deg, 9), round(lat_deg, 9)]}
    return {"type": "Feature", "geometry": point, "properties": {"kind": "marker", **properties}}
