"""Plans and roads in the browser: a planner's whole way, from the file of a road to the files for the crews."""

from __future__ import annotations

import json
import re
import zipfile
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlencode

import pytest
from playwright.sync_api import Locator, expect
from ruamel.yaml import YAML

from app.services.access.access import Scope
from tests.api.plans.test_plans import road
from tests.conftest import LiveServer
from tests.http import created, finished
from tests.web.browsing import PHONE, Watched, shows, until
from tests.web.conftest import OpenPage

ROOT = Path(__file__).resolve().parents[2]
SHORT_M = 240.0
RULES: dict[str, Any] = {
    "version": 1,
    "name": "few plates",
    "plates": {"spacing_m": 100, "unit_mm": 50},
    "decision_points": {"at": ["stop_line"]},
    "cameras": [{"name": "front", "horizontal_fov_deg": 50, "depression_deg": 12, "frames_per_s": 60}],
    "costs": {"currency": "EUR", "items": [{"item": "plate", "per": "plate", "price": 60}]},
}


@pytest.fixture(scope="module")
def alignment(server: LiveServer) -> dict[str, Any]:
    """A short straight road with a stop line at its end."""
    parts = {
        "file": ("road.geojson", road(8.2, 49.2, SHORT_M), "application/geo+json"),
        "declaration": (None, json.dumps({"name": "L 560"})),
    }
    with server.client() as client:
        response = client.post("/v1/alignments", files=parts)
        assert response.status_code == 201, response.text
        return dict(response.json())


@pytest.fixture(scope="module")
def plans(server: LiveServer, alignment: dict[str, Any]) -> tuple[str, str]:
    """Ids of two variants: every 100 m, and every 50 m with line magnets."""
    with server.agency("default") as client:
        far = created(client, "/v1/plans", name="every 100 m", alignment_id=alignment["id"], rules=RULES)
        rules = {**RULES, "plates": {**RULES["plates"], "spacing_m": 50}, "lines": {}}
        near = created(client, "/v1/plans", name="every 50 m", alignment_id=alignment["id"], rules=rules)
    return far["id"], near["id"]


def planner(server: LiveServer, label: str) -> str:
    """A key of a planner."""
    return str(server.app.state.use_cases.access.create_key("default", Scope.PLANNER, label))


def strip_text(watched: Watched, start: str) -> str:
    """What the strip says about the place that is pointed at, once it begins as it should."""
    strip = watched.page.get_by_role("slider").first
    expect(strip).to_have_attribute("aria-valuetext", re.compile(f"^{re.escape(start)}"))
    return strip.get_attribute("aria-valuetext") or ""


def check_rows_of(table: Locator) -> None:
    """The rows of a table are rows, below one another, with their cells beside one another in common columns."""
    table.locator("tbody tr").nth(1).wait_for()
    script = """table => [...table.rows].map(row => ({
        display: getComputedStyle(row).display, top: row.getBoundingClientRect().top,
        cells: [...row.cells].map(cell => (({ left, top }) => ({ left, top }))(cell.getBoundingClientRect())) }))"""
    rows = table.evaluate(script)
    assert table.evaluate("table => getComputedStyle(table).display") == "table"
    assert {row["display"] for row in rows} == {"table-row"}
    assert [row["top"] for row in rows] == sorted({row["top"] for row in rows})
    for row in rows:
        assert len({cell["top"] for cell in row["cells"]}) == 1
        assert [cell["left"] for cell in row["cells"]] == [cell["left"] for cell in rows[0]["cells"]]


def contrast_of(part: Locator) -> float:
    """Contrast of an element's text with its own background, by WCAG 2.2."""
    colours = part.evaluate("e => [getComputedStyle(e).color, getComputedStyle(e).backgroundColor]")
    found = []
    for colour in colours:
        assert re.fullmatch(r"rgb\(\d+, \d+, \d+\)", colour), "opaque"
        linear = [
            c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4
            for c in (int(level) / 255 for level in re.findall(r"\d+", colour))
        ]
        found.append(0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2])
    return float((max(found) + 0.05) / (min(found) + 0.05))


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_buttons_can_be_read_under_the_pointer(watched: Watched, scheme: Literal["light", "dark"]) -> None:
    page = watched.page
    page.emulate_media(color_scheme=scheme)
    watched.open("/roads")
    for pressed in ("true", "false"):
        button = page.locator(f".segments button[aria-pressed={pressed}]").first
        button.hover()
        until(page, f"document.querySelector('.segments button[aria-pressed={pressed}]').matches(':hover')")
        assert contrast_of(button) >= 4.5, pressed


