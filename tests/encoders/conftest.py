"""Fixtures of the encoders' tests: orders to draw."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from app.encoders.plate import PlateOrder
from app.markers.plate import PlateCode, PlateGeometry

RECORD_URL = "https://waymark.example/v1/markers/3f0c8a52-6a0c-7d1e-9f52-0123456789ab"


@pytest.fixture
def make_order() -> Callable[..., PlateOrder]:
    """An order with the paper's example code, or another code or geometry."""

    def make(code: PlateCode | None = None, geometry: PlateGeometry | None = None, **fields: object) -> PlateOrder:
        code = code or PlateCode("023792168411")
        values: dict[str, object] = {
            "plate_id": "HK-000123",
            "record_url": RECORD_URL,
            "revision": 2,
            "lon_deg": 114.023792,
            "lat_deg": 22.168411,
            "crs": "EPSG:4326, ITRF2014 at epoch 2024.50",
        }
        return PlateOrder(code=code, geometry=geometry or PlateGeometry(n=code.n), **(values | fields))

    return make
