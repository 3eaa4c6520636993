"""Realistic surveys along four lanes: what a crew hands in, and what the registry holds beside it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import orjson
from pyproj import Transformer

from app.surveys.georeference import east_north_m
from app.values import Floats

ROUTES = Path(__file__).parents[1] / "cerpm" / "routes"
LANES = ("karlsruhe_low_1", "karlsruhe_moderate_1", "tfhrc_bend_1", "tfhrc_low_1")
EVIDENCE = ("plan", "beside", "area", "none")
"""What there is to check a survey against: the plan it measures, markers beside it, a declared area, nothing."""
_GEOID_M = {"k": 48.2, "t": -33.1}
_GROUND_M = {"k": 115.0, "t": 62.0}
_M_PER_DEG = 111_195.0
CRSS = {
    "k": ("EPSG:4326", "EPSG:25832", "EPSG:32632"),
    "t": ("EPSG:4326", "EPSG:26918", "EPSG:6347", "EPSG:6593"),
}
SPACINGS_M = (8.0, 12.0, 24.0)


@dataclass(frozen=True)
class Survey:
    """A survey before it is written: values in the declared CRS, and what is registered."""

    lane: str
    evidence: str
    crs: str
    lon_deg: Floats
    lat_deg: Floats
    height_m: Floats
    geoid_m: float
    codes: list[str]
    first: Floats
    second: Floats
    declaration: dict[str, Any]
    registered: list[tuple[str, float, float, float]] = field(default_factory=list)

    @property
    def projected(self) -> bool:
        """Whether the coordinates are easting and northing."""
        return self.crs != "EPSG:4326"

    def with_values(self, **values: Any) -> Survey:
        """The survey with other values."""
        return replace(self, **values)

    def cells(self) -> list[list[str]]:
        """Rows of text: code, first, second, height."""
        places = 4 if self.projected else 9
        return [
            [code, f"{x:.{places}f}", f"{y:.{places}f}", f"{h:.3f}"]
            for code, x, y, h in zip(self.codes, self.first, self.second, self.height_m, strict=True)
        ]

    def csv(self, rows: list[list[str]] | None = None, *, delimiter: str = ",", header: bool = True) -> bytes:
        """The file."""
        names = ["number", "easting", "northing", "height"] if self.projected else ["number", "lon", "lat", "height"]
        lines = [names, *(rows or self.cells())] if header else (rows or self.cells())
        return "\n".join(delimiter.join(line) for line in lines).encode() + b"\n"


def make_survey(rng: np.random.Generator, lane: str, evidence: str, crs: str | None = None) -> Survey:
    """A clean survey of a lane's boundary markers."""
    left, right = (_boundary(lane, side) for side in "LR")
    spacing_m = float(rng.choice(SPACINGS_M))
    lines = [_stations(line, spacing_m, rng) for line in (left, right)]
    both = evidence != "beside" and bool(rng.integers(2))
    if both and rng.integers(2):
        count = min(len(line) for line in lines)
        points = np.stack([line[:count] for line in lines], axis=1).reshape(-1, 2)
    else:
        points = np.concatenate(lines) if both else lines[0]
    points = points + rng.normal(0, 0.012, points.shape) / _M_PER_DEG
    key = lane[0]
    height_m = _heights(points, key) + rng.normal(0, 0.015, len(points))
    crs = crs or str(rng.choice(CRSS[key]))
    first, second = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(points[:, 0], points[:, 1])
    start = int(rng.integers(1, 9000))
    codes = [str(start + k) for k in range(len(points))]
    declaration: dict[str, Any] = {
        "crs": crs,
        "family": "cerpm",
        "vertical_datum": "ellipsoid",
        "height_unit": "m",
        "columns": {"code": "number"},
    }
    registered: list[tuple[str, float, float, float]] = []
    if evidence == "plan":
        planned = points + rng.normal(0, 0.015, points.shape) / _M_PER_DEG
        registered = _rows(codes, planned, _heights(points, key))
        declaration |= {"compare": True, "tolerance_m": 0.15}
    elif evidence == "beside":
        others = lines[1]
        registered = _rows([str(20_000 + k) for k in range(len(others))], others, _heights(others, key))
    elif evidence == "area":
        margin = 0.004
        box = [*(points.min(axis=0) - margin), *(points.max(axis=0) + margin)]
        declaration["area_deg"] = tuple(float(v) for v in box)
    return Survey(
        lane, evidence, crs, points[:, 0], points[:, 1], height_m, _GEOID_M[key], codes,
        np.asarray(first), np.asarray(second), declaration, registered,
    )  # fmt: skip


def _rows(codes: list[str], points: Floats, height_m: Floats) -> list[tuple[str, float, float, float]]:
    return [(code, float(p[0]), float(p[1]), float(h)) for code, p, h in zip(codes, points, height_m, strict=True)]


def _boundary(lane: str, side: str) -> Floats:
    document = orjson.loads((ROUTES / f"{lane}.geojson").read_bytes())
    feature = next(f for f in document["features"] if f["properties"]["side"] == side)
    return np.array(feature["geometry"]["coordinates"], dtype=np.float64)[:, :2]


def _stations(line: Floats, spacing_m: float, rng: np.random.Generator) -> Floats:
    """Points every `spacing_m` along a line, with a gap or two where a junction is."""
    east, north = east_north_m(line[:, 0], line[:, 1], (float(line[0, 0]), float(line[0, 1])))
    chainage = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(east), np.diff(north)))])
    stations = np.arange(rng.uniform(0, spacing_m), chainage[-1], spacing_m)
    if len(stations) > 12 and rng.integers(2):
        at = int(rng.integers(4, len(stations) - 6))
        stations = np.delete(stations, [at, at + 1])
    return np.column_stack([np.interp(stations, chainage, line[:, k]) for k in (0, 1)])


def _heights(points: Floats, key: str) -> Floats:
    """Ellipsoidal heights of a road that falls by 2 %."""
    east, north = east_north_m(points[:, 0], points[:, 1], (float(points[0, 0]), float(points[0, 1])))
    return np.asarray(_GROUND_M[key] + _GEOID_M[key] + 0.02 * east + 0.8 * np.sin(north / 90.0))
