"""Lines of markers as features: runs of CERPMs and painted lines of magnets."""

from __future__ import annotations

from typing import Any

import httpx
import pytest
from pyproj import Geod

from tests.api.test_ogc_features import MERCATOR, get, ids
from tests.conftest import LiveServer

ITEMS = "/ogc/collections/marker_lines/items"
GEOD = Geod(ellps="WGS84")


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def backend(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def _cerpm(client: httpx.Client, measure_m: float | None, side: str = "left", road: str | None = "A7") -> str:
    """A CERPM on a straight road to the north, where its measure says."""
    lon, lat, _ = GEOD.fwd(8.0, 47.0, 0.0, measure_m or 0.0)
    body = {"family": "cerpm", "position": {"lon_deg": lon, "lat_deg": lat}, "side": side, "measure_m": measure_m}
    response = client.post("/v1/markers", json={name: v for name, v in {**body, "road": road}.items() if v is not None})
    assert response.status_code == 201, response.text
    return str(response.json()["id"])


def _line(page: dict[str, Any], line_id: str) -> dict[str, Any]:
    return next(feature for feature in page["features"] if feature["id"] == line_id)


def test_runs_are_cut_at_gaps_sides_and_roads(client: httpx.Client) -> None:
    left = [_cerpm(client, m) for m in (24.0, 0.0, 12.0, 124.0, 400.0, 412.0, 900.0)]
    right = [_cerpm(client, m, "right") for m in (0.0, 12.0)]
    _cerpm(client, None)
    _cerpm(client, 18.0, road=None)
    other = [_cerpm(client, m, road="B1") for m in (6.0, 8.0)]
    page = get(client, ITEMS)
    assert set(ids(page)) == {left[1], left[4], right[0], other[0]}
    assert page["numberMatched"] == 4
    run = _line(page, left[1])
    assert run["properties"] == {
        "family": "cerpm",
        "code": None,
        "side": "left",
        "road": "A7",
        "status": "planned",
        "count": 4,
        "spacing_m": 12.0,
        "longest_gap_m": 100.0,
        "length_m": 124.0,
        "from_measure_m": 0.0,
        "to_measure_m": 124.0,
    }
    lats = [lat for _, lat in run["geometry"]["coordinates"]]
    assert lats == sorted(lats)
    assert get(client, f"{ITEMS}/{left[1]}")["geometry"] == run["geometry"]
    assert client.get(f"{ITEMS}/{left[0]}").status_code == 404  # a CERPM of the run, not its first


def test_retired_ones_leave_their_run(client: httpx.Client) -> None:
    run = [_cerpm(client, m) for m in (0.0, 90.0, 180.0)]
    assert len(ids(get(client, ITEMS))) == 1
    response = client.patch(f"/v1/markers/{run[1]}", json={"status": "retired"}, headers={"If-Match": '"1"'})
    assert response.status_code == 200
    assert ids(get(client, ITEMS)) == []


def test_filters_boxes_and_pages(client: httpx.Client) -> None:
    runs = [_cerpm(client, m, side) for side in ("left", "right") for m in (0.0, 95.0, 1000.0, 1095.0)]
    firsts = {runs[0], runs[2], runs[4], runs[6]}
    assert set(ids(get(client, ITEMS))) == firsts
    assert set(ids(get(client, ITEMS, side="right"))) == {runs[4], runs[6]}
    assert ids(get(client, ITEMS, road="B9")) == []
    between = "7.999,47.0003,8.001,47.0004"  # no CERPM in it, but lines pass through
    assert set(ids(get(client, ITEMS, bbox=between))) == {runs[0], runs[4]}
    assert ids(get(client, ITEMS, bbox="8.001,47.0003,8.002,47.0004")) == []
    first = get(client, ITEMS, limit=3)
    onward = next(link["href"] for link in first["links"] if link["rel"] == "next")
    assert {*ids(first), *ids(client.get(onward).json())} == firsts
    x, y = get(client, ITEMS, crs=MERCATOR)["features"][0]["geometry"]["coordinates"][0]
    assert (x, y) == pytest.approx((890555.926, 5942074.072), abs=2000)


def test_a_painted_line_of_magnets_is_a_line(client: httpx.Client) -> None:
    lon, lat, _ = GEOD.fwd(20.0, 40.0, 90.0, 60.0)
    lane = {"geometry": {"type": "LineString", "coordinates": [[20.0, 40.0], [lon, lat]]}}
    response = client.post("/v1/markers", json={"family": "magnet", "lane": lane, "line": {"style": "solid"}})
    assert response.status_code == 201, response.text
    magnets = response.json()["magnets"]
    (line,) = get(client, ITEMS, bbox="20.0001,39.9,20.0002,40.1", family="magnet")["features"]
    assert line["id"] == response.json()["id"]
    assert line["properties"]["count"] == len(magnets)
    assert line["properties"]["longest_gap_m"] <= 6.0
    ends = [(magnet["lon_deg"], magnet["lat_deg"]) for magnet in (magnets[0], magnets[-1])]
    for end, expected in zip((line["geometry"]["coordinates"][k] for k in (0, -1)), ends, strict=True):
        assert end == pytest.approx(expected, abs=1e-9)


def test_one_agency_never_sees_anothers_lines(server: LiveServer, client: httpx.Client) -> None:
    run = [_cerpm(client, m) for m in (0.0, 12.0)]
    with server.agency("strangers to lines") as stranger:
        assert ids(get(stranger, ITEMS)) == []
        assert stranger.get(f"{ITEMS}/{run[0]}").status_code == 404


def test_what_lines_do_not_have(client: httpx.Client) -> None:
    assert client.get(f"{ITEMS}?version=1").status_code == 400
    assert client.get("/ogc/collections/marker_lines/tiles").status_code == 404