def test_a_road_is_uploaded_and_planned_by_rules(watched: Watched, tmp_path: Path) -> None:
    start = {**RULES, "lines": {}}
    page = watched.open(f"/plans/new?{urlencode({'rules': json.dumps(start)})}")
    page.get_by_role("button", name="Upload the road").click()
    page.locator(".field-error").wait_for()
    until(page, "document.activeElement.name === 'file'")
    (tmp_path / "nothing.geojson").write_text("{}")
    page.locator("[name=file]").set_input_files(tmp_path / "nothing.geojson")
    page.get_by_role("button", name="Upload the road").click()
    page.locator(".drop .field-error").get_by_text("nothing").wait_for(state="detached")
    page.locator("[name=file][aria-invalid=true]").wait_for()
    watched.complaints.clear()  # the browser itself reports the 422
    (tmp_path / "B 42.geojson").write_bytes(road(8.3, 49.3, SHORT_M))
    page.locator("[name=file]").set_input_files(tmp_path / "B 42.geojson")
    expect(page.locator("[name=name]").first).to_have_value("nothing")
    page.locator("[name=name]").first.fill("B 42")
    page.get_by_role("button", name="Upload the road").click()
    page.get_by_text("The road B 42 is stored.").wait_for()
    page.wait_for_url("**alignment=*")
    page.locator("[name='+lines']").uncheck()
    preview = page.locator(".preview[aria-busy=false]")
    preview.get_by_text("plates", exact=True).wait_for()
    check_rows_of(preview.locator("table.figures"))
    (tmp_path / "wrong.yaml").write_text("version: 1\nplatse: {}\n")
    page.get_by_label("Rules from a file").set_input_files(tmp_path / "wrong.yaml")
    page.locator(".problem", has_text="platse").wait_for()
    watched.complaints.clear()  # the browser itself reports the 422
    (tmp_path / "rules.yaml").write_text("version: 1\nplates: {spacing_m: 35, scheme: id}\nlines: {}\n")
    page.get_by_label("Rules from a file").set_input_files(tmp_path / "rules.yaml")
    page.get_by_text("The rules of rules.yaml are in the form.").wait_for()
    expect(page.locator("[name='plates.spacing_m']")).to_have_value("35")
    expect(page.locator("[name='+lines']")).to_be_checked()
    page.locator("[name='+lines']").uncheck()
    with page.expect_download() as download:
        page.get_by_role("button", name="Save these rules as a file").click()
    assert json.loads(Path(download.value.path()).read_bytes())["plates"] == {"spacing_m": 35, "scheme": "id"}
    spacing = page.locator("[name='plates.spacing_m']")
    spacing.fill("1")
    page.locator(".field:has([name='plates.spacing_m']) .field-error").wait_for()
    page.locator("[name='plates.spacing_m'][aria-invalid=true]").wait_for()
    until(page, "document.activeElement.name === 'plates.spacing_m'")
    watched.complaints.clear()  # the browser itself reports the 422
    spacing.fill("60")
    page.locator(".field-error").wait_for(state="detached")
    page.wait_for_url("**rules=*")
    page.reload()
    expect(page.locator("[name='plates.spacing_m']")).to_have_value("60")
    expect(page.locator("[name='+lines']")).not_to_be_checked()
    page.get_by_role("button", name="Make the plan").click()
    page.locator("[name=name][aria-invalid=true]").wait_for()
    watched.complaints.clear()  # the browser itself reports the 422
    page.get_by_label("Name of the plan").fill("B 42, plates")
    page.get_by_role("button", name="Make the plan").click()
    page.get_by_role("heading", name="B 42, plates").wait_for()
    page.locator(".plan-view .strip").wait_for()
    page.wait_for_url("**/plans/*")


