"""Markers of the registry on the lanes of a road."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from app.planning.alignment import Alignment
from app.planning.outputs.hd_map import MapMarker, map_of_road
from tests.planning.roads import GEOD, straight
from tests.planning.roads import road as road_of

GRADE, CROSSFALL = 0.04, 0.025


@pytest.fixture(scope="module")
def road() -> Alignment:
    """300 m uphill to the east, higher on the left."""
    lane = straight(300, heading_deg=90.0, grade=GRADE)
    lane = replace(lane, superelevation_rad=np.full(301, np.arctan(CROSSFALL)))
    return replace(road_of(lane), vertical_datum="ellipsoid")


def marker_at(road: Alignment, chainage_m: float, left_m: float = 0.0, **more: object) -> MapMarker:
    lon, lat = road.lanes[0].position_at([chainage_m], left_m)
    marker = MapMarker("m", "plate", "12", float(lon[0]), float(lat[0]), 105.0, 90.0, vertical_datum="ellipsoid")
    return replace(marker, **more)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("heading_deg", "grade", "crossfall"),
    [
        (90.0, GRADE, CROSSFALL), (270.0, -GRADE, -CROSSFALL), (0.0, CROSSFALL, -GRADE), (180.0, -CROSSFALL, GRADE),
        (None, GRADE, CROSSFALL),
    ],
    ids=["along", "against", "to the left", "to the right", "without a heading"],
)  # fmt: skip
def test_slopes_are_those_of_the_road_in_the_markers_direction(
    road: Alignment, heading_deg: float | None, grade: float, crossfall: float
) -> None:
    (found,) = map_of_road(road, [marker_at(road, 150.0, heading_deg=heading_deg)], within_m=20.0).markers
    assert (found.grade, found.crossfall) == pytest.approx((grade, crossfall), abs=1e-4)


def test_only_heights_in_the_datum_of_the_road_are_taken(road: Alignment) -> None:
    markers = [
        marker_at(road, 150.0), marker_at(road, 160.0, vertical_datum="EPSG:5703"),
        marker_at(road, 170.0, vertical_datum=None),
    ]  # fmt: skip
    assert [found.height_m for found in map_of_road(road, markers, within_m=20.0).markers] == [105.0, None, None]
    flat = replace(road, vertical_datum=None)
    assert [found.height_m for found in map_of_road(flat, markers, within_m=20.0).markers] == [None] * 3


def test_markers_are_taken_by_their_distance_from_the_centre_line(road: Alignment) -> None:
    places = [(0.0, 0.0), (150.25, 19.99), (150.75, -19.99), (150.5, 20.05), (150.0, -20.05)]
    markers = [marker_at(road, along, left, id=f"{k}") for k, (along, left) in enumerate(places)]
    lon, lat, _ = GEOD.fwd(road.lanes[0].lon_deg[0], road.lanes[0].lat_deg[0], 270.0, 10.0)
    markers.append(replace(markers[0], id="behind", lon_deg=lon, lat_deg=lat))
    content = map_of_road(road, markers, within_m=20.0)
    assert [found.id for found in content.markers] == ["0", "1", "2", "behind"]
    assert (content.name, content.lanes, content.vertical_datum) == (road.name, road.lanes, "ellipsoid")
    assert map_of_road(road, [], within_m=20.0).markers == ()
