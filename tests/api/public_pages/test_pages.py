"""Public pages: what they show without a key, in which form and language, and what nobody learns from them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from html.parser import HTMLParser

import httpx
import pytest

from app.services.access.access import Scope
from app.settings import Settings
from tests.api.public_pages.markers import EVERYTHING, HTML, JSON, new_marker, release
from tests.conftest import LiveServer, Place
from tests.http import refused

pytestmark = pytest.mark.both_databases

SCRIPT = '"><script>alert(1)</script>&<img src=x onerror=alert(1)>'


@pytest.fixture(scope="module")
def owner(server: LiveServer) -> Iterator[httpx.Client]:
    with server.agency("Straßenbau <Süd>", Scope.ADMIN) as client:
        yield client


class Tags(HTMLParser):
    """The start tags of a page, its attributes, and its text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data


def test_by_default_code_agency_status_and_revision_are_shown(
    server: LiveServer, anybody: httpx.Client, place: Place
) -> None:
    with server.agency("nothing changed", Scope.ADMIN) as client:
        marker = new_marker(client, place())
        assert client.get("/v1/public-page").json() == {
            "fields": ["code", "agency", "status", "revision"], "damage_reports": True, "version": 0,
            "updated_at": None,
        }  # fmt: skip
    document = anybody.get(f"/m/{marker['id']}", headers=JSON).json()
    assert document.pop("report")["href"] == f"/m/{marker['id']}/reports"
    assert document == {
        "code": marker["code"]["digits"], "agency": "nothing changed", "status": "active", "revision": 1,
    }  # fmt: skip
    page = anybody.get(f"/m/{marker['id']}", headers=HTML)
    for hidden in ("A 5", "12345", str(marker["position"]["lon_deg"]), str(marker["position"]["lat_deg"])):
        assert hidden not in page.text


def test_what_is_released_is_shown_and_nothing_else(owner: httpx.Client, anybody: httpx.Client, place: Place) -> None:
    marker = new_marker(owner, place())
    shown = {
        "code": marker["code"]["digits"], "agency": "Straßenbau <Süd>", "status": "in use", "revision": ">1<",
        "road": "A 5", "measure": "km 12.346",
    }  # fmt: skip
    for released in (EVERYTHING, *([name] for name in EVERYTHING)):
        release(owner, released)
        page = anybody.get(f"/m/{marker['id']}", headers=HTML | {"Accept-Language": "en"}).text
        document = anybody.get(f"/m/{marker['id']}", headers=JSON).json()
        assert set(document) == {"measure_m" if n == "measure" else n for n in released} | {"report"}
        facts = page.split("<dl")[1].split("</dl>")[0].replace("&lt;", "<").replace("&gt;", ">")
        rest = page.split("<dl")[0] + page.split("</dl>")[1]
        for name, text in shown.items():
            assert (text in facts) is (name in released), (released, name)
            assert text not in rest or name == "agency", (released, name)
        assert ("Süd" in rest) is ("agency" in released)


def test_unknown_and_unpublished_markers_have_the_same_plain_404(
    server: LiveServer, anybody: httpx.Client, place: Place
) -> None:
    with server.agency("publishes nothing", Scope.ADMIN) as client:
        marker = new_marker(client, place())
        release(client, [])
    ids = (marker["id"], marker["id"][:-4] + "0000", "0" * 36, "x", "%00", marker["id"].upper(), "DROP TABLE")
    pages, documents = set(), set()
    for name in ids:
        for path in (f"/m/{name}", f"/m/{name}/thanks"):
            page = anybody.get(path, headers=HTML)
            assert page.status_code == 404
            assert "no public page at this address" in page.text
            pages.add(page.text.replace("../../", "../"))
            documents.add(str({**refused(anybody.get(path, headers=JSON), 404), "instance": "", "request_id": ""}))
        form = {"kind": (None, "loose"), "token": (None, "x")}
        assert anybody.post(f"/m/{name}/reports", files=form, headers=HTML).status_code == 404
    assert len(pages) == len(documents) == 1
    assert anybody.get("/m/", headers=HTML).status_code == 404