def test_map_strip_and_table_mark_the_same(watched: Watched, plans: tuple[str, str]) -> None:
    page = watched.open(f"/plans/{plans[0]}?tab=markers")
    page.locator("tbody tr").first.wait_for()
    page.locator(".map canvas").wait_for()
    strip = page.get_by_role("slider")
    strip.focus()
    strip.press("End")
    strip_text(watched, "stop line")
    strip.press("ArrowLeft")
    text = strip_text(watched, "Plate ")
    number = re.match(r"Plate (\d+) ", text)
    assert number, text
    assert re.search(r"station 0\+\d{3}\.\d\d$", text)
    page.locator("tr.pointed").wait_for()
    expect(page.locator("tr.pointed th")).to_have_text(number[1])
    strip.press("Enter")
    page.wait_for_url(f"**item=m{number[1]}*")
    page.reload()
    page.locator("tr.chosen").wait_for()
    expect(page.locator("tr.chosen th")).to_have_text(number[1])
    expect(page.locator(".strip-ring")).to_have_count(1)
    page.locator("tbody tr").first.hover()
    until(page, "document.querySelector('[role=slider]').getAttribute('aria-valuetext').startsWith('Plate 1 ')")
    closer = page.get_by_role("button", name="Show a shorter stretch")
    closer.click()
    page.wait_for_url("**strip=*")
    page.get_by_role("button", name="Show a longer stretch").click()
    until(page, "!location.search.includes('strip=')")
    page.get_by_role("link", name="Checks (").click()
    row = page.locator("tr", has_text="Frames per pass")
    row.hover()
    until(page, "document.querySelector('[role=slider]').getAttribute('aria-valuetext').startsWith('Frames per pass')")
    page.go_back()
    page.get_by_role("columnheader", name="Purpose").wait_for()


def test_a_change_of_spacing_shows_cost_and_read_rates_and_becomes_a_variant(
    watched: Watched, server: LiveServer, plans: tuple[str, str]
) -> None:
    page = watched.open(f"/plans/{plans[0]}?tab=rules")
    page.locator("[name='plates.spacing_m']").fill("40")
    box = page.locator(".preview[aria-busy=false]:has(th:text('Now'))")
    box.wait_for()
    cost = box.locator("tr", has_text="Cost").locator("td").all_inner_texts()
    assert re.match(r"[\d,.]+\u00a0EUR", cost[0])
    assert float(cost[1].split("\u00a0")[0]) > float(cost[0].split("\u00a0")[0])
    expect(box.locator("tr", has_text="Predicted read rate").locator("td")).to_have_count(2)
    page.get_by_text("Preview: nothing of this is stored.").wait_for()
    page.get_by_role("button", name="Make a new variant").click()
    page.locator("[name=name][aria-invalid=true]").wait_for()
    watched.complaints.clear()  # the browser itself reports the 422
    page.get_by_label("Name of the variant").fill("every 40 m")
    page.get_by_role("button", name="Make a new variant").click()
    page.wait_for_url("**/plans/compare?ids=*")
    page.get_by_role("columnheader", name="every 40 m").first.wait_for()
    page.locator("tr", has_text="plates.spacing_m").wait_for()
    page.locator(".strip").nth(1).wait_for()
    expect(page.locator("tr", has_text="Cost").locator("td").nth(1)).to_contain_text("+")
    page.get_by_role("button", name="Remove every 40 m from the comparison").click()
    page.get_by_role("columnheader", name="every 40 m").first.wait_for(state="detached")
    page.go_back()
    page.get_by_role("columnheader", name="every 40 m").first.wait_for()


def test_other_rules_are_stored_with_their_reason(watched: Watched, server: LiveServer, plans: tuple[str, str]) -> None:
    page = watched.open(f"/plans/{plans[1]}?tab=rules")
    page.locator("[name='+lines']").uncheck()
    page.get_by_label("Reason").fill("no magnets here")
    page.get_by_role("button", name="Store in this plan").click()
    page.get_by_text("The plan is placed and checked again.").wait_for()
    page.get_by_text("version 2").wait_for()
    page.get_by_role("link", name="History").click()
    page.locator(".history").get_by_text("no magnets here").wait_for()
    with server.client() as client:
        assert client.get(f"/v1/plans/{plans[1]}").json()["counts"].keys() == {"plate"}


def test_variants_are_ticked_in_the_list(watched: Watched, plans: tuple[str, str]) -> None:
    page = watched.open("/plans")
    page.get_by_role("search").get_by_label("Road").select_option(label="L 560")
    page.get_by_role("link", name="B 42, plates").wait_for(state="detached")
    page.get_by_label("Select every 100 m").check()
    page.get_by_label("Select every 50 m").check()
    page.reload()
    page.get_by_role("button", name="Compare (2)").click()
    page.get_by_role("heading", name="Rules that differ").wait_for()


