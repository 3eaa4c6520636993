"""A lane with a sharp bend, from a published map."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from app.roads.lane_line import LaneLine


@pytest.fixture(scope="session")
def bend_deg() -> list[list[float]]:
    """Longitude and latitude of the lane's line, which bends with a radius of about 20 m at chainage 70 to 80 m."""
    lane = json.loads((Path(__file__).parent / "data" / "bend.geojson").read_text())
    coordinates: list[list[float]] = lane["features"][0]["geometry"]["coordinates"]
    return coordinates


@pytest.fixture(scope="session")
def bend(bend_deg: list[list[float]]) -> LaneLine:
    """The same as a line in a local frame, on the ellipsoid."""
    return LaneLine.from_lon_lat(bend_deg)
