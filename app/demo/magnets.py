"""The demo's magnets: a codebook, tags and lines on a lane, and drives over them as the recorder's files."""

from __future__ import annotations

import io
import json
import math
import time
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import httpx
import numpy as np

from app.demo.server import checked
from app.demo.table import TraceResult
from app.errors import Unavailable, WaymarkError
from app.geodesy import enu_from_wgs84, wgs84_from_enu
from app.markers.magnet import InformationTag, LineStyle, LineTag, Orientation, Polarity, parse_tag
from app.simulation.magnetic.clutter import Clutter
from app.simulation.magnetic.drive import Course, Scene, SimulatedDrive, TrueMagnet, Vehicle, simulate_drive
from app.simulation.magnetic.recorder import write_recorder_files
from app.simulation.magnetic.road import PlacedTag, Road, RoadMagnet
from app.values import Floats, JsonObject

LENGTH_M, BEND = 350.0, (150.0, 230.0, 260.0)
ORIGIN = (8.4133, 49.0058, 165.0)
HEADING_DEG = 294.0
LINES = {LineStyle.DASHED: 1.75, LineStyle.SOLID: -1.75}
STOP_LINE_M = 340.0
SURVEY_RMSE_M = 0.01
_KMH = 1 / 3.6

BOOK: JsonObject = {
    "name": "Demo lane",
    "design": {"magnets": 3, "length_m": 4.0, "segment_m": 1.0},
    "rules": {"speed_m_s": 13.9, "clearance_m": 0.3, "wrong_way_safe": True},
    "meanings": [
        {"kind": "speed-limit-kmh", "value": 50},
        {"kind": "bend-left", "value": 18},
        {"kind": "speed-limit-kmh", "value": 30},
        {"kind": "stop-line-ahead", "value": 100},
        {"kind": "arrow", "value": "straight-right"},
        {"kind": "arrow", "value": "straight-left"},
        {"kind": "stop-line-ahead", "value": 50},
        {"kind": "bend-right", "value": 90},
    ],
}
TAGS_M = (40.0, 95.0, 190.0, 240.0, 320.0)
"""Chainages of the first five meanings; the third lies in the bend. [m]"""


@dataclass(frozen=True, slots=True, eq=False)
class Lane:
    """The lane as it is driven, the legal way or against it."""

    road: Road
    shift_m: Floats  # shape (2,): [m] what leads from the road's world to east and north of `ORIGIN`

    @classmethod
    def legal(cls) -> Lane:
        """In the direction of travel."""
        road = Road(LENGTH_M, (BEND,), heading_deg=HEADING_DEG)
        return cls(road, -road.world_m(np.zeros(1))[0])

    def reversed(self) -> Lane:
        """The same line, begun at its end."""
        end = np.array([LENGTH_M])
        heading_deg = 270.0 - math.degrees(float(self.road.yaw_rad(end)[0]))
        start, stop, radius = BEND
        back = Road(LENGTH_M, ((LENGTH_M - stop, LENGTH_M - start, -radius),), heading_deg=heading_deg)
        return Lane(back, self.road.world_m(end)[0] + self.shift_m - back.world_m(np.zeros(1))[0])

    def lon_lat(self, chainage_m: float, left_m: float = 0.0) -> list[float]:
        """Position of a point beside the lane. [deg]"""
        east, north = self.road.world_m(np.array([chainage_m]), left_m)[0] + self.shift_m
        return list(wgs84_from_enu(np.array([east, north, 0.0]), ORIGIN)[:2])

    def off_m(self, lon_deg: float, lat_deg: float, chainage_m: float) -> tuple[float, float]:
        """How far a position is ahead of a chainage and left of the lane's centre. [m]"""
        off = enu_from_wgs84(lon_deg, lat_deg, ORIGIN[2], ORIGIN)[:2] - self.shift_m
        off = off - self.road.world_m(np.array([chainage_m]))[0]
        yaw = float(self.road.yaw_rad(np.array([chainage_m]))[0])
        return float(off @ (math.cos(yaw), math.sin(yaw))), float(off @ (-math.sin(yaw), math.cos(yaw)))

    def project_m(self, lon_deg: float, lat_deg: float) -> tuple[float, float]:
        """Chainage and offset of a position beside the lane. [m]"""
        along = np.arange(0.0, LENGTH_M, 1.0)
        off = enu_from_wgs84(lon_deg, lat_deg, ORIGIN[2], ORIGIN)[:2] - self.shift_m
        chainage = float(along[np.argmin(np.linalg.norm(self.road.world_m(along) - off, axis=1))])
        for _ in range(3):
            chainage += self.off_m(lon_deg, lat_deg, chainage)[0]
        return chainage, self.off_m(lon_deg, lat_deg, chainage)[1]


