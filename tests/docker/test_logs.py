"""The logs of a real server have ids, and neither keys, nor positions, nor contents of files."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

from tests.docker.test_image import STARTED
from tests.http import WITHIN_S, finished, wait_until

ADMIN_KEY = "an-admin-key-that-no-log-may-have"
WRONG_KEY = "wm_a-wrong-key-that-no-log-may-have"
LON, LAT = "8.4037219", "49.0068831"
NOTE = "content-of-an-uploaded-file"
SURVEY = f"number,lon,lat,note\n1,{LON},{LAT},{NOTE}\n"
DECLARED = json.dumps({"crs": "EPSG:4326", "family": "cerpm", "columns": {"code": "number"}})


def use(url: str) -> None:
    """What clients do, right and wrong, with secrets and positions in every place where they may stand."""
    key = {"Authorization": f"Bearer {ADMIN_KEY}"}
    place = {"lon_deg": float(LON), "lat_deg": float(LAT)}
    with httpx.Client(base_url=url, headers=key, trust_env=False, timeout=200) as client:
        marker = client.post("/v1/markers", json={"position": place}).json()
        assert client.get(f"/v1/markers/{marker['id']}").status_code == 200
        assert client.post("/v1/markers", json={"position": {**place, "lon_deg": f"{LON}x"}}).status_code == 422
        assert client.get("/v1/markers", params={"bbox": f"{LON},{LAT},9,50"}).status_code == 200
        assert client.get("/ogc/collections/markers/items", params={"bbox": f"{LON},{LAT},9,50"}).status_code == 200
        assert client.get(f"/v1/markers/{LON},{LAT}").status_code in (404, 422)
        assert client.get(f"/v1/nothing/{WRONG_KEY}").status_code == 404
        parts = {"file": ("survey.csv", SURVEY, "text/csv"), "declaration": (None, DECLARED)}
        job = client.post("/v1/imports", files=parts, headers={"Prefer": "respond-async"})
        assert finished(client, job.headers["location"])["state"] == "done"
        for content in (b"\x89PNG\r\n" + NOTE.encode(), SURVEY.encode()):
            client.post("/v1/decodes", files={"file": ("frame.png", content)}, data={"context": json.dumps(place)})
        made = client.post("/v1/keys", json={"label": "another", "scope": "viewer"})
        assert made.status_code == 201, made.text
    httpx.get(f"{url}/v1/markers", headers={"X-API-Key": WRONG_KEY}, trust_env=False, timeout=WITHIN_S)
    httpx.get(f"{url}/v1/markers", params={"key": WRONG_KEY}, trust_env=False, timeout=WITHIN_S)


def address_of(server: subprocess.Popen[bytes], log: Path) -> str | None:
    """The address of a server, from its log; None while it starts. One that ended fails the test at once."""
    ended, started = server.poll() is not None, STARTED.search(log.read_text())
    assert not ended, "the server ended"
    return started[1] if started else None


@pytest.mark.slow
def test_the_log_has_ids_and_neither_keys_nor_positions_nor_contents(tmp_path: Path) -> None:
    own = {
        "WAYMARK_DATA_DIR": str(tmp_path / "var"), "WAYMARK_ADMIN_KEY": ADMIN_KEY, "WAYMARK_LOG_FORMAT": "json",
        "WAYMARK_LOG_LEVEL": "DEBUG", "WAYMARK_DECODE_WORKERS": "1", "WAYMARK_WARM_DECODERS": "false",
    }  # fmt: skip
    environment = {name: value for name, value in os.environ.items() if not name.startswith("WAYMARK_")} | own
    command = [sys.executable, "-c", "from app.cli import main; main()", "serve", "--port", "0"]
    with (
        (tmp_path / "log").open("wb") as log,
        subprocess.Popen(command, env=environment, stdout=log, stderr=log) as server,
    ):
        try:
            use(wait_until(lambda: address_of(server, tmp_path / "log"), "the server"))
        finally:
            server.send_signal(signal.SIGTERM)
            print("exit status", server.wait())  # shown if the test fails
            print((tmp_path / "log").read_text()[-5000:])
    text = (tmp_path / "log").read_text()
    for secret in (ADMIN_KEY, WRONG_KEY, LON, LAT, NOTE, LON[:6], LAT[:7]):
        assert secret not in text, [line for line in text.splitlines() if secret in line][:3]
    lines = [json.loads(line) for line in text.splitlines() if line.startswith("{")]
    requests = [line for line in lines if line["event"] == "request"]
    assert len(requests) > 10
    assert all(re.fullmatch(r"[0-9a-f]{32}", line["request_id"]) for line in requests)
    assert any(re.fullmatch(r"/v1/markers/[0-9a-f-]{36}", line["path"]) for line in requests)
    jobs = [line for line in lines if line["event"] == "job"]
    assert [(len(line["job_id"]), line["kind"]) for line in jobs] == [(36, "import")]
