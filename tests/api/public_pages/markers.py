"""Markers with public pages, and forms for damage reports, for tests."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

import httpx

from tests.conftest import LiveServer
from tests.http import created

HTML = {"Accept": "text/html,application/xhtml+xml,*/*;q=0.8"}
"""As browsers send it."""
JSON = {"Accept": "application/json"}
EVERYTHING = ["code", "agency", "status", "revision", "road", "measure"]


def new_marker(client: httpx.Client, place: dict[str, Any], **more: Any) -> dict[str, Any]:
    """An active plate on a road."""
    values = {"status": "active", "road": "A 5", "measure_m": 12345.6, **more}
    return created(client, "/v1/markers", position=place, **values)


def release(admin: httpx.Client, fields: list[str], *, damage_reports: bool | None = None) -> None:
    """Change what an agency releases."""
    reports = bool(fields) if damage_reports is None else damage_reports
    body = {"fields": fields, "damage_reports": reports}
    answer = admin.put("/v1/public-page", json=body, headers={"If-Match": "*"})
    assert answer.status_code == 200, answer.text


def old_token(server: LiveServer, marker_id: str, age_s: float = 60.0) -> str:
    """A token of a form that was opened some time ago."""
    at = datetime.now(UTC) - timedelta(seconds=age_s)
    return str(server.app.state.use_cases.form_tokens.issue(marker_id, at))


def send_report(
    anybody: httpx.Client, server: LiveServer, marker_id: str, *, query: str = "", photo: Any = None,
    headers: dict[str, str] = HTML, **fields: str,
) -> httpx.Response:  # fmt: skip
    """Send the form for a damage report."""
    fields = {"kind": "loose", "token": old_token(server, marker_id), **fields}
    files: dict[str, Any] = {name: (None, text) for name, text in fields.items()}
    files["photo"] = photo if photo is not None else ("", b"", "application/octet-stream")  # as browsers do
    return anybody.post(f"/m/{marker_id}/reports{query}", files=files, headers=headers)
