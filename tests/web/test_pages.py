"""Every page, in both sizes: everybody can read it, it fits its window, asks no other host and reports no error."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import expect

from tests.conftest import LiveServer
from tests.web.browsing import DESKTOP, PHONE, Watched, open_sections, shows, until
from tests.web.conftest import OpenPage

AXE = (Path(__file__).parent / "vendor/axe.min.js").read_text()
MAX_FIRST_PAGE_BYTES = 500_000
PAGES = (
    "/", "/markers", "/markers?view=table", "/markers/{plate}", "/markers/{tag}?view=table",
    "/markers/{cerpm}?view=table",
    "/roads", "/roads?kind=lanes", "/roads/{road}", "/roads/{road}?edit=axis", "/roads/lanes/{alignment}",
    "/roads/new", "/roads/new?kind=lanes",
    "/plans", "/plans/new", "/plans/new?alignment={alignment}", "/plans/compare?ids={plan},{variant}", "/plans/{plan}",
    "/plans/{plan}?tab=markers", "/plans/{plan}?tab=rules", "/plans/{plan}?tab=proof", "/plans/{plan}?tab=files",
    "/decode", "/decodes", "/studio/plates",
    "/studio/plates?scheme=position-robust&n=10&unit=27&lon=8.4188&lat=49.0071", "/studio/plates?tab=camera",
    "/studio/plates?tab=many", "/studio/plates?tab=print", "/studio/magnets", "/studio/magnets?tab=plan",
    "/studio/cerpms", "/imports",
    "/operations/vehicles", "/operations/vehicles/{vehicle}", "/operations/jobs", "/operations/maintenance",
    "/operations/codebooks", "/operations/codebooks/{codebook}", "/operations/keys", "/operations/audit",
    "/operations/settings", "/operations/nowhere", "/operations/keys/{key}", "/operations/audit/2",
    "/operations/reports", "/operations/reports/{report}", "/operations/maintenance/{item}", "/operations/webhooks",
    "/operations/webhooks/{webhook}", "/operations/snapshots", "/operations/reprocessings",
)  # fmt: skip


def wait_until_quiet(watched: Watched) -> None:
    """Wait until nothing is loading: neither data nor the map."""
    until(
        watched.page,
        "document.querySelector('main') && !document.querySelector('main .loading')"
        " && document.querySelectorAll('main h1').length === 1",
    )


def audit(watched: Watched, *rules: str) -> list[str]:
    """What axe-core finds by all of its rules, or by some. It is put in by the driver, outside of the page's policy."""
    options = {"resultTypes": ["violations"]} | ({"runOnly": rules} if rules else {})
    watched.page.evaluate(f"() => {{ if (!window.axe) {{ {AXE} }} }}")
    run = f"axe.run(document, {json.dumps(options)})"
    found: list[dict[str, Any]] = watched.page.evaluate(run)["violations"]
    return [f"{fault['id']}: {fault['help']}: {node['html'][:200]}" for fault in found for node in fault["nodes"]]


@pytest.mark.timeout(600)  # twenty-five pages
@pytest.mark.parametrize("pages", [PAGES[0::2], PAGES[1::2]], ids=["even", "odd"])
@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_axe_finds_nothing_on_any_page(
    new_page: OpenPage, ids: dict[str, str], size: tuple[int, int], pages: tuple[str, ...]
) -> None:
    """In light and in dark; phones also in German, whose words are longer, in a window of 320 pixels."""
    phone = size == PHONE
    watched = new_page(size=size, locale="de-DE" if phone else "en-GB", reduced_motion="reduce")
    found, too_wide = {}, []
    for path in pages:
        watched.open(path.format(**ids))
        for scheme in ("light", "dark"):
            watched.page.emulate_media(color_scheme=scheme)
            wait_until_quiet(watched)
            rules = ["color-contrast"] if scheme == "dark" else []  # only colours differ
            if faults := audit(watched, *rules):
                found[f"{path}, {scheme}"] = faults
        if phone:
            watched.page.set_viewport_size({"width": 320, "height": 640})
            watched.page.wait_for_timeout(100)  # drawings follow the width in the next picture
            width = watched.page.evaluate("document.scrollingElement.scrollWidth")
            if width > 320:
                too_wide.append((path, width))
            watched.page.set_viewport_size({"width": size[0], "height": size[1]})
    assert found == {}, json.dumps(found, indent=1)
    assert too_wide == []


def test_pages_show_no_empty_values(watched: Watched, ids: dict[str, str]) -> None:
    for path in ("/markers/{plate}", "/markers/{tag}?view=table", "/markers/{cerpm}?view=table", "/markers/{retired}"):
        page = watched.open(path.format(**ids))
        wait_until_quiet(watched)
        open_sections(page)
        wait_until_quiet(watched)
        shown = page.locator("main").inner_text()
        for word in ("null", "undefined", "NaN", "[object"):
            assert word not in shown, path


def test_the_first_page_is_small(new_page: OpenPage, ids: dict[str, str]) -> None:
    """All scripts until the map with the markers is there, as they are transferred."""
    watched = new_page()
    sizes: dict[str, int] = {}

    def add(request: Any) -> None:
        if request.url.split("?")[0].endswith(".js"):
            sizes[request.url] = int(request.response().header_value("content-length") or 0)

    watched.page.on("requestfinished", add)
    watched.open("/markers?view=map")
    watched.page.wait_for_selector(".map-tools")
    wait_until_quiet(watched)
    assert any("maplibre-gl-worker" in url for url in sizes)
    assert all(sizes.values())
    assert not [url for url in sizes if "terra-draw" in url or "uplot" in url or "pmtiles" in url]
    assert sum(sizes.values()) <= MAX_FIRST_PAGE_BYTES, sum(sizes.values())


