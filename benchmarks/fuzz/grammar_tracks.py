"""Valid tracks of vehicles as CSV and GPX, with known content."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from xml.sax.saxutils import escape

import numpy as np

from app.formats.logs import LogClock
from app.formats.poses import PoseDeclaration, read_poses
from app.values import Floats
from benchmarks.fuzz.grammar import Check, Grammar, Rng
from benchmarks.fuzz.grammar_tables import (
    LEAP_SECOND,
    Instant,
    TimeForm,
    calendar_text,
    chance,
    draw_name,
    draw_table_form,
    draw_time_form,
    instants,
    pick,
    zone_text,
)


@dataclass(frozen=True, slots=True)
class _Drive:
    """Positions of a vehicle; NaN where the receiver states no heading or accuracy."""

    times: list[Instant]
    lon_deg: Floats
    lat_deg: Floats
    heading_deg: Floats
    accuracy_m: Floats


def _draw_drive(rng: Rng, digits: int) -> _Drive:
    """A few positions, 2 to 15 m apart; over a leap second, over midnight, or at any time."""
    count = int(rng.integers(2, 12))
    when = str(pick(rng, "leap", "midnight", "any", "any", "any"))
    step_us = int(pick(rng, 1_000_000, 2_000_000)) if not digits else int(pick(rng, 100_000, 250_000, 1_000_000))
    begins = datetime(2012, 9, 1, tzinfo=UTC) + timedelta(days=int(rng.integers(0, 6000)))
    if when == "leap":
        begins = LEAP_SECOND
    elif when == "midnight":
        begins -= timedelta(seconds=1)
    else:
        begins += timedelta(seconds=int(rng.integers(0, 86_000)))
    lon_deg = float(rng.uniform(-179.9, 179.9)) + np.cumsum(rng.uniform(2e-5, 5e-5, count))
    lat_deg = float(rng.uniform(-65, 65)) + np.cumsum(rng.uniform(2e-5, 8e-5, count))
    heading_deg = np.round(rng.uniform(0, 359.9, count), 1)
    heading_deg[rng.random(count) < 0.1] = np.nan
    accuracy_m = np.round(rng.uniform(0.01, 9, count), 3)
    accuracy_m[rng.random(count) < 0.1] = np.nan
    times = instants(begins, [k * step_us for k in range(count)])
    return _Drive(times, np.round(lon_deg, 9), np.round(lat_deg, 9), heading_deg, accuracy_m)


def _compare(content: bytes, declaration: PoseDeclaration, drive: _Drive, left_out: int, *, is_zoned: bool) -> str:
    """The difference. In a leap second and the one after it, times are the same: the first positions count."""
    track, report = read_poses("upload", content, declaration)
    seconds = np.array([at.seconds for at in drive.times])
    _times, first = np.unique(seconds, return_index=True)
    left_out += len(seconds) - len(first)
    if len(track.time_s) != len(first):
        return f"{len(track.time_s)} of {len(first)} positions; {report.left_out[:2]}"
    if report.left_out_count != left_out:
        return f"{report.left_out_count} left out, not {left_out}"
    if np.abs(track.time_s - seconds[first]).max() > 2e-6:
        return f"times off by {np.abs(track.time_s - seconds[first]).max():.6f} s"
    lon_deg, lat_deg = drive.lon_deg[first], drive.lat_deg[first]
    if max(np.abs(track.lon_deg - lon_deg).max(), np.abs(track.lat_deg - lat_deg).max()) > 1e-10:
        return "other positions"
    heading_deg = drive.heading_deg[first] % 360
    if not np.allclose(track.heading_deg, heading_deg, atol=1e-6, equal_nan=True):
        return f"headings {track.heading_deg}, not {heading_deg}"
    if not np.allclose(track.accuracy_m, drive.accuracy_m[first], atol=1e-9, equal_nan=True):
        return f"accuracies {track.accuracy_m}, not {drive.accuracy_m[first]}"
    assumed = any("without a zone" in warning for warning in report.warnings)
    return f"{'a' if assumed else 'no'} warning that times have no zone" if assumed is is_zoned else ""


def _track(rng: Rng) -> tuple[bytes, Check]:
    return _gpx(rng) if chance(rng) else _csv(rng)


# === CSV.


def _csv(rng: Rng) -> tuple[bytes, Check]:
    """Columns in any order beside others, rows without a fix between the others."""
    form, digits = draw_table_form(rng), int(pick(rng, 0, 3, 6))
    times = draw_time_form(rng, digits, point=form.point)
    drive = _draw_drive(rng, digits)
    while any(at.is_leap for at in drive.times) and not times.has_leap_seconds:
        drive = _draw_drive(rng, digits)
    has = {"heading": chance(rng, 0.7), "accuracy": chance(rng, 0.6), "crs": chance(rng, 0.3)}
    signed = chance(rng, 0.3)  # headings from -180 to 180
    datum = str(pick(rng, "WGS84", "EPSG:4326", "WGS 84", "ITRF2014"))
    cells: list[dict[str, str]] = []
    left_out = 0
    for k, at in enumerate(drive.times):
        heading_deg = float(drive.heading_deg[k])
        heading_deg -= 360 if signed and heading_deg > 180 else 0
        row = {
            "time": times.write(at), "lon": form.number(drive.lon_deg[k], 9), "lat": form.number(drive.lat_deg[k], 9),
            "heading": "" if np.isnan(heading_deg) else form.number(heading_deg, 1),
            "accuracy": "" if np.isnan(drive.accuracy_m[k]) else form.number(drive.accuracy_m[k], 3), "crs": datum,
        }  # fmt: skip
        if chance(rng, 0.1):  # no fix yet, in the same instant
            nothing = form.number(0, 9) if chance(rng) else ""
            cells.append(row | {"lon": nothing, "lat": nothing})
            left_out += 1
        cells.append(row)
    names = {
        "time": draw_name(rng, "time", "timestamp", "utc_time", "datetime"),
        "lon": draw_name(rng, "longitude", "lon", "lng", "lon_deg", "longitude_deg"),
        "lat": draw_name(rng, "latitude", "lat", "lat_deg", "latitude_deg"),
        "heading": draw_name(rng, "heading", "heading_deg", "course", "cog", "bearing", "azimuth"),
        "accuracy": draw_name(rng, "accuracy", "accuracy_m", "hacc", "horizontal_accuracy"),
        "crs": draw_name(rng, "crs", "datum"),
    }  # fmt: skip
    quantities = ["time", "lon", "lat", *(name for name, there in has.items() if there)]
    columns = [(names[name], [row[name] for row in cells]) for name in quantities]
    for name, cell in (("speed", "12"), ("remark", ""), ("satellites", "14"), ("hdop", form.number(0.8, 1))):
        if chance(rng, 0.3):
            columns.append((name, [cell] * len(cells)))
    columns = [columns[int(place)] for place in rng.permutation(len(columns))]
    content = form.write([name for name, _ in columns], [[part[k] for _, part in columns] for k in range(len(cells))])
    missing = np.full(len(drive.times), np.nan)
    stated = _Drive(
        drive.times, drive.lon_deg, drive.lat_deg, drive.heading_deg if has["heading"] else missing,
        drive.accuracy_m if has["accuracy"] else missing,
    )  # fmt: skip
    return content, lambda: _compare(
        content, PoseDeclaration(clock=times.clock), stated, left_out, is_zoned=_is_zoned(times)
    )


def _is_zoned(times: TimeForm) -> bool:
    return times.names_zone or (times.clock is not None and bool(times.clock.utc_offset_s))


# === GPX.

_NAMESPACES = {"1.0": "http://www.topografix.com/GPX/1/0", "1.1": "http://www.topografix.com/GPX/1/1"}
_EXTENSIONS = "http://www.garmin.com/xmlschemas/TrackPointExtension/v2"


def _gpx(rng: Rng) -> tuple[bytes, Check]:
    """GPX 1.0 and 1.1: tracks of several segments, beside waypoints and points without a time."""
    version, digits = str(pick(rng, "1.0", "1.1")), int(pick(rng, 0, 3, 6))
    drive = _draw_drive(rng, digits)
    prefix = str(pick(rng, "", "", "", "gpx:"))
    quote = str(pick(rng, '"', '"', "'"))
    zone_s = int(rng.integers(-11, 13)) * 3600
    kind = str(pick(rng, "Z", "Z", "zone", "local"))
    own = int(pick(rng, digits, 9)) if digits else 0
    has_heading = chance(rng, 0.7)
    extension = str(pick(rng, "tpx:course", "tpx:bearing", "heading", "nested", "both"))
    breaks = set(rng.integers(1, len(drive.times), 2).tolist()) if chance(rng) else set()
    body: list[str] = []
    left_out = 0
    for k, at in enumerate(drive.times):
        written = calendar_text(at, "%Y-%m-%dT%H:%M:%S", own, 0 if kind == "Z" else zone_s)
        written += {"Z": "Z", "zone": zone_text(zone_s), "local": ""}[kind]
        heading_deg = float(drive.heading_deg[k])
        heading = "" if np.isnan(heading_deg) or not has_heading else f"{heading_deg:.1f}"
        position = [f"lat={quote}{drive.lat_deg[k]:.9f}{quote}", f"lon={quote}{drive.lon_deg[k]:.9f}{quote}"]
        parts = [f"<{prefix}ele>12.5</{prefix}ele>", f"<{prefix}time>{written}</{prefix}time>"]
        if heading and version == "1.0":
            parts.append(f"<{prefix}course>{heading}</{prefix}course><{prefix}speed>12.0</{prefix}speed>")
        parts.append(f"<{prefix}sat>9</{prefix}sat><{prefix}hdop>0.8</{prefix}hdop>" if chance(rng) else "")
        if version == "1.1":
            parts.append(_extensions(heading, extension, prefix))
        if k in breaks:
            body.append(f"</{prefix}trkseg>{'<!-- tunnel -->' if chance(rng) else ''}<{prefix}trkseg>")
        if chance(rng, 0.1):
            body.append(f"<{prefix}trkpt {' '.join(position)}><{prefix}ele>1</{prefix}ele></{prefix}trkpt>")
            left_out += 1
        body.append(f"<{prefix}trkpt {' '.join(position[:: pick(rng, 1, -1)])}>{''.join(parts)}</{prefix}trkpt>")
    track = f"<{prefix}trk><{prefix}name>{escape('Ring & <east>')}</{prefix}name><{prefix}trkseg>"
    of_prefix = f":{prefix[:-1]}" if prefix else ""
    when = f"<{prefix}time>2001-01-01T00:00:00Z</{prefix}time>"
    content = (
        f"<?xml version={quote}1.0{quote} encoding={quote}UTF-8{quote}?>\n"
        f"<{prefix}gpx version={quote}{version}{quote} creator={quote}a{quote} "
        f"xmlns{of_prefix}={quote}{_NAMESPACES[version]}{quote} xmlns:tpx={quote}{_EXTENSIONS}{quote}>"
        + (f"<{prefix}metadata>{when}</{prefix}metadata>" if version == "1.1" else when)
        + f"<{prefix}wpt lat={quote}1{quote} lon={quote}2{quote}>{when}</{prefix}wpt>"
        + track + str(pick(rng, "", "\n")).join(body) + f"</{prefix}trkseg></{prefix}trk></{prefix}gpx>\n"
    ).encode()  # fmt: skip
    missing = np.full(len(drive.times), np.nan)
    stated = _Drive(drive.times, drive.lon_deg, drive.lat_deg, drive.heading_deg if has_heading else missing, missing)
    clock = LogClock(utc_offset_s=zone_s) if kind == "local" else None
    is_zoned = kind != "local" or bool(zone_s)
    return content, lambda: _compare(content, PoseDeclaration(clock=clock), stated, left_out, is_zoned=is_zoned)


def _extensions(heading: str, kind: str, prefix: str) -> str:
    """Heading or course as receivers and phones add them; of both, the compass counts."""
    inner = "<tpx:speed>12</tpx:speed>"
    beside = ""
    if heading and kind in ("tpx:course", "tpx:bearing"):
        inner += f"<{kind}>{heading}</{kind}>"
    elif heading and kind == "nested":
        beside = f"<a><b>1</b><tpx:heading>{heading}</tpx:heading></a>"
    elif heading:
        beside = f"<heading>{heading}</heading>"
        inner += f"<tpx:course>{(float(heading) + 90) % 360:.1f}</tpx:course>" if kind == "both" else ""
    point = f"<tpx:TrackPointExtension>{inner}</tpx:TrackPointExtension>"
    return f"<{prefix}extensions>{point}{beside}</{prefix}extensions>"


TRACK_GRAMMARS: dict[str, Grammar] = {"track": _track}
