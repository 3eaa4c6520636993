"""Damage reports: what is received without a key, what is refused, and how the agency decides."""

from __future__ import annotations

import io
import socket
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import httpx
import pytest
import sqlalchemy as sa
from PIL import Image

from app.registry.engines import across_agencies
from app.registry.public_pages import damage_report_contacts
from app.registry.webhooks import list_events
from app.services.access.access import Scope
from app.services.public_pages import reports as service
from app.settings import Settings
from tests.api.public_pages.markers import HTML, JSON, new_marker, old_token, release, send_report
from tests.conftest import LiveServer, Place
from tests.formats.pictures import corner_frame, jpeg, png
from tests.http import WITHIN_S, refused

pytestmark = pytest.mark.both_databases

SCRIPT = '"><script>alert(1)</script>'


@pytest.fixture(scope="module")
def owner(server: LiveServer) -> Iterator[httpx.Client]:
    with server.agency("maintainers of roads", Scope.ADMIN) as client:
        yield client


@pytest.fixture
def marker(owner: httpx.Client, place: Place) -> dict[str, Any]:
    return new_marker(owner, place())


def reports_of(client: httpx.Client, marker: dict[str, Any], **query: str) -> list[dict[str, Any]]:
    answer = client.get("/v1/damage-reports", params={"marker_id": marker["id"], **query})
    assert answer.status_code == 200, answer.text
    found: list[dict[str, Any]] = answer.json()["items"]
    return found


def photo_with_exif() -> bytes:
    """A JPEG that was turned, with the camera, the place and a comment in it."""
    exif = Image.Exif()
    exif[0x0112], exif[0x010F], exif[0x9286] = 6, "SecretCamera", "SecretComment"
    exif.get_ifd(0x8825).update({1: "N", 2: (49.0, 0.0, 30.0), 3: "E", 4: (8.0, 24.0, 0.0)})
    out = io.BytesIO()
    Image.fromarray(corner_frame(2400, 1200)).save(out, "JPEG", exif=exif, comment=b"SecretText")
    return out.getvalue()


@pytest.mark.slow
def test_a_report_is_received_and_its_sender_thanked(
    server: LiveServer, owner: httpx.Client, anybody: httpx.Client, marker: dict[str, Any]
) -> None:
    answer = send_report(
        anybody, server, marker["id"], query="?lang=de", kind="loose", text=" wobbles\r\nbadly ", email="a@b.example"
    )
    assert answer.status_code == 303, answer.text
    assert answer.headers["location"] == "thanks?lang=de"
    thanks = anybody.get(f"/m/{marker['id']}/thanks?lang=de", headers=HTML)
    assert "Vielen Dank" in thanks.text
    (report,) = reports_of(owner, marker)
    expected = {
        "marker_id": marker["id"], "kind": "loose", "text": "wobbles\nbadly", "language": "de", "has_photo": False,
        "has_contact": True, "status": "new", "note": None, "item_id": None, "decided_by": None, "decided_at": None,
    }  # fmt: skip
    assert expected.items() <= report.items()
    assert "a@b.example" not in str(report)
    assert owner.get(f"/v1/damage-reports/{report['id']}").json() == report
    agency_id = server.app.state.use_cases.public_pages.read(marker["id"]).agency_id
    with server.app.state.database.read() as connection:
        newest = list_events(connection, agency_id, limit=1000)[-1]
    assert (newest.kind, newest.subject_id) == ("report.received", report["id"])
    assert newest.detail == {"marker_id": marker["id"], "kind": "loose", "status": "new"}


def test_a_client_that_prefers_json_gets_json(
    server: LiveServer, owner: httpx.Client, anybody: httpx.Client, marker: dict[str, Any]
) -> None:
    form = anybody.get(f"/m/{marker['id']}", headers=JSON).json()["report"]
    assert form["kinds"] == ["damaged", "dirty", "missing", "loose", "other"]
    refused(send_report(anybody, server, marker["id"], headers=JSON, token=form["token"]), 422, field="token")
    answer = send_report(anybody, server, marker["id"], headers=JSON)
    assert (answer.status_code, answer.json()) == (201, {"status": "received"})
    assert len(reports_of(owner, marker)) == 1