def test_heavy_libraries_are_loaded_where_they_are_needed(watched: Watched) -> None:
    urls: list[str] = []
    watched.page.on("request", lambda request: urls.append(request.url))
    watched.open("/studio/plates")
    wait_until_quiet(watched)
    assert len(urls) > 10
    assert not [url for url in urls if "maplibre" in url or "terra-draw" in url or "uplot" in url]


def test_without_a_key_one_signs_in_and_out(new_page: OpenPage, server: LiveServer, ids: dict[str, str]) -> None:
    watched = new_page(None)
    page = watched.open("/operations/vehicles")
    page.get_by_role("button", name="Sign in").click()
    expect(page.locator(".problem")).to_contain_text("No key was entered")
    page.get_by_label("API key").fill("wm_not-a-key")
    page.get_by_role("button", name="Sign in").click()
    page.wait_for_selector(".field-error")
    watched.complaints.clear()  # the browser itself reports the 401
    page.get_by_label("API key").fill("an-admin-key-for-tests-only")
    page.get_by_role("button", name="Sign in").click()
    page.get_by_role("link", name="BUS-7").wait_for()
    page.locator(".account summary").click()
    shows(page.locator(".account-box"), "WAYMARK_ADMIN_KEY", "default", "Role: Admin")
    page.reload()
    page.get_by_role("link", name="BUS-7").wait_for()
    page.locator(".account summary").click()
    page.get_by_role("button", name="Sign out").click()
    page.get_by_label("API key").wait_for()
    until(page, "sessionStorage.getItem('waymark-key') === null")


def test_a_viewer_is_offered_what_a_viewer_may(new_page: OpenPage, server: LiveServer, ids: dict[str, str]) -> None:
    from app.services.access.access import Scope

    key = server.app.state.use_cases.access.create_key("default", Scope.VIEWER, "reader")
    watched = new_page(key)
    page = watched.open(f"/markers/{ids['plate']}?view=table")
    page.locator(".panel .facts").first.wait_for()
    wait_until_quiet(watched)
    expect(page.get_by_role("button", name="Edit")).to_have_count(0)
    expect(page.get_by_role("button", name="Change status")).to_have_count(0)
    page.get_by_role("button", name="Operations").click()
    expect(page.get_by_role("link", name="API keys")).to_have_count(0)


def test_what_a_vehicle_may_not_see_is_refused_and_said(
    new_page: OpenPage, server: LiveServer, ids: dict[str, str]
) -> None:
    """A key with the fewest permissions: every page ends loading, and says what is refused."""
    from app.services.access.access import Scope

    watched = new_page(server.app.state.use_cases.access.create_key("default", Scope.VEHICLE, "a bus"))
    for path in PAGES:
        watched.open(path.format(**ids))
        wait_until_quiet(watched)
        if path in ("/markers?view=table", "/roads", "/plans", "/studio/plates", "/studio/plates?tab=camera"):
            watched.page.locator(".problem").first.wait_for()
        assert [complaint for complaint in watched.complaints if "403" not in complaint] == [], path
        watched.complaints.clear()  # the browser itself reports the 403
    watched.page.goto("about:blank")
    watched.page.wait_for_timeout(500)
    watched.complaints.clear()  # reports that came late


def test_the_language_is_that_of_the_browser_until_another_is_chosen(new_page: OpenPage, ids: dict[str, str]) -> None:
    watched = new_page(locale="de-CH")
    page = watched.open("/operations/vehicles")
    page.get_by_role("heading", name="Fahrzeuge").wait_for()
    until(page, "document.documentElement.lang === 'de'")
    page.locator(".language select").select_option("en")
    page.get_by_role("heading", name="Vehicles").wait_for()
    page.reload()
    page.get_by_role("heading", name="Vehicles").wait_for()
    expect(page).to_have_title("Vehicles – Waymark")


def test_unknown_addresses_and_ids_are_explained(watched: Watched) -> None:
    page = watched.open("/operations/nowhere")
    page.get_by_role("heading", name="Page not found").wait_for()
    page = watched.open("/markers/019cb624-0000-7000-8000-00000000ffff?view=table")
    page.locator(".panel .problem").wait_for()
    watched.complaints.clear()  # the browser itself reports the 404


def test_keyboard_reaches_content_menu_and_dialogs(watched: Watched, ids: dict[str, str]) -> None:
    page = watched.open("/operations/vehicles")
    page.get_by_role("link", name="BUS-7").wait_for()
    page.keyboard.press("Tab")
    until(page, "document.activeElement.textContent === 'Skip to content'")
    page.keyboard.press("Enter")
    until(page, "document.activeElement.id === 'content'")
    page.get_by_role("button", name="Add a vehicle").focus()
    page.keyboard.press("Enter")
    page.get_by_role("dialog").wait_for()
    page.keyboard.press("Escape")
    page.get_by_role("dialog").wait_for(state="detached")
    until(page, "document.activeElement.textContent === 'Add a vehicle'")
    page.get_by_role("button", name="Registry").focus()
    page.keyboard.press("Enter")
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    page.wait_for_url("**/markers")


def test_a_dialog_that_closes_leaves_the_focus_where_it_has_gone(watched: Watched, ids: dict[str, str]) -> None:
    page = watched.open("/operations/vehicles")
    page.get_by_role("button", name="Add a vehicle").click()
    page.get_by_role("dialog").wait_for()
    page.evaluate("document.querySelector('dialog').close(); document.querySelector('.menu-title').focus()")
    until(page, "!document.querySelector('dialog')")
    assert page.evaluate("document.activeElement.className").startswith("menu-title")
