"""The markers' page: map, table, filters, selection, details and changes."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
from playwright.sync_api import Route, expect

from app.registry.tiles import write_layer
from tests.conftest import LiveServer
from tests.web.browsing import PHONE, Watched, shows, until
from tests.web.conftest import OpenPage
from tests.web.demo_data import CERPMS, PLATES

ALL = PLATES + CERPMS + 1  # and a tag


def test_the_map_shows_all_markers(watched: Watched, ids: dict[str, str]) -> None:
    page = watched.open("/markers")
    page.get_by_text(f"{ALL} markers", exact=True).wait_for()
    page.get_by_text(f"{ALL - 1} markers on the map").wait_for()  # one is retired
    page.get_by_text("Layers").click()
    page.get_by_label("Retired markers").check()
    page.get_by_text(f"{ALL} markers on the map").wait_for()
    page.wait_for_url("**layers=roads%2Cretired**")
    page.locator(".map-tools").get_by_text("Legend").click()
    shows(page.locator(".legend"), "Plate", "Magnet tag", "CERPM", "Fiducial sign", "planned", "suspect", "retired")


def test_groups_of_markers_are_counted_by_the_filter(watched: Watched, ids: dict[str, str]) -> None:
    columns = {
        "count": [3000, 12],
        "plate_active": [2000, None],
        "cerpm_active": [900, 12],
        "cerpm_suspect": [100, None],
    }
    tile = write_layer("markers_groups", columns, np.array([[1000, 1000], [3000, 1000]]))

    def answer(route: Route) -> None:
        (at,) = re.findall(r"WebMercatorQuad/(\d+/\d+/\d+)", route.request.url)
        route.fulfill(body=tile if at == "4/5/8" else b"", content_type="application/vnd.mapbox-vector-tile")

    watched.page.route("**/collections/markers/tiles/WebMercatorQuad/*/*/*", answer)
    page = watched.open("/markers?map=20,50,4")
    page.get_by_text("3,012 markers on the map").wait_for()
    page.get_by_role("search").get_by_label("Family").select_option("cerpm")
    page.get_by_text("1,012 markers on the map").wait_for()
    page.get_by_role("search").get_by_label("Status").select_option("suspect")
    page.get_by_text("100 markers on the map").wait_for()


def test_filters_order_and_view_are_kept_by_back_and_reload(watched: Watched, ids: dict[str, str]) -> None:
    page = watched.open("/markers?view=table")
    page.get_by_text(f"{ALL} markers", exact=True).wait_for()
    page.get_by_role("search").get_by_label("Family").select_option("cerpm")
    page.get_by_text(f"{CERPMS} markers", exact=True).wait_for()
    page.get_by_role("button", name="Measure", exact=True).click()
    page.get_by_role("button", name="Code").click()
    page.get_by_role("button", name="Code").click()
    first = page.locator("tbody a.code").first
    expect(first).to_have_text(str(700 + CERPMS - 1))
    page.locator("summary", has_text="Columns").click()
    page.get_by_label("Longitude [°]").check()
    page.get_by_role("columnheader", name="Longitude").wait_for()
    page.reload()
    page.get_by_text(f"{CERPMS} markers", exact=True).wait_for()
    expect(page.locator("tbody a.code").first).to_have_text(str(700 + CERPMS - 1))
    page.get_by_role("columnheader", name="Longitude").wait_for()
    page.locator("tbody a.code").first.click()
    page.locator(".panel-head .code").wait_for()
    page.go_back()
    page.locator(".panel").wait_for(state="detached")
    page.go_back()
    page.get_by_text(f"{ALL} markers", exact=True).wait_for()
    expect(page.get_by_role("search").get_by_label("Family")).to_have_value("")


def test_search_by_code_road_and_measure(watched: Watched, server: LiveServer, ids: dict[str, str]) -> None:
    with server.client() as client:
        code = client.get(f"/v1/markers/{ids['active']}").json()["code"]["digits"]
    page = watched.open("/markers?view=table")
    page.get_by_role("search").get_by_label("Code or number").fill(code)
    page.get_by_text("1 marker", exact=True).wait_for()
    page.get_by_role("search").get_by_label("Code or number").fill("703")
    page.get_by_role("link", name="703").wait_for()
    page.get_by_role("button", name="Clear filters").click()
    page.get_by_role("search").get_by_label("Road").fill("A7")
    page.locator("summary", has_text="Measure and area").click()
    page.get_by_label("From measure").fill("100")
    page.get_by_label("To measure").fill("120")
    page.get_by_text("3 markers", exact=True).wait_for()
    page.get_by_role("search").get_by_label("Road").fill("B9")
    page.get_by_text("No marker fits these filters").wait_for()


def test_an_area_is_drawn_and_exported(watched: Watched, ids: dict[str, str], tmp_path: Path) -> None:
    page = watched.open("/markers?map=8.4188,49.0069,16")
    page.get_by_text(f"{ALL - 1} markers on the map").wait_for()
    page.get_by_role("button", name="Select box").click()
    page.locator(".map[data-drawing=rectangle]").wait_for()
    box = page.locator(".map canvas").bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x - 160, y - 60)
    page.mouse.click(x - 160, y - 60)
    page.mouse.move(x, y + 60, steps=4)
    page.mouse.click(x, y + 60)
    page.wait_for_url("**polygon=POLYGON**")
    found = "document.querySelector('.actions-bar span').textContent"
    until(page, f"/^[1-9]\\d* markers$/.test({found}) && !{found}.startsWith('{ALL} ')")
    count = int(page.locator(".actions-bar span").first.inner_text().split()[0])
    assert 0 < count < PLATES
    page.get_by_role("button", name="Export").click()
    page.get_by_role("dialog").get_by_label("Format").select_option("geojson")
    with page.expect_download() as download:
        page.get_by_role("button", name="Save the file").click()
    download.value.save_as(tmp_path / "markers.geojson")
    assert len(json.loads((tmp_path / "markers.geojson").read_text())["features"]) == count
    page.reload()
    page.get_by_text(f"{count} markers on the map").wait_for()


def test_the_status_of_ticked_markers_is_changed(watched: Watched, server: LiveServer, ids: dict[str, str]) -> None:
    page = watched.open("/markers?view=table&family=cerpm&sort=code")
    page.get_by_label("Select 706").check()
    page.get_by_label("Select 707").check()
    page.get_by_text(re.compile(r"2 selected, \d+")).wait_for()  # and their distance
    page.reload()
    page.get_by_text(re.compile("2 selected")).wait_for()
    page.get_by_role("button", name="Change status").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Status").select_option("suspect")
    dialog.get_by_label("Reason").fill("not heard")
    dialog.get_by_role("button", name="Change status").click()
    page.get_by_text("The status of 2 markers is changed.").wait_for()
    with server.client() as client:
        found = client.get("/v1/markers", params={"family": "cerpm", "status": "suspect"}).json()["items"]
    assert sorted(marker["code"]["number"] for marker in found) == [706, 707]


def test_artwork_of_ticked_plates_is_a_job_that_ends_in_a_file(
    watched: Watched, ids: dict[str, str], tmp_path: Path
) -> None:
    page = watched.open("/markers?view=table&family=plate&status=planned")
    page.get_by_label("Select all rows").check()
    page.get_by_role("button", name="Artwork (ZIP)").click()
    with page.expect_download() as download:
        page.get_by_role("dialog").get_by_role("button", name="Make the artwork").click()
    download.value.save_as(tmp_path / "artwork.zip")
    assert (tmp_path / "artwork.zip").read_bytes()[:2] == b"PK"


def test_a_marker_is_edited_and_its_history_says_so(watched: Watched, server: LiveServer, ids: dict[str, str]) -> None:
    page = watched.open(f"/markers/{ids['active']}?view=table")
    page.get_by_role("button", name="Edit").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Direction of travel").fill("400")
    dialog.get_by_role("button", name="Save").click()
    dialog.locator(".field-error").wait_for()
    until(page, "document.activeElement.name === 'heading_deg'")
    watched.complaints.clear()  # the browser itself reports the 422
    dialog.get_by_label("Direction of travel").fill("48.5")
    dialog.get_by_label("Road").fill("")
    dialog.get_by_label("Measure").fill("")
    dialog.get_by_label("Offset").fill("")
    dialog.get_by_label("Reason").fill("turned")
    dialog.get_by_role("button", name="Save").click()
    page.get_by_text("The change is saved.").wait_for()
    page.locator("summary", has_text="History").click()
    shows(page.locator(".history"), "turned", "Direction of travel [°]: 47 → 48.5", "Road: A7 → none")
    with server.client() as client:
        marker = client.get(f"/v1/markers/{ids['active']}").json()
    assert (marker["heading_deg"], marker["road"], marker["version"]) == (48.5, None, 2)


def test_a_change_of_somebody_else_is_not_overwritten(
    watched: Watched, server: LiveServer, ids: dict[str, str]
) -> None:
    page = watched.open(f"/markers/{ids['cerpm']}?view=table")
    page.get_by_role("button", name="Edit").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Road").fill("A8")
    with server.client() as client:
        path = f"/v1/markers/{ids['cerpm']}"
        assert client.patch(path, json={"road": "A9"}, headers={"If-Match": "*"}).status_code == 200
    dialog.get_by_role("button", name="Save").click()
    expect(dialog.locator(".problem")).to_contain_text("version")
    watched.complaints.clear()  # the browser itself reports the 412
    with server.client() as client:
        assert client.get(path).json()["road"] == "A9"


def test_a_marker_is_retired_on_a_phone(new_page: OpenPage, server: LiveServer, ids: dict[str, str]) -> None:
    watched = new_page(size=PHONE)
    page = watched.open(f"/markers/{ids['plate']}?view=table")
    page.get_by_role("button", name="Retire").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Reason").fill("road works")
    dialog.get_by_role("button", name="Retire").click()
    page.locator(".panel").get_by_text("retired").first.wait_for()
    page.keyboard.press("Escape")
    page.locator(".panel").wait_for(state="detached")
    with server.client() as client:
        assert client.get(f"/v1/markers/{ids['plate']}").json()["status"] == "retired"


def test_a_long_list_has_only_the_rows_in_view_in_the_document(watched: Watched, ids: dict[str, str]) -> None:
    page = watched.open("/markers?view=both&sort=code")
    page.get_by_text(f"{ALL} markers", exact=True).wait_for()
    rows = "document.querySelectorAll('tbody tr:not(.space)').length"
    until(page, f"{rows} > 0 && {rows} < {ALL - 10}")
    page.locator(".table-scroll").evaluate("(box) => box.scrollTo(0, box.scrollHeight)")
    page.locator(f"tr[aria-rowindex='{ALL + 1}']").wait_for()