@pytest.mark.slow
def test_a_form_that_is_sent_twice_is_one_report(
    server: LiveServer, owner: httpx.Client, anybody: httpx.Client, marker: dict[str, Any]
) -> None:
    token = old_token(server, marker["id"])
    for _ in range(2):
        assert send_report(anybody, server, marker["id"], token=token, photo=("a.jpg", jpeg())).status_code == 303
    assert len(reports_of(owner, marker)) == 1


@pytest.mark.parametrize("file", [photo_with_exif(), png(), jpeg(corner_frame()[..., 0])])
def test_a_photo_is_written_anew_without_metadata(
    server: LiveServer, owner: httpx.Client, anybody: httpx.Client, marker: dict[str, Any], file: bytes
) -> None:
    answer = send_report(anybody, server, marker["id"], photo=("../../etc/x.jpg", file, "text/html"))
    assert answer.status_code == 303, answer.text
    (report,) = reports_of(owner, marker)
    assert report["has_photo"] is True
    photo = owner.get(f"/v1/damage-reports/{report['id']}/photo")
    assert photo.headers["content-type"] == "image/jpeg"
    with Image.open(io.BytesIO(photo.content)) as stored, Image.open(io.BytesIO(file)) as sent:
        assert stored.format == "JPEG"
        assert not stored.getexif()
        assert not stored.info.keys() - {"jfif", "jfif_version", "jfif_unit", "jfif_density"}
        assert max(stored.size) == min(max(sent.size), 2048)
        turned = sent.getexif().get(0x0112) == 6
        assert (stored.size[0] < stored.size[1]) is turned
        if turned:  # red, green / blue, white, turned clockwise: blue is at the upper left
            red, _green, blue = stored.convert("RGB").getpixel((stored.size[0] // 4, stored.size[1] // 4))
            assert blue > 200 > 60 > red
    assert b"Secret" not in photo.content
    assert b"Secret" in file or "Exif" not in str(file[:64])
    assert owner.delete(f"/v1/damage-reports/{report['id']}/photo").status_code == 204
    refused(owner.get(f"/v1/damage-reports/{report['id']}/photo"), 404)
    refused(owner.delete(f"/v1/damage-reports/{report['id']}/photo"), 404)
    assert reports_of(owner, marker)[0]["has_photo"] is False


@pytest.mark.parametrize(
    ("fields", "photo", "field", "shown"),
    [
        ({"kind": ""}, None, "kind", "Choose what is wrong"),
        ({"kind": SCRIPT}, None, "kind", "Choose what is wrong"),
        ({"kind": "other"}, None, "text", "Describe what is wrong"),
        ({"text": "x" * 1001}, None, "text", "1001 characters"),
        ({"email": "nobody"}, None, "email", "not an e-mail address"),
        ({"email": "a@b.example, c@d.example"}, None, "email", "not an e-mail address"),
        ({"email": f"{'x' * 250}@b.example"}, None, "email", "not an e-mail address"),
        ({"website": "https://spam.example"}, None, "website", "Leave this field empty"),
        ({"token": ""}, None, "token", "open for too long"),
        ({"token": "x"}, None, "token", "open for too long"),
        ({}, ("x.gif", b"GIF89a" + bytes(100)), "photo", "not a JPEG or PNG"),
        ({}, ("x.svg", b"<svg onload='alert(1)'/>"), "photo", "not a JPEG or PNG"),
        ({}, ("x.jpg", jpeg()[:300]), "photo", "cannot be read"),
        ({}, ("x.jpg", jpeg() + bytes(16_000_000)), "photo", "larger than 16 MB"),
    ],
)
def test_a_form_that_is_wrong_comes_back_with_what_was_typed(
    server: LiveServer, owner: httpx.Client, anybody: httpx.Client, marker: dict[str, Any],
    fields: dict[str, str], photo: Any, field: str, shown: str,
) -> None:  # fmt: skip
    typed = {"text": f"</textarea>{SCRIPT}", "email": "a'b@c.example", **fields}
    if field == "text":
        typed["text"] = fields.get("text", "")
    page = send_report(anybody, server, marker["id"], photo=photo, **typed)
    assert page.status_code == 422
    assert shown in page.text.replace("&#39;", "'")
    assert "<title>Error: " in page.text
    assert "<script" not in page.text
    assert ("Choose the photo again" in page.text) is (photo is not None)
    if field != "text":
        assert "&lt;/textarea&gt;&#34;&gt;&lt;script&gt;alert(1)" in page.text
    if field != "email":
        assert 'value="a&#39;b@c.example"' in page.text
    refused(send_report(anybody, server, marker["id"], photo=photo, headers=JSON, **typed), 422, field=field)
    assert reports_of(owner, marker) == []


@pytest.mark.parametrize(
    ("age_s", "other"), [(0.0, False), (7 * 3600.0, False), (60.0, True)], ids=["young", "expired", "another marker's"]
)
def test_a_form_has_a_token_of_some_age(
    server: LiveServer, owner: httpx.Client, anybody: httpx.Client, marker: dict[str, Any], place: Place,
    age_s: float, other: bool,
) -> None:  # fmt: skip
    token = old_token(server, new_marker(owner, place())["id"] if other else marker["id"], age_s)
    page = send_report(anybody, server, marker["id"], token=token)
    assert page.status_code == 422
    assert ("Wait a few seconds" in page.text) is (age_s == 0.0)
    assert (token in page.text) is (age_s == 0.0)  # else there is a new one
    assert reports_of(owner, marker) == []


def test_bodies_that_are_no_form_are_refused(server: LiveServer, anybody: httpx.Client, marker: dict[str, Any]) -> None:
    path = f"/m/{marker['id']}/reports"
    refused(anybody.post(path, json={"kind": "loose"}, headers=JSON), 415, field="Content-Type")
    assert anybody.post(path, data={"kind": "loose"}, headers=HTML).status_code == 415
    boundary = {"Content-Type": "multipart/form-data; boundary=b; charset=unicode_escape"}
    refused(anybody.post(path, content=b"--b--", headers=JSON | boundary), 415)
    boundary = {"Content-Type": "multipart/form-data; boundary=b"}
    refused(anybody.post(path, content=b"no parts", headers=JSON | boundary), 400)
    refused(send_report(anybody, server, marker["id"], headers=JSON, colour="red"), 400, field="colour")
    twice = [("kind", (None, "loose")), ("kind", (None, "dirty"))]
    refused(anybody.post(path, files=twice, headers=JSON), 400, field="kind")
    refused(anybody.post(path, files={"text": ("x.txt", b"x")}, headers=JSON), 400, field="text")
    refused(anybody.post(path, files={"photo": (None, "x")}, headers=JSON), 400, field="photo")
    refused(send_report(anybody, server, marker["id"], headers=JSON, text="x" * 20_000), 400)
    with socket.create_connection(("127.0.0.1", int(server.url.rpartition(":")[2])), WITHIN_S) as client:
        head = f"POST {path} HTTP/1.1\r\nHost: x\r\nAccept: text/html\r\nContent-Length: 99999999\r\n\r\n"
        client.sendall(head.encode())
        page = b"".join(iter(lambda: client.recv(65536), b"")).decode()  # it hangs up
    assert page.startswith("HTTP/1.1 413 ")
    assert "smaller photo" in page
    assert "default-src 'none'" in page
    assert anybody.get(path, headers=HTML).status_code == 405


def test_texts_are_kept_as_texts_without_what_is_none(
    server: LiveServer, owner: httpx.Client, anybody: httpx.Client, marker: dict[str, Any]
) -> None:
    text = f"{SCRIPT}\x00\x1b[31m \u202eevil \U0001f6a7 '; DROP TABLE markers; --"
    assert send_report(anybody, server, marker["id"], text=text, email="<x>@b.example").status_code == 422
    assert send_report(anybody, server, marker["id"], text=text).status_code == 303
    (report,) = reports_of(owner, marker)
    assert report["text"] == f"{SCRIPT}[31m evil \U0001f6a7 '; DROP TABLE markers; --"


# --- decisions ----------------------------------------------------------------------------------------------------


def test_an_approved_report_becomes_an_item_of_the_work_list(
    server: LiveServer, owner: httpx.Client, anybody: httpx.Client, marker: dict[str, Any]
) -> None:
    for kind in ("dirty", "loose"):
        assert send_report(anybody, server, marker["id"], kind=kind).status_code == 303
    loose, dirty = reports_of(owner, marker)
    assert reports_of(owner, marker, status="approved") == []
    with server.agency("maintainers of roads", Scope.VIEWER) as viewer:
        assert reports_of(viewer, marker) == [loose, dirty]
        refused(viewer.post(f"/v1/damage-reports/{dirty['id']}/approve", json={}), 403)
    decided = owner.post(f"/v1/damage-reports/{dirty['id']}/approve", json={"note": "clean it"}).json()
    assert (decided["status"], decided["note"], decided["decided_by"]) == (
        "approved", "clean it", "maintainers of roads admin",
    )  # fmt: skip
    item = owner.get(f"/v1/maintenance/{decided['item_id']}").json()
    assert (item["what"], item["status"], item["marker_id"], item["road"]) == ("reported", "open", marker["id"], "A 5")
    reported = {"report_id": dirty["id"], "kind": "dirty", "at": dirty["created_at"]}
    assert item["evidence"] == {"uploads": [], "reports": [reported]}
    # a second report adds to the open item, which becomes more urgent
    again = owner.post(f"/v1/damage-reports/{loose['id']}/approve", json={}).json()
    assert again["item_id"] == decided["item_id"]
    more = owner.get(f"/v1/maintenance/{decided['item_id']}").json()
    assert [report["kind"] for report in more["evidence"]["reports"]] == ["dirty", "loose"]
    assert more["priority"] > item["priority"]
    assert owner.get(f"/v1/markers/{marker['id']}").json()["status"] == "active"
    refused(owner.post(f"/v1/damage-reports/{dirty['id']}/approve", json={}), 409, "conflict")
    refused(owner.post(f"/v1/damage-reports/{dirty['id']}/reject", json={"reason": "x"}), 409, "conflict")
    approved = owner.post(f"/v1/maintenance/{item['id']}/approve", json={"outcome": "suspect"})
    assert approved.status_code == 200, approved.text
    assert owner.get(f"/v1/markers/{marker['id']}").json()["status"] == "suspect"
    assert "in use, to be checked" in anybody.get(f"/m/{marker['id']}", headers=HTML).text
    actions = [entry["action"] for entry in owner.get("/v1/audit", params={"limit": 1000}).json()["items"]]
    assert actions[-4:] == [
        "damage-report.approved", "damage-report.approved", "marker.changed", "maintenance.approved",
    ]  # fmt: skip
    agency_id = server.app.state.use_cases.public_pages.read(marker["id"]).agency_id
    with server.app.state.database.read() as connection:
        kinds = [event.kind for event in list_events(connection, agency_id, limit=1000)]
    assert kinds[-4:] == ["maintenance.opened", "report.decided", "report.decided", "maintenance.decided"]


def test_a_report_is_rejected_with_a_reason(
    server: LiveServer, owner: httpx.Client, anybody: httpx.Client, marker: dict[str, Any]
) -> None:
    send_report(anybody, server, marker["id"], text="it is green")
    (report,) = reports_of(owner, marker, status="new")
    path = f"/v1/damage-reports/{report['id']}/reject"
    refused(owner.post(path, json={}), 422, field="reason")
    decided = owner.post(path, json={"reason": "it is meant to be green"}).json()
    assert (decided["status"], decided["note"], decided["item_id"]) == ("rejected", "it is meant to be green", None)
    assert reports_of(owner, marker, status="new") == []
    assert reports_of(owner, marker, status="rejected") == [decided]
    assert owner.get("/v1/maintenance", params={"marker_id": marker["id"]}).json()["items"] == []


def test_pages_of_reports(
    server: LiveServer, owner: httpx.Client, anybody: httpx.Client, marker: dict[str, Any]
) -> None:
    for _ in range(3):
        send_report(anybody, server, marker["id"])
    everything = reports_of(owner, marker)
    found, url = [], f"/v1/damage-reports?marker_id={marker['id']}&limit=2"
    while url:
        answer = owner.get(url)
        found += answer.json()["items"]
        url = answer.links.get("next", {}).get("url", "")
    assert found == everything
    assert len({report["id"] for report in found}) == 3
    for wrong in ({"status": "old"}, {"marker_id": "x"}, {"after": "x"}, {"kind": "loose"}):
        assert owner.get("/v1/damage-reports", params=wrong).status_code in (400, 422)


def test_a_contact_is_kept_apart_and_deleted(
    server: LiveServer, owner: httpx.Client, anybody: httpx.Client, marker: dict[str, Any]
) -> None:
    for address in ("first@b.example", "second@b.example", ""):
        send_report(anybody, server, marker["id"], email=address)
    without, second, first = reports_of(owner, marker)
    assert [report["has_contact"] for report in (first, second, without)] == [True, True, False]
    path = f"/v1/damage-reports/{first['id']}/contact"
    assert owner.get(path).json()["email"] == "first@b.example"
    with server.agency("maintainers of roads", Scope.VIEWER) as viewer:
        refused(viewer.get(path), 403)
    assert owner.delete(path).status_code == 204
    refused(owner.get(path), 404)
    refused(owner.delete(path), 404)
    refused(owner.get(f"/v1/damage-reports/{without['id']}/contact"), 404)
    assert owner.get("/v1/audit", params={"limit": 1000}).json()["items"][-1]["action"] == (
        "damage-report.contact-deleted"
    )
    # and after some time by the server
    cases, database = server.app.state.use_cases.damage_reports, server.app.state.database
    with across_agencies():
        assert cases.delete_old_contacts() == 0
        old = datetime.now(UTC) - timedelta(days=91)
        with database.write() as connection:
            change = sa.update(damage_report_contacts).where(damage_report_contacts.c.report_id == second["id"])
            connection.execute(change.values(created_at=old))
        assert cases.delete_old_contacts() == 1
    assert [report["has_contact"] for report in reports_of(owner, marker)] == [False] * 3


def test_agencies_see_their_own_reports_only(
    server: LiveServer, owner: httpx.Client, anybody: httpx.Client, marker: dict[str, Any]
) -> None:
    send_report(anybody, server, marker["id"])
    (report,) = reports_of(owner, marker)
    with server.agency("neighbours", Scope.ADMIN) as others:
        assert others.get("/v1/damage-reports").json()["items"] == []
        assert reports_of(others, marker) == []
        refused(others.get(f"/v1/damage-reports/{report['id']}"), 404)


def test_an_agency_may_take_no_reports(server: LiveServer, anybody: httpx.Client, place: Place) -> None:
    with server.agency("takes none", Scope.ADMIN) as client:
        marker = new_marker(client, place())
        release(client, ["code"], damage_reports=False)
        page = anybody.get(f"/m/{marker['id']}", headers=HTML)
        assert page.status_code == 200
        assert "<form" not in page.text
        assert anybody.get(f"/m/{marker['id']}", headers=JSON).json()["report"] is None
        refused(send_report(anybody, server, marker["id"], headers=JSON), 404)
        assert client.get("/v1/damage-reports").json()["items"] == []


# --- limits -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_reports_are_limited_by_address_and_by_marker(
    settings: Settings, serve: Callable[[Settings], LiveServer], place: Place
) -> None:
    server = serve(settings.model_copy(update={"damage_reports_per_hour": 5.0, "marker_reports_per_day": 2.0}))
    with server.client() as owner, server.client(None) as anybody:
        ids = [new_marker(owner, place())["id"] for _ in range(2)]
        assert send_report(anybody, server, ids[0], kind="").status_code == 422  # counts for the address only
        statuses = [send_report(anybody, server, ids[0]).status_code for _ in range(3)]
        assert statuses == [303, 303, 429]
        assert send_report(anybody, server, ids[1]).status_code == 303
        refusal = send_report(anybody, server, ids[1])
        assert refusal.status_code == 429
        assert int(refusal.headers["retry-after"]) > 60
        assert "Wait a while" in refusal.text
        assert len(owner.get("/v1/damage-reports").json()["items"]) == 3


def test_reports_that_wait_for_a_decision_are_limited(
    server: LiveServer, owner: httpx.Client, anybody: httpx.Client, marker: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(service, "MAX_NEW_OF_MARKER", 1)
    assert send_report(anybody, server, marker["id"]).status_code == 303
    refused(send_report(anybody, server, marker["id"], headers=JSON), 429)
    (report,) = reports_of(owner, marker)
    owner.post(f"/v1/damage-reports/{report['id']}/reject", json={"reason": "x"})
    assert send_report(anybody, server, marker["id"]).status_code == 303


@pytest.mark.slow
def test_a_photo_beyond_the_quota_is_refused_without_figures(
    settings: Settings, serve: Callable[[Settings], LiveServer], place: Place
) -> None:
    server = serve(settings.model_copy(update={"agency_stored_bytes": 1000}))
    with server.client() as owner, server.client(None) as anybody:
        marker_id = new_marker(owner, place())["id"]
        problem = refused(send_report(anybody, server, marker_id, headers=JSON, photo=("x.jpg", jpeg())), 503)
        assert "1000" not in str({**problem, "request_id": "", "instance": ""})
        assert owner.get("/v1/damage-reports").json()["items"] == []
        assert send_report(anybody, server, marker_id).status_code == 303
