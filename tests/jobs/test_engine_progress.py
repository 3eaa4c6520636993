"""Jobs are followed, exported files are stored and uploads decoded again, whichever engine runs the jobs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from app.services.access.access import Scope
from app.settings import Settings
from tests.api.decodes.conftest import post_frame
from tests.api.decodes.test_archives import pack
from tests.api.jobs.test_jobs import Reader
from tests.conftest import ADMIN_KEY, UNLIMITED, LiveServer, serving
from tests.formats.pictures import png
from tests.http import created, finished, wait_until
from tests.jobs import standin

pytestmark = pytest.mark.both_engines


@pytest.fixture(scope="module")
def server(
    tmp_path_factory: pytest.TempPathFactory, new_database_url: Callable[[Path], str], engine_settings: dict[str, Any]
) -> Iterator[LiveServer]:
    """A server, and on Celery a worker."""
    folder = tmp_path_factory.mktemp("engines") / "var"
    url = new_database_url(folder)
    settings = Settings(
        data_dir=folder, database_url=url, admin_key=ADMIN_KEY, decode_workers=1, **UNLIMITED, **engine_settings
    )
    with serving(settings, decode=standin.decode) as running:
        yield running


@pytest.mark.slow
def test_a_job_is_followed_to_its_end(client: httpx.Client) -> None:
    good = png(standin.frame_that(standin.OBEY))
    job = post_frame(client, pack({f"{k}.png": good for k in range(3)}), name="drive.zip").json()
    last = Reader(client, f"/v1/jobs/{job['id']}/events").rest()[-1]
    assert (last["event"], last["data"]["links"]["result"]) == ("done", f"/v1/decodes/{job['id']}")
    kinds = [(event["kind"], event["subject_id"]) for event in client.get("/v1/events").json()["items"]]
    assert ("job.done", job["id"]) in kinds


def test_an_export_is_stored_where_the_server_finds_it(client: httpx.Client, place: Callable[[], Any]) -> None:
    marker = created(client, "/v1/markers", position=place())
    answer = client.post("/v1/exports", json={"format": "csv"})
    job = finished(client, answer.headers["location"])
    assert job["state"] == "done", job
    assert marker["id"] in client.get(job["links"]["result"]).text


def test_stored_uploads_are_decoded_again(server: LiveServer) -> None:
    with server.agency("archive", Scope.ADMIN) as admin:
        assert post_frame(admin, png(standin.frame_that(standin.OBEY))).status_code == 201
        path = admin.post("/v1/reprocessings", json={}).headers["location"]
        wait_until(lambda: admin.get(path).json()["state"] != "running", "the reprocessing")
        run = admin.get(path).json()
        assert (run["state"], run["done"], run["summary"]["failed"]) == ("ready", 1, 0)
        assert admin.post(f"{path}/approve").json()["state"] == "approved"
