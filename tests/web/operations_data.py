"""What the pages of operations show: damage reports, an item of the work list, a key, a webhook."""

from __future__ import annotations

import time
from typing import Any

import httpx


def open_forms(client: httpx.Client, marker_ids: list[str]) -> list[dict[str, Any]]:
    """The forms for damage reports of some markers, each with the monotonic time from which on it is old enough."""
    pages = [client.get(f"/m/{marker_id}", headers={"Accept": "application/json"}) for marker_id in marker_ids]
    forms = [page.json()["report"] for page in pages]
    return [{**form, "from_s": time.monotonic() + form["min_age_s"]} for form in forms]


def send_report(
    client: httpx.Client, form: dict[str, Any], fields: dict[str, str], photo: tuple[str, bytes] = ("", b"")
) -> None:
    """Send a damage report once its form is old enough: one that is sent too early counts for the limit of reports."""
    time.sleep(max(form["from_s"] - time.monotonic(), 0.0))
    answer = client.post(
        form["href"], data={"token": form["token"], **fields}, files={"photo": photo},
        headers={"Accept": "application/json"},
    )  # fmt: skip
    assert answer.status_code == 201, answer.text


def fill_operations(client: httpx.Client, forms: list[dict[str, Any]]) -> dict[str, str]:
    """Send two damage reports, approve the first one, make the rest; returns ids by what they are of."""
    for form, (kind, text) in zip(forms, (("loose", "One corner is bent up."), ("dirty", "Mud")), strict=True):
        send_report(client, form, {"kind": kind, "text": text, "email": "walker@example.org"})
    second, first = client.get("/v1/damage-reports").json()["items"]
    approved = client.post(f"/v1/damage-reports/{first['id']}/approve", json={"note": "seen by the patrol"})
    assert approved.status_code == 200, approved.text
    key = client.post("/v1/keys", json={"scope": "viewer", "label": "Fabricator", "expires_at": "2031-01-01T00:00:00Z"})
    webhook = client.post("/v1/webhooks", json={"url": "https://example.org/hooks/waymark", "events": ["job.*"]})
    for answer in (key, webhook):
        assert answer.status_code == 201, answer.text
    return {
        "report": second["id"], "approved_report": first["id"], "item": approved.json()["item_id"],
        "key": key.json()["id"], "webhook": webhook.json()["id"],
    }  # fmt: skip
