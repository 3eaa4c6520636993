"""QGIS, Debian's python3-qgis, against a running server: a key as password, filters, pages, tiles, maps."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from app.plots.map_symbols import LOOKS
from app.services.access.access import Scope
from tests.api.ogc.test_features import ITEMS, add, get
from tests.conftest import LiveServer
from tests.http import WITHIN_S
from tests.machine import refuse, require_tool

pytestmark = [pytest.mark.slow, pytest.mark.both_databases]

PYTHON = "/usr/bin/python3"
STATUSES = ("planned", "built", "surveyed", "active", "suspect")
NO_GEOMETRY, POINT = 100, 1
STYLE = "/ogc/collections/markers/tiles/WebMercatorQuad/style"


def _require_qgis() -> None:
    command = [require_tool(PYTHON), "-c", "import qgis.core"]
    found = subprocess.run(command, capture_output=True, check=False, timeout=WITHIN_S)
    if found.returncode == 0:
        return
    refuse(f"{PYTHON} has no QGIS; Debian has it in python3-qgis")


@pytest.fixture(scope="module")
def qgis(server: LiveServer, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What a session of QGIS found, with the features as the server has them."""
    _require_qgis()
    folder = tmp_path_factory.mktemp("qgis")
    key = str(server.app.state.use_cases.access.create_key("with QGIS", Scope.PLANNER, label="QGIS"))
    with server.client(key) as client:
        for k in range(25):
            member = {"family": "cerpm", "side": "left"} if k % 2 else {}
            road = {"road": f"A{k % 3}", "measure_m": float(k), "heading_deg": 90.0}
            lon, lat = 8.40 + 0.003 * (k % 5), 49.0 + 0.001 * (k // 5)
            made = _add(client, lon, lat, **member, **road)
            if STATUSES[k // 5] != "planned":
                response = client.patch(
                    f"/v1/markers/{made}", json={"status": STATUSES[k // 5]}, headers={"If-Match": '"1"'}
                )
                assert response.status_code == 200, response.text
        style = folder / "style.json"
        style.write_bytes(client.get(STYLE).content)
        features = get(client, ITEMS)["features"]
    home = folder / "home"
    home.mkdir(mode=0o700)
    environment = {
        "PATH": os.environ["PATH"], "HOME": str(home), "XDG_RUNTIME_DIR": str(home), "QT_QPA_PLATFORM": "offscreen",
        "LANG": "C.UTF-8",
    }  # fmt: skip
    script = Path(__file__).with_name("qgis_session.py")
    done = subprocess.run(
        [PYTHON, script, server.url, key, folder, style.as_uri()],
        env=environment, capture_output=True, text=True, timeout=WITHIN_S, check=False,
    )  # fmt: skip
    results = [line.removeprefix("RESULT ") for line in done.stdout.splitlines() if line.startswith("RESULT ")]
    assert results, done.stdout + done.stderr
    return {**json.loads(results[0]), "features": features, "folder": folder}


def _add(client: Any, lon: float, lat: float, **members: Any) -> str:
    if members.get("family") != "cerpm":
        return add(client, lon, lat, **members)
    response = client.post("/v1/markers", json={"position": {"lon_deg": lon, "lat_deg": lat}, **members})
    assert response.status_code == 201, response.text
    return str(response.json()["id"])


def test_a_key_as_password_opens_a_layer_and_nothing_else_does(qgis: dict[str, Any]) -> None:
    assert (qgis["markers"]["valid"], qgis["markers"]["geometry"]) == (True, POINT)
    assert qgis["refused"]["valid"] is False


def test_all_markers_are_counted_and_read_over_several_pages(qgis: dict[str, Any]) -> None:
    assert qgis["count"] == 25
    assert qgis["places"].keys() == {feature["id"] for feature in qgis["features"]}
    for feature in qgis["features"]:
        assert qgis["places"][feature["id"]] == pytest.approx(feature["geometry"]["coordinates"], abs=1e-9)


def test_boxes_and_expressions_filter(qgis: dict[str, Any]) -> None:
    def those(keep: Any) -> list[str]:
        return sorted(feature["id"] for feature in qgis["features"] if keep(feature))

    road = those(lambda f: f["properties"]["road"] == "A1" and f["properties"]["measure_m"] >= 10)
    assert len(road) == 5
    assert qgis["subset"] == road
    assert qgis["in box"] == those(
        lambda f: 8.4005 <= f["geometry"]["coordinates"][0] <= 8.4025 and f["geometry"]["coordinates"][1] <= 49.0005
    )


def test_numbers_and_times_have_their_types(qgis: dict[str, Any]) -> None:
    """QGIS 3.22 takes the types from the first page: a field without any value is a text there."""
    fields = qgis["markers"]["fields"]
    assert list(fields)[1:] == list(qgis["features"][0]["properties"])
    assert (fields["measure_m"], fields["heading_deg"], fields["version"]) == ("Real", "Real", "Integer")
    assert (fields["updated_at"], fields["road"], fields["code"]) == ("DateTime", "String", "String")


def test_an_empty_collection(qgis: dict[str, Any]) -> None:
    """QGIS from 3.44 on reads the schema. Before, its provider knows no fields; through GDAL it knows their types."""
    assert qgis["empty"]["valid"]
    if qgis["version"] < 34400:
        assert (qgis["empty"]["geometry"], qgis["empty"]["fields"]) == (NO_GEOMETRY, {})
    else:
        assert (qgis["empty"]["geometry"], qgis["empty"]["fields"]["number"]) == (POINT, "Integer64")
    through_gdal = qgis["empty through GDAL"]["fields"]
    assert (through_gdal["number"], through_gdal["station_m"], through_gdal["plan"]) == ("Integer", "Real", "String")


def test_what_can_be_edited(qgis: dict[str, Any]) -> None:
    """QGIS edits OGC API Features from 3.32 on; the versions before read only."""
    expected = qgis["version"] >= 33200
    assert qgis["edits"] == dict.fromkeys(("add", "change", "move", "delete"), expected)


def test_the_style_of_the_tiles_is_read(qgis: dict[str, Any]) -> None:
    assert qgis["tiles"]
    assert qgis["style"] == ["", True]
    assert {"Dots", "Plates: planned", "CERPMs: suspect", "Magnets: active"} <= set(qgis["styles"])


def _spots(path: Path, colour: tuple[int, int, int]) -> np.ndarray:
    """Centres of the areas of a colour on a picture. [px]"""
    picture = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB).astype(int)
    near = (np.abs(picture - colour).max(axis=2) <= 40).astype(np.uint8)
    near = cv2.morphologyEx(near, cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8))  # a mark parts a symbol
    count, _, stats, centres = cv2.connectedComponentsWithStats(near)
    return np.array([centres[k] for k in range(1, count) if 15 <= stats[k][cv2.CC_STAT_AREA] <= 400])


def test_the_map_shows_every_marker_in_its_place(qgis: dict[str, Any]) -> None:
    assert qgis["errors"] == []
    picture = cv2.imread(str(qgis["folder"] / "features.png")).astype(int)
    drawn = (np.abs(picture - 238).max(axis=2) > 60).astype(np.uint8)
    count, _, _, centres = cv2.connectedComponentsWithStats(drawn)
    assert count - 1 == 25
    columns = sorted({round(x / 10) for x, _ in centres[1:]})
    assert len(columns) == 5


@pytest.mark.parametrize("status", ["surveyed", "active", "suspect"])
def test_the_tiles_show_the_status_by_colour(qgis: dict[str, Any], status: str) -> None:
    """Five markers of each status are on one parallel, and the parallels from the south to the north."""
    spots = _spots(qgis["folder"] / "tiles.png", LOOKS[status].fill)
    assert len(spots) == 5
    assert np.ptp(spots[:, 1]) < 6
    others = [_spots(qgis["folder"] / "tiles.png", LOOKS[other].fill) for other in ("surveyed", "active", "suspect")]
    heights = [found[:, 1].mean() for found in others]
    assert heights == sorted(heights, reverse=True)
