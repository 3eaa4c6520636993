"""The plate studio and the magnet studio follow what is typed; a link shows the same."""

from __future__ import annotations

import io
import json
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Locator, Page, expect

from app.markers.magnet import MOMENT_AM2, parse_tag
from app.markers.plate import PlateCode, PlateScheme
from app.services.access.access import Scope
from app.simulation.magnetic.dipoles import dipole_field_ut
from tests.conftest import LiveServer
from tests.decoders.plate.print_photos import CODE, photo_of
from tests.web.browsing import Watched, until
from tests.web.conftest import OpenPage


def field(page: Page, name: str, value: str) -> None:
    """Type into the first field of a name."""
    page.locator(f"main [name='{name}']").first.fill(value)


def heading(page: Page, text: str) -> None:
    """Wait for a plate or a tag to be drawn."""
    page.locator(".studio-view h2.code", has_text=re.compile(f"^{re.escape(text)}$")).wait_for()


def grouped(code: PlateCode, size: int = 4) -> str:
    """Digits as people read them."""
    return " ".join(code.digits[k : k + size] for k in range(0, len(code.digits), size))


def dimension(page: Page, name: str) -> Locator:
    """Value in the table of dimensions."""
    return page.locator("tr", has=page.get_by_text(name, exact=True)).locator("td").nth(1)


def test_the_plate_follows_what_is_typed_and_a_link_shows_the_same(watched: Watched) -> None:
    page = watched.open("/studio/plates")
    page.get_by_text("The number is an example").wait_for()
    code = PlateCode.from_registry_number(48879)
    field(page, "number", "0xBEEF")
    heading(page, grouped(code))
    expect(page.get_by_text("The number is an example")).to_have_count(0)
    field(page, "geometry.unit_mm", "40")
    page.locator(".plate-drawing text", has_text=re.compile("^365$")).wait_for()
    shown = page.locator(".plate-drawing text").all_text_contents()
    assert {"365", "40", "5", "45", "85", "20"} <= set(shown)
    for name, value in (
        ("Outer edge", "365"),
        ("Boundary marker", "85"),
        ("Pitch of the units", "45"),
        ("Diagonal", "516.2"),
    ):
        expect(dimension(page, name)).to_have_text(value)
    squares = page.evaluate(
        "[...document.querySelectorAll('.plate-drawing > path')].map((path) => path.getAttribute('d'))"
    )
    assert squares[1].count("M") == int(code.units.sum())
    until(page, "location.search.includes('number=0xBEEF') && location.search.includes('unit=40')")
    until(page, "!location.search.includes('gap')")
    page.reload()
    heading(page, grouped(code))
    expect(page.locator("[name='geometry.unit_mm']")).to_have_value("40")
    expect(dimension(page, "Outer edge")).to_have_text("365")


def test_a_position_gives_its_digits_and_a_wrong_one_is_explained_at_its_field(watched: Watched) -> None:
    page = watched.open("/studio/plates?scheme=position")
    page.get_by_text("There is no plate to draw yet").wait_for()
    field(page, "position.lon_deg", "114.179203")
    field(page, "position.lat_deg", "22,304161")
    code = PlateCode.from_position(114.179203, 22.304161)
    heading(page, grouped(code, 6))
    field(page, "geometry.gap_mm", "1")
    page.locator("[name='geometry.gap_mm'][aria-invalid=true]").wait_for()
    page.get_by_text("The drawing shows the last valid plate").wait_for()
    expect(page.locator(".studio-form .field-error")).to_contain_text("2 to 10 mm")
    expect(page.get_by_role("button", name="PDF")).to_be_disabled()
    heading(page, grouped(code, 6))
    field(page, "geometry.gap_mm", "6")
    page.locator("[aria-invalid=true]").wait_for(state="detached")
    expect(page.get_by_role("button", name="PDF")).to_be_enabled()
    watched.complaints.clear()  # the browser itself reports the 422