@dataclass(frozen=True, slots=True)
class TraceDrive:
    """How the lane is driven."""

    name: str
    clearance_m: float
    course: Course
    clutter: Sequence[Clutter] = ()
    wrong_way: bool = False


def list_drives() -> list[TraceDrive]:
    """An ordinary drive that leaves its lane twice, a high vehicle among iron, and one on the wrong way."""
    speeds = [(s, v * _KMH) for s, v in ((0, 50), (150, 50), (190, 32), (230, 50), (310, 50), (350, 25))]
    drift = [(105, 0), (125, 1.1), (145, 1.1), (170, 0), (252, 0), (270, -1.1), (284, -1.1), (305, 0)]
    covers = [Clutter("manhole cover", at, left) for at, left in ((34, 0.3), (70, -0.5), (165, 0.1), (285, 0.6))]
    cars = [Clutter("car", at, -2.9) for at in (44, 51, 100, 192, 199, 238, 318)]
    return [
        TraceDrive("ordinary", 0.16, Course(speeds=speeds, lefts=drift, weave_m=0.12, weave_period_s=6.0)),
        TraceDrive("high, iron", 0.30, Course(speed_m_s=45 * _KMH), (*covers, *cars)),
        TraceDrive("wrong way", 0.16, Course(speed_m_s=40 * _KMH), wrong_way=True),
    ]


@dataclass(slots=True)
class Built:
    """Registered magnets on the lane."""

    lane: Lane
    tags: list[JsonObject] = field(default_factory=list)
    lines: list[JsonObject] = field(default_factory=list)

    def scene(self, drive: TraceDrive) -> tuple[Scene, Lane]:
        """The scene of a drive: tags at their planned chainages, lines at the holes of their sheets."""
        back = drive.wrong_way
        lane = self.lane.reversed() if back else self.lane
        tags = []
        for marker, at in zip(self.tags, TAGS_M, strict=True):
            tag = parse_tag(marker["code"]["text"])
            assert isinstance(tag, InformationTag)
            tags.append(PlacedTag(tag, LENGTH_M - at - tag.length_m if back else at))
        holes = [hole for marker in self.lines for hole in marker["magnets"]]
        lines = [
            RoadMagnet(*lane.project_m(h["lon_deg"], h["lat_deg"]), Polarity(h["polarity"]), Orientation.UP)
            for h in holes
        ]
        vehicle = Vehicle.compact(clearance_m=drive.clearance_m)
        ordered = sorted(tags, key=lambda placed: placed.chainage_m)
        return Scene(lane.road, vehicle, drive.course, ordered, lines, drive.clutter, wrong_way=back), lane


def build(client: httpx.Client, folder: Path, rng: np.random.Generator) -> Built:
    """Make the codebook, register tags and lines, fetch their drilling sheets, survey the tags within 1 cm."""
    book = checked(client.post("/v1/codebooks", json=BOOK)).json()
    built = Built(Lane.legal())
    for meaning, at in zip(BOOK["meanings"], TAGS_M, strict=False):
        tag = {"codebook_id": book["id"], "meaning": meaning, "chainage_m": at}
        ahead = {"stop_line_chainage_m": STOP_LINE_M} if meaning["kind"] == "stop-line-ahead" else {}
        body = _body(built.lane, 0.0) | {"tag": tag, "site": {"design_speed_m_s": 13.9, **ahead}}
        built.tags.append(checked(client.post("/v1/markers", json=body)).json())
    for style, left_m in LINES.items():
        line = {"style": style, "from_m": 10.0, "to_m": 340.0, "spacing_m": 5.0}
        answer = checked(client.post("/v1/markers", json=_body(built.lane, left_m) | {"line": line}))
        built.lines.append(answer.json())
    for number, marker in enumerate([*built.tags, *built.lines], 1):
        if marker["warnings"]:
            raise WaymarkError(f"the layout of {marker['code']['text']} fails a check: {marker['warnings'][0]}")
        for form in ("pdf", "csv", "geojson"):
            sheet = checked(client.get(f"/v1/markers/{marker['id']}/layout.{form}"))
            (folder / f"{number}_{marker['code']['text']}.{form}").write_bytes(sheet.content)
    for marker in built.tags:
        _survey(client, marker, rng)
    return built


