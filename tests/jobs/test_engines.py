"""Every kind of job on both engines: threads of the server, and a worker that takes messages from RabbitMQ."""

from __future__ import annotations

import io
import json
import socket
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa
from rosbags.typesys import Stores, get_typestore

from app.registry.engines import across_agencies
from app.registry.marker_rows import marker_versions
from app.services.access.access import Scope
from app.services.markers.artwork import IMMEDIATE_PLATES
from app.settings import Settings
from tests.api.decodes.conftest import post_frame
from tests.api.decodes.test_archives import pack
from tests.api.drives.test_drives import BEGAN, frames, made, store, trace
from tests.api.plans.test_packages import RULES, road, send_road
from tests.api.surveys.test_imports import DEGREES, _csv, _markers, _send
from tests.conftest import ADMIN_KEY, UNLIMITED, LiveServer, serving
from tests.formats.pictures import png
from tests.formats.test_bags import bag_fields, sqlite_bag
from tests.formats.test_video import video
from tests.http import created, finished, refused, wait_until
from tests.jobs import standin
from tests.jobs.hostile_files import hostile_files, send

pytestmark = [pytest.mark.slow, pytest.mark.both_engines]


@pytest.fixture(scope="module")
def server(
    tmp_path_factory: pytest.TempPathFactory, new_database_url: Callable[[Path], str], engine_settings: dict[str, Any]
) -> Iterator[LiveServer]:
    """A server, and on Celery a worker."""
    folder = tmp_path_factory.mktemp("engines") / "var"
    url = new_database_url(folder)
    settings = Settings(
        data_dir=folder, database_url=url, admin_key=ADMIN_KEY, decode_workers=1, decode_timeout_s=5.0, **UNLIMITED,
        **engine_settings,
    )  # fmt: skip
    with serving(settings, decode=standin.decode) as running:
        yield running


def test_an_archive_is_decoded_though_a_frame_kills_its_process(client: httpx.Client) -> None:
    good, deadly = png(standin.frame_that(standin.OBEY)), png(standin.frame_that(standin.DIE))
    answer = post_frame(client, pack({"0.png": good, "1.png": deadly, "2.png": good}), name="drive.zip")
    assert answer.status_code == 202, answer.text
    decode = finished(client, answer.headers["Location"])
    assert decode["state"] == "done", decode
    assert [frame["error"] is not None for frame in decode["frames"]] == [False, True, False]


def test_damaged_and_hostile_files_are_refused_or_fail_their_job(client: httpx.Client, tmp_path: Path) -> None:
    """None is a defect of the server, none reaches another file or an address, and sound files are decoded after."""
    other = tmp_path / "another.png"
    other.write_bytes(png(standin.frame_that(standin.OBEY)))
    with socket.create_server(("127.0.0.1", 0)) as elsewhere:
        address = f"http://127.0.0.1:{elsewhere.getsockname()[1]}"
        for file in hostile_files(address, other):
            answer = send(client, file)
            document = answer.json()
            if answer.status_code in (200, 201, 202) and "Location" in answer.headers:
                document = finished(client, answer.headers["Location"])
                assert document["state"] in ("done", "failed"), (file.what, document)
            else:
                assert answer.status_code < 500, (file.what, answer.text)
            assert not document.get("readings"), (file.what, document)
            assert not any(frame.get("readings") for frame in document.get("frames") or ()), (file.what, document)
            if file.what.startswith("video:"):
                assert answer.status_code in (415, 422) or document["state"] == "failed", (file.what, document)
        elsewhere.setblocking(False)
        with pytest.raises(BlockingIOError):
            elsewhere.accept()
    assert post_frame(client, png(standin.frame_that(standin.OBEY))).status_code == 201


def test_a_running_job_is_cancelled(client: httpx.Client) -> None:
    good, slow = png(standin.frame_that(standin.OBEY)), png(standin.frame_that(standin.SLEEP))
    members = {f"{k}.png": slow if k == 1 else good for k in range(20)}
    location = post_frame(client, pack(members), name="drive.zip").headers["Location"]
    wait_until(lambda: client.get(location).json()["state"] == "running", "the job to run")
    assert client.post(f"/v1/jobs/{location.rpartition('/')[2]}/cancel").status_code == 200
    assert finished(client, location)["state"] == "cancelled"


def test_a_video_and_a_bag_in_a_zip_are_decoded_and_become_a_drive(
    server: LiveServer, client: httpx.Client, tmp_path: Path
) -> None:
    fields = sqlite_bag(tmp_path / "drive.db3", bag_fields(get_typestore(Stores.ROS2_HUMBLE), 14, 150), padding=9 << 20)
    bag = pack({"drive.db3": fields}, zipfile.ZIP_STORED)
    uploads = {"video": (video(20), {}), "trace": (bag, {"trace": {"axes": "ISO8855"}})}
    answers = {kind: post_frame(client, data, context) for kind, (data, context) in uploads.items()}
    for kind, answer in answers.items():
        assert answer.status_code == 202, answer.text
        decode = finished(client, answer.headers["Location"])
        assert (decode["state"], decode["kind"], decode["attempts"]) == ("done", kind, 1), decode
    bar = store(server, client, "trace", trace(), captured_at=BEGAN.isoformat())
    camera = store(server, client, "archive", frames(8.0, 16.0, 24.0))
    assert made(client, bar, camera)["report"]["statistics"]["markers_used"] == 6


