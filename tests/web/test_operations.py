"""The pages of operations: jobs, the work list, damage reports, codebooks, keys, webhooks, the audit log, settings."""

from __future__ import annotations

import io
import json
import re
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import sqlalchemy as sa
from PIL import Image
from playwright.sync_api import expect

from app.registry import jobs as store
from app.registry.column_types import new_id
from app.registry.engines import across_agencies
from app.registry.jobs import JobKind, jobs
from app.services.access.access import Scope
from tests.conftest import LiveServer
from tests.web.browsing import PHONE, Watched, until
from tests.web.conftest import OpenPage
from tests.web.operations_data import open_forms, send_report

# --- keys -----------------------------------------------------------------------------------------------------------


def test_a_key_is_made_shown_once_and_revoked(watched: Watched, server: LiveServer, ids: dict[str, str]) -> None:
    page = watched.open("/operations/keys")
    page.get_by_role("button", name="Make a key").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Name").fill("BUS-9")
    dialog.get_by_label("Role").select_option("vehicle")
    expect(dialog.get_by_label("Expires (UTC)")).to_have_value(re.compile(r"^\d{4}-\d\d-\d\d$"))
    dialog.get_by_role("button", name="Make a key").click()
    page.get_by_text("The key is shown only now").wait_for()
    shown_once = page.get_by_role("dialog").get_by_label("API key")
    expect(shown_once).to_have_value(re.compile("^wm_"))
    key = shown_once.input_value()
    expect(page.get_by_role("dialog").get_by_role("button", name="Close", exact=True).last).to_be_disabled()
    page.get_by_label("I have stored it in a safe place").check()
    page.get_by_role("dialog").get_by_role("button", name="Close", exact=True).last.click()
    assert key not in page.content()
    with server.client(key) as client:
        assert client.get("/v1/me").json()["label"] == "BUS-9"
    page.get_by_role("link", name="BUS-9").click()
    page.locator(".panel").get_by_role("button", name="Revoke").click()
    page.get_by_role("dialog", name="Revoke the key of BUS-9").get_by_role("button", name="Revoke").click()
    page.locator(".panel .verdict", has_text="revoked").wait_for()
    with server.client(key) as client:
        assert client.get("/v1/me").status_code == 401


def test_a_key_is_copied(new_page: OpenPage) -> None:
    watched = new_page(permissions=["clipboard-read", "clipboard-write"])
    page = watched.open("/operations/keys")
    page.get_by_role("button", name="Make a key").click()
    page.get_by_role("dialog").get_by_label("Name").fill("copied")
    page.get_by_role("dialog").get_by_role("button", name="Make a key").click()
    page.get_by_role("button", name="Copy", exact=True).click()
    page.get_by_text("It is in the clipboard").wait_for()
    assert page.evaluate("navigator.clipboard.readText()") == page.locator("dialog input[readonly]").input_value()


def test_a_key_is_replaced_and_the_last_admin_key_stays(watched: Watched, ids: dict[str, str]) -> None:
    page = watched.open(f"/operations/keys/{ids['key']}")
    page.locator(".panel").get_by_role("button", name="Replace").click()
    page.get_by_label("The old key stays valid").select_option("3600")
    page.get_by_role("dialog").get_by_role("button", name="Replace").click()
    page.get_by_role("heading", name="New key of Fabricator").wait_for()
    page.get_by_label("I have stored it in a safe place").check()
    page.get_by_role("dialog").get_by_role("button", name="Close", exact=True).last.click()
    page.get_by_role("link", name="WAYMARK_ADMIN_KEY").click()
    page.locator(".panel h2", has_text="WAYMARK_ADMIN_KEY").wait_for()
    page.locator(".panel").get_by_role("button", name="Revoke").click()
    page.get_by_role("dialog").get_by_role("button", name="Revoke").click()
    page.get_by_role("dialog").locator(".problem").wait_for()
    page.get_by_role("button", name="Do not").click()
    watched.complaints.clear()  # the browser itself reports the 409


# --- the audit log --------------------------------------------------------------------------------------------------