def _body(lane: Lane, left_m: float) -> dict[str, object]:
    coordinates = [lane.lon_lat(at, left_m) for at in np.arange(0.0, LENGTH_M + 0.5)]
    geometry = {"type": "LineString", "coordinates": coordinates}
    source = {"height_m": ORIGIN[2], "realization": "ITRF2014", "epoch": 2026.4, "horizontal_rmse_m": 0.02}
    return {"family": "magnet", "road": "Karlsruhe, magnet lane", "lane": {"geometry": geometry, **source}}


def _survey(client: httpx.Client, marker: JsonObject, rng: np.random.Generator) -> None:
    hole = marker["magnets"][0]
    error_m = np.array([*rng.standard_normal(2) * SURVEY_RMSE_M / np.sqrt(2), 0.0])
    lon_deg, lat_deg, _height = wgs84_from_enu(error_m, (hole["lon_deg"], hole["lat_deg"], ORIGIN[2]))
    position = {
        "lon_deg": lon_deg, "lat_deg": lat_deg, "height_m": ORIGIN[2], "realization": "ITRF2014", "epoch": 2026.4,
        "horizontal_rmse_m": SURVEY_RMSE_M, "survey_method": "simulated GNSS RTK",
    }  # fmt: skip
    body = {"status": "surveyed", "position": position, "reason": "as-built survey"}
    path, headers = f"/v1/markers/{marker['id']}", {"If-Match": f'"{marker["version"]}"'}
    checked(client.patch(path, json=body, headers=headers))


# === Drives over the demo's magnets: uploaded as the recorder's own files, decoded, compared with the truth.


_UNDER_CM = 88.0  # a magnet farther off is beside the bar
_REACH_M = 0.4  # a reading so near to a magnet is of it
_EPISODE_S = 1.5  # between magnets of a line that are passed in one departure, and about it
_WAIT_S = 120.0


def drive_and_judge(
    client: httpx.Client, built: Built, drive: TraceDrive, rng: np.random.Generator
) -> tuple[TraceResult, JsonObject, bytes, JsonObject]:
    """Drive over what is built.

    Returns
    -------
    result : TraceResult
    decode : dict
        The server's answer.
    recording : bytes
        ZIP of the recorder's files, as uploaded.
    context : dict
        Uploaded with it: a coarse position; the recorder knows no heading, and its files need no declaration.
    """
    scene, lane = built.scene(drive)
    simulated = simulate_drive(scene, rng)
    lon_deg, lat_deg = lane.lon_lat(0.0, float(rng.uniform(-5, 5)))
    coarse = {"lon_deg": lon_deg, "lat_deg": lat_deg, "accuracy_m": 15.0}
    context = {"coarse_position": coarse, "captured_at": "2026-06-01T08:00:00Z", "trace": {}}
    recording = _pack(simulated)
    decode = _upload(client, recording, context)
    return judge_drive(built, drive, lane, simulated, decode), decode, recording, context


def judge_drive(
    built: Built, drive: TraceDrive, lane: Lane, simulated: SimulatedDrive, decode: JsonObject
) -> TraceResult:
    """The server's answer against what was simulated."""
    t_s = simulated.trace.t_s
    speed_kmh = 3.6 * LENGTH_M / float(t_s[-1] - t_s[0])
    result = TraceResult(drive.name, drive.clearance_m, speed_kmh, drive.wrong_way, len(built.tags))
    _judge_magnets(result, simulated, decode["magnets"])
    _judge_tags(result, built, lane, simulated, decode["tags"])
    for style in ("dashed", "solid"):
        result.departures[style] = _judge_departures(style, simulated.magnets, decode["crossings"])
    return result


def _pack(drive: SimulatedDrive) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, data in write_recorder_files(drive.trace).items():
            archive.writestr(name, data)
    return packed.getvalue()


