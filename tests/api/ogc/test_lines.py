"""Lines of markers as features: runs of CERPMs and painted lines of magnets."""

from __future__ import annotations

from typing import Any

import httpx
import pytest
from pyproj import Geod

from app.registry import lines
from tests.api.ogc.test_features import MERCATOR, get, ids
from tests.conftest import LiveServer

pytestmark = pytest.mark.both_databases

ITEMS = "/ogc/collections/marker_lines/items"
GEOD = Geod(ellps="WGS84")


def _cerpm(
    client: httpx.Client,
    measure_m: float | None,
    side: str = "left",
    road: str | None = "A7",
    along_m: float | None = None,
) -> str:
    """A CERPM on a straight road to the north, where its measure says, or at a distance along the road."""
    lon, lat, _ = GEOD.fwd(8.0, 47.0, 0.0, (measure_m or 0.0) if along_m is None else along_m)
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
        "marker_count": 4,
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


@pytest.mark.parametrize("repeated_m", [30.0, 300.0])
def test_where_measures_repeat_there_are_two_runs(client: httpx.Client, repeated_m: float) -> None:
    """After 400 m the measures go on at an earlier one: in their order, CERPMs of both stretches alternate."""
    before = [_cerpm(client, m) for m in (340.0, 352.0, 364.0, 376.0, 388.0)]
    after = [_cerpm(client, m + 400.0 - repeated_m, along_m=400.0 + m) for m in (4.0, 16.0, 28.0, 40.0)]
    page = get(client, ITEMS)
    assert set(ids(page)) == {before[0], after[0]}
    counts = {line_id: _line(page, line_id)["properties"]["marker_count"] for line_id in ids(page)}
    assert counts == {before[0]: 5, after[0]: 4}
    assert max(_line(page, line_id)["properties"]["longest_gap_m"] for line_id in ids(page)) == 12.0
    first = get(client, ITEMS, limit=1)
    link = next(link["href"] for link in first["links"] if link["rel"] == "next")
    assert ids(client.get(link).json()) == [line_id for line_id in ids(page) if line_id not in ids(first)]


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


def test_pages_one_by_one_are_the_whole(client: httpx.Client) -> None:
    """Runs of both sides begin and end in turns, at equal measures, across roads; some are cut, some are no runs."""
    places = [
        ("A7", "left", (0.0, 95.0, 190.0, 285.0, 380.0)), ("A7", "right", (0.0, 50.0, 151.0, 250.0, 360.0, 400.0)),
        ("A7", "unknown", (10.0, 300.0, 400.0)), ("A8", "left", (0.0,)), ("A8", "right", (380.0, 390.0)),
        ("B1", "left", (385.0, 395.0)),
    ]  # fmt: skip
    for road, side, measures in places:
        for measure_m in measures:
            _cerpm(client, measure_m, side, road)
    lons = [GEOD.fwd(20.0 + k, 41.0, 90.0, 60.0)[0] for k in range(2)]
    for k, lon in enumerate(lons):
        lane = {"geometry": {"type": "LineString", "coordinates": [[20.0 + k, 41.0], [lon, 41.0]]}}
        body = {"family": "magnet", "lane": lane, "line": {"style": "solid"}}
        assert client.post("/v1/markers", json=body).status_code == 201
    whole = get(client, ITEMS)
    told = [
        (line["properties"]["road"], line["properties"]["from_measure_m"], line["properties"]["marker_count"])
        for line in whole["features"]
    ]
    assert told[:2] == [(None, None, 11)] * 2
    assert told[2:] == [
        ("A7", 0.0, 5), ("A7", 0.0, 2), ("A7", 151.0, 2), ("A7", 300.0, 2), ("A7", 360.0, 2), ("A8", 380.0, 2),
        ("B1", 385.0, 2),
    ]  # fmt: skip
    for limit in (1, 2, 3, 4):
        found, page = [], get(client, ITEMS, limit=limit)
        assert "numberMatched" not in page
        while True:
            found += page["features"]
            onward = [link["href"] for link in page["links"] if link["rel"] == "next"]
            if not onward:
                break
            page = client.get(onward[0]).json()
        assert found == whole["features"]
    assert get(client, ITEMS, limit=1, count="true")["numberMatched"] == 9
    last = whole["features"][-1]["id"]
    assert get(client, ITEMS, after=last, count="true")["numberMatched"] == 9
    assert get(client, ITEMS, resultType="hits")["numberMatched"] == 9
    for line in whole["features"]:
        assert get(client, f"{ITEMS}/{line['id']}")["properties"] == line["properties"]
    # the line that a page ended with is gone: the next one goes on where it was
    second = whole["features"][3]["id"]
    client.patch(f"/v1/markers/{second}", json={"status": "retired"}, headers={"If-Match": '"1"'})
    assert ids(get(client, ITEMS, after=second))[-4:] == ids(whole)[-4:]
    plate = client.post("/v1/markers", json={"position": {"lon_deg": 1.0, "lat_deg": 1.0}}).json()["id"]
    for none in ("019cb624-0000-7000-8000-00000000ffff", "x", plate, _cerpm(client, None)):
        refused = client.get(ITEMS, params={"after": none})
        assert (refused.status_code, refused.json()["errors"][0]["field"]) == (400, "after")