def test_the_log_is_filtered_and_shows_what_a_change_did(
    watched: Watched, server: LiveServer, ids: dict[str, str]
) -> None:
    with server.client() as client:
        marker = client.get(f"/v1/markers/{ids['cerpm']}").json()
        change = {"status": "suspect", "reason": "hit by a plough"}
        changed = client.patch(
            f"/v1/markers/{ids['cerpm']}", json=change, headers={"If-Match": f'"{marker["version"]}"'}
        )
        assert changed.status_code == 200
    page = watched.open(f"/operations/audit?subject={ids['cerpm']}")
    page.get_by_role("link", name=re.compile(r"^\d+$")).first.wait_for()
    expect(page.locator("tbody tr")).to_have_count(2)
    expect(page.locator("tbody tr").first.get_by_text("Marker changed")).to_have_count(1)
    page.get_by_role("link", name=re.compile(r"^\d+$")).first.click()
    row = page.locator(".changes tr", has_text="Status")
    expect(row.locator("del")).to_have_text("active")
    expect(row.locator("ins")).to_have_text("suspect")
    expect(page.locator(".panel")).to_contain_text("hit by a plough")
    expect(page.locator(".changes tbody tr")).to_have_count(1)
    page.locator("#filter-action").select_option("marker.*")
    page.wait_for_url("**action=marker.*")
    page.locator("#filter-until").fill("2020-01-01")
    page.locator("#filter-until").press("Enter")
    page.get_by_text("Nothing fits these filters").wait_for()
    page.get_by_role("button", name="Clear filters").click()
    page.locator("tbody tr").nth(5).wait_for()
    page.go_back()
    page.get_by_text("Nothing fits these filters").wait_for()


def test_the_whole_log_is_checked(watched: Watched, ids: dict[str, str]) -> None:
    page = watched.open("/operations/audit")
    page.get_by_role("button", name="Check the log").click()
    page.get_by_text("Nothing was changed behind the log").wait_for()
    expect(page.get_by_role("dialog")).to_have_text(re.compile(r"\d+:[0-9a-f]{64}"))


# --- damage reports and the work list -------------------------------------------------------------------------------


def test_a_report_is_rejected_with_a_reason(watched: Watched, ids: dict[str, str]) -> None:
    page = watched.open("/operations/reports")
    page.locator("tbody a").first.click()
    page.locator(".quote", has_text="Mud").wait_for()
    page.get_by_role("button", name="Show the address").click()
    page.get_by_role("link", name="walker@example.org").wait_for()
    page.get_by_role("button", name="Reject").click()
    page.locator(".field-error").wait_for()
    page.get_by_label("Note").fill("washed off by the rain")
    page.get_by_role("button", name="Reject").click()
    page.locator(".panel .verdict", has_text="rejected").wait_for()
    page.get_by_text("No new damage reports").wait_for()
    watched.complaints.clear()  # the browser itself reports the 422


def test_a_photo_is_shown_and_a_report_accepted_into_the_work_list(
    watched: Watched, server: LiveServer, ids: dict[str, str]
) -> None:
    photo = io.BytesIO()
    Image.fromarray(np.full((60, 80, 3), 128, np.uint8)).save(photo, "JPEG")
    with server.client() as client:
        (form,) = open_forms(client, [ids["plate"]])
        fields = {"kind": "damaged", "text": "Broken"}
        send_report(client, form, fields, ("photo.jpg", photo.getvalue()))
        report = client.get("/v1/damage-reports").json()["items"][0]
    page = watched.open(f"/operations/reports/{report['id']}")
    page.locator(".panel img").wait_for()
    until(page, "document.querySelector('.panel img').naturalWidth === 80")
    page.get_by_label("Note").fill("send a crew")
    page.get_by_role("button", name="Approve for the work list").click()
    page.get_by_role("link", name="Item of the work list").click()
    page.wait_for_url("**/operations/maintenance/*")
    page.get_by_label("Decision").select_option("suspect")
    page.get_by_role("button", name="Approve").click()
    page.locator(".panel .facts", has_text="approved").wait_for()
    with server.client() as client:
        assert client.get(f"/v1/markers/{ids['plate']}").json()["status"] == "suspect"
    page.get_by_role("link", name="Show the place on the map").click()
    page.wait_for_url("**/markers?view=map&map=*")


def test_the_work_list_is_exported_and_an_item_rejected(watched: Watched, ids: dict[str, str]) -> None:
    page = watched.open(f"/operations/maintenance/{ids['item']}")
    with page.expect_download() as download:
        page.get_by_role("button", name="Export CSV").click()
    assert ids["item"] in Path(download.value.path()).read_text()
    page.get_by_label("Decision").select_option("reject")
    page.get_by_label("Note").fill("it stands right")
    page.get_by_role("button", name="Reject").click()
    page.locator(".panel .facts", has_text="rejected").wait_for()
    page.locator("#filter-status").select_option("rejected")
    page.wait_for_url("**status=rejected")
    page.locator("tbody tr", has_text="Reported by people").wait_for()


# --- jobs and reprocessings -----------------------------------------------------------------------------------------


def test_jobs_show_their_result(watched: Watched, server: LiveServer, ids: dict[str, str]) -> None:
    page = watched.open("/operations/jobs?kind=export")
    page.get_by_text("Nothing fits these filters").or_(page.get_by_text("No jobs yet")).wait_for()
    with server.client() as client:
        job = client.post("/v1/exports", json={"format": "csv"}).json()
    page.goto(f"{server.url}/operations/jobs/{job['id']}?kind=export")
    page.locator(".panel .verdict", has_text="Done").wait_for()
    page.locator("tbody tr", has_text="Done").wait_for()
    with page.expect_download() as download:
        page.get_by_role("button", name="Download the result").click()
    assert download.value.suggested_filename == "markers.csv"


