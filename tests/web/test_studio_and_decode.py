"""Registering markers and managing vehicles in the browser, against the real decoders."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from tests.api.fleet.board_photos import good_photos, jpeg
from tests.conftest import LiveServer
from tests.web.browsing import Watched, shows, until

ROOT = Path(__file__).resolve().parents[2]


def field(page: Page, name: str, value: str) -> None:
    """Type into the field with a path in the body."""
    page.locator(f"main [name='{name}']").last.fill(value)


def test_a_refused_plate_is_explained(watched: Watched) -> None:
    page = watched.open("/studio/plates")
    field(page, "position.lon_deg", "22.304")
    field(page, "position.lat_deg", "114.179")
    page.locator("[name='position.lat_deg'][aria-invalid=true]").wait_for()
    page.locator(".registration summary").click()
    page.get_by_role("button", name="Register").click()
    problem = page.locator(".registration .problem")
    shows(problem, "lat_deg is 114.179", "position.lat_deg", "-90 to 90 deg", "swapped axes")
    expect(page.locator("[aria-invalid=true]")).to_have_count(1)
    watched.complaints.clear()  # the browser itself reports the 422


def test_a_plate_is_registered_and_its_artwork_shown(watched: Watched) -> None:
    page = watched.open("/studio/plates")
    field(page, "position.lon_deg", "12.345678")
    field(page, "position.lat_deg", "45.678912")
    for wanted, unit_mm in (("position-robust", "27"), ("id", "35")):
        page.locator("[name='code.scheme']").select_option(wanted)
        page.get_by_text("Outer edge of the plate: 325\u00a0mm").wait_for()
        expect(page.locator("[name='geometry.unit_mm']")).to_have_value(unit_mm)
    field(page, "geometry.gap_mm", "6")
    page.get_by_text("Outer edge of the plate: 334\u00a0mm").wait_for()
    page.locator(".registration summary").click()
    page.get_by_role("button", name="Register").click()
    page.wait_for_url("**/markers/*")
    page.locator(".artwork").wait_for()
    shows(page.locator(".panel"), "id, number", "334 mm square", "Read back by the decoder")
    until(page, "document.querySelector('.artwork').naturalWidth > 100")
    with page.expect_download() as download:
        page.locator(".panel").get_by_role("button", name="SVG").click()
    assert re.fullmatch(r"[0-9A-F]{12}\.svg", download.value.suggested_filename)


def test_a_tag_is_planned_from_a_meaning_and_its_layout_shown(watched: Watched, server: LiveServer) -> None:
    book = {
        "name": "Page",
        "design": {"magnets": 3, "length_m": 4, "segment_m": 0.1},
        "meanings": [{"kind": "arrow", "value": "left"}, {"kind": "bend-right", "value": 125}],
    }
    with server.client() as client:
        entry = client.post("/v1/codebooks", json=book).json()["entries"][1]
    page = watched.open("/studio/magnets?tab=plan")
    expect(page.get_by_label("Codebook")).not_to_have_value("")
    page.get_by_label("Codebook").select_option(label="Page")
    page.get_by_label("Meaning").select_option(label=f"bend right 125 deg: {entry['code']}")
    field(page, "tag.chainage_m", "60")
    field(page, "line", "-84.48, 42.7263\n-84.4776, 42.7263")
    field(page, "site.design_speed_m_s", "200")
    page.get_by_role("button", name="Plan tag").click()
    expect(page.locator(".problem")).to_contain_text("0.5 to 70 m/s")
    expect(page.locator("[aria-invalid=true]")).to_have_attribute("name", "site.design_speed_m_s")
    watched.complaints.clear()  # the browser itself reports the 422
    field(page, "site.design_speed_m_s", "13.4")
    field(page, "site.stop_line_chainage_m", "100")
    page.get_by_role("button", name="Plan tag").click()
    page.wait_for_url("**/markers/*")
    page.locator(".place-plot").wait_for()
    parts = (entry["code"], "bend right 125 deg", "reaction-distance: 36 >= 59.9059 m", "3.00\u00a0USD")
    shows(page.locator(".panel"), *parts)
    expect(page.locator(".place-plot .spot")).to_have_count(3)
    expect(page.locator(".panel .buttons button")).to_have_text(["PDF", "CSV", "GEOJSON"])
    with page.expect_download() as download:
        page.locator(".panel").get_by_role("button", name="PDF").click()
    assert download.value.suggested_filename.endswith("-r1.pdf")


def test_a_cerpm_is_registered_and_its_message_explained(watched: Watched) -> None:
    page = watched.open("/studio/cerpms")
    field(page, "position.lon_deg", "-85.6436")
    field(page, "position.lat_deg", "42.2531")
    field(page, "speed_limit.value", "300")
    field(page, "number", "4711")
    page.get_by_role("button", name="Register").click()
    expect(page.locator(".problem")).to_contain_text("255")
    watched.complaints.clear()  # the browser itself reports the 422
    field(page, "speed_limit.value", "25")
    page.locator("[name='speed_limit.unit']").select_option("mph")
    page.get_by_role("button", name="Register").click()
    page.wait_for_url("**/markers/*")
    page.locator(".panel table").wait_for()
    parts = ("4711", "left", "25 mph", "-85.6436000", "SF7, 500 kHz", "marker's own")
    shows(page.locator(".panel"), *parts)
    with page.expect_download() as download:
        page.locator(".panel").get_by_role("button", name="BIN").click()
    assert download.value.suggested_filename == "cerpm-4711.bin"


def test_a_vehicle_is_added_and_listed(watched: Watched) -> None:
    page = watched.open("/operations/vehicles")
    page.get_by_role("button", name="Add a vehicle").click()
    dialog = page.get_by_role("dialog")
    dialog.locator("[name=name]").fill("BUS <7>")
    dialog.locator("[name=profile]").fill("{")
    dialog.get_by_role("button", name="Add a vehicle").click()
    expect(dialog.locator(".problem")).to_contain_text("The profile cannot be read")
    dialog.locator("[name=profile]").fill('{"camera": {"height_m": 0}}')
    dialog.get_by_role("button", name="Add a vehicle").click()
    dialog.locator(".problem", has_text="profile.camera.height_m").wait_for()
    watched.complaints.clear()  # the browser itself reports the 422
    dialog.locator("[name=profile]").fill('{"camera": {"height_m": 1.4, "horizontal_fov_deg": 70}, "trace": {}}')
    dialog.get_by_role("button", name="Add a vehicle").click()
    parts = ("BUS <7>", "active, Version 1", "70° field of view", "1.4 m above the road", "0.000", "never")
    shows(page.locator(".panel"), *parts)
    expect(page.locator("tbody").first).to_contain_text("BUS <7>")
    page.get_by_role("button", name="Calibrate").click()
    expect(page.locator(".panel .problem")).to_contain_text("No photos are selected")


def test_a_camera_is_calibrated_and_its_errors_shown(watched: Watched, server: LiveServer, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "photos.zip", "w") as archive:
        for k, grey in enumerate(good_photos()):
            archive.writestr(f"{k}.jpg", jpeg(grey))
        archive.writestr("mirrored.jpg", jpeg(good_photos()[0][:, ::-1].copy()))
    with server.client() as client:
        mount = {"camera": {"height_m": 1.4, "depression_deg": 12.0}}
        vehicle = client.post("/v1/vehicles", json={"name": "To calibrate", "profile": mount}).json()
        page = watched.open(f"/operations/vehicles/{vehicle['id']}")
        page.locator("[name=photos]").set_input_files(tmp_path / "photos.zip")
        page.get_by_role("button", name="Calibrate").click()
        page.locator(".coverage").wait_for()
        expect(page.locator(".coverage span")).to_have_count(48)
        result = page.locator(".calibration")
        expect(result).to_contain_text(re.compile(r"Reprojection error 0\.\d{3} px over 14 of 15 photos"))
        shows(result, "mirrored", "±")
        page.get_by_role("button", name="Use for To calibrate").click()
        page.locator(".panel", has_text="Version 2").wait_for()
        camera = client.get(f"/v1/vehicles/{vehicle['id']}").json()["profile"]["camera"]
    assert camera["fx_px"] == pytest.approx(754.0, rel=0.003)
    assert camera["depression_deg"] == 12.0
