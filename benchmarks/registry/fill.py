"""A registry full of markers along roads, with rows as the product writes them.

One plate and one CERPM are registered through the use cases; what was stored of them is repeated along the roads
with ids, codes, places, headings and measures of its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import sqlalchemy as sa
from scipy.spatial import cKDTree

from app.families.cerpm import CerpmIn
from app.families.documents import PositionIn
from app.families.plate.plates import CodeInput, PlateIn
from app.markers.plate import PlateCode, PlateScheme
from app.markers.reading import MarkerRow
from app.registry.bulk_load import large_load, load_rows
from app.registry.column_types import new_id, row_of
from app.registry.database import Database
from app.registry.features import feature_text
from app.registry.marker_rows import markers
from app.services.access.access import Access, Caller, Scope
from app.services.markers.markers import Markers
from app.values import Floats

AREA_DEG = (6.0, 46.0, 4.0, 4.0)  # west, south, width, height: a country
SPACING_M = 25.0
PER_ROAD = 1000
CERPM_EVERY = 5
_CHUNK = 20_000
_COLUMNS = [column for column in markers.c if column.name not in ("row", "feature")]
_M_PER_DEG = 111_195.0
_SURVEY: dict[str, Any] = {
    "height_m": 212.345,
    "realization": "ITRF2014",
    "epoch": 2025.5,
    "vertical_datum": "ellipsoid",
    "horizontal_rmse_m": 0.012,
    "vertical_rmse_m": 0.02,
    "survey_method": "RTK, 3 epochs of 60 s",
}


@dataclass(frozen=True)
class Network:
    """Where the markers are, in the order of their ids; road k // PER_ROAD."""

    lon_deg: Floats
    lat_deg: Floats
    heading_deg: Floats

    def boxes_of(self, features: int, count: int, seed: int) -> list[tuple[float, float, float, float]]:
        """Boxes round random markers that hold so many of them: west, south, east, north. [deg]"""
        rng = np.random.default_rng(seed)
        places = np.column_stack((self.lon_deg, self.lat_deg))
        chosen = places[rng.integers(0, len(places), count)]
        far = np.asarray(cKDTree(places).query(chosen, k=features, p=np.inf)[0])[:, -1]
        return [
            (lon - d, lat - d, lon + d, lat + d) for (lon, lat), d in zip(chosen.tolist(), far.tolist(), strict=True)
        ]

    def places(self, count: int, seed: int) -> list[tuple[int, float, float]]:
        """Random markers: row, longitude, latitude. [deg]"""
        rows = np.random.default_rng(seed).integers(0, len(self.lon_deg), count)
        return [(int(k), float(self.lon_deg[k]), float(self.lat_deg[k])) for k in rows]


def lay_roads(count: int, seed: int = 1) -> Network:
    """Roads that begin anywhere in the country and wind, a marker every 25 m."""
    rng = np.random.default_rng(seed)
    roads = -(-count // PER_ROAD)
    west, south, width, height = AREA_DEG
    bend = rng.normal(0.0, 0.02, (roads, PER_ROAD)).cumsum(axis=1) * 0.1
    heading = rng.uniform(0, 2 * np.pi, (roads, 1)) + bend
    start = rng.uniform((west, south), (west + width, south + height), (roads, 2))
    lat = start[:, 1:] + (np.cos(heading) * SPACING_M / _M_PER_DEG).cumsum(axis=1)
    lon = start[:, :1] + (np.sin(heading) * SPACING_M / _M_PER_DEG / np.cos(np.radians(lat))).cumsum(axis=1)
    flat = [np.round(values.ravel()[:count], 9) for values in (lon, lat, np.degrees(heading) % 360.0)]
    return Network(*flat)


def fill(database: Database, network: Network) -> str:
    """Register the network's markers, all of one agency, without their histories; returns a key of it."""
    access = Access(database, lambda: datetime.now(UTC))
    key = access.create_key("roads", Scope.ADMIN, label="benchmark")
    caller = access.authenticate(key)
    templates = _register_templates(database, caller)
    with database.write(long=True) as connection, large_load(connection, (markers,), len(network.lon_deg)):
        for chunk in _chunks(templates, network, datetime.now(UTC) + timedelta(minutes=1)):
            load_rows(connection, markers, chunk)
    return key


def _register_templates(database: Database, caller: Caller) -> dict[str, dict[str, Any]]:
    """What the product stores of a plate and of a CERPM; the two stay in the registry, far from the roads."""
    use_cases = Markers(database, lambda: datetime.now(UTC))
    place = PositionIn(lon_deg=-30.0, lat_deg=-30.0, **_SURVEY)
    common: dict[str, Any] = {"status": "surveyed", "heading_deg": 90.0, "heading_rmse_deg": 0.5, "road": "A0"}
    common |= {"measure_m": 0.0, "offset_m": 1.75}
    use_cases.register(caller, PlateIn(position=place, code=CodeInput(scheme=PlateScheme.POSITION), **common))
    use_cases.register(caller, CerpmIn(family="cerpm", position=place, **common))
    with database.read() as connection:
        return {str(row["family"]): dict(row) for row in connection.execute(sa.select(*_COLUMNS)).mappings()}


def _chunks(templates: dict[str, dict[str, Any]], network: Network, now: datetime) -> Iterator[list[dict[str, Any]]]:
    total = len(network.lon_deg)
    for start in range(0, total, _CHUNK):
        part = slice(start, start + _CHUNK)
        places = zip(*(v[part].tolist() for v in (network.lon_deg, network.lat_deg, network.heading_deg)), strict=True)
        at = now + timedelta(milliseconds=start / _CHUNK)
        ids = sorted(new_id(at) for _ in range(min(_CHUNK, total - start)))
        rows = enumerate(zip(ids, places, strict=True), start)
        yield [_row(templates, k, marker_id, *place) for k, (marker_id, place) in rows]


def _row(
    templates: dict[str, dict[str, Any]], k: int, marker_id: str, lon_deg: float, lat_deg: float, heading_deg: float
) -> dict[str, Any]:
    template = templates["plate" if k % CERPM_EVERY else "cerpm"]
    digits = PlateCode.from_position(lon_deg, lat_deg).digits if k % CERPM_EVERY else str(k // CERPM_EVERY + 2)
    marker = {
        **template,
        "id": marker_id,
        "digits": digits,
        "lon_deg": lon_deg,
        "lat_deg": lat_deg,
        "heading_deg": round(heading_deg, 3),
        "road": f"A{k // PER_ROAD}",
        "measure_m": k % PER_ROAD * SPACING_M,
        "original": {**template["original"], "lon_deg": lon_deg, "lat_deg": lat_deg},
    }
    return {**marker, "feature": feature_text(row_of(MarkerRow, marker))}