def test_a_plan_is_made(client: httpx.Client) -> None:
    alignment = send_road(client, road(47.0, 45.0, 60.0), name="r").json()
    wanted = {"name": "p", "alignment_id": alignment["id"], "rules": {"version": 1, "plates": {"spacing_m": 50}}}
    answer = client.post("/v1/plans", json=wanted, headers={"Prefer": "respond-async"})
    assert answer.status_code == 202, answer.text
    job = finished(client, answer.headers["Location"])
    assert (job["kind"], job["state"]) == ("plan", "done"), job
    assert client.get(job["links"]["result"]).json()["name"] == "p"


def test_a_survey_is_imported_once(client: httpx.Client) -> None:
    job = _send(client, _csv(3), DEGREES, Prefer="respond-async")
    assert job.status_code == 202, job.text
    assert finished(client, f"/v1/jobs/{job.json()['id']}")["state"] == "done"
    assert len(_markers(client)) == 3


def test_a_plan_is_packed(client: httpx.Client) -> None:
    alignment = send_road(client, road(47.0, 41.0, 150.0), name="r").json()
    plan = created(client, "/v1/plans", name="p", alignment_id=alignment["id"], rules=RULES)
    answer = client.post(f"/v1/plans/{plan['id']}/package", json={})
    assert answer.status_code == 202, answer.text
    job = finished(client, answer.headers["Location"])
    assert job["state"] == "done", job
    assert client.get(f"/v1/plans/{plan['id']}/package").content.startswith(b"PK")


def test_artwork_of_many_plates_is_drawn(client: httpx.Client, place: Callable[[], dict[str, Any]]) -> None:
    ids = [created(client, "/v1/markers", position=place())["id"] for _ in range(IMMEDIATE_PLATES + 1)]
    answer = client.post("/v1/artwork", json={"marker_ids": ids, "formats": ["svg"]})
    assert answer.status_code == 202, answer.text
    job = finished(client, answer.headers["Location"])
    assert (job["kind"], job["state"], job["done"]) == ("artwork", "done", len(ids)), job
    with zipfile.ZipFile(io.BytesIO(client.get(job["links"]["result"]).content)) as bundle:
        plates = json.loads(bundle.read("manifest.json"))["plates"]
    assert [plate["plate_id"] for plate in plates] == ids


def test_a_plan_is_proved(client: httpx.Client) -> None:
    alignment = send_road(client, road(47.0, 43.0, 60.0), name="r").json()
    rules = {"version": 1, "plates": {"spacing_m": 50}}
    plan = created(client, "/v1/plans", name="p", alignment_id=alignment["id"], rules=rules)
    terms = {"drives": 1, "seed": 5, "max_markers_per_drive": 1}
    answer = client.post(f"/v1/plans/{plan['id']}/proof", json=terms, headers={"If-Match": '"1"'})
    assert answer.status_code == 202, answer.text
    job = finished(client, answer.headers["Location"])
    assert (job["kind"], job["state"], job["done"]) == ("proof", "done", job["total"]), job
    assert client.get(f"/v1/plans/{plan['id']}/proof").json()["complete"]


def test_the_log_is_verified(server: LiveServer, client: httpx.Client, place: Callable[[], dict[str, Any]]) -> None:
    with server.agency(f"auditors {client.headers['Authorization'][-8:]}", Scope.ADMIN) as admin:
        marker = created(admin, "/v1/markers", position=place())
        answer = admin.post("/v1/audit/verifications", json={})
        assert (answer.status_code, answer.json()["state"]) == (202, "queued"), answer.text
        done = finished(admin, answer.headers["Location"])
        head = admin.get("/v1/audit").json()["head"]
        assert (done["state"], done["progress"], done["result"]["fault_count"]) == ("done", 1.0, 0)
        assert done["result"]["head"] == f"{head['number']}:{head['hash']}"
        assert done["result"]["versions"] == 1
        assert admin.get(f"/v1/jobs/{done['id']}").json()["links"]["result"] == answer.headers["Location"]
        with across_agencies(), server.app.state.database.write() as connection:
            changed = sa.update(marker_versions).where(marker_versions.c.marker_id == marker["id"])
            connection.execute(changed.values(sha256="0" * 64))
        again = admin.post("/v1/audit/verifications", json={"expected_head": f"999:{'0' * 64}"})
        result = finished(admin, again.headers["Location"])["result"]
        assert result["fault_count"] == len(result["faults"]) >= 2
        assert any(fault["where"] == "entry 999" for fault in result["faults"])
        refused(admin.post("/v1/audit/verifications", json={"expected_head": "x"}), 422, field="expected_head")