def test_a_dimension_is_emphasised_by_keyboard(watched: Watched) -> None:
    page = watched.open("/studio/plates")
    page.get_by_role("button", name="Diagonal").focus()
    page.locator(".dimension.chosen text", has_text="459.6").wait_for()
    page.get_by_role("button", name="Thickness").focus()
    expect(page.locator(".dimension.chosen text")).to_have_text("20")


def test_numbers_of_64_bits_keep_their_digits_and_files_are_saved(watched: Watched) -> None:
    page = watched.open(f"/studio/plates?n=12&unit=30&number={2**64 - 3}")
    code = PlateCode.from_registry_number(2**64 - 3, n=12)
    heading(page, grouped(code))
    expect(page.locator(".facts")).to_contain_text(f"0xFFFFFFFFFFFFFFFD = {2**64 - 3}")
    page.get_by_label("Heating tracks").check()
    with page.expect_download() as download:
        page.get_by_role("button", name="SVG").click()
    assert download.value.suggested_filename == f"{code.digits}.svg"
    drawing = Path(download.value.path()).read_text()
    assert 'id="HEATER"' in drawing
    assert code.digits in drawing
    page.get_by_text("The sheet for the workshop").click()
    until(page, "document.querySelector('.artwork')?.naturalWidth > 100")


def test_the_id_of_a_marker_shows_that_plate(watched: Watched, ids: dict[str, str], server: LiveServer) -> None:
    with server.client() as client:
        digits = client.get(f"/v1/markers/{ids['plate']}").json()["code"]["digits"]
    page = watched.open(f"/studio/plates?number={ids['plate']}")
    page.get_by_text("Registered as").wait_for()
    heading(page, " ".join(digits[k : k + 4] for k in range(0, 12, 4)))
    expect(page.get_by_role("link", name=digits)).to_have_attribute("href", f"/markers/{ids['plate']}")
    expect(page.locator(".registration")).to_have_count(0)
    field(page, "number", ids["tag"])
    page.get_by_text("This marker is no plate").first.wait_for()


def test_the_camera_calculator_shows_frames_rates_and_a_picture(watched: Watched, server: LiveServer) -> None:
    page = watched.open("/studio/plates?tab=camera&number=48879&width=960&rows=540&speed=50")
    picture = page.locator(".camera-pictures canvas").first
    picture.wait_for()
    with server.client() as client:
        camera = {"width_px": 960, "height_px": 540}
        found = client.post("/v1/plate-drafts/pass", json={"camera": camera, "speed_kmh": 50}).json()
    figures = page.locator(".figure-tiles .figure")
    frames = found["readable_frames_per_pass"]
    expect(figures.nth(0)).to_have_text(f"{frames:.{1 if frames < 10 else 0}f}")
    expect(figures.nth(1)).to_have_text(f"{found['best_unit_px']:.1f}\u00a0px")
    expect(figures.nth(2)).to_have_text(f"{found['blur_mm']:.1f}\u00a0mm")
    expect(page.locator("tbody").nth(1).locator("tr")).to_have_count(len(found["frames"]))
    page.get_by_text("The decoder reads the plate in this picture").wait_for()
    assert picture.evaluate("(canvas) => [canvas.width, canvas.height]") == [960, 540]
    field(page, "exposure_ms", "30")
    page.get_by_text("The decoder does not read the plate in this picture").wait_for()
    page.get_by_text("416.7\u00a0mm").wait_for()
    page.get_by_text("not expected to be read").nth(1).wait_for()
    until(page, "location.search.includes('exposure=30')")
    page.locator("#ahead").fill("0.5")
    page.get_by_text("The plate is not in view at this distance").wait_for()
    until(page, "location.search.includes('ahead=0.5')")
    field(page, "camera.height_m", "9")
    page.locator("[name='camera.height_m'][aria-invalid=true]").wait_for()
    watched.complaints.clear()  # the browser itself reports the 422


