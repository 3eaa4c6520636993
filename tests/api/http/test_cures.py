"""Slips that a new user makes, and the cures that the answers propose."""

from __future__ import annotations

import re
import socket
from pathlib import Path

import httpx
import pytest

from app.cli.database import read_settings
from app.cli.serving import serve_until_stopped
from app.errors import InvalidParameter
from app.settings import Settings
from tests.http import refused

ROOT = Path(__file__).resolve().parents[3]
PLACED = {"lon_deg": 8.4, "lat_deg": 49.0}


@pytest.mark.parametrize(
    ("body", "field", "near"),
    [
        ({"position": {"lon": 8.4, "lat_deg": 49.0}}, "position.lon", "lon_deg"),
        ({"position": PLACED | {"easting": 1.0}}, "position.easting", "easting_m"),
        ({"position": PLACED, "headingdeg": 90}, "headingdeg", "heading_deg"),
        ({"positon": PLACED}, "positon", "position"),
    ],
)
def test_the_nearest_name_is_proposed(client: httpx.Client, body: object, field: str, near: str) -> None:
    problem = refused(client.post("/v1/markers", json=body), 422)
    cures = {error["field"]: error["cure"] for error in problem["errors"]}
    assert cures[field] == f"did you mean {near}? If not, leave {field} out"


def test_names_that_are_near_to_none_are_to_be_left_out(client: httpx.Client) -> None:
    problem = refused(client.post("/v1/markers", json={"position": PLACED, "zzz": 1}), 422, field="zzz")
    assert problem["cure"] == "leave zzz out"


def test_items_of_bulk_requests_are_not_bare_markers(client: httpx.Client) -> None:
    problem = refused(client.post("/v1/markers/bulk", json={"items": [{"position": PLACED}]}), 422)
    assert "create" in problem["cure"]
    nearly = refused(client.post("/v1/markers/bulk", json={"items": [{"create": {"position": {"lon": 1}}}]}), 422)
    assert "did you mean lon_deg?" in nearly["cure"]


@pytest.mark.parametrize(
    ("path", "right"),
    [("/v1/decodes", "file"), ("/v1/imports", "file"), ("/v1/calibrations", "photos"), ("/v1/print-grades", "photo")],
)
def test_a_form_names_its_parts(client: httpx.Client, path: str, right: str) -> None:
    problem = refused(client.post(path, files={"image": ("a.png", b"x")}), 400, field="image")
    assert f"name the part with the file {right}" in problem["cure"]
    twice = [("declaration", (None, "{}")), ("declaration", (None, "{}"))]
    if right == "photos":
        refused(client.post(path, files=twice), 400, field="declaration")


@pytest.mark.parametrize(("bbox", "status"), [("8.5,49.0,8.4,49.1", False), ("179,-1,-179,1", True)])
def test_a_box_that_is_swapped_is_refused(client: httpx.Client, bbox: str, status: bool) -> None:
    west, south, east, north = (float(number) for number in bbox.split(","))
    found = client.get("/v1/markers", params={"bbox": bbox})
    searched = client.post("/v1/markers/search", json={"bbox": [west, south, east, north]})
    features = client.get("/ogc/collections/markers/items", params={"bbox": bbox})
    if status:
        assert {found.status_code, searched.status_code, features.status_code} == {200}
        return
    for response in (found, searched):
        assert "359.9 degrees" in refused(response, 422, field="bbox")["detail"]
    assert "359.9 degrees" in refused(features, 400, field="bbox")["detail"]


def test_a_slip_in_the_name_of_a_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("WAYMARK_SERVICE_PORT", "WAYMARK_KEY", "WAYMARK_TEST_POSTGRES_URL"):  # of other programs
        monkeypatch.setenv(name, "1")
    read_settings()
    monkeypatch.setenv("WAYMARK_PROT", "8001")
    with pytest.raises(InvalidParameter, match="there is no setting WAYMARK_PROT") as error:
        read_settings()
    assert error.value.cure == "did you mean WAYMARK_PORT? See docs/settings.md"


def test_a_port_that_is_in_use(settings: Settings) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(InvalidParameter, match=f"cannot listen on 127.0.0.1, port {port}") as error:
            serve_until_stopped(settings.model_copy(update={"port": port}))
    assert "--port" in str(error.value.cure)


def test_pages_append_no_null() -> None:
    """`append(null)` writes the word null into the page."""
    for script in (ROOT / "static").glob("*.js"):
        for call in re.findall(r"\.(?:append|replaceChildren)\(\n(.*?)\n  \);", script.read_text(), re.DOTALL):
            assert not re.search(r"^    \S.*: null,$", call, re.MULTILINE), script.name
