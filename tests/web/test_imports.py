"""The page of imports: a survey is checked, its rows are shown, corrections are accepted, the survey is stored."""

from __future__ import annotations

import json
import re
from pathlib import Path

from playwright.sync_api import Locator, Page, expect

from tests.conftest import LiveServer
from tests.web.browsing import PHONE, Watched, until
from tests.web.conftest import OpenPage

EXAMPLE_ROWS = 10
LON, LAT = 12.3, 45.6  # where no marker of other tests is


def survey(rows: int = 8, *, header: str = "number,lon,lat", **changed: str) -> bytes:
    """A survey of CERPMs, five metres apart; `row3="..."` replaces a line."""
    lines = [f"{k},{LON + k * 6.4e-5:.9f},{LAT + k % 3 * 1e-8:.9f}" for k in range(1, rows + 1)]
    for name, line in changed.items():
        lines[int(name.removeprefix("row")) - 1] = line
    return "\n".join([header, *lines]).encode()


def choose(page: Page, data: bytes, name: str = "survey.csv", **options: str) -> None:
    """Drop a file, and declare what it is."""
    page.locator("main input[type=file]").set_input_files({"name": name, "mimeType": "text/csv", "buffer": data})
    for option, value in {"family": "cerpm", **options}.items():
        field = page.locator(f"main [name='{option}']")
        if field.evaluate("field => !field.closest('details') || field.closest('details').open") is False:
            field.locator("xpath=ancestor::details/summary").click()
        if field.evaluate("field => field.tagName") == "SELECT":
            field.select_option(value)
        else:
            field.fill(value)


def check(page: Page) -> Locator:
    """Check the survey; returns the place of its results."""
    page.get_by_role("button", name="Check", exact=True).click()
    page.locator(".results .summary").wait_for()
    settled(page)
    return page.locator(".results")


def settled(page: Page) -> None:
    """Wait until no check is running."""
    until(page, "!document.querySelector('main form button[type=submit]').disabled")


AREA = {"area_deg": f"{LON - 0.1}, {LAT - 0.1}, {LON + 0.1}, {LAT + 0.1}"}


def test_the_example_is_checked_and_stored(watched: Watched, server: LiveServer) -> None:
    page = watched.open("/imports")
    with page.expect_download() as download:
        page.get_by_role("button", name="Download the example file").click()
    assert Path(download.value.path()).read_text().count("\n") == EXAMPLE_ROWS
    page.get_by_role("button", name="Try it with an example").click()
    expect(check(page)).to_contain_text("10 rows can be stored")
    page.locator(".rows-view .maplibregl-canvas").wait_for()
    expect(page.locator(".rows-view tbody tr")).to_have_count(EXAMPLE_ROWS)
    with server.client() as client:
        before = client.get("/v1/markers", params={"bbox": "8.39,49.00,8.41,49.02"}).json()["items"]
    assert before == []
    page.get_by_role("button", name="Store 10 rows").click()
    page.get_by_role("link", name="Show the markers").wait_for()
    with page.expect_download() as download:
        page.get_by_role("button", name="Report (JSON)").click()
    assert json.loads(Path(download.value.path()).read_text())["stored"] == EXAMPLE_ROWS
    page.get_by_role("link", name="Show the markers").click()
    page.get_by_text("10 markers", exact=True).wait_for()
    watched.open("/imports")
    with server.client() as client:
        assert len(client.get("/v1/markers", params={"bbox": "8.39,49.00,8.41,49.02"}).json()["items"]) == EXAMPLE_ROWS


def test_rows_are_left_out_one_by_one_and_taken_back(watched: Watched) -> None:
    page = watched.open("/imports")
    choose(page, survey(row3="3,12.3,abc", row5="2,12.3003,45.6"), crs="EPSG:4326", **AREA)
    expect(check(page)).to_contain_text("refused")
    page.get_by_label("Use row 3").uncheck()
    page.locator(".counts", has_text="1 left out").wait_for()
    settled(page)
    page.get_by_label("Use row 3").check()
    expect(page.locator(".counts", has_text="left out")).to_have_count(0)
    settled(page)
    page.get_by_role("button", name="Accept all corrections").click()
    page.locator(".counts", has_text="2 left out").wait_for()
    settled(page)
    page.get_by_role("button", name="Store 6 rows").wait_for()
    page.get_by_role("button", name="left out (2)").click()
    page.wait_for_url("**rows=left-out*")
    expect(page.locator(".rows-view tbody tr")).to_have_count(2)
    watched.complaints.clear()  # the browser itself reports a 422


