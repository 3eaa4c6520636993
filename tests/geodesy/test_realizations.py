"""Grades by realization and epoch, and how far realizations are apart according to those who keep them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pyproj import Geod, Transformer

from app.errors import ReferenceSystemError
from app.geodesy import LocalizationGrade, grade_accuracy, place_position, reference_system, total_accuracy_m
from app.geodesy.place import Origin, positions_in_system
from app.geodesy.systems import accuracy_of_global, normalize_vertical_datum

KARLSRUHE = (8.4, 49.0)
CM, DM, M, UNFIT = LocalizationGrade


@pytest.mark.parametrize(
    ("rmse_m", "frame", "grade", "cure"),
    [
        (12.0, {"realization": "ITRF2020", "epoch": 2025.4}, UNFIT, ""),
        (None, {"realization": "ITRF2020", "epoch": 2025.4}, UNFIT, ""),
        (0.02, {}, M, "state the realization"),
        (0.02, {"epoch": 2025.4}, M, "state the realization"),
        (0.02, {"realization": "WGS 84", "epoch": 2025.4}, M, "state the realization"),
        (0.02, {"realization": "ITRF2014"}, DM, "state the epoch"),
        (0.02, {"crs": "EPSG:7912"}, DM, "state the epoch"),
        (0.02, {"realization": "ITRF2014", "epoch": 2015.0}, CM, ""),
        (0.02, {"realization": "WGS 84 (G2139)", "epoch": 2024.0}, CM, ""),
        (0.02, {"crs": "EPSG:9057", "epoch": 2024.0}, CM, ""),
        (0.02, {"realization": "WGS 84 (G873)", "epoch": 2000.0}, DM, ""),
        (0.02, {"realization": "ITRF97", "epoch": 2000.0}, DM, ""),
        (0.02, {"crs": "EPSG:4258"}, DM, "state the realization"),
        (0.02, {"crs": "EPSG:4258", "realization": "ETRF2000"}, CM, "state the epoch"),
        (0.02, {"crs": "EPSG:4258", "realization": "ETRF 2000", "epoch": 2025.4}, CM, ""),
        (0.02, {"crs": "EPSG:4258", "realization": "DHDN", "epoch": 2025.4}, DM, "DHDN is not one of EPSG:4258"),
        (0.02, {"realization": "NAD83(2011)", "epoch": 2025.4}, UNFIT, "is not one of EPSG:4326"),
        (0.02, {"crs": "EPSG:4314"}, UNFIT, "no transformation with a stated accuracy"),
    ],
)
def test_grades_of_the_documented_table(rmse_m: float | None, frame: dict[str, object], grade: str, cure: str) -> None:
    placed = place_position(*KARLSRUHE, **frame)  # type: ignore[arg-type]
    assert grade_accuracy(total_accuracy_m(rmse_m, placed.transform_accuracy_m)) is grade
    assert cure in (placed.note or "")
    assert ("state the" in (placed.note or "")) == ("state the" in cure)


def test_the_realizations_of_etrs89_differ() -> None:
    """ETRF2000 and ETRF2020 are 8.4 cm apart in Karlsruhe; ETRS89 alone states no better than EPSG does, 0.1 m."""
    places = [
        place_position(*KARLSRUHE, crs="EPSG:4258", realization=name, epoch=2025.0)
        for name in ("ETRF2000", "ETRF2020", None)
    ]
    known, other, unstated = ((p.lon_deg, p.lat_deg) for p in places)
    assert Geod(ellps="GRS80").inv(*known, *other)[2] == pytest.approx(0.084, abs=0.001)
    assert unstated == other
    assert [p.transform_accuracy_m for p in places] == [0.0, 0.0, 0.1]
    # EPSG:8405, ITRF2014 to ETRF2000 as EUREF Technical Note 1 has it
    expected = Transformer.from_crs("EPSG:7931", "EPSG:7912", always_xy=True).transform(*KARLSRUHE, 0.0, 2025.0)
    assert known == pytest.approx(expected[:2], abs=1e-9)


def test_a_stated_realization_is_undone_by_its_own_transformation() -> None:
    placed = place_position(*KARLSRUHE, crs="EPSG:4258", realization="ETRF2000")
    lon, lat, none = (np.array([v]) for v in (placed.lon_deg, placed.lat_deg, np.nan))
    origin = Origin("EPSG:4258", True, placed.epoch, False, "ETRF2000")
    back = positions_in_system(lon, lat, none, "EPSG:4258", origin=origin)
    assert (back.first[0], back.second[0]) == pytest.approx(KARLSRUHE, abs=1e-10)


@pytest.mark.parametrize(
    ("crs", "name"), [("EPSG:7911", "ITRF2008"), ("EPSG:7910", "ITRF2005"), ("EPSG:9989", "ITRF2020")]
)
def test_recent_realizations_agree_as_stated(crs: str, name: str) -> None:
    """By the parameters of the ITRF, at four places and times."""
    to_itrf2014 = Transformer.from_crs(crs, "EPSG:7912", always_xy=True)
    assert reference_system(crs).name == name
    bound_m = accuracy_of_global(name)
    assert bound_m is not None
    for lon, lat, epoch in ((8.4, 49.0, 2015.0), (-84.5, 42.7, 2026.0), (151.2, -33.9, 2010.0), (139.0, 36.0, 2026.0)):
        moved = to_itrf2014.transform(lon, lat, 0.0, epoch)
        assert Geod(ellps="GRS80").inv(lon, lat, moved[0], moved[1])[2] <= bound_m


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("ellipsoid", "ellipsoid"), ("EPSG:5703", "EPSG:5703"), ("urn:ogc:def:crs:EPSG::7837", "EPSG:7837"),
        ("NAVD88", "EPSG:5703"), ("DHHN2016 height", "EPSG:7837"), ("egm2008", "EPSG:3855"),
    ],
)  # fmt: skip
def test_vertical_datums_have_one_name(text: str, name: str) -> None:
    assert normalize_vertical_datum(text) == name


@pytest.mark.parametrize("text", ["banana", "EPSG:4326", "EPSG:6360", "EPSG:6357", "EPSG:7405", "EPSG:999999", " "])
def test_other_vertical_datums_are_refused(text: str) -> None:
    """Also feet (6360), depths (6357) and compound systems (7405)."""
    with pytest.raises(ReferenceSystemError, match="vertical datum") as caught:
        normalize_vertical_datum(text)
    assert "EPSG:5703" in (caught.value.cure or "")


@pytest.mark.parametrize(
    ("name", "place", "moved_m"), [("Karlsruhe", KARLSRUHE, 0.25), ("Michigan", (-85.6436, 42.2531), 0.16)]
)
def test_motion_without_an_epoch_is_stated_beside_the_error_of_its_model(
    name: str, place: tuple[float, float], moved_m: float
) -> None:
    placed = place_position(*place, realization="ITRF2014")
    assert placed.note is not None
    assert f"moves by {moved_m:.2f} m in 10 years, by a model with an error of 0.02 m" in placed.note
    assert placed.transform_accuracy_m == pytest.approx(moved_m + 0.02, abs=0.005)
    page = (Path(__file__).resolve().parents[2] / "docs/positions.md").read_text()
    assert f"{moved_m:.2f} + 0.02 m in {name}" in page