def _upload(client: httpx.Client, recording: bytes, context: JsonObject) -> dict[str, object]:
    body = json.dumps(context).encode()
    parts = {"file": ("drive.zip", recording, "application/zip"), "context": ("context", body, "application/json")}
    decode: dict[str, object] = checked(client.post("/v1/decodes", files=parts)).json()
    deadline = time.monotonic() + _WAIT_S
    while decode["state"] in ("queued", "running") and time.monotonic() < deadline:
        time.sleep(0.2)
        decode = checked(client.get(f"/v1/decodes/{decode['id']}")).json()
    if decode["state"] != "done":
        raise Unavailable(f"the decode of a drive is {decode['state']}: {decode['error']}")
    return decode


def _judge_magnets(result: TraceResult, drive: SimulatedDrive, readings: Sequence[JsonObject]) -> None:
    """Assign the nearest reading to each magnet under the bar; others are false, except at magnets beside the bar."""
    left = list(readings)
    beside = [magnet for magnet in drive.magnets if abs(magnet.lateral_cm) > _UNDER_CM]
    for magnet in drive.magnets:
        if abs(magnet.lateral_cm) > _UNDER_CM:
            continue
        result.passed += 1
        if near := [r for r in left if _is_near(r, magnet)]:
            nearest = min(near, key=lambda r: abs(r["t_s"] - magnet.t_s))
            left.remove(nearest)
            kind = (str(magnet.polarity), int(magnet.orientation))
            result.found += (nearest["polarity"], nearest["phi_deg"]) == kind
    result.false = sum(not any(_is_near(r, magnet) for magnet in beside) for r in left)


def _is_near(reading: JsonObject, magnet: TrueMagnet) -> bool:
    off_m = abs(reading["t_s"] - magnet.t_s) * magnet.speed_m_s
    return off_m < _REACH_M and bool(abs(reading["lateral_cm"] - magnet.lateral_cm) < 100 * _REACH_M)


def _judge_tags(
    result: TraceResult, built: Built, lane: Lane, drive: SimulatedDrive, readings: Sequence[JsonObject]
) -> None:
    markers = built.tags[::-1] if result.wrong_way else built.tags
    chainages_m = [tag.chainage_m for tag in drive.tags]
    claimed: list[dict[str, object]] = []
    for number, (marker, placed, at) in enumerate(zip(markers, drive.tags, chainages_m, strict=True)):
        magnets = [magnet for magnet in drive.magnets if magnet.tag == number]
        near = [r for r in readings if abs(r["start_s"] - magnets[0].t_s) * magnets[0].speed_m_s < 1.0]
        if not near:
            continue
        claimed += near
        reading = near[0]
        right = reading["tag"] == marker["code"]["text"]
        result.right += right
        result.wrong += not right and reading["tag"] is not None
        result.flagged += reading["direction"] == "wrong-way"
        match = reading["match"]
        result.matched += right and match is not None and match["marker_id"] == marker["id"]
        if right and not reading["missing"]:
            result.deviations += [a / b for a, b in zip(reading["ratios"], placed.tag.ratios, strict=True)]
        if fix := reading["fix"]:
            last = magnets[-1]
            # where the bar truly is at the fix's time: level with the last magnet, but for the error of that time
            ahead_m, left_m = lane.off_m(fix["lon_deg"], fix["lat_deg"], at + placed.tag.length_m)
            result.along_m.append(ahead_m - (fix["t_s"] - last.t_s) * last.speed_m_s)
            result.across_m.append(left_m + last.lateral_cm / 100)
    result.wrong += sum(reading["tag"] is not None for reading in readings if reading not in claimed)


def _judge_departures(
    style: str, magnets: Sequence[TrueMagnet], crossings: Sequence[JsonObject]
) -> tuple[int, int, int]:
    """True positives, actual departures, false positives."""
    under = [
        magnet
        for magnet in magnets
        if magnet.orientation is Orientation.UP
        and LineTag(magnet.polarity).style == style
        and abs(magnet.lateral_cm) <= _UNDER_CM
    ]
    starts = under[:1] + [b for a, b in pairwise(under) if b.t_s - a.t_s > _EPISODE_S]
    ends = [a for a, b in pairwise(under) if b.t_s - a.t_s > _EPISODE_S] + under[-1:]
    detected = [c for c in crossings if c["style"] == style]
    right = 0
    for start, end in zip(starts, ends, strict=True):
        side = "left" if start.lateral_cm >= 0 else "right"
        hits = [c for c in detected if c["side"] == side and start.t_s - _EPISODE_S < c["t_s"] < end.t_s + _EPISODE_S]
        right += bool(hits)
        if hits:
            detected.remove(hits[0])
    return right, len(starts), len(detected)