def test_a_row_is_chosen_by_its_number_and_kept_in_the_address(watched: Watched) -> None:
    page = watched.open("/imports")
    choose(page, survey(), crs="EPSG:4326", **AREA)
    check(page)
    page.locator(".rows-view tbody button", has_text="4").click()
    page.wait_for_url("**row=4**")
    expect(page.locator(".rows-view tr.chosen")).to_have_text(re.compile("^4"))


def test_corrections_of_the_declaration_are_accepted(watched: Watched) -> None:
    page = watched.open("/imports")
    choose(page, survey(header="number,lat,lon"), crs="EPSG:4326", **AREA)
    check(page)
    fault = page.locator(".fault", has_text="Axes are swapped")
    fault.get_by_role("button", name="Accept: ").click()
    page.locator(".summary", has_text="8 rows can be stored").wait_for()
    expect(page.locator("[name=columns]")).to_have_value(re.compile("lon_deg = lat"))


def test_the_place_is_confirmed_on_the_map(watched: Watched) -> None:
    page = watched.open("/imports")
    choose(page, survey(), crs="EPSG:4326", area_deg="")
    check(page)
    fault = page.locator(".fault", has_text="Place could not be checked")
    fault.get_by_role("button", name="The map shows the right place").click()
    expect(page.locator(".fault", has_text="Place could not be checked")).to_have_count(0)
    west = float(page.locator("[name=area_deg]").input_value().split(",")[0])
    assert LON - 0.01 < west < LON


def test_what_is_missing_is_named_at_its_field(watched: Watched) -> None:
    page = watched.open("/imports")
    page.get_by_role("button", name="Check", exact=True).click()
    page.locator(".problem", has_text="No file is selected").wait_for()
    choose(page, b"number,easting,northing,height\n1,456850,5428180,110\n", crs="EPSG:25832")
    page.get_by_role("button", name="Check", exact=True).click()
    page.locator(".field-error", has_text="vertical datum").wait_for()
    page.locator("[name=vertical_datum][aria-invalid=true]").wait_for()
    page.locator("[name=area_deg]").evaluate("field => { field.closest('details').open = true; }")
    page.locator("[name=area_deg]").fill("8, 49")
    page.get_by_role("button", name="Check", exact=True).click()
    page.locator(".problem", has_text="4 numbers").wait_for()
    watched.complaints.clear()  # the browser itself reports the 422


def test_after_a_change_one_checks_again(watched: Watched) -> None:
    page = watched.open("/imports")
    choose(page, survey(), crs="EPSG:4326", **AREA)
    check(page)
    page.locator("[name=road]").fill("B 10")
    page.get_by_text("The options have changed since this check").wait_for()
    expect(page.get_by_role("button", name="Store 8 rows")).to_be_disabled()


def test_a_large_survey_becomes_a_job_with_a_page(watched: Watched, server: LiveServer) -> None:
    form = {
        "file": ("survey.csv", survey(6)),
        "declaration": ("", json.dumps({"crs": "EPSG:4326", "family": "cerpm", "dry_run": True, "list_rows": 50})),
    }
    with server.client() as client:
        job = client.post("/v1/imports", files=form, headers={"Prefer": "respond-async"}).json()
    page = watched.open(f"/imports/{job['id']}")
    page.locator(".counts", has_text="6 rows").wait_for()
    page.get_by_role("link", name="All imports").click()
    page.locator(f"a[href='/imports/{job['id']}']").wait_for()


def test_the_page_fits_a_phone(new_page: OpenPage) -> None:
    watched = new_page(size=PHONE, locale="de-DE")
    page = watched.open("/imports")
    page.get_by_role("button", name="Mit einem Beispiel ausprobieren").click()
    page.get_by_role("button", name="Prüfen", exact=True).click()
    page.locator(".results .summary").wait_for()
    assert page.evaluate("document.scrollingElement.scrollWidth") <= PHONE[0]