def test_ticked_plates_become_a_zip(watched: Watched, ids: dict[str, str]) -> None:
    page = watched.open(f"/studio/plates?tab=many&status=active&ids={ids['active']}")
    page.get_by_text("The artwork of the 1 ticked plates.").wait_for()
    page.locator("tbody input[type=checkbox]:not(:checked)").first.check()
    page.get_by_text("The artwork of the 2 ticked plates.").wait_for()
    page.get_by_label("SVG").uncheck()
    page.get_by_label("PDF").uncheck()
    page.get_by_role("button", name="Make the artwork").click()
    page.get_by_text("choose at least one format").wait_for()
    page.get_by_label("DXF").check()
    field(page, "width", "800")
    field(page, "height", "100")
    page.get_by_role("button", name="Make the artwork").click()
    page.locator("[name=height][aria-invalid=true]").wait_for()
    watched.complaints.clear()  # the browser itself reports the 422
    field(page, "height", "900")
    with page.expect_download() as download:
        page.get_by_role("button", name="Make the artwork").click()
    with zipfile.ZipFile(io.BytesIO(Path(download.value.path()).read_bytes())) as archive:
        plates = json.loads(archive.read("manifest.json"))["plates"]
        assert "sheets/sheet-0001.dxf" in archive.namelist()
    assert {ids["active"]} < {plate["plate_id"] for plate in plates}
    assert len(plates) == 2


def test_a_photo_of_a_print_gets_its_grade(watched: Watched, tmp_path: Path) -> None:
    (tmp_path / "plate.jpg").write_bytes(photo_of())
    (tmp_path / "far.jpg").write_bytes(photo_of(side_px=250.0))
    page = watched.open(f"/studio/plates?tab=print&scheme=position&digits={CODE.digits}")
    page.get_by_role("button", name="Grade the print").click()
    page.get_by_text("No photo is selected").wait_for()
    page.get_by_label("It should be the plate").wait_for()
    page.locator("[name=photo]").set_input_files(tmp_path / "far.jpg")
    page.get_by_text("far.jpg").wait_for()
    page.get_by_role("button", name="Grade the print").click()
    page.locator(".problem", has_text="400 px").wait_for()
    watched.complaints.clear()  # the browser itself reports the 422
    page.locator("[name=photo]").set_input_files(tmp_path / "plate.jpg")
    page.get_by_text("plate.jpg").wait_for()
    page.get_by_role("button", name="Grade the print").click()
    expect(page.locator(".grade-letter")).to_have_text("A")
    expect(page.get_by_text("Vehicles will read it")).to_have_count(1)
    page.locator(".tall tbody tr").nth(7).wait_for()
    expect(page.locator(".unit-map .unit.good")).to_have_count(48)
    with page.expect_download() as download:
        page.get_by_role("button", name="Report (PDF)").click()
    assert Path(download.value.path()).read_bytes().startswith(b"%PDF-")


def test_the_field_of_a_tag_is_that_of_its_dipoles(watched: Watched) -> None:
    page = watched.open("/studio/magnets?tag=SNS_4_0.1_10-30&clearance=0.2&depth=0.05&lateral=0.16")
    heading(page, "SNS_4_0.1_10-30")
    tag = parse_tag("SNS_4_0.1_10-30")
    at = np.linspace(-0.8, 4.8, 2001)
    points = np.column_stack([at, np.full_like(at, 0.16), np.full_like(at, 0.25)])
    total = sum(
        dipole_field_ut(points, np.array([m.along_m, 0.0, 0.0]), np.array([m.polarity.sign * MOMENT_AM2, 0.0, 0.0]))
        for m in tag.magnets
    )
    peak = np.linalg.norm(np.asarray(total), axis=1).max()
    shown = page.locator("dt", has_text="Peak of the trace").locator("xpath=following-sibling::dd[1]").inner_text()
    assert float(shown.split("\u00a0")[0]) == pytest.approx(peak, abs=0.1)
    expect(page.locator(".magnet")).to_have_count(3)
    expect(page.locator(".magnet.south")).to_have_count(2)
    expect(page.locator(".tag-drawing .dimension text")).to_have_text(["1.00\u00a0m", "3.00\u00a0m", "4.00\u00a0m"])
    field(page, "clearance_m", "0.4")
    until(page, "location.search.includes('clearance=0.4')")
    expect(page.locator("dt", has_text="Peak of the trace").locator("xpath=following-sibling::dd[1]")).not_to_have_text(
        shown
    )
    lower = page.locator("dt", has_text="Peak of the trace").locator("xpath=following-sibling::dd[1]").inner_text()
    assert float(lower.split("\u00a0")[0]) < peak / 3
    page.get_by_label("Or type a tag").fill("N_90")
    heading(page, "N_90")
    page.get_by_label("Or type a tag").fill("SNS_4_0.1_10-31")
    page.locator("input[name=tag][aria-invalid=true]").wait_for()
    expect(page.locator(".tag-drawing")).to_have_count(0)