def test_filter_expressions_ask_lines(client: httpx.Client) -> None:
    short = [_cerpm(client, m, road="A7") for m in (0.0, 12.0)]
    long = [_cerpm(client, m, "right", road="A8") for m in (0.0, 90.0, 180.0)]
    asked = {
        "marker_count > 2": {long[0]},
        "length_m < 100 AND road = 'A7'": {short[0]},
        "road = 'A7' AND road = 'A8'": set(),
        "road = 'A7' OR side = 'right'": {short[0], long[0]},
        "family = 'magnet'": set(),
        "NOT family = 'magnet'": {short[0], long[0]},
        "code IS NULL AND longest_gap_m BETWEEN 89.9 AND 90.1": {long[0]},
        "road LIKE 'A_' AND status <> 'mixed'": {short[0], long[0]},
    }
    for text, expected in asked.items():
        assert set(ids(get(client, ITEMS, filter=text))) == expected, text
        assert get(client, ITEMS, filter=text, resultType="hits")["numberMatched"] == len(expected)
    as_json = '{"op": ">", "args": [{"property": "marker_count"}, 2]}'
    assert ids(get(client, ITEMS, **{"filter": as_json, "filter-lang": "cql2-json"})) == [long[0]]
    assert ids(get(client, ITEMS, filter="marker_count > 2", road="A7")) == []
    assert client.get(ITEMS, params={"filter": "measure_m > 2"}).status_code == 400


def test_a_page_reads_no_more_than_it_needs(client: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    for road in ("A1", "A2", "A3", "A4"):
        for measure_m in (0.0, 12.0, 24.0):
            _cerpm(client, measure_m, road=road)
    read: list[Any] = []
    is_complete = lines._is_complete

    def counting(run: Any, row: Any) -> bool:
        read.append(row.id)
        return is_complete(run, row)

    monkeypatch.setattr(lines, "_is_complete", counting)
    first = get(client, ITEMS, limit=1)
    rows = set(read)
    read.clear()
    get(client, ITEMS, limit=1, after=ids(first)[0])
    assert (len(rows), len(set(read))) == (7, 10)  # the line, the next one to know of more, and what ends it
    read.clear()
    get(client, ITEMS, filter="road = 'A3'")
    assert len(set(read)) == 3


def test_a_painted_line_of_magnets_is_a_line(client: httpx.Client) -> None:
    lon, lat, _ = GEOD.fwd(20.0, 40.0, 90.0, 60.0)
    lane = {"geometry": {"type": "LineString", "coordinates": [[20.0, 40.0], [lon, lat]]}}
    response = client.post("/v1/markers", json={"family": "magnet", "lane": lane, "line": {"style": "solid"}})
    assert response.status_code == 201, response.text
    magnets = response.json()["magnets"]
    (line,) = get(client, ITEMS, bbox="20.0001,39.9,20.0002,40.1", family="magnet")["features"]
    assert line["id"] == response.json()["id"]
    assert line["properties"]["marker_count"] == len(magnets)
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