def test_texts_of_strangers_are_text(server: LiveServer, anybody: httpx.Client, place: Place) -> None:
    with server.agency(SCRIPT, Scope.ADMIN) as client:
        marker = new_marker(client, place(), road=SCRIPT)
        release(client, EVERYTHING)
    for query in ("", f"?lang={SCRIPT}", "?utm_source=x"):
        answer = anybody.get(f"/m/{marker['id']}{query}", headers=HTML)
        page = Tags(answer.text)
        assert answer.status_code == 200
        assert not {tag for tag, _ in page.tags} & {"script", "img", "style", "iframe"}
        assert not [name for _, attributes in page.tags for name in attributes if name.startswith(("on", "style"))]
        assert page.text.count(SCRIPT) == 3  # in the title, too


def test_nothing_runs_and_nothing_is_kept(owner: httpx.Client, anybody: httpx.Client, place: Place) -> None:
    marker = new_marker(owner, place())
    release(owner, EVERYTHING)
    for path in (f"/m/{marker['id']}", f"/m/{marker['id']}/thanks", "/m/x"):
        headers = anybody.get(path, headers=HTML).headers
        assert headers["content-security-policy"] == (
            "default-src 'none'; style-src 'self'; img-src 'self'; form-action 'self'; base-uri 'none'; "
            "frame-ancestors 'none'"
        )
        assert headers["cache-control"] == "private, no-store"
        assert headers["referrer-policy"] == "no-referrer"
        assert headers["x-robots-tag"] == "noindex"
        assert {"accept", "accept-language"} <= {name.strip().lower() for name in headers["vary"].split(",")}


@pytest.mark.parametrize(
    ("query", "accepted", "language"),
    [
        ("", None, "en"), ("", "de", "de"), ("", "de-AT,de;q=0.9,en;q=0.5", "de"), ("", "en-GB,de;q=0.9", "en"),
        ("", "fr,de;q=0.3,en;q=0.1", "de"), ("", "fr", "en"), ("", "de;q=x", "en"), ("", "de;q=0", "en"),
        ("?lang=de", "en", "de"), ("?lang=en", "de", "en"), ("?lang=fr", "de", "de"),
    ],
)  # fmt: skip
def test_both_languages(
    owner: httpx.Client, anybody: httpx.Client, place: Place, query: str, accepted: str | None, language: str
) -> None:
    marker = new_marker(owner, place())
    release(owner, EVERYTHING)
    headers = {"Accept": HTML["Accept"], **({"Accept-Language": accepted} if accepted else {})}
    answer = anybody.get(f"/m/{marker['id']}{query}", headers=headers)
    assert answer.headers["content-language"] == language
    assert f'<html lang="{language}">' in answer.text
    expected = {"en": ("Report damage", "in use", "km 12.346"), "de": ("Schaden melden", "in Betrieb", "km 12,346")}
    assert all(text in answer.text for text in expected[language])
    (switch,) = [a for tag, a in Tags(answer.text).tags if tag == "a" and "hreflang" in a]
    other = anybody.get(httpx.URL(str(answer.url)).join(str(switch["href"])), headers=headers)
    assert other.headers["content-language"] == switch["hreflang"] == switch["lang"] != language
    missing = anybody.get(f"/m/x{query}", headers=headers)
    assert missing.headers["content-language"] == language


@pytest.mark.parametrize(
    ("accept", "is_json"),
    [
        (None, False), ("*/*", False), ("text/html", False), ("application/json", True),
        ("application/json, */*", True),
        ("text/html, application/json;q=0.9", False), ("application/json, text/html;q=0.5", True), ("x;q=,;;", False),
    ],
)  # fmt: skip
def test_json_on_request(
    owner: httpx.Client, anybody: httpx.Client, place: Place, accept: str | None, is_json: bool
) -> None:
    marker = new_marker(owner, place())
    release(owner, EVERYTHING)
    request = anybody.build_request("GET", f"/m/{marker['id']}")
    del request.headers["accept"]
    if accept is not None:
        request.headers["accept"] = accept
    answer = anybody.send(request)
    assert answer.headers["content-type"].startswith("application/json" if is_json else "text/html")


