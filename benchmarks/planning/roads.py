"""Roads of the benchmarks: generated two-lane roads as GeoJSON files, and the lanes of benchmarks/planning/data."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import orjson
from pyproj import Geod

from app.families import rows_of_plan
from app.formats.alignments.read import read_alignment
from app.planning.alignment import Alignment
from app.planning.build_alignment import build_alignment
from app.planning.plan import Plan
from app.planning.proof import ProofTerms
from app.planning.proof.drives import START
from app.planning.proof.prove import Prover
from app.planning.rules import RoadRules
from app.values import Floats

DATA = Path(__file__).parent / "data"
LANES = ("karlsruhe_low_1", "karlsruhe_moderate_1", "tfhrc_bend_1", "tfhrc_low_1")
"""Names of the real lanes."""
START_DEG = (8.4, 49.0)
_GEOD = Geod(ellps="WGS84")
_STEP_M = 2.0  # [m] between vertices, about; the sagitta at a radius of 60 m is 8 mm
_WIDTH_M = 3.5  # [m] of a lane
_MAX_STEPS = 5  # of 2 m, between vertices of digitised boundaries; by hand
_SIGNS_EVERY_M, _JUNCTIONS_EVERY_M = 1500.0, 4000.0  # [m] as on a rural road


class Roughness(NamedTuple):
    """Of digitised boundaries: standard deviation of their vertices from smooth lines [m], and the seed."""

    sd_m: float
    seed: int


def real_lane(name: str, rules: RoadRules | None = None) -> Alignment:
    """A lane of benchmarks/planning/data."""
    file = read_alignment((DATA / f"{name}.geojson").read_bytes(), f"{name}.geojson")
    return build_alignment(file, rules, name=name)


def generated_road(
    length_m: float, seed: int, *, radii_m: tuple[float, float], rules: RoadRules, rough_m: float = 0.0
) -> Alignment:
    """A generated two-lane road as an alignment."""
    speed_kmh = rules.design_speed_kmh or 80.0
    data = generated_file(length_m, seed, radii_m=radii_m, speed_kmh=speed_kmh, rough_m=rough_m)
    return build_alignment(read_alignment(data, "road.geojson"), rules, name=f"generated-{seed}")


def generated_file(
    length_m: float, seed: int, *, radii_m: tuple[float, float], speed_kmh: float = 80.0, rough_m: float = 0.0
) -> bytes:
    """A two-lane road as a GeoJSON file: centre lines or boundaries of both lanes, speed limits and junctions.

    Parameters
    ----------
    length_m : float
        Of the road. [m]
    seed : int
    radii_m : (float, float)
        Least and greatest radius of the bends; arcs have clothoids of a third of their length at both ends. [m]
    speed_kmh : float
        Limit of both lanes. [km/h]
    rough_m : float
        Standard deviation of the boundaries from smooth lines, as digitised ones have it; 0: centre lines. [m]
    """
    step_m = length_m / round(length_m / _STEP_M)
    curvature = _curvature(length_m, step_m, np.random.default_rng((seed, 13)), radii_m)
    heading = 90.0 - np.degrees(np.concatenate([[0.0], np.cumsum(curvature[1:] + curvature[:-1]) * step_m / 2]))
    lon, lat = _line(heading, step_m)
    right = _beside(lon, lat, heading, -_WIDTH_M / 2)
    left = _beside(lon, lat, heading, _WIDTH_M / 2)[::-1]
    features = [_lane("1", right, speed_kmh), _lane("2", left, speed_kmh)]
    if rough_m > 0:
        rough = Roughness(rough_m, seed)
        axis = (lon, lat, heading)
        features = [feature for name in ("1", "2") for feature in _boundaries(name, axis, speed_kmh, rough)]
    for every_m, kind, value in (
        (_SIGNS_EVERY_M, "speed_limit", speed_kmh),
        (_JUNCTIONS_EVERY_M, "junction", None),
    ):
        for at in np.arange(every_m, length_m - every_m / 2, every_m):
            k = round(at / step_m)
            for lane, line in (("1", right), ("2", left)):
                features.append(_point(kind, lane, line[k], value))
    return orjson.dumps({"type": "FeatureCollection", "features": features})


def _curvature(length_m: float, step_m: float, rng: np.random.Generator, radii_m: tuple[float, float]) -> Floats:
    """Curvature at every step: straights and bends that turn back towards the first direction. [1/m]"""
    parts: list[Floats] = []
    count, turned = 0, 0.0
    while count * step_m <= length_m:
        radius = math.exp(rng.uniform(*np.log(radii_m)))
        turn = rng.uniform(0.15, 0.9)  # [rad]
        sign = -math.copysign(1.0, turned) if abs(turned) > 0.3 else rng.choice([-1.0, 1.0])
        arc = max(round(radius * turn / step_m), 3)
        ramp = max(arc // 3, 1)
        shape = np.minimum(1.0, np.minimum(np.arange(1, arc + 1), np.arange(arc, 0, -1)) / ramp)
        bend = sign / radius * shape
        turned += float(bend.sum()) * step_m
        straight = np.zeros(round(rng.uniform(80.0, 500.0) / step_m))
        parts += [straight, bend]
        count += len(straight) + arc
    return np.concatenate(parts)[: round(length_m / step_m) + 1]


def _line(heading_deg: Floats, step_m: float) -> tuple[Floats, Floats]:
    """Positions of the axis, each of shape (N,). [deg]"""
    middle = (heading_deg[1:] + heading_deg[:-1]) / 2
    lon, lat = [START_DEG[0]], [START_DEG[1]]
    for azimuth in middle.tolist():
        x, y, _ = _GEOD.fwd(lon[-1], lat[-1], azimuth, step_m)
        lon.append(x)
        lat.append(y)
    return np.array(lon), np.array(lat)


def _beside(lon: Floats, lat: Floats, heading_deg: Floats, left_m: float | Floats) -> list[list[float]]:
    x, y, _ = _GEOD.fwd(lon, lat, heading_deg - 90.0, np.full(len(lon), left_m))
    return np.round(np.column_stack([x, y]), 9).tolist()  # type: ignore[no-any-return]


def _lane(name: str, line: list[list[float]], speed_kmh: float) -> dict[str, object]:
    properties = {
        "lane": name, "road": "generated", "width_m": _WIDTH_M, "speed_limit_kmh": speed_kmh, "left_style": "dashed",
        "right_style": "solid",
    }  # fmt: skip
    geometry = {"type": "LineString", "coordinates": line}
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def _boundaries(
    name: str, axis: tuple[Floats, Floats, Floats], speed_kmh: float, rough: Roughness
) -> list[dict[str, object]]:
    """Left and right boundary of a lane, each with deviations of its own; the axis is the left one of both lanes."""
    lon, lat, heading = axis
    rng = np.random.default_rng((rough.seed, 14, int(name)))
    sign = -1.0 if name == "1" else 1.0
    features = []
    for side, left_m in (("L", 0.0), ("R", sign * _WIDTH_M)):
        every = int(rng.integers(1, _MAX_STEPS + 1))
        kept = np.unique(np.append(np.arange(0, len(lon), every), len(lon) - 1))
        off_m = left_m + rough.sd_m * rng.standard_normal(len(kept))
        line = _beside(lon[kept], lat[kept], heading[kept], off_m)
        lane = _lane(name, line if name == "1" else line[::-1], speed_kmh)
        style = "dashed" if side == "L" else "solid"
        keep = ("lane", "road", "speed_limit_kmh")
        properties = {key: value for key, value in lane["properties"].items() if key in keep}  # type: ignore[attr-defined]
        features.append({**lane, "properties": {**properties, "side": side, "style": style}})
    return features


def _point(kind: str, lane: str, place: list[float], value: float | None) -> dict[str, object]:
    properties = {"kind": kind, "lane": lane, **({} if value is None else {"value": value})}
    return {"type": "Feature", "properties": properties, "geometry": {"type": "Point", "coordinates": place}}


def prover_of(plan: Plan, terms: ProofTerms) -> Prover:
    """The prover of a plan, with the rows that its commit stores."""
    return Prover(plan, terms, rows_of_plan(plan, START))
