"""Every limit is refused with a message that names it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from app.encoders.plate import BundleOptions, PlateOrder, encode_sheets, write_bundle
from app.errors import CodeMismatch, InvalidParameter
from app.markers.plate import PlateCode, PlateGeometry


@pytest.mark.parametrize(
    ("values", "field", "limit", "words"),
    [
        ({"n": 7}, "n", "8, 10 or 12", "8, 10 or 12"),
        ({"unit_mm": 19.9}, "unit_mm", "20 to 50 mm", "2-5 cm"),
        ({"unit_mm": 50.1}, "unit_mm", "20 to 50 mm", "2-5 cm"),
        ({"gap_mm": 1.9}, "gap_mm", "2 to 10 mm", "0.2-1 cm"),
        ({"gap_mm": 10.1}, "gap_mm", "2 to 10 mm", "0.2-1 cm"),
        ({"thickness_mm": 4.9}, "thickness_mm", "5 to 50 mm", "0.5-5 cm"),
        ({"thickness_mm": 50.1}, "thickness_mm", "5 to 50 mm", "0.5-5 cm"),
        ({"n": 12, "unit_mm": 40.0}, "side_mm", "150 to 500 mm", "15-50 cm"),
        ({"unit_mm": float("nan")}, "unit_mm", "20 to 50 mm", "2-5 cm"),
    ],
)
def test_a_geometry_outside_the_papers_limits_is_refused(
    values: dict[str, Any], field: str, limit: str, words: str
) -> None:
    with pytest.raises(InvalidParameter, match=words) as caught:
        PlateGeometry(**values)
    assert (caught.value.field, caught.value.limit) == (field, limit)


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"plate_id": ""}, "plate_id"),
        ({"plate_id": "x" * 65}, "plate_id"),
        ({"plate_id": "a\nb"}, "plate_id"),
        ({"plate_id": "a\ud800"}, "plate_id"),
        ({"plate_id": " padded "}, "plate_id"),
        ({"crs": "x" * 81}, "crs"),
        ({"record_url": "https://waymark.example/路"}, "record_url"),
        ({"record_url": "u" * 151}, "record_url"),
        ({"revision": 0}, "revision"),
        ({"lat_deg": None}, "position"),
        ({"lon_deg": 180.1}, "position.lon_deg"),
        ({"lat_deg": float("nan")}, "position.lat_deg"),
        ({"geometry": PlateGeometry(10)}, "geometry.n"),
    ],
)
def test_an_order_that_cannot_be_made_is_refused(
    values: dict[str, Any], field: str, make_order: Callable[..., PlateOrder]
) -> None:
    with pytest.raises(InvalidParameter) as caught:
        make_order(**values)
    assert caught.value.field == field
    assert caught.value.limit


def test_a_sheet_too_small_names_what_it_needs(make_order: Callable[..., PlateOrder]) -> None:
    with pytest.raises(InvalidParameter, match="needs 365 mm") as caught:
        encode_sheets([make_order()], width_mm=364.9, height_mm=1000)
    assert caught.value.field == "sheet.width_mm"
    assert caught.value.limit == "365 to 5000 mm"
    with pytest.raises(InvalidParameter) as caught:
        encode_sheets([make_order()], width_mm=1000, height_mm=float("nan"))
    assert caught.value.field == "sheet.height_mm"
    with pytest.raises(InvalidParameter, match="no plate"):
        encode_sheets([], width_mm=1000, height_mm=1000)


def test_a_bundle_needs_plates_and_formats(make_order: Callable[..., PlateOrder], tmp_path: Any) -> None:
    with (tmp_path / "x.zip").open("wb") as target:
        with pytest.raises(InvalidParameter, match="0 plates") as caught:
            write_bundle([], target)
        assert caught.value.limit == "1 to 10000 plates"
        with pytest.raises(InvalidParameter, match="format"):
            write_bundle([make_order()], target, options=BundleOptions(formats=()))


def test_position_plates_group_their_digits_by_axis(make_order: Callable[..., PlateOrder]) -> None:
    assert make_order().grouped_digits == "023792 168411"
    assert make_order(PlateCode.from_registry_number(0x12345678)).grouped_digits.startswith("1234 5678 ")


def test_blank_faces_are_refused() -> None:
    with pytest.raises(CodeMismatch, match="no unit is dark") as caught:
        PlateOrder("blank", PlateCode("0" * 12), PlateGeometry())
    assert caught.value.field == "digits"
