"""Positions as they are given, and how far the systems are apart according to those who keep them."""

from __future__ import annotations

import math

import pytest
from pyproj import Geod

from app.errors import InvalidParameter, ReferenceSystemError
from app.geodesy import LocalizationGrade, PlacedPosition, normalize_crs, place_position

MICHIGAN = (-84.5, 42.7)
EXACT, APPROXIMATE = LocalizationGrade.EXACT, LocalizationGrade.APPROXIMATE


def _shift_m(placed: PlacedPosition, lon_deg: float, lat_deg: float) -> float:
    return float(Geod(ellps="GRS80").inv(lon_deg, lat_deg, placed.lon_deg, placed.lat_deg)[2])


@pytest.mark.parametrize(
    "crs",
    [
        None,
        "EPSG:4326",
        "epsg:4326",
        "EPSG:4979",
        "OGC:CRS84",
        "urn:ogc:def:crs:OGC:1.3:CRS84",
        "urn:ogc:def:crs:EPSG::4326",
        "http://www.opengis.net/def/crs/EPSG/0/4326",
        "EPSG:9000",
        "EPSG:7912",
        "EPSG:9057",
    ],
)
def test_wgs84_and_itrf_are_kept_to_the_last_bit(crs: str | None) -> None:
    placed = place_position(114.179203123, 22.304161456, 5.2, crs=crs)
    assert (placed.lon_deg, placed.lat_deg, placed.height_m) == (114.179203123, 22.304161456, 5.2)
    assert placed.grade is EXACT
    assert placed.transform_accuracy_m == 0


def test_nad83_without_an_epoch_is_not_taken_for_wgs84() -> None:
    placed = place_position(*MICHIGAN, crs="EPSG:6318")
    assert placed.grade is APPROXIMATE
    assert placed.transform_accuracy_m is None
    assert "epoch" in (placed.note or "")


@pytest.mark.parametrize(("epoch", "shift_m"), [(2010.0, 1.12), (2025.0, 1.30)])
def test_nad83_with_an_epoch_moves_by_the_plate_motion(epoch: float, shift_m: float) -> None:
    placed = place_position(*MICHIGAN, 250.0, crs="EPSG:6319", epoch=epoch)
    assert placed.grade is EXACT
    assert placed.realization == "ITRF2014"
    assert _shift_m(placed, *MICHIGAN) == pytest.approx(shift_m, abs=0.02)
    assert placed.height_m == pytest.approx(248.9, abs=0.02)


def test_a_height_above_another_datum_is_kept() -> None:
    placed = place_position(*MICHIGAN, 250.0, crs="EPSG:6318", epoch=2025.0, ellipsoidal_height=False)
    assert placed.height_m == 250.0
    assert _shift_m(placed, *MICHIGAN) == pytest.approx(1.31, abs=0.01)


def test_a_realization_that_contradicts_the_crs_is_only_approximate() -> None:
    assert place_position(*MICHIGAN, crs="EPSG:4326", realization="NAD83(2011)").grade is APPROXIMATE
    assert place_position(*MICHIGAN, crs="EPSG:4326", realization="ITRF2020").grade is EXACT


def test_hong_kong_1980_states_only_a_metre() -> None:
    placed = place_position(836694.05, 819069.80, crs="EPSG:2326", projected=True)
    # Explanatory Notes on Geodetic Datums in Hong Kong (Survey and Mapping Office): the grid's origin is
    # 22 18 43.68 N, 114 10 42.80 E in HK80; WGS 84 is HK80 - 5.5" in latitude and + 8.8" in longitude
    assert placed.lon_deg == pytest.approx(114 + 10 / 60 + (42.80 + 8.8) / 3600, abs=2e-5)
    assert placed.lat_deg == pytest.approx(22 + 18 / 60 + (43.68 - 5.5) / 3600, abs=2e-5)
    assert placed.grade is APPROXIMATE


def test_the_stated_accuracy_has_to_be_good_enough() -> None:
    placed = place_position(*MICHIGAN, crs="EPSG:4269", epoch=2025.0)  # NAD83 of 1986: EPSG states 1 m
    assert placed.grade is APPROXIMATE
    assert "states 1 m, the limit is 0.1 m" in (placed.note or "")
    coarse = place_position(*MICHIGAN, crs="EPSG:4269", epoch=2025.0, accuracy_m=1.0)
    assert (coarse.grade, coarse.transform_accuracy_m) == (EXACT, 1.0)


def test_utm_on_wgs84_is_exact() -> None:
    placed = place_position(500_000.0, 0.0, crs="EPSG:32650", projected=True)
    assert (placed.lon_deg, placed.lat_deg) == pytest.approx((117.0, 0.0), abs=1e-12)
    assert placed.grade is EXACT


@pytest.mark.parametrize("crs", ["EPSG:4277", "EPSG:4267", "EPSG:4258", "EPSG:4269", "EPSG:8888"])
def test_systems_without_a_bound_or_an_epoch_are_flagged(crs: str) -> None:
    lon_lat = (-1.5, 52.0) if crs in ("EPSG:4277", "EPSG:4258") else MICHIGAN
    assert place_position(*lon_lat, crs=crs).grade is APPROXIMATE


@pytest.mark.parametrize(
    "crs",
    [
        "EPSG:999999",
        "EPSG:5703",
        "EPSG:4978",
        "EPSG:7405",
        "EPSG:0",
        "WGS84",
        "",
        "+proj=longlat +datum=WGS84",
        "+init=/etc/passwd:x",
        'GEOGCS["x"]',
        "EPSG:4326\x00",
        "EPSG:٤٣٢٦",
    ],
)
def test_unknown_systems_are_refused_by_name(crs: str) -> None:
    with pytest.raises(ReferenceSystemError) as caught:
        place_position(10.0, 50.0, crs=crs)
    assert caught.value.field == "position.crs"
    assert caught.value.limit
    assert caught.value.cure


def test_normalized_forms() -> None:
    assert normalize_crs("urn:ogc:def:crs:EPSG:9.9.1:2326") == "EPSG:2326"
    assert normalize_crs(" epsg:4326 ") == "EPSG:4326"


@pytest.mark.parametrize(
    ("lon", "lat"),
    [(181.0, 0.0), (0.0, 90.1), (math.nan, 0.0), (0.0, math.inf), (-181.0, 0.0), (22.3, 114.1)],
)
def test_degrees_out_of_range_are_refused(lon: float, lat: float) -> None:
    with pytest.raises(InvalidParameter):
        place_position(lon, lat)


def test_positions_outside_the_area_of_use_are_refused() -> None:
    with pytest.raises(InvalidParameter, match="area of use"):
        place_position(819069.80, 8_366_940.5, crs="EPSG:2326", projected=True)
    with pytest.raises(InvalidParameter, match="area of use"):
        place_position(10.0, 50.0, crs="EPSG:6318")


def test_degrees_in_a_projected_system_are_refused() -> None:
    with pytest.raises(InvalidParameter, match="easting_m"):
        place_position(114.1, 22.3, crs="EPSG:2326")
    with pytest.raises(InvalidParameter, match="lon_deg"):
        place_position(500_000.0, 0.0, crs="EPSG:4326", projected=True)
