"""Commands that talk to a server: upload, artwork and reprocessing, with progress as lines."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from app.cli import cli
from app.main import create_app
from app.services.access.access import Scope
from app.services.decodes import archive_handler
from app.settings import Settings
from tests.api.decodes.conftest import near
from tests.conftest import ADMIN_KEY, UNLIMITED, LiveServer
from tests.formats.pictures import png
from tests.http import created, finished
from tests.jobs import standin

GOOD = png(standin.frame_that(standin.OBEY))


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveServer]:
    folder = tmp_path_factory.mktemp("remote") / "var"
    settings = Settings(data_dir=folder, admin_key=ADMIN_KEY, decode_workers=1, **UNLIMITED)
    with LiveServer(create_app(settings, decode=standin.decode)) as running:
        yield running


@pytest.fixture
def run(server: LiveServer, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Result]:
    monkeypatch.setenv("WAYMARK_KEY", ADMIN_KEY)

    def invoke(*arguments: str) -> Result:
        return CliRunner().invoke(cli, [*arguments, "--server", server.url])

    return invoke


def archive(path: Path, frames: int) -> Path:
    with zipfile.ZipFile(path, "w") as packed:
        for number in range(frames):
            packed.writestr(f"{number:03d}.png", GOOD)
    return path


def printed(result: Result) -> dict[str, Any]:
    """The JSON that a command printed; the server of the test logs to the same standard output."""
    text = result.stdout
    document: dict[str, Any] = json.loads(text[text.index("{\n") : text.rindex("\n}") + 2])
    return document


def test_a_frame_and_a_zip_are_uploaded_and_followed(
    server: LiveServer, run: Callable[..., Result], tmp_path: Path, place: Callable[[], dict[str, Any]]
) -> None:
    frame = tmp_path / "frame.png"
    frame.write_bytes(GOOD)
    with server.client() as client:
        context = json.dumps(near(created(client, "/v1/markers", position=place())))
    done = run("upload", str(frame), "--context", context)
    assert done.exit_code == 0, done.output
    assert "1 plate read" in done.stdout
    assert "upload: 100%" in done.stderr
    followed = run("upload", str(archive(tmp_path / "drive.zip", 3)))
    assert followed.exit_code == 0, followed.output
    assert "decode: 100%" in followed.stderr
    as_json = run("upload", str(archive(tmp_path / "again.zip", 2)), "--json")
    assert printed(as_json)["summary"]["frames"] == 2
    assert as_json.stderr == ""


def test_refusals_are_errors(run: Callable[..., Result], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = tmp_path / "frame.png"
    text.write_bytes(b"this is no picture")
    refused = run("upload", str(text))
    assert refused.exit_code == 1
    assert refused.exception is not None
    monkeypatch.delenv("WAYMARK_KEY")
    assert "no key was given" in str(run("upload", str(text)).exception)


def test_stored_uploads_are_decoded_again(server: LiveServer, run: Callable[..., Result], tmp_path: Path) -> None:
    run("upload", str(archive(tmp_path / "drive.zip", 1)))
    report = tmp_path / "report.csv"
    done = run("reprocess", "--kind", "archive", "--report", str(report), "--json")
    assert done.exit_code == 0, done.output
    found = printed(done)
    assert found["state"] == "ready"
    assert report.read_text().startswith("decode_id,change,")
    accepted = run("reprocess", "--accept", found["id"])
    assert "accepted" in accepted.stdout


def test_a_running_decode_shows_its_result_so_far(
    server: LiveServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(archive_handler, "PART_EVERY", timedelta(0))
    decodes, seen = server.app.state.decodes, []
    keep_part = decodes._keep_part
    handler = next(handler for handler in decodes._handlers if handler.kind == "archive")
    monkeypatch.setattr(handler, "_rules", replace(handler._rules, progress_every=timedelta(0)))
    with server.agency("partial", Scope.PLANNER) as client:

        def keep_and_look(job: Any, progress: float, part: Any) -> None:
            keep_part(job, progress, part)
            seen.append(client.get(f"/v1/decodes/{job.row.id}").json())

        monkeypatch.setattr(decodes, "_keep_part", keep_and_look)
        answer = client.post("/v1/decodes", files={"file": archive(tmp_path / "drive.zip", 4).read_bytes()})
        assert answer.status_code == 202, answer.text
        path = answer.headers["location"]
        done = finished(client, path)
    assert [len(document["frames"]) for document in seen] == sorted(len(document["frames"]) for document in seen)
    assert any(0 < len(document["frames"]) < 4 for document in seen)
    assert all(
        document["partial"] is True and document["state"] == "running" for document in seen if document["frames"]
    )
    assert len(done["frames"]) == 4
    assert "partial" not in done