def waiting_job(server: LiveServer) -> str:
    """A job that nobody runs: a test sets its state."""
    now = datetime.now(UTC)
    with server.client() as client:
        agency_id = client.get("/v1/snapshots/trust").json()["agency_id"]
        holder_id = client.get("/v1/me").json()["holder_id"]
    job = store.new_job(JobKind.EXPORT, new_id(now), agency_id, holder_id, now, job_input={"format": "csv"})
    with across_agencies(), server.app.state.database.write() as connection:
        store.add_job(connection, job)
    return job.id


def set_job(server: LiveServer, job_id: str, **values: object) -> None:
    """Change a job as one who runs it does."""
    with across_agencies(), server.app.state.database.write() as connection:
        connection.execute(sa.update(jobs).where(jobs.c.id == job_id).values(**values))


def test_progress_is_shown_as_it_happens(watched: Watched, server: LiveServer, ids: dict[str, str]) -> None:
    job_id = waiting_job(server)
    page = watched.open(f"/operations/jobs/{job_id}")
    page.locator(".panel .job", has_text="Waiting").wait_for()
    now = datetime.now(UTC)
    set_job(server, job_id, state="running", progress=0.3, steps_done=3, steps_total=10, started_at=now)
    page.locator(".panel .job", has_text="Running (3 of 10)").wait_for()
    page.locator("tbody tr", has_text="3 of 10").wait_for()
    error = {"kind": "Unavailable", "detail": "the disk is full", "cure": "make room"}
    set_job(server, job_id, state="failed", error=error, finished_at=now)
    page.locator(".panel .problem", has_text="make room").wait_for()
    page.locator("tbody tr", has_text="Failed").wait_for()


def test_a_waiting_job_is_cancelled(watched: Watched, server: LiveServer, ids: dict[str, str]) -> None:
    page = watched.open(f"/operations/jobs/{waiting_job(server)}")
    page.locator(".panel").get_by_role("button", name="Cancel").click()
    page.locator(".panel .verdict", has_text="Cancelled").wait_for()


def test_why_a_job_failed_is_shown_with_its_cure(watched: Watched, server: LiveServer, ids: dict[str, str]) -> None:
    declaration = json.dumps({"crs": "EPSG:4326", "family": "cerpm"})
    form = {"file": ("survey.csv", b"%PDF-1.7\n"), "declaration": ("", declaration)}
    with server.client() as client:
        job = client.post("/v1/imports", files=form, headers={"Prefer": "respond-async"}).json()
    page = watched.open(f"/operations/jobs/{job['id']}")
    page.locator(".panel .problem", has_text="export the points as CSV").wait_for()


def test_stored_uploads_are_decoded_again(watched: Watched, server: LiveServer, ids: dict[str, str]) -> None:
    picture = io.BytesIO()
    Image.fromarray(np.full((240, 320, 3), 90, np.uint8)).save(picture, "PNG")
    with server.client() as client:
        frame = {"file": ("frame.png", picture.getvalue(), "image/png"), "context": ("", "{}")}
        assert client.post("/v1/decodes", files=frame).status_code in (200, 201)
    page = watched.open("/operations/reprocessings")
    page.get_by_role("button", name="Start a reprocessing").click()
    page.get_by_role("dialog").get_by_role("button", name="Start a reprocessing").click()
    page.wait_for_url("**/operations/reprocessings/*")
    page.get_by_role("button", name="Approve the new results").click()
    page.get_by_role("dialog").get_by_role("button", name="Approve the new results").click()
    page.locator(".panel .verdict", has_text="approved").wait_for()


# --- codebooks, webhooks, snapshots, settings -----------------------------------------------------------------------


def test_a_codebook_is_made_and_filled_from_a_file(watched: Watched, server: LiveServer) -> None:
    page = watched.open("/operations/codebooks")
    page.get_by_role("button", name="Make a codebook").click()
    dialog = page.get_by_role("dialog")
    dialog.locator("[name=name]").fill("Ring road")
    dialog.locator("[name=meanings]").fill("bend-right 125\narrow left")
    dialog.get_by_role("button", name="Make a codebook").click()
    page.wait_for_url("**/operations/codebooks/*")
    page.get_by_text(re.compile("^2 of ")).wait_for()
    csv = b"kind,value\nstop-line-ahead,20\nspeed-limit-kmh,50\n"
    page.locator(".panel input[type=file]").set_input_files({"name": "m.csv", "mimeType": "text/csv", "buffer": csv})
    until(page, "document.querySelector('.panel [name=meanings]').value.includes('stop-line-ahead')")
    page.locator(".panel").get_by_role("button", name="Add", exact=True).click()
    page.get_by_text(re.compile("^4 of ")).wait_for()
    with page.expect_download() as download:
        page.locator(".panel").get_by_role("button", name="Export CSV").click()
    assert Path(download.value.path()).read_text().count("\n") == 4
    page.locator(".panel [name=meanings]").fill("nonsense")
    page.locator(".panel").get_by_role("button", name="Add", exact=True).click()
    page.locator(".panel .field-error", has_text="Line 1").wait_for()