def test_a_plan_is_proved_approved_committed_and_packed(
    new_page: OpenPage, server: LiveServer, alignment: dict[str, Any], tmp_path: Path
) -> None:
    author = planner(server, "author")
    with server.client(author) as client:
        rules = {**RULES, "plates": {"spacing_m": 200, "unit_mm": 50}, "decision_points": None}
        body = {"name": "to build", "alignment_id": alignment["id"], "rules": rules}
        plan = created(client, "/v1/plans", **body)
    url = f"/plans/{plan['id']}"
    mine = new_page(author)
    page = mine.open(f"{url}?tab=proof")
    page.locator("[name=conditions]").fill("fog")
    page.get_by_role("button", name="Start the proof").click()
    page.locator("[name=conditions][aria-invalid=true]").wait_for()
    mine.complaints.clear()  # the browser itself reports the 422
    page.locator("[name=conditions]").fill("day")
    page.locator("[name=drives]").fill("1")
    page.get_by_role("button", name="Start the proof").click()
    page.locator(".job").wait_for()
    page.get_by_text("No reading was wrong.").wait_for()
    check_rows_of(page.locator("table.rates"))
    expect(page.locator(".way [aria-current=step]")).to_have_text(re.compile(r"proved$"))
    expect(page.get_by_role("button", name="Commit")).to_have_count(0)
    page.get_by_role("button", name="Approve").click()
    page.get_by_role("dialog").get_by_text("You made this plan").wait_for()
    page.get_by_role("dialog").get_by_role("button", name="Approve").click()
    page.get_by_role("dialog").locator(".problem").get_by_text("author").first.wait_for()
    mine.complaints.clear()  # the browser itself reports the 409
    page.keyboard.press("Escape")

    colleague = new_page(planner(server, "colleague"))
    page = colleague.open(url)
    page.get_by_role("button", name="Approve").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_role("button", name="Cancel").click()
    dialog.wait_for(state="detached")
    page.get_by_role("button", name="Approve").click()
    dialog.get_by_role("button", name="Approve").click()
    page.get_by_text("to build is approved.").wait_for()
    page.get_by_role("button", name="Commit").click()
    dialog.get_by_role("button", name="Commit").click()
    page.get_by_text("planned markers are in the registry.").wait_for()
    page.get_by_role("link", name="As built").click()
    page.get_by_text("Nothing has been surveyed yet.").wait_for()
    page.get_by_role("link", name="Files").click()
    with page.expect_download() as bill:
        page.get_by_role("button", name="bill.csv").click()
    bill.value.save_as(tmp_path / "bill.csv")
    assert "plate" in (tmp_path / "bill.csv").read_text()
    page.get_by_role("group", name="Artwork of each plate").get_by_label("svg").uncheck()
    page.get_by_role("button", name="Make the package").click()
    page.get_by_role("button", name="Download the package").wait_for()
    with page.expect_download() as package:
        page.get_by_role("button", name="Download the package").click()
    package.value.save_as(tmp_path / "plan.zip")
    with zipfile.ZipFile(tmp_path / "plan.zip") as archive:
        names = archive.namelist()
    assert {"bill.csv", "drawings.pdf", "manifest.json", "artwork/plate-00001.pdf"} <= set(names)
    with server.client() as client:
        numbers = {m["code"]["digits"] for m in client.get("/v1/markers", params={"status": "planned"}).json()["items"]}
        document = client.get(f"/v1/plans/{plan['id']}/files/plan.json").json()
    assert {marker["code"] for marker in document["markers"]} <= numbers


