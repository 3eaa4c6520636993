"""The demo's magnets: a codebook, tags and lines on a lane, and drives over them as the recorder's files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import numpy.typing as npt

from app.demo.server import checked
from app.errors import WaymarkError
from app.geodesy import enu_from_wgs84, wgs84_from_enu
from app.markers.magnet import InformationTag, LineStyle, Orientation, Polarity, parse_tag
from app.simulation.magnetic.clutter import Clutter
from app.simulation.magnetic.drive import Scene
from app.simulation.magnetic.road import PlacedTag, Road, RoadMagnet
from app.simulation.magnetic.vehicle import Course, Vehicle

LENGTH_M, BEND = 350.0, (150.0, 230.0, 260.0)
ORIGIN = (8.4133, 49.0058, 165.0)
HEADING_DEG = 294.0
LINES = {LineStyle.DASHED: 1.75, LineStyle.SOLID: -1.75}
STOP_LINE_M = 340.0
SURVEY_RMSE_M = 0.01
_KMH = 1 / 3.6
Floats = npt.NDArray[np.float64]

BOOK: dict[str, Any] = {
    "name": "Demo lane",
    "design": {"magnets": 3, "length_m": 4.0, "segment_m": 1.0},
    "rules": {"speed_mps": 13.9, "clearance_m": 0.3, "wrong_way_safe": True},
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
    """The lane as it is driven, the legal way or against it.

    Attributes
    ----------
    road : Road
    shift_m : ndarray, shape (2,)
        What leads from the road's world to east and north of `ORIGIN`. [m]
    """

    road: Road
    shift_m: Floats

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
    tags: list[dict[str, Any]] = field(default_factory=list)
    lines: list[dict[str, Any]] = field(default_factory=list)

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
        body = _body(built.lane, 0.0) | {"tag": tag, "site": {"design_speed_mps": 13.9, **ahead}}
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


def _body(lane: Lane, left_m: float) -> dict[str, Any]:
    coordinates = [lane.lon_lat(at, left_m) for at in np.arange(0.0, LENGTH_M + 0.5)]
    geometry = {"type": "LineString", "coordinates": coordinates}
    source = {"height_m": ORIGIN[2], "realization": "ITRF2014", "epoch": 2026.4, "horizontal_rmse_m": 0.02}
    return {"family": "magnet", "road": "Karlsruhe, magnet lane", "lane": {"geometry": geometry, **source}}


def _survey(client: httpx.Client, marker: dict[str, Any], rng: np.random.Generator) -> None:
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
