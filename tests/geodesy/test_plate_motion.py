"""Velocities of the ground against those that others publish, and positions moved to another epoch."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest
from pyproj import Geod, Transformer

from app.geodesy import decimal_year, move_to_epoch, plate_motion

GEOD = Geod(ellps="GRS80")
PLACES = {
    "ANTA": (0.0, -85.0), "ARAB": (46.7, 24.7), "AUST": (133.0, -25.0), "EURA": (8.4, 49.0), "INDI": (78.0, 15.0),
    "NAZC": (-95.0, -20.0), "NOAM": (-84.5, 42.7), "NUBI": (10.0, 15.0), "PCFC": (-158.0, 21.3),
    "SOAM": (-47.0, -15.0), "SOMA": (45.0, 5.0),
}  # fmt: skip


@pytest.mark.parametrize("plate", PLACES)
def test_velocities_are_those_that_proj_has_for_the_plate(plate: str) -> None:
    """PROJ's file ITRF2014 has the model's angular velocities; ten years of it in Cartesian coordinates."""
    lon, lat = PLACES[plate]
    cart = "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=GRS80"
    back = "+step +inv +proj=cart +ellps=GRS80 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    pipeline = Transformer.from_pipeline(f"{cart} +step +init=ITRF2014:{plate} +t_epoch=2010 {back}")
    expected = pipeline.transform(lon, lat, 0.0, 2020.0)
    moved = move_to_epoch(lon, lat, 2010.0, 2020.0)
    assert GEOD.inv(moved.lon_deg[0], moved.lat_deg[0], *expected[:2])[2] < 1e-4
    assert moved.accuracy_m[0] == pytest.approx(0.02)  # inside a plate: 2 mm a year


def test_karlsruhe_moves_as_etrs89_does() -> None:
    """ETRF2014 is fixed to the Eurasian plate by EUREF: EPSG:8366 from ITRF2014, between 2015 and 2026."""
    to_itrf = Transformer.from_crs("EPSG:8403", "EPSG:7912", always_xy=True)
    then, now = (to_itrf.transform(8.4, 49.0, 0.0, epoch)[:2] for epoch in (2015.0, 2026.0))
    assert GEOD.inv(*then, *now)[2] == pytest.approx(0.27, abs=0.01)
    moved = move_to_epoch(*then, 2015.0, 2026.0)
    assert GEOD.inv(moved.lon_deg[0], moved.lat_deg[0], *now)[2] < 0.003


@pytest.mark.parametrize(
    ("crs", "lon", "lat", "limit_m"),
    [
        ("EPSG:7843", 151.2, -33.9, 0.001),  # GDA2020: the Australian plate by Geoscience Australia
        ("EPSG:6319", -84.5, 42.7, 0.002),  # NAD83(2011): the North American plate by NGS
        ("EPSG:6319", -97.0, 32.8, 0.002),
    ],
)
def test_plate_fixed_frames_move_like_their_plate(crs: str, lon: float, lat: float, limit_m: float) -> None:
    """Rates of transformations that national agencies publish, apart from the ITRF's own model. [m/year]"""
    to_itrf = Transformer.from_crs(crs, "EPSG:7912", always_xy=True)
    then, now = (to_itrf.transform(lon, lat, 0.0, epoch)[:2] for epoch in (2020.0, 2030.0))
    moved = move_to_epoch(*then, 2020.0, 2030.0)
    assert GEOD.inv(moved.lon_deg[0], moved.lat_deg[0], *now)[2] / 10 < limit_m


@pytest.mark.parametrize(
    ("lon", "lat", "accuracy_m"),
    [(8.4, 49.0, 0.002), (12.5, 41.9, 0.01), (114.2, 22.3, 0.01), (23.7, 38.0, 0.03), (-118.2, 34.0, 0.03),
     (139.7, 35.7, 0.03), (174.8, -41.3, 0.03), (-180.0, 90.0, 0.002), (180.0, -90.0, 0.002)],
)  # fmt: skip
def test_velocities_are_less_certain_where_plates_meet(lon: float, lat: float, accuracy_m: float) -> None:
    motion = plate_motion(lon, lat)
    assert motion.accuracy_m[0] == accuracy_m
    assert 0.0 < motion.speed_m[0] < 0.12


def test_an_array_moves_like_its_places() -> None:
    lon, lat = (np.array(values) for values in zip(*PLACES.values(), strict=True))
    moved = move_to_epoch(lon, lat, np.full(len(lon), 2010.0), 2026.5)
    for k in range(len(lon)):
        one = move_to_epoch(lon[k], lat[k], 2010.0, 2026.5)
        assert (one.lon_deg[0], one.lat_deg[0]) == (moved.lon_deg[k], moved.lat_deg[k])
    back = move_to_epoch(moved.lon_deg, moved.lat_deg, 2026.5, 2010.0)
    assert GEOD.inv(back.lon_deg, back.lat_deg, lon, lat)[2] == pytest.approx(np.zeros(len(lon)), abs=1e-5)


def test_decimal_years() -> None:
    assert decimal_year(datetime(2026, 1, 1, tzinfo=UTC)) == 2026.0
    assert decimal_year(datetime(2024, 7, 2, tzinfo=UTC)) == 2024.5  # the 184th of 366 days begins
