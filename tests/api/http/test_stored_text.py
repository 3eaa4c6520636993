"""Texts of users are texts: on the page, in drawings and maps, in file names and tables. Tried in a real browser."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlencode
from xml.etree import ElementTree as ET

import httpx
import pytest
from playwright.sync_api import Page

from app.services.access.access import Scope
from tests.api.markers.test_cerpm_markers import cerpm
from tests.conftest import LiveServer
from tests.web.browsing import chromium, open_sections, until, watched_page

pytestmark = pytest.mark.slow

HOSTILE = "=1\"'><img src=x onerror=hit=1><script>hit=1</script>"
"""Breaks out of an attribute and of a text, and is a formula. Every text below begins with it."""
WAY = {"type": "LineString", "coordinates": [[12.1, 45.1], [12.106, 45.1]]}
SURVEY = dict.fromkeys(("survey_method", "surveyor", "instrument"), HOSTILE)


def _made(answer: httpx.Response) -> dict[str, Any]:
    assert answer.status_code == 201, answer.text
    return dict(answer.json())


@pytest.fixture(scope="module")
def stored(server: LiveServer) -> Iterator[tuple[httpx.Client, dict[str, str]]]:
    """The client of an agency whose every text is hostile, and the ids of what it has."""
    with server.agency(HOSTILE, Scope.ADMIN) as client:
        road, code = {"road": HOSTILE, "reason": HOSTILE}, {"scheme": "id"}
        plate = {"position": {"lon_deg": 12.1, "lat_deg": 45.2, **SURVEY}, "code": code, **road}
        book = {
            "name": HOSTILE,
            "design": {"magnets": 3, "length_m": 4, "segment_m": 0.1},
            "meanings": [{"kind": "notice", "value": HOSTILE}],
        }
        entry = _made(client.post("/v1/codebooks", json=book))
        lane = {"geometry": WAY, **SURVEY}
        tag = {"code": entry["entries"][0]["code"], "codebook_id": entry["id"], "chainage_m": 100}
        vehicle = {"name": HOSTILE, "note": HOSTILE, "profile": {"trace": {"columns": {"speed": HOSTILE}}}}
        key = _made(client.post("/v1/keys", json={"label": HOSTILE, "scope": "vehicle"}))
        alignment = _made(client.post("/v1/alignments", files={
            "file": (f"{HOSTILE}.geojson".replace("/", ""), _road_file(), "application/geo+json"),
            "declaration": (None, json.dumps({"name": HOSTILE}), "application/json"),
        }))["id"]  # fmt: skip
        rules = {"version": 1, "plates": {"spacing_m": 100}, "costs": {"items": [
            {"item": HOSTILE, "per": "plate", "price": 1, "pay_item": HOSTILE[:40], "source": HOSTILE}
        ]}}  # fmt: skip
        ids = {
            "plate": _made(client.post("/v1/markers", json=plate))["id"],
            "tag": _made(client.post("/v1/markers", json={"family": "magnet", "lane": lane, "tag": tag, **road}))["id"],
            "cerpm": _made(client.post("/v1/markers", json=cerpm({"lon_deg": 12.1, "lat_deg": 45.3}, **road)))["id"],
            "road": _made(client.post("/v1/roads", json={"name": HOSTILE, "geometry": WAY, "reason": HOSTILE}))["id"],
            "vehicle": _made(client.post("/v1/vehicles", json=vehicle))["id"],
            "plan": _made(client.post("/v1/plans", json={"name": HOSTILE, "alignment_id": alignment, "rules": rules}))[
                "id"
            ],
            "alignment": alignment,
        }
        linked = client.put(f"/v1/vehicles/{ids['vehicle']}/keys/{key['id']}")
        assert linked.is_success, linked.text
        yield client, ids


def _road_file() -> bytes:
    properties = {"speed_limit_kmh": 50, "name": HOSTILE, "id": HOSTILE, "lane": HOSTILE}
    feature = {"type": "Feature", "properties": properties, "geometry": WAY}
    return json.dumps({"type": "FeatureCollection", "features": [feature]}).encode()


def _plan_files(client: httpx.Client, plan: str) -> list[str]:
    names: list[str] = client.get(f"/v1/plans/{plan}/files/none").json()["limit"].split(", ")
    assert len(names) > 5
    return names


def test_nothing_runs_on_the_pages(
    server: LiveServer, stored: tuple[httpx.Client, dict[str, str]], tmp_path: Path
) -> None:
    client, ids = stored
    picture = tmp_path / (HOSTILE.replace("/", "") + ".png")
    picture.write_bytes(b"no picture")
    key = client.headers["authorization"].split()[1]
    with chromium() as browser, watched_page(browser, server.url, key) as watched:

        def check(page: Page) -> None:
            """Texts are there as texts, and nothing else."""
            assert page.locator("[onerror], script:not([src]):not([type=importmap])").count() == 0
            assert page.evaluate("typeof hit") == "undefined"

        page = watched.open("/")
        page.get_by_text(f"Road markers of {HOSTILE}").wait_for()
        for family in ("plate", "tag", "cerpm"):
            page = watched.open(f"/markers/{ids[family]}")
            page.locator(".panel .facts", has_text=HOSTILE).first.wait_for()
            page.locator(".map-tools").wait_for()
            open_sections(page)
            page.locator(".history", has_text=HOSTILE).wait_for()
            until(page, "!document.querySelector('main .loading')")
            check(page)
        lists = ("roads", "plans", "operations/vehicles", "operations/codebooks", "operations/keys", "operations/audit")
        for name in lists:
            page = watched.open(f"/{name}")
            page.locator("tbody", has_text=HOSTILE).wait_for()
            check(page)
        page = watched.open(f"/operations/vehicles/{ids['vehicle']}")
        page.locator(".panel .facts", has_text=HOSTILE).first.wait_for()
        open_sections(page)
        check(page)
        for path in (f"roads/{ids['road']}", f"roads/lanes/{ids['alignment']}", f"plans/{ids['plan']}?tab=rules",
                     f"plans/{ids['plan']}?tab=history", f"plans/compare?ids={ids['plan']}"):  # fmt: skip
            page = watched.open(f"/{path}")
            page.locator("main", has_text=HOSTILE).wait_for()
            until(page, "!document.querySelector('main .loading')")
            check(page)
        page = watched.open("/studio/magnets")
        page.locator("[name=book] option", has_text=HOSTILE).wait_for(state="attached")
        check(page)
        page = watched.open("/studio/magnets?tab=plan")
        page.locator("[name=codebook] option", has_text=HOSTILE).wait_for(state="attached")
        page.locator("[name=meaning] option", has_text=HOSTILE).wait_for(state="attached")
        check(page)
        page = watched.open("/decode")
        page.locator("[name=file]").set_input_files(picture)
        page.locator("main", has_text="onerror").wait_for()
        check(page)
        page = watched.open(
            "/markers?" + urlencode({"view": "table", "road": HOSTILE, "polygon": HOSTILE, "sort": HOSTILE})
        )
        page.locator(".problem").wait_for()
        check(page)
        watched.complaints = [text for text in watched.complaints if "400" not in text and "422" not in text]
        page = watched.open("/operations/vehicles")
        page.get_by_role("button", name="Add a vehicle").click()
        page.locator("dialog [name=name]").fill(HOSTILE)  # a second vehicle of this name is refused by an error message
        page.locator("dialog button[type=submit]").click()
        page.locator("dialog .problem", has_text=HOSTILE[:20]).wait_for()
        check(page)
        assert not [text for text in watched.complaints if "Content Security Policy" in text]
        watched.complaints.clear()  # the browser itself reports the 409


def test_files_contain_the_text_and_nothing_that_runs(stored: tuple[httpx.Client, dict[str, str]]) -> None:
    client, ids = stored
    paths = [f"/v1/markers/{ids['plate']}/artwork.{form}" for form in ("svg", "pdf", "dxf", "png")]
    paths += [f"/v1/markers/{ids['tag']}/layout.{form}" for form in ("csv", "geojson", "pdf")]
    paths += [f"/v1/plans/{ids['plan']}/files/{name}" for name in _plan_files(client, ids["plan"])]
    paths += [f"/v1/exports/{kind}" for kind in ("csv", "geojson", "kml", "landxml")]
    paths += [f"/v1/alignments/{ids['alignment']}/map.osm"]
    seen = set()
    for path in paths:
        answer = client.get(path)
        if answer.status_code == 404:
            continue
        assert answer.status_code == 200, f"{path}: {answer.text}"
        kind = answer.headers["content-type"].partition(";")[0]
        seen.add(kind)
        name = answer.headers.get("content-disposition")
        assert name is None or re.fullmatch(r'(inline|attachment); filename="[\w.-]+"', name), f"{path}: {name}"
        if kind == "text/html" or kind.endswith("xml"):
            for element in ET.fromstring(answer.content).iter():
                assert str(element.tag).rpartition("}")[2].lower() not in ("script", "img", "iframe"), path
                assert not [name for name in element.attrib if name.lower().startswith("on")], path
        if kind == "text/csv":
            for row in csv.reader(io.StringIO(answer.text, newline="")):
                assert not [cell for cell in row if cell.startswith(("=", "@", "+"))], f"{path}: {row}"
    assert {"image/svg+xml", "text/csv", "application/pdf"} <= seen


def test_answers_with_texts_are_json(stored: tuple[httpx.Client, dict[str, str]]) -> None:
    """A browser that opens one shows no page, whatever it contains."""
    client, _ids = stored
    for name in ("markers", "codebooks", "roads", "vehicles", "keys", "plans", "alignments", "audit"):
        answer = client.get(f"/v1/{name}")
        assert HOSTILE in json.dumps(answer.json(), ensure_ascii=False).replace('\\"', '"')
        assert answer.headers["content-type"].startswith("application/json")
    refused = client.get("/v1/markers", params={HOSTILE: "1"})
    assert refused.status_code >= 400
    assert refused.headers["content-type"] == "application/problem+json"
