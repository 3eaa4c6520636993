"""A server that is killed in the middle of a video, and in the middle of a commit of a plan, and started again."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import httpx
import pytest

from benchmarks.faults.server import FaultServer
from tests.api.plans.test_plans import RULES, road, send_road
from tests.formats.test_video import HEIGHT, WIDTH, video
from tests.http import created, finished, wait_until

pytestmark = pytest.mark.slow
FRAMES = 1200
"""Of the video: enough for several seconds of decoding on a fast machine."""
MOMENTS = ("sent", "written", "acknowledged")
"""Of a commit, at which the server is killed."""


@pytest.fixture
def server(tmp_path: Path) -> Iterator[FaultServer]:
    """A server in a process of its own."""
    running = FaultServer(tmp_path / "var")
    running.start()
    yield running
    running.stop()


def test_a_video_whose_server_is_killed_is_decoded_after_the_restart(server: FaultServer) -> None:
    for frames in (
        FRAMES,
        3 * FRAMES,
        9 * FRAMES,
    ):  # a fast machine may have decoded it before the kill
        decode = _decode_with_a_kill(server, frames)
        assert decode["state"] == "done", decode
        assert decode["summary"]["frames"] == frames
        if decode["attempts"] == 2:
            return
    pytest.fail("each video was decoded before the server was killed")


def _decode_with_a_kill(server: FaultServer, frames: int) -> dict[str, Any]:
    """The decode of a video that is sent to a server, which is killed after the first frames and started again."""
    context = {"camera": {"width_px": WIDTH, "height_px": HEIGHT, "horizontal_fov_deg": 60.0}}
    with server.client() as client:
        parts = {"file": ("drive.mp4", video(frames)), "context": (None, json.dumps(context))}
        answer = client.post("/v1/decodes", files=parts)
        assert answer.status_code == 202, answer.text
        path = answer.headers["location"]
        wait_until(lambda: client.get(path).json()["progress"], "the first frames")
        server.kill()
    server.start()
    with server.client() as client:
        return finished(client, path)


@pytest.mark.parametrize("moment", MOMENTS)
def test_a_plan_whose_server_is_killed_in_its_commit_is_committed_whole_or_not_at_all(
    server: FaultServer, moment: str, tmp_path: Path
) -> None:
    with server.client() as client:
        alignment = send_road(client, road(8.0, 47.0)).json()
        plan = created(client, "/v1/plans", name="killed", alignment_id=alignment["id"], rules=RULES)
        url = f"/v1/plans/{plan['id']}"
        other = client.post("/v1/keys", json={"scope": "planner", "label": "approver"}).json()["key"]
        head = {"If-Match": '"1"', "X-API-Key": other}
        assert client.post(f"{url}/approve", headers=head).status_code == 200
        log = next((tmp_path / "var").glob("*.sqlite3-wal"))
        size = log.stat().st_size
        with ThreadPoolExecutor(1) as pool:
            sent = pool.submit(_commit, client, url)
            if moment == "written":
                wait_until(lambda: sent.done() or log.stat().st_size != size, "the first write")
            elif moment == "acknowledged":
                wait([sent])
            server.kill()
            acknowledged = sent.result()
    server.start()
    with server.client() as client:
        is_committed = client.get(url).json()["status"] == "committed"
        if not is_committed:
            assert not acknowledged
            assert client.get("/v1/markers").json()["items"] == []
            assert _commit(client, url)
        families = Counter(marker["family"] for marker in client.get("/v1/markers?limit=1000").json()["items"])
        assert all(families[family] == plan["counts"][family] for family in ("plate", "cerpm")), families
        assert families["magnet"] > 0


def _commit(client: httpx.Client, url: str) -> bool:
    """Whether the commit was acknowledged."""
    try:
        return client.post(f"{url}/commit", headers={"If-Match": '"2"'}).status_code == 201
    except httpx.TransportError:
        return False
