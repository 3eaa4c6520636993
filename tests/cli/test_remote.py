"""Commands that talk to a server: upload, artwork and reprocessing, with progress as lines."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import httpx
import pytest
from typer.testing import CliRunner, Result

from app.cli import cli
from app.cli.terminal import BYTES, Progress, amount, speed
from app.errors import WaymarkError
from app.main import create_app
from app.services.access.access import Scope
from app.services.decodes import frames as archive_handler
from app.services.decodes import frames as frame_runs
from app.services.decodes.upload_path import Upload
from app.settings import Settings
from tests.api.decodes.conftest import near
from tests.conftest import ADMIN_KEY, UNLIMITED, LiveServer
from tests.formats.pictures import png
from tests.http import created, finished
from tests.jobs import standin

pytestmark = pytest.mark.slow

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
    assert "decode: 100%, 3 of 3" in followed.stderr
    assert not set(followed.stderr) & set("\r\x1b")  # no terminal: no control characters
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
    approved = run("reprocess", "--approve", found["id"])
    assert "approved" in approved.stdout


def test_artwork_is_drawn_and_fetched_with_progress(
    server: LiveServer, run: Callable[..., Result], tmp_path: Path, place: Callable[[], dict[str, Any]]
) -> None:
    with server.client() as client:
        ids = [created(client, "/v1/markers", position=place())["id"] for _ in range(2)]
    out = tmp_path / "plates.zip"
    arguments = ("artwork", str(out), "--marker", ids[0], "--marker", ids[1], "--format", "svg")
    done = run(*arguments)
    assert done.exit_code == 0, done.output
    assert "artwork: 100%, 2 of 2" in done.stderr
    assert "download: 100%" in done.stderr
    with zipfile.ZipFile(out) as bundle:
        assert [plate["plate_id"] for plate in json.loads(bundle.read("manifest.json"))["plates"]] == ids
    assert "already exists" in str(run(*arguments).exception)


def test_a_terminal_gets_bars(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = io.StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True, raising=False)
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    with Progress() as shown:
        shown.show("upload", 1e6, 4e6, BYTES)
        shown.show("decode", 3, 12)
    lines = terminal.getvalue().splitlines()
    for step, share, counted in (("upload", "25%", "1.0 of 4.0 MB"), ("decode", "25%", "3 of 12")):
        assert any(step in line and share in line and counted in line for line in lines), lines


def test_a_running_decode_shows_its_result_so_far(
    server: LiveServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(archive_handler, "PART_EVERY", timedelta(0))
    monkeypatch.setattr(frame_runs, "RUN_FRAMES", 1)
    decodes, report, seen, steps = server.app.state.use_cases.decodes, Upload.report, [], []
    handler = next(handler for handler in decodes._handlers if handler.kind == "archive")
    monkeypatch.setattr(handler, "_rules", replace(handler._rules, progress_every=timedelta(0)))
    with server.agency("partial", Scope.PLANNER) as client:

        def report_and_look(upload: Upload, done: int, total: int, part: Any = None) -> None:
            report(upload, done, total, part)
            if part is not None:
                steps.append((client.get(f"/v1/jobs/{upload.job.row.id}").json()["done"], total))
                seen.append(client.get(f"/v1/decodes/{upload.job.row.id}").json())

        monkeypatch.setattr(Upload, "report", report_and_look)
        answer = client.post("/v1/decodes", files={"file": archive(tmp_path / "drive.zip", 4).read_bytes()})
        assert answer.status_code == 202, answer.text
        path = answer.headers["location"]
        done = finished(client, path)
    assert [len(document["frames"]) for document in seen] == sorted(len(document["frames"]) for document in seen)
    assert any(0 < len(document["frames"]) < 4 for document in seen)
    assert steps == [(len(document["frames"]), 4) for document in seen]
    assert all(
        document["partial"] is True and document["state"] == "running" for document in seen if document["frames"]
    )
    assert len(done["frames"]) == 4
    assert "partial" not in done


class Cut(httpx.BaseTransport):
    """A connection that breaks after some bytes of a part, so often."""

    def __init__(self, after_bytes: int, times: int) -> None:
        self._inner, self._after, self.left = httpx.HTTPTransport(), after_bytes, times
        self.methods: list[str] = []

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        self.methods.append(request.method)
        if request.method == "PATCH" and self.left:
            self.left -= 1
            request.stream = Broken(request.stream, self._after)
        return self._inner.handle_request(request)

    def close(self) -> None:
        self._inner.close()


class Broken(httpx.SyncByteStream):
    """A body whose connection breaks."""

    def __init__(self, stream: Any, after_bytes: int) -> None:
        self._stream, self._after = stream, after_bytes

    def __iter__(self) -> Iterator[bytes]:
        sent = 0
        for part in self._stream:
            yield part
            sent += len(part)
            if sent >= self._after:
                raise httpx.WriteError("the connection broke")


@pytest.fixture
def cut(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[int], Cut]:
    """Have the command's next connections break, and its uploads take the way of large files."""
    monkeypatch.setattr("app.cli.remote._SMALL_BYTES", 0)
    monkeypatch.setattr("app.cli.remote._PAUSES_S", (0.1,) * 600)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    make = httpx.Client

    def prepare(times: int) -> Cut:
        transport = Cut(600_000, times)
        monkeypatch.setattr(httpx, "Client", lambda **given: make(**{**given, "transport": transport}))
        return transport

    return prepare