def test_the_capacity_follows_the_format_and_a_codebook_is_made(watched: Watched, server: LiveServer) -> None:
    page = watched.open("/studio/magnets?magnets=4&length=3&segment=0.5&safe=yes")
    design = {"magnets": 4, "length_m": 3.0, "segment_m": 0.5}
    with server.client() as client:
        draft = client.post("/v1/codebook-drafts", json={"design": design, "rules": {"wrong_way_safe": True}}).json()
    figures = draft["figures"]
    page.locator(".figure-tiles .figure", has_text=re.compile(f"^{figures['capacity_under_rules']}$")).wait_for()
    expect(page.locator("[name='rules.wrong_way_safe']")).to_be_checked()
    page.locator("[name='rules.wrong_way_safe']").uncheck()
    page.locator(".figure-tiles .figure", has_text=re.compile(f"^{figures['capacity_under_rules']}$")).wait_for(
        state="detached"
    )
    field(page, "design.length_m", "3.2")
    page.locator("[name='design.length_m'][aria-invalid=true]").wait_for()
    expect(page.locator(".studio-form .field-error")).to_contain_text("not a whole number")
    watched.complaints.clear()  # the browser itself reports the 422
    field(page, "design.length_m", "3")
    page.locator("[aria-invalid=true]").wait_for(state="detached")
    page.locator("summary", has_text="Make a codebook").click()
    field(page, "name", "Made here")
    field(page, "meanings", "bend-right 125\nspeed-limit-mph 25\nnotice Slow down")
    page.get_by_role("button", name="Make a codebook of this format").click()
    page.get_by_text("Made here is made with 3 meanings").wait_for()
    until(page, "/book=[0-9a-f-]{36}/.test(location.search)")
    page.locator(".studio-view td", has_text="Slow down").wait_for()
    expect(page.locator("[name='design.magnets']")).to_have_count(0)
    page.locator("select[name=tag]").select_option(index=1)
    page.locator(".title-line", has_text="speed limit 25 mph").wait_for()


def test_a_viewer_sees_drawings_but_registers_nothing(new_page: OpenPage, server: LiveServer) -> None:
    key = server.app.state.use_cases.access.create_key("default", Scope.VIEWER, "drawer")
    watched = new_page(key)
    page = watched.open("/studio/plates")
    page.locator(".plate-drawing").wait_for()
    expect(page.locator(".registration")).to_have_count(0)
    page = watched.open("/studio/magnets")
    page.locator(".tag-drawing").wait_for()
    expect(page.get_by_text("Plan a magnet tag")).to_have_count(0)
    expect(page.get_by_text("Make a codebook")).to_have_count(0)


def test_robust_positions_have_their_own_size(watched: Watched) -> None:
    page = watched.open("/studio/plates?lon=8.4188&lat=49.0071")
    page.locator("[name='code.scheme']").select_option("position-robust")
    code = PlateCode.from_position(8.4188, 49.0071, n=10, scheme=PlateScheme.POSITION_ROBUST)
    heading(page, grouped(code))
    until(page, "location.search.includes('n=10') && location.search.includes('unit=27')")
