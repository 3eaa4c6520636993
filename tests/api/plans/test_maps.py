"""Registered roads as alignments, and HD maps of the registry and of plans, over HTTP."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import httpx
import lanelet2
import pytest
import scenariogeneration
from lanelet2.io import Origin
from lanelet2.projection import UtmProjector
from lxml import etree
from pyproj import Geod

from tests.api.plans.test_plans import road, send_road
from tests.conftest import LiveServer
from tests.http import created, refused

pytestmark = pytest.mark.both_databases

GEOD = Geod(ellps="WGS84")
SCHEMA = Path(scenariogeneration.__file__).parents[1] / "schemas" / "opendrive_17_core.xsd"
PLACES = itertools.count(1)
LANES = {"forward": 1, "backward": 1, "width_m": 3.25, "speed_limit_kmh": 70, "centre_style": "dashed"}


@pytest.fixture
def start() -> tuple[float, float]:
    """Where the road of a test begins."""
    return 9.0, 48.0 + next(PLACES) * 0.02


def ahead(start: tuple[float, float], along_m: float, left_m: float = 0.0) -> dict[str, Any]:
    """A position along a road to the east."""
    lon, lat, _ = GEOD.fwd(*start, 90.0, along_m)
    lon, lat, _ = GEOD.fwd(lon, lat, 0.0, left_m)
    return {"lon_deg": lon, "lat_deg": lat}


def register(client: httpx.Client, start: tuple[float, float]) -> dict[str, Any]:
    """A straight road to the east in the registry."""
    points = [list(ahead(start, 50.0 * k).values()) for k in range(11)]
    line = {"type": "LineString", "coordinates": points}
    return created(client, "/v1/roads", name="B 27", geometry=line, calibration=[{"measure_m": 2000, "vertex": 0}])


@pytest.mark.slow
def test_a_registered_road_is_the_source_of_an_alignment(client: httpx.Client, start: tuple[float, float]) -> None:
    source = register(client, start)
    body = {"name": "B 27, two lanes", "road_id": source["id"], "lanes": LANES}
    response = client.post("/v1/alignments", json=body, headers={"Idempotency-Key": "one"})
    assert response.status_code == 201, response.text
    alignment = response.json()
    assert client.post("/v1/alignments", json=body, headers={"Idempotency-Key": "one"}).json() == alignment
    refused(client.post("/v1/alignments", json=body), 409, field="name")
    assert [lane["name"] for lane in alignment["lanes"]] == ["forward 1", "backward 1"]
    for lane in alignment["lanes"]:
        assert lane["length_m"] == pytest.approx(500.0, abs=0.01)
        assert (lane["road"], lane["left_style"], lane["width_m"]) == ("B 27", "dashed", pytest.approx([3.25, 3.25]))
    assert (alignment["format"], alignment["localization_grade"]) == ("road", "m")
    assert (alignment["declaration"]["road_id"], alignment["declaration"]["road_version"]) == (source["id"], 1)
    # the source can be sent as a file again, and a changed road changes no alignment
    client.patch(f"/v1/roads/{source['id']}", json={"calibration": []}, headers={"If-Match": '"1"'})
    data = client.get(f"/v1/alignments/{alignment['id']}/source").content
    again = send_road(client, data, name="sent again")
    assert again.status_code == 201, again.text
    assert again.json()["lanes"] == alignment["lanes"]
    rules = {"version": 1, "plates": {"spacing_m": 100}}
    plan = created(client, "/v1/plans", name="B 27", alignment_id=alignment["id"], rules=rules)
    assert plan["counts"] == {"plate": 10}
    stations = client.get(f"/v1/plans/{plan['id']}/files/schedule.csv").text
    assert "2+050.00" in stations


@pytest.mark.parametrize(
    ("change", "status", "field"),
    [
        ({"road_id": "019cb624-0000-7000-8000-00000000ffff"}, 404, "road_id"),
        ({"lanes": LANES | {"forward": 0, "backward": 0}}, 422, "lanes"),
        ({"lanes": LANES | {"width_m": 0.0}}, 422, "lanes.width_m"),
        ({"lanes": {"forward": 1}}, 422, "lanes.speed_limit_kmh"),
        ({"lanes": LANES | {"width": 3}}, 422, "lanes.width"),
        ({"crs": "EPSG:4326"}, 422, "crs"),
    ],
)
def test_bad_lanes_of_a_road_are_refused_and_nothing_is_stored(
    client: httpx.Client, start: tuple[float, float], change: dict[str, Any], status: int, field: str
) -> None:
    body = {"name": "bad", "road_id": register(client, start)["id"], "lanes": LANES} | change
    refused(client.post("/v1/alignments", json=body), status, field=field)
    assert client.get("/v1/alignments").json()["items"] == []


def test_the_registry_is_a_map_with_the_lanes_of_an_alignment(
    server: LiveServer, client: httpx.Client, start: tuple[float, float], tmp_path: Path
) -> None:
    alignment = created_alignment(client, start)
    plate = created(client, "/v1/markers", position=ahead(start, 100), heading_deg=90)
    side = created(client, "/v1/markers", family="cerpm", position=ahead(start, 120, -1.7), side="right")
    way = [list(ahead(start, m, 1.75).values()) for m in (100, 130)]
    lane = {"geometry": {"type": "LineString", "coordinates": way}}
    line = created(client, "/v1/markers", family="magnet", lane=lane, line={"style": "solid"})
    code = {"dictionary": "aruco-4x4-50", "number": 7}
    sign = created(
        client, "/v1/markers", family="fiducial", code=code, geometry={"side_mm": 400, "mounting": "upright"},
        position=ahead(start, 150, 6), heading_deg=90,
    )  # fmt: skip
    old = created(client, "/v1/markers", position=ahead(start, 200), heading_deg=90)
    client.patch(f"/v1/markers/{old['id']}", json={"status": "retired"}, headers={"If-Match": '"1"'})
    far = created(client, "/v1/markers", position=ahead(start, 300, 90), heading_deg=90)
    behind = created(client, "/v1/markers", position=ahead(start, -10), heading_deg=90)
    url = f"/v1/alignments/{alignment['id']}/map"

    loaded = load(tmp_path, client.get(f"{url}.osm"), start)
    points = {p.attributes["waymark_id"]: p for p in loaded.pointLayer if "waymark_id" in p.attributes}
    magnets = [f"{line['id']}.{k}" for k in range(1, 7)]
    assert set(points) == {side["id"], *magnets}
    faces = {w.attributes["waymark_id"]: w for w in [*loaded.lineStringLayer, *loaded.polygonLayer]
             if "waymark_id" in w.attributes}  # fmt: skip
    assert set(faces) == {plate["id"], sign["id"], behind["id"]}
    assert faces[plate["id"]].attributes["marker_id"] == plate["code"]["digits"]
    assert len(list(loaded.laneletLayer)) > 10

    root = etree.fromstring(client.get(f"{url}.xodr").content)
    etree.XMLSchema(etree.parse(SCHEMA)).assertValid(root)
    assert {s.get("name") for s in root.iter("signal")} == {plate["id"], side["id"], sign["id"], *magnets}
    said = {element.get("code"): element.get("value") for element in root.findall("header/userData")}
    assert said["left_out"] == behind["id"]

    def names(**parameters: Any) -> set[str]:
        return {
            s.get("name") for s in etree.fromstring(client.get(f"{url}.xodr", params=parameters).content).iter("signal")
        }

    assert names(family="cerpm") == {side["id"]}
    assert far["id"] in names(within_m=95)
    assert names(code=plate["code"]["digits"], status="planned") == {plate["id"]}
    refused(client.get(f"{url}.osm", params={"status": "retired"}), 422, field="status")
    refused(client.get(f"{url}.osm", params={"within_m": 101}), 422, field="within_m")
    refused(client.get(f"{url}.dxf"), 422, field="form")
    with server.agency("a stranger to maps") as stranger:
        refused(stranger.get(f"{url}.osm"), 404)


def created_alignment(client: httpx.Client, start: tuple[float, float]) -> dict[str, Any]:
    response = send_road(client, road(*start, length_m=500))
    assert response.status_code == 201, response.text
    return dict(response.json())


def load(folder: Path, response: httpx.Response, start: tuple[float, float]) -> lanelet2.core.LaneletMap:
    assert response.status_code == 200, response.text
    path = folder / "map.osm"
    path.write_bytes(response.content)
    loaded, errors = lanelet2.io.loadRobust(str(path), UtmProjector(Origin(start[1], start[0])))
    assert list(errors) == []
    return loaded


def test_maps_are_files_of_a_plan(client: httpx.Client, start: tuple[float, float], tmp_path: Path) -> None:
    alignment = created_alignment(client, start)
    rules = {"version": 1, "plates": {"spacing_m": 100}}
    plan = created(client, "/v1/plans", name="maps", alignment_id=alignment["id"], rules=rules)
    url = f"/v1/plans/{plan['id']}/files"
    loaded = load(tmp_path, client.get(f"{url}/map.osm"), start)
    faces = [w for w in [*loaded.lineStringLayer, *loaded.polygonLayer] if "waymark_id" in w.attributes]
    assert len(faces) == plan["counts"]["plate"]
    response = client.get(f"{url}/map.xodr")
    assert response.headers["content-type"] == "application/xml"
    root = etree.fromstring(response.content)
    assert len(list(root.iter("signal"))) == plan["counts"]["plate"]
    assert json.loads(client.get(f"{url}/plan.json").content)["counts"] == plan["counts"]