def test_a_webhook_is_added_and_deleted(watched: Watched, ids: dict[str, str]) -> None:
    page = watched.open("/operations/webhooks")
    page.get_by_role("button", name="Add a webhook").click()
    page.get_by_role("dialog").get_by_label("Address").fill("http://127.0.0.1/hook")
    page.get_by_role("dialog").get_by_role("button", name="Add a webhook").click()
    page.get_by_role("dialog").locator(".field-error").wait_for()
    page.get_by_role("dialog").get_by_label("Address").fill("https://example.org/second")
    page.get_by_role("dialog").get_by_role("button", name="Add a webhook").click()
    secret = page.get_by_label("Secret for checking signatures")
    secret.wait_for()
    expect(secret).to_have_value(re.compile("^whsec_"))
    page.get_by_label("I have stored it in a safe place").check()
    page.get_by_role("dialog").get_by_role("button", name="Close", exact=True).last.click()
    page.get_by_role("link", name="https://example.org/second").click()
    page.locator(".panel").get_by_role("button", name="Delete").click()
    page.get_by_role("dialog").get_by_role("button", name="Delete").click()
    expect(page.get_by_role("link", name="https://example.org/second")).to_have_count(0)
    watched.complaints.clear()  # the browser itself reports the 422


def test_a_snapshot_and_the_trust_file_are_saved(watched: Watched, ids: dict[str, str]) -> None:
    page = watched.open("/operations/snapshots")
    page.get_by_role("button", name="Make and download").click()
    page.locator(".field-error").first.wait_for()
    page.get_by_role("button", name="Area of the markers").click()
    until(page, "document.querySelector('[name=west]').value !== ''")
    with page.expect_download() as download:
        page.get_by_role("button", name="Make and download").click()
    assert Path(download.value.path()).read_bytes().startswith(b"WAYMARKS")
    page.wait_for_url("**bbox=**")
    with page.expect_download() as download:
        page.get_by_role("button", name="Download trust.json").click()
    assert json.loads(Path(download.value.path()).read_text())["algorithm"] == "Ed25519"


def test_the_public_pages_are_changed(watched: Watched, server: LiveServer, ids: dict[str, str]) -> None:
    page = watched.open("/operations/settings")
    page.get_by_label("Measure along the road").check()
    page.get_by_role("button", name="Save").click()
    page.get_by_text("The public pages are changed").wait_for()
    with server.client() as client:
        assert "measure" in client.get("/v1/public-page").json()["fields"]
    page.get_by_label("Revision of the artwork").uncheck()
    page.get_by_role("button", name="Save").click()
    until(page, "document.querySelectorAll('.notice').length > 1")


def test_the_settings_in_use_are_for_admins(
    watched: Watched, new_page: OpenPage, server: LiveServer, ids: dict[str, str]
) -> None:
    page = watched.open("/operations/settings")
    page.locator("tr", has_text="WAYMARK_MAX_IMPORT_BYTES").wait_for()
    expect(page.locator("tr", has_text="WAYMARK_MAX_IMPORT_BYTES")).to_contain_text("256\u00a0MiB")
    expect(page.locator("main")).to_contain_text("SQLite")
    viewer = new_page(server.app.state.use_cases.access.create_key("default", Scope.VIEWER, "reader"))
    page = viewer.open("/operations/settings")
    page.get_by_text("Admins can change this").wait_for()
    expect(page.get_by_role("heading", name="Settings in use")).to_have_count(0)


def test_the_pages_are_used_on_a_phone(new_page: OpenPage, ids: dict[str, str]) -> None:
    watched = new_page(size=PHONE, locale="de-DE")
    page = watched.open(f"/operations/maintenance/{ids['approved_report']}")
    page.locator(".panel .problem").wait_for()  # this id is no item's
    watched.complaints.clear()
    page = watched.open(f"/operations/keys/{ids['key']}")
    expect(page.locator(".panel")).to_contain_text("Fabricator")
    page.keyboard.press("Escape")
    expect(page.locator(".panel")).to_have_count(0)
    page.wait_for_url("**/operations/keys")