def test_a_running_proof_is_followed_after_a_reload_and_cancelled(
    watched: Watched, server: LiveServer, plans: tuple[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Held:
        def submit(self, *_: Any) -> None:
            """Leave it waiting."""

    monkeypatch.setattr(server.app.state.use_cases.proofs, "_queue", Held())
    page = watched.open(f"/plans/{plans[0]}?tab=proof")
    page.get_by_role("button", name="Start the proof").click()
    page.get_by_text("Waiting").wait_for()
    page.reload()
    page.get_by_text("Waiting").wait_for()
    page.locator(".job").get_by_role("button", name="Cancel").click()
    page.get_by_text("Cancelled").wait_for()
    with server.client() as client:
        [job] = client.get("/v1/jobs", params={"subject_id": plans[0]}).json()["items"]
        assert finished(client, f"/v1/jobs/{job['id']}")["state"] == "cancelled"


def test_a_plan_prints_as_a_report(watched: Watched, plans: tuple[str, str]) -> None:
    page = watched.open(f"/plans/{plans[0]}?tab=files")
    page.get_by_role("button", name="bill.csv").wait_for()
    page.emulate_media(media="print")
    parts = ("Checks", "Frames per pass", "Markers", "Offset, left positive", '"spacing_m": 100')
    shows(page.locator(".report"), *parts)
    expect(page.locator(".bar")).not_to_be_visible()
    expect(page.locator(".strip-tools").first).not_to_be_visible()
    page.emulate_media(media="screen")
    page.get_by_role("button", name="bill.csv").wait_for()


def test_a_road_is_registered_and_shown_with_its_stations(new_page: OpenPage, server: LiveServer) -> None:
    watched = new_page()
    page = watched.open("/roads/new")
    page.get_by_label("Name").fill("B 27")
    page.get_by_role("button", name="Register the road").click()
    page.locator("textarea[aria-invalid=true]").wait_for()
    page.locator("[name=geometry]").fill("9.1, 48.1\n9.105, 48.1\n9.11, 48.102")
    page.get_by_role("button", name="Add a known measure").click()
    page.locator("[name='calibration.0.measure_m']").fill("1000")
    page.locator("[name='calibration.0.vertex']").fill("7")
    page.get_by_role("button", name="Check only").click()
    page.locator("[name='calibration.0.vertex'][aria-invalid=true]").wait_for()
    watched.complaints.clear()  # the browser itself reports the 422
    page.locator("[name='calibration.0.vertex']").fill("0")
    page.get_by_role("button", name="Check only").click()
    page.get_by_text("The road would be registered like this").wait_for()
    page.get_by_role("button", name="Register the road").click()
    page.wait_for_url(re.compile(r"/roads/[0-9a-f-]{36}$"))
    page.get_by_text("1+000.000 to 1+").wait_for()
    slider = page.get_by_role("slider")
    slider.press("ArrowRight")
    known = "Known measure 1+000.000, station 1+000.00"
    assert strip_text(watched, known) == known
    page.get_by_role("link", name="Its markers").click()
    until(page, "location.pathname === '/markers' && new URLSearchParams(location.search).get('road') === 'B 27'")


def test_a_road_gets_another_axis_and_other_measures(watched: Watched, server: LiveServer) -> None:
    with server.client() as client:
        line = {"type": "LineString", "coordinates": [[9.3, 48.1], [9.305, 48.1], [9.31, 48.102]]}
        known = [{"measure_m": 5000, "vertex": 0}, {"measure_m": 5500, "chainage_m": 500.25}]
        axis = created(client, "/v1/roads", name="L 77", geometry=line, calibration=known)
        page = watched.open(f"/roads/{axis['id']}?edit=axis")
        page.locator("[name='calibration.1.chainage_m']").wait_for()
        expect(page.locator("[name='calibration.0.vertex']")).to_have_value("0")
        expect(page.locator("[name='calibration.1.vertex']")).to_have_value("")
        expect(page.locator("[name='calibration.1.chainage_m']")).to_have_value("500.25")
        page.get_by_role("button", name="Remove it").first.click()
        page.locator("[name='calibration.1.chainage_m']").fill("99999")
        page.get_by_role("button", name="Check only").click()
        page.locator("[name='calibration.1.chainage_m'][aria-invalid=true]").wait_for()
        watched.complaints.clear()  # the browser itself reports the 422
        page.locator("[name='calibration.1.chainage_m']").fill("400")
        page.get_by_label("Reason").fill("new kilometre posts")
        page.get_by_role("button", name="Check only").click()
        page.get_by_text("The road would be changed like this").wait_for()
        assert client.get(f"/v1/roads/{axis['id']}").json()["version"] == 1
        page.get_by_role("button", name="Change the road").click()
        page.get_by_text("now has version 2").wait_for()
        until(page, "!new URLSearchParams(location.search).has('edit')")
        changed = client.get(f"/v1/roads/{axis['id']}").json()
        assert changed["geometry"] == axis["geometry"]
        assert [(point["measure_m"], point["chainage_m"]) for point in changed["calibration"]] == [(5500, 400)]
        page.get_by_role("button", name="Change axis and measures").click()
        page.locator("[name=geometry]").fill("9.3, 48.1\n9.302, 48.1\n9.31, 48.103")
        page.get_by_role("button", name="Change the road").click()
        page.get_by_text("now has version 3").wait_for()
        page.get_by_text("new kilometre posts").wait_for()
        assert client.get(f"/v1/roads/{axis['id']}").json()["geometry"]["coordinates"][1] == [9.302, 48.1]


def test_a_registered_road_gets_lanes_and_variants(watched: Watched, server: LiveServer) -> None:
    with server.client() as client:
        line = {"type": "LineString", "coordinates": [[9.2, 48.2], [9.205, 48.201], [9.21, 48.2]]}
        axis = created(client, "/v1/roads", name="K 9", geometry=line)
    page = watched.open("/roads/new?kind=lanes&way=registered")
    page.get_by_label("Road", exact=True).select_option(label="K 9")
    page.locator("[name='lanes.width_m']").fill("40")
    page.get_by_role("button", name="Use these lanes").click()
    page.locator("[name='lanes.width_m'][aria-invalid=true]").wait_for()
    watched.complaints.clear()  # the browser itself reports the 422
    page.locator("[name='lanes.width_m']").fill("3.25")
    page.get_by_role("button", name="Use these lanes").click()
    page.get_by_role("heading", name="K 9").wait_for()
    page.locator(".lane-choice select").select_option("backward 1")
    page.get_by_role("heading", name="Lane backward 1").wait_for()
    page.reload()
    page.get_by_role("heading", name="Lane backward 1").wait_for()
    page.get_by_role("link", name="The registered road").click()
    page.wait_for_url(f"**/roads/{axis['id']}")


def test_a_line_is_drawn_on_the_map_and_becomes_a_road(watched: Watched, alignment: dict[str, Any]) -> None:
    page = watched.open("/roads/new?kind=lanes&way=draw")
    page.get_by_role("button", name="Draw the centre line").click()
    page.locator(".map[data-drawing=linestring]").wait_for()
    box = page.locator(".map canvas").bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    for dx, dy in ((-200, 40), (0, 30), (200, 0)):
        page.mouse.move(x + dx, y + dy, steps=3)
        page.mouse.click(x + dx, y + dy)
    page.mouse.click(x + 200, y)
    until(page, "document.querySelector('[name=vertices]').value.split('\\n').length === 3")
    page.get_by_label("Name of the road").fill("drawn")
    page.get_by_role("button", name="Use this line").click()
    page.get_by_role("heading", name="drawn", exact=True).wait_for()
    page.locator(".strip").wait_for()


def test_a_viewer_sees_a_plan_and_changes_nothing(
    new_page: OpenPage, server: LiveServer, plans: tuple[str, str]
) -> None:
    key = server.app.state.use_cases.access.create_key("default", Scope.VIEWER, "reader of plans")
    watched = new_page(key, size=PHONE)
    page = watched.open(f"/plans/{plans[0]}")
    page.locator(".plan-view .strip").wait_for()
    for name in ("Approve", "Commit", "Make the package"):
        expect(page.get_by_role("button", name=name)).to_have_count(0)
    expect(page.get_by_role("link", name="New variant")).to_have_count(0)
    expect(page.get_by_role("link", name="Rules")).to_have_count(0)


def test_rules_to_begin_with_are_those_of_the_documentation() -> None:
    text = (ROOT / "static/app/pages/plans_templates.js").read_text()
    for name, file in (
        ("rural_plates", "rules-rural-plates"),
        ("city_magnets", "rules-city-magnets"),
        ("work_zone_cerpms", "rules-work-zone-cerpms"),
    ):
        documented = YAML(typ="safe").load((ROOT / f"docs/plans/{file}.yaml").read_text())
        (own,) = re.findall(rf"^  {name}: (\{{.*?^  \}}),$", text, re.M | re.S)
        assert YAML(typ="safe").load(own) == json.loads(json.dumps(documented, default=str)), name
