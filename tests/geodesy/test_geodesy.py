"""Positions as they are given, and how far the systems are apart according to those who keep them."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from pyproj import Geod, Transformer

from app.errors import InvalidParameter, ReferenceSystemError
from app.geodesy import (
    LocalizationGrade,
    PlacedPosition,
    normalize_crs,
    place_position,
    place_positions,
    use_grids,
)

MICHIGAN = (-84.5, 42.7)
CM, DM, M, UNFIT = LocalizationGrade


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
    assert placed.transform_accuracy_m is not None


def test_nad83_without_an_epoch_is_not_taken_for_wgs84() -> None:
    placed = place_position(*MICHIGAN, crs="EPSG:6318")
    assert (placed.grade, placed.realization, placed.epoch) == (CM, "ITRF2014", 2020.0)
    assert placed.transform_accuracy_m == pytest.approx(0.02)  # ten years of motion within the plate
    assert "state the epoch" in (placed.note or "")
    california = place_position(-118.2, 34.0, crs="EPSG:6318")
    assert california.transform_accuracy_m == pytest.approx(0.3)
    assert california.grade is DM


@pytest.mark.parametrize(("epoch", "shift_m"), [(2010.0, 1.12), (2025.0, 1.30)])
def test_nad83_with_an_epoch_moves_by_the_plate_motion(epoch: float, shift_m: float) -> None:
    placed = place_position(*MICHIGAN, 250.0, crs="EPSG:6319", epoch=epoch)
    assert (placed.grade, placed.epoch) == (CM, epoch)
    assert placed.realization == "ITRF2014"
    assert _shift_m(placed, *MICHIGAN) == pytest.approx(shift_m, abs=0.02)
    assert placed.height_m == pytest.approx(248.9, abs=0.02)


def test_a_height_above_another_datum_is_kept() -> None:
    placed = place_position(*MICHIGAN, 250.0, crs="EPSG:6318", epoch=2025.0, ellipsoidal_height=False)
    assert placed.height_m == 250.0
    assert _shift_m(placed, *MICHIGAN) == pytest.approx(1.31, abs=0.01)


def test_a_realization_that_contradicts_the_crs_is_unfit() -> None:
    assert place_position(*MICHIGAN, crs="EPSG:4326", realization="NAD83(2011)").grade is UNFIT
    assert place_position(*MICHIGAN, crs="EPSG:4326", realization="ITRF2020", epoch=2026.0).grade is CM


def test_hong_kong_1980_states_only_a_metre() -> None:
    placed = place_position(836694.05, 819069.80, crs="EPSG:2326", projected=True)
    # Explanatory Notes on Geodetic Datums in Hong Kong (Survey and Mapping Office): the grid's origin is
    # 22 18 43.68 N, 114 10 42.80 E in HK80; WGS 84 is HK80 - 5.5" in latitude and + 8.8" in longitude
    assert placed.lon_deg == pytest.approx(114 + 10 / 60 + (42.80 + 8.8) / 3600, abs=2e-5)
    assert placed.lat_deg == pytest.approx(22 + 18 / 60 + (43.68 - 5.5) / 3600, abs=2e-5)
    assert placed.grade is UNFIT


def test_the_stated_accuracy_has_to_be_good_enough() -> None:
    gulf = (-90.0, 27.0)
    placed = place_position(*gulf, crs="EPSG:4269", epoch=2025.0)  # NAD83 of 1986: EPSG states 1 m, offshore there
    assert placed.grade is UNFIT
    assert "states 1 m, the limit is 0.1 m" in (placed.note or "")
    coarse = place_position(*gulf, crs="EPSG:4269", epoch=2025.0, accuracy_m=1.0)
    assert (coarse.grade, coarse.transform_accuracy_m) == (M, 1.0)


def test_a_transformation_states_nothing_outside_the_area_that_it_is_made_for() -> None:
    """What EPSG states of the Gulf of Mexico is no bound in Michigan, though PROJ computes it there."""
    placed = place_position(*MICHIGAN, crs="EPSG:4269", epoch=2025.0, accuracy_m=1.0)
    assert (placed.grade, placed.transform_accuracy_m) == (UNFIT, None)
    assert "is made for this place" in (placed.note or "")
    many = place_positions(*(np.array([v, v]) for v in (*MICHIGAN, np.nan)), crs="EPSG:4269", epoch=2025.0)
    assert (many.grade, many.transform_accuracy_m) == (UNFIT, None)


def test_utm_on_wgs84_is_unprojected() -> None:
    placed = place_position(500_000.0, 0.0, crs="EPSG:32650", projected=True, realization="ITRF2020", epoch=2026.0)
    assert (placed.lon_deg, placed.lat_deg) == pytest.approx((117.0, 0.0), abs=1e-12)
    assert placed.grade is CM


@pytest.mark.parametrize("crs", ["EPSG:4277", "EPSG:4267", "EPSG:4269"])
def test_systems_without_a_bound_are_unfit(crs: str) -> None:
    lon_lat = (-1.5, 52.0) if crs == "EPSG:4277" else MICHIGAN
    assert place_position(*lon_lat, crs=crs).grade is UNFIT


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


# --- what PROJ does without a word --------------------------------------------------------------------------------


def test_the_null_shift_of_nad83_never_passes_for_a_position() -> None:
    """PROJ itself moves NAD83(2011) to WGS 84 by nothing at all; the frames are over a metre apart."""
    naive = Transformer.from_crs("EPSG:6318", "EPSG:4326", always_xy=True).transform(*MICHIGAN)
    assert Geod(ellps="GRS80").inv(*MICHIGAN, *naive)[2] == 0.0
    assert _shift_m(place_position(*MICHIGAN, crs="EPSG:6318"), *MICHIGAN) > 1.2
    moved = place_position(*MICHIGAN, crs="EPSG:6318", epoch=2025.0)
    assert (moved.grade, moved.realization, moved.transform_accuracy_m) == (CM, "ITRF2014", 0.0)
    assert _shift_m(moved, *MICHIGAN) > 1.2


def test_the_silent_epoch_never_passes_for_one() -> None:
    """PROJ fills in 2010 where no epoch is given: 27 cm from 2025 in Michigan. Here the epoch is in the result."""
    to_itrf = Transformer.from_crs("EPSG:6318", "EPSG:9000", always_xy=True)
    silent = to_itrf.transform(*MICHIGAN)[:2]
    assert silent == pytest.approx(to_itrf.transform(*MICHIGAN, 0.0, 2010.0)[:2], abs=1e-12)
    said = place_position(*MICHIGAN, crs="EPSG:6318", epoch=2025.0)
    assert _shift_m(said, *silent) == pytest.approx(0.27, abs=0.02)
    unstated = place_position(*MICHIGAN, crs="EPSG:6318")
    assert (unstated.lon_deg, unstated.lat_deg) == to_itrf.transform(*MICHIGAN, 0.0, 2020.0)[:2]
    many = place_positions(*(np.array([v]) for v in (*MICHIGAN, np.nan)), crs="EPSG:6318")
    assert (many.lon_deg[0], many.epoch, many.note) == (unstated.lon_deg, 2020.0, unstated.note)


def test_a_projected_survey_is_as_accurate_as_its_longitudes_and_latitudes() -> None:
    """ETRS89 / UTM zone 32N: its bound is that of ETRS89, and ITRF2014 is 0.8 m from it in 2025."""
    east, north = Transformer.from_crs("EPSG:4258", "EPSG:25832", always_xy=True).transform(8.4, 49.0)
    placed = place_position(east, north, crs="EPSG:25832", projected=True, epoch=2025.0)
    direct = place_position(8.4, 49.0, crs="EPSG:4258", epoch=2025.0)
    assert (placed.grade, placed.transform_accuracy_m) == (DM, 0.1)
    assert (placed.lon_deg, placed.lat_deg) == pytest.approx((direct.lon_deg, direct.lat_deg), abs=1e-10)
    assert _shift_m(placed, 8.4, 49.0) == pytest.approx(0.85, abs=0.1)
    assert "ETRS89" in (placed.note or "")
    many = place_positions(*(np.array([v, v]) for v in (east, north, np.nan)), crs="EPSG:25832", epoch=2025.0)
    assert many.lon_deg.tolist() == [placed.lon_deg] * 2


def test_systems_that_proj_knows_no_operation_from_are_flagged() -> None:
    placed = place_position(-60.0, -10.0, crs="EPSG:4618")  # SAD69: pyproj raises an IndexError here
    assert placed.grade is UNFIT
    assert "no transformation with a stated accuracy" in (placed.note or "")


# --- grids of an operator -----------------------------------------------------------------------------------------

GRID = "au_icsm_GDA94_GDA2020_conformal_and_distortion.tif"
SHIFT_ARCSEC = 0.054
SYDNEY = (151.2, -33.9)


def ntv2(south: float, north: float, west: float, east: float) -> bytes:
    """A grid in NTv2 that moves every place by the same angle north and east; PROJ looks at contents, not at names."""

    def record(key: str, value: bytes) -> bytes:
        return key.ljust(8).encode() + value.ljust(8, b"\0")

    def whole(value: int) -> bytes:
        return struct.pack("<i", value)

    step = 3600.0
    rows, columns = round(north - south) + 1, round(east - west) + 1
    sides = {
        "S_LAT": south * step, "N_LAT": north * step, "E_LONG": -east * step, "W_LONG": -west * step,
        "LAT_INC": step, "LONG_INC": step,
    }  # fmt: skip
    head = [
        record("NUM_OREC", whole(11)), record("NUM_SREC", whole(11)), record("NUM_FILE", whole(1)),
        record("GS_TYPE", b"SECONDS "), record("VERSION", b"test    "), record("SYSTEM_F", b"GDA94   "),
        record("SYSTEM_T", b"GDA2020 "), *(record(k, struct.pack("<d", v)) for k, v in
        (("MAJOR_F", 6378137.0), ("MINOR_F", 6356752.314), ("MAJOR_T", 6378137.0), ("MINOR_T", 6356752.314))),
        record("SUB_NAME", b"TEST    "), record("PARENT", b"NONE    "), record("CREATED", b"20260101"),
        record("UPDATED", b"20260101"), *(record(k, struct.pack("<d", v)) for k, v in sides.items()),
        record("GS_COUNT", whole(rows * columns)),
    ]  # fmt: skip
    node = struct.pack("<4f", SHIFT_ARCSEC, -SHIFT_ARCSEC, 0.0, 0.0)
    return b"".join([*head, node * (rows * columns), record("END", b"")])


@pytest.fixture
def grids(tmp_path: Path) -> Iterator[Path]:
    (tmp_path / GRID).write_bytes(ntv2(-38.0, -30.0, 145.0, 155.0))
    use_grids(tmp_path)
    yield tmp_path
    use_grids(None)


def test_a_grid_that_an_operator_adds_makes_positions_accurate(grids: Path) -> None:
    placed = place_position(*SYDNEY, crs="EPSG:4283", epoch=2020.0)
    assert (placed.grade, placed.realization) == (CM, "ITRF2014")
    assert placed.transform_accuracy_m == pytest.approx(0.07, abs=0.02)  # releases of EPSG's table differ
    turned = SHIFT_ARCSEC / 3600
    # at 2020.0 GDA2020 is ITRF2014 by its definition
    assert (placed.lon_deg, placed.lat_deg) == pytest.approx((SYDNEY[0] + turned, SYDNEY[1] + turned), abs=1e-9)
    many = place_positions(*(np.array([v, v]) for v in (*SYDNEY, np.nan)), crs="EPSG:4283", epoch=2020.0)
    assert many.lon_deg.tolist() == [placed.lon_deg] * 2


def test_a_grid_reaches_no_further_than_it_goes(grids: Path) -> None:
    perth = place_position(115.9, -32.0, crs="EPSG:4283", epoch=2020.0)
    assert perth.grade is UNFIT
    assert "does not reach" in (perth.note or "")


def test_without_its_grid_a_system_is_flagged_again(grids: Path) -> None:
    assert place_position(*SYDNEY, crs="EPSG:4283", epoch=2020.0).grade is CM
    use_grids(None)
    assert place_position(*SYDNEY, crs="EPSG:4283", epoch=2020.0).grade is UNFIT