def long_archive(path: Path) -> Path:
    archive(path, 2)
    with zipfile.ZipFile(path, "a") as packed:
        packed.writestr("noise.bin", bytes(3_000_000))
    return path


def test_a_large_upload_goes_on_after_interruptions(
    run: Callable[..., Result], cut: Callable[[int], Cut], tmp_path: Path
) -> None:
    connection = cut(2)
    done = run("upload", str(long_archive(tmp_path / "drive.zip")))
    assert done.exit_code == 0, done.output
    assert connection.methods.count("POST") == 1
    assert connection.methods.count("PATCH") == 3
    assert "upload: 100%, 3.0 of 3.0 MB" in done.stderr


def test_an_upload_goes_on_in_the_next_run_of_the_command(
    run: Callable[..., Result], cut: Callable[[int], Cut], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = long_archive(tmp_path / "drive.zip")
    cut(1)
    with monkeypatch.context() as impatient:
        impatient.setattr("app.cli.remote._PAUSES_S", ())
        broken = run("upload", str(path))
    assert broken.exit_code == 1
    assert "run the command again" in str(getattr(broken.exception, "cure", ""))
    connection = cut(0)
    done = run("upload", str(path), "--json")
    assert done.exit_code == 0, done.output
    assert connection.methods.count("POST") == 0
    assert printed(done)["summary"]["frames"] == 3
    assert list((tmp_path / "state/waymark/uploads").iterdir()) == []
    run("upload", str(path))
    assert connection.methods.count("POST") == 1  # the same file again is another upload


def test_a_large_file_that_is_refused_is_not_sent_again(
    run: Callable[..., Result], cut: Callable[[int], Cut], tmp_path: Path
) -> None:
    path = tmp_path / "drive.zip"
    path.write_bytes(b"this is no picture" * 1000)
    connection = cut(0)
    assert run("upload", str(path)).exit_code == 1
    assert connection.methods.count("PATCH") == 1
    assert list((tmp_path / "state/waymark/uploads").iterdir()) == []


@pytest.mark.parametrize("address", ["http://127.0.0.1:9", "ftp://here", "http://[", "no address"])
def test_a_server_that_does_not_answer(address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WAYMARK_KEY", "key")
    frame = tmp_path / "frame.png"
    frame.write_bytes(GOOD)
    failed = CliRunner().invoke(cli, ["upload", str(frame), "--server", address])
    assert isinstance(failed.exception, WaymarkError), failed.exception
    assert "--server" in failed.exception.cure


def test_a_box_that_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WAYMARK_KEY", "key")
    failed = CliRunner().invoke(cli, ["reprocess", "--bbox", "1,2,x"])
    assert isinstance(failed.exception, WaymarkError)
    assert "1,2,x" in failed.exception.message


def test_amounts_are_shown_with_their_units() -> None:
    assert amount(3, 12, "") == "3 of 12"
    assert amount(1500, 2500, BYTES) == "1.5 of 2.5 kB"
    assert amount(1.5e6, 1e9, BYTES) == "1.5 of 1000.0 MB"
    assert (amount(7, 0, ""), amount(0.5, 1, ""), amount(0, 0, "")) == ("7", "", "")
    assert (speed(2.5e6, 1e9, BYTES), speed(0.5, 9, ""), speed(4321.0, 9999, "")) == ("2.5 MB/s", "0.5/s", "4321/s")
    assert (speed(None, 9, ""), speed(3.0, 1, "")) == ("", "")
