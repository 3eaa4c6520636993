"""Sixty ways to make a page run a text: stored, drawn and typed, none of them opens a dialog or sets a variable."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Dialog, Page, expect

from app.services.access.access import Scope
from tests.conftest import LiveServer
from tests.web.browsing import Watched, until
from tests.web.conftest import OpenPage

RUN = "alert(hit=1)"
TEXTS = (
    f"<script>{RUN}</script>", f"<SCRIPT>{RUN}</SCRIPT>", f"<scr<script>ipt>{RUN}</script>",
    f"<script/x>{RUN}</script>",
    f"</title><script>{RUN}</script>", f"</textarea><script>{RUN}</script>", f"</style><script>{RUN}</script>",
    f"--><script>{RUN}</script>", f"]]><script>{RUN}</script>", f"</script><script>{RUN}</script>",
    f"<img src=x onerror={RUN}>", f"<img src=x onerror='{RUN}'>", f'<img src=x onerror="{RUN}">',
    f"<img/src=x/onerror={RUN}>", f"<IMG SRC=x OnErRoR={RUN}>", f"<image src=x onerror={RUN}>",
    f"<img src=x:x onerror={RUN}//", f"<img src='' onerror={RUN}>", f"\" onerror=\"{RUN}\" src=x x=\"",
    f"' onerror='{RUN}' src=x x='", f"\"><img src=x onerror={RUN}>", f"'><img src=x onerror={RUN}>",
    f"<svg onload={RUN}>", f"<svg/onload={RUN}>", f"<svg><script>{RUN}</script></svg>",
    f"<svg><a href=javascript:{RUN}><text y=20>x</text></a></svg>",
    f"<svg><animate onbegin={RUN} attributeName=x dur=1s>",
    f"<svg><set onbegin={RUN} attributeName=x>", f"<svg><style><img src=x onerror={RUN}></style>",
    f"<svg><foreignObject><img src=x onerror={RUN}></foreignObject></svg>", f"]]></text><script>{RUN}</script><text>",
    f"</text><image href=x onerror={RUN} /><text>", f"<body onload={RUN}>", f"<body onpageshow={RUN}>",
    f"<input autofocus onfocus={RUN}>", f"<select autofocus onfocus={RUN}>", f"<textarea autofocus onfocus={RUN}>",
    f"<details open ontoggle={RUN}>", f"<video src=x onerror={RUN}>", f"<video><source onerror={RUN}></video>",
    f"<audio src=x onerror={RUN}>", f"<marquee onstart={RUN}>", f"<object data=javascript:{RUN}>",
    f"<embed src=javascript:{RUN}>", f"<iframe src=javascript:{RUN}>", f"<iframe srcdoc='<script>{RUN}</script>'>",
    f"<a href=javascript:{RUN}>x</a>", f"<a href=' javascript:{RUN}'>x</a>", f"<a href=java&#9;script:{RUN}>x</a>",
    f"<form action=javascript:{RUN}><button>x</button></form>", f"<button formaction=javascript:{RUN}>x</button>",
    f"<math><mtext><img src=x onerror={RUN}></mtext></math>", f"<template><script>{RUN}</script></template>",
    f"<link rel=stylesheet href=x onerror={RUN}>", f"<style>@import 'x'</style><img src=x onerror={RUN}>",
    f"<base href=//x/><script src=a></script><img src=x onerror={RUN}>", f"${{{RUN}}}", f"{{{{{RUN}}}}}",
    f"javascript:{RUN}", f"&lt;script&gt;{RUN}&lt;/script&gt;",
)  # fmt: skip


def _check(watched: Watched) -> None:
    """Nothing ran, and nothing tried to: what the policy refuses is an error in the console."""
    assert watched.page.evaluate("typeof hit") == "undefined"
    expect(watched.page.locator("[onerror], [onload], [onfocus], [ontoggle], [onbegin], [onstart]")).to_have_count(0)
    assert not [text for text in watched.complaints if "Content Security Policy" in text]


def _watch_dialogs(page: Page) -> list[str]:
    opened: list[str] = []

    def note(dialog: Dialog) -> None:
        opened.append(dialog.message)
        dialog.dismiss()

    page.on("dialog", note)
    return opened


@pytest.fixture(scope="module")
def stored(server: LiveServer) -> Iterator[tuple[str, list[str]]]:
    """A key of an agency, and ids of its plates, each on a road with another hostile name."""
    with server.agency("hostile", Scope.ADMIN) as client:
        items = [
            {"create": {"position": {"lon_deg": 9.0 + k / 1000, "lat_deg": 47.0, "surveyor": text},
                        "code": {"scheme": "id"}, "road": text, "measure_m": float(k)}}
            for k, text in enumerate(TEXTS)
        ]  # fmt: skip
        answer = client.post("/v1/markers/bulk", json={"items": items})
        assert answer.status_code == 200, answer.text
        ids = [result["id"] for result in answer.json()["results"]]
        for text in TEXTS[::6]:
            assert client.post("/v1/vehicles", json={"name": text, "note": text, "profile": {}}).status_code == 201
        yield client.headers["authorization"].split()[1], ids


def test_stored_texts_are_shown_as_texts(new_page: OpenPage, stored: tuple[str, list[str]]) -> None:
    assert len(set(TEXTS)) == 60
    key, ids = stored
    watched = new_page(key)
    dialogs = _watch_dialogs(watched.page)
    page = watched.open("/markers?view=table&sort=measure")
    page.get_by_text("60 markers", exact=True).wait_for()
    seen: set[str] = set()
    for _ in range(40):  # rows are made as they come into view
        seen |= set(page.locator("tbody td").all_inner_texts())
        _check(watched)
        if set(TEXTS) <= seen:
            break
        page.evaluate("() => document.querySelector('.table-scroll').scrollBy(0, 300)")
        page.wait_for_timeout(50)
    assert set(TEXTS) <= seen
    for k in range(0, len(TEXTS), 12):
        page = watched.open(f"/markers/{ids[k]}?view=table")
        page.locator(".panel .facts", has_text=TEXTS[k]).first.wait_for()
        _check(watched)
    page = watched.open("/operations/vehicles")
    page.locator("tbody", has_text=TEXTS[-6]).wait_for()
    _check(watched)
    assert dialogs == []


def test_labels_of_artwork_run_nothing(
    watched: Watched, server: LiveServer, stored: tuple[str, list[str]], tmp_path: Path
) -> None:
    """The drawings as documents of their own, without the policy of the server."""
    key, ids = stored
    page = watched.page
    dialogs = _watch_dialogs(page)
    with server.client() as client:
        for k, marker_id in enumerate(ids):
            headers = {"Authorization": f"Bearer {key}"}
            drawing = client.get(f"/v1/markers/{marker_id}/artwork.svg", headers=headers)
            assert drawing.status_code == 200, drawing.text
            file = tmp_path / f"{k}.svg"
            file.write_bytes(drawing.content)
            page.goto(file.as_uri())
            assert page.evaluate("document.documentElement.localName") == "svg"
            assert page.evaluate("typeof hit") == "undefined"
    assert dialogs == []
    watched.foreign.clear()  # files


@pytest.mark.parametrize(
    "path",
    ["/markers", "/studio/plates", "/studio/plates?tab=camera", "/studio/magnets", "/studio/cerpms", "/plans/new",
     "/roads/new", "/imports", "/decode", "/operations/audit", "/operations/webhooks"],
)  # fmt: skip
def test_typed_texts_run_nothing(watched: Watched, ids: dict[str, str], path: str) -> None:
    dialogs = _watch_dialogs(watched.page)
    page = watched.open(path)
    page.locator("main h1").wait_for()
    until(page, "!document.querySelector('main .loading')")
    fields = page.locator("main :is(input:not([type]), input[type=text], input[type=search], textarea):visible")
    for k in range(len(TEXTS)):
        count = fields.count()
        if not count:
            break
        field = fields.nth(k % count)
        if field.is_enabled() and field.is_editable():
            field.fill(TEXTS[k])
    page.wait_for_timeout(500)
    _check(watched)
    assert dialogs == []
    # the server refuses most of these texts, which the console reports
    watched.complaints = [text for text in watched.complaints if "Failed to load resource" not in text]