def test_addresses_on_plates_from_before_lead_to_the_page(
    owner: httpx.Client, anybody: httpx.Client, place: Place
) -> None:
    marker = new_marker(owner, place())
    release(owner, EVERYTHING)
    old = f"/v1/markers/{marker['id']}"
    answer = anybody.get(old, headers=HTML)
    assert answer.status_code == 303
    assert answer.headers["location"] == f"../../m/{marker['id']}"
    assert "accept" in answer.headers["vary"].lower()
    assert marker["code"]["digits"] in anybody.get(old, headers=HTML, follow_redirects=True).text
    nobodys = anybody.get(f"/v1/markers/{'0' * 8}-0000-7000-8000-{'0' * 12}", headers=HTML)
    assert nobodys.status_code == 303  # whether there is such a marker is not said here
    refused(anybody.get(old, headers=JSON), 401)
    refused(anybody.get(old), 401)
    refused(anybody.get(f"{old}/versions", headers=HTML), 401)
    refused(anybody.get(old, headers=HTML | {"X-API-Key": "wrong"}), 401)
    assert owner.get(old, headers=HTML).json()["id"] == marker["id"]


def test_settings_are_changed_by_admins_at_a_version(server: LiveServer, owner: httpx.Client) -> None:
    before = owner.get("/v1/public-page")
    body = {"fields": ["measure", "code", "code"], "damage_reports": False}
    refused(owner.put("/v1/public-page", json=body), 428)
    changed = owner.put("/v1/public-page", json=body, headers={"If-Match": before.headers["etag"]})
    assert changed.json()["fields"] == ["code", "measure"]
    assert changed.json()["version"] == before.json()["version"] + 1
    assert owner.get("/v1/public-page").json() == changed.json()
    refused(owner.put("/v1/public-page", json=body, headers={"If-Match": before.headers["etag"]}), 412)
    for wrong in ({"fields": ["lon_deg"], "damage_reports": True}, {"fields": []}, {"fields": "code"}):
        refused(owner.put("/v1/public-page", json=wrong, headers={"If-Match": "*"}), 422, "invalid-parameter")
    refused(
        owner.put("/v1/public-page", json={"fields": [], "damage_reports": True}, headers={"If-Match": "*"}),
        422, field="damage_reports",
    )  # fmt: skip
    with server.agency("Straßenbau <Süd>", Scope.PLANNER) as planner:
        assert planner.get("/v1/public-page").json() == changed.json()
        refused(planner.put("/v1/public-page", json=body, headers={"If-Match": "*"}), 403)
    entries = owner.get("/v1/audit", params={"limit": 1000}).json()["items"]
    entry = [entry for entry in entries if entry["action"] == "public-page.changed"][-1]
    assert entry["detail"] == {"fields": ["code", "measure"], "damage_reports": False}


def test_addresses_are_not_tried_without_end(
    settings: Settings, serve: Callable[[Settings], LiveServer], place: Place
) -> None:
    server = serve(settings.model_copy(update={"public_pages_per_minute": 12.0}))
    with server.client() as owner, server.client(None) as anybody:
        marker = new_marker(owner, place())
        statuses = [anybody.get(f"/m/{marker['id']}", headers=HTML).status_code for _ in range(3)]
        assert statuses == [200] * 3
        # 9 are left; each miss counts as five
        statuses = [anybody.get(f"/m/{k}", headers=HTML).status_code for k in range(3)]
        assert statuses == [404, 404, 429]
        page = anybody.get(f"/m/{marker['id']}", headers=HTML | {"Accept-Language": "de"})
        assert page.status_code == 429
        assert int(page.headers["retry-after"]) >= 1
        assert "Zu viele Anfragen" in page.text
        refused(anybody.get(f"/m/{marker['id']}", headers=JSON), 429, "too-many-requests")
        assert owner.get(f"/v1/markers/{marker['id']}").status_code == 200


def test_every_text_is_in_both_languages() -> None:
    from app.api.public_pages.texts import ENGLISH, GERMAN

    for name in ENGLISH.__slots__:
        one, other = getattr(ENGLISH, name), getattr(GERMAN, name)
        if isinstance(one, dict):
            assert one.keys() == other.keys(), name
            pairs = [(str(one[key]), str(other[key])) for key in one]
        else:
            pairs = [(one, other)]
        for english, german in pairs:
            assert english
            assert german
            assert re.findall(r"\{\w+\}", english) == re.findall(r"\{\w+\}", german), name
