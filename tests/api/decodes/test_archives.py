"""ZIP archives of frames: jobs with progress, bombs and broken members."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import pytest

from app.errors import UnreadableUpload, UnsupportedUpload, UploadTooLarge
from app.formats.format import ArchiveLimits, count_members, read_members
from app.main import create_app
from app.settings import Settings
from app.simulation.magnetic.recorder import write_recorder_files
from tests.api.decodes.conftest import Stored, near, post_frame
from tests.conftest import ADMIN_KEY, LiveServer
from tests.formats.pictures import corner_frame, huge_png, jpeg, lying_png, png
from tests.formats.traces.recordings import make_trace
from tests.http import finished, wait_until
from tests.jobs import standin

GOOD = png(standin.frame_that(standin.OBEY))


def pack(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return out.getvalue()


def wait_for(client: httpx.Client, location: str, state: str = "done") -> dict[str, Any]:
    decode = finished(client, location)
    assert decode["state"] == state, decode
    return decode


@pytest.fixture(scope="module")
def impatient(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """A client of a server that gives a frame five seconds: slow frames end, others need a small part of it."""
    settings = Settings(
        data_dir=tmp_path_factory.mktemp("impatient") / "var", admin_key=ADMIN_KEY, decode_timeout_s=5.0
    )
    with LiveServer(create_app(settings, decode=standin.decode)) as server, server.client() as client:
        yield client


@pytest.mark.parametrize(
    ("files", "kind"),
    [
        (write_recorder_files(make_trace(200)), "trace"),
        (
            {"log.jsonl": b'{"time": "2026-06-01T08:00:00Z", "payload_hex": "00", "rssi_dbm": -80, "snr_db": 9}\n'},
            "packets",
        ),
    ],
)
def test_an_archive_of_another_kind_is_refused_with_the_cure(
    client: httpx.Client, files: dict[str, bytes], kind: str
) -> None:
    answer = post_frame(client, pack(files), name="drive.zip")
    assert answer.status_code == 415, answer.text
    assert answer.json()["field"] == "file"
    assert f'"{kind}": {{}}' in answer.json()["cure"]
    beside = post_frame(client, pack(files | {"0001.png": GOOD}), name="drive.zip")
    assert wait_for(client, beside.headers["location"])["frames"]


# --- jobs ---------------------------------------------------------------------------------------------------------


def test_an_archive_becomes_a_job(client: httpx.Client, plate: dict[str, Any], stored: Stored) -> None:
    archive = pack({f"drive/{k:04d}.png": GOOD for k in range(6)} | {"drive/": b""})
    answer = post_frame(client, archive, near(plate), name="drive.zip")
    assert answer.status_code == 202, answer.text
    assert answer.json()["state"] == "queued"
    assert answer.headers["retry-after"] == "1"
    decode = wait_for(client, answer.headers["location"])
    assert (decode["kind"], decode["progress"], decode["attempts"]) == ("archive", 1.0, 1)
    assert [frame["name"] for frame in decode["frames"]] == [f"{k:04d}.png" for k in range(6)]
    assert {reading["match"]["marker_id"] for reading in decode["readings"]} == {plate["id"]}
    seen = stored.rows("SELECT frame FROM observations WHERE decode_id = :id ORDER BY frame", id=decode["id"])
    assert [frame for (frame,) in seen] == list(range(6))
    assert client.get(f"{answer.headers['location']}/annotated.jpg?frame=5").status_code == 200
    assert client.get(f"{answer.headers['location']}/annotated.jpg?frame=6").status_code == 404


@pytest.mark.slow
def test_a_member_that_cannot_be_read_is_named_and_the_rest_goes_on(impatient: httpx.Client) -> None:
    client = impatient
    inner = pack({"x.png": GOOD})
    members = {
        "a.png": GOOD,
        "notes.txt": b"no picture",
        "nested.zip": inner,
        "lying.png": lying_png(),
        "huge.png": huge_png(),
        "deadly.png": png(standin.frame_that(standin.DIE)),
        "slow.png": png(standin.frame_that(standin.SLEEP)),
        "empty.png": b"",
        "z.jpg": jpeg(),
    }
    answer = post_frame(client, pack(members), {})
    decode = wait_for(client, answer.headers["location"])
    errors = {frame["name"]: frame["error"] and frame["error"]["kind"] for frame in decode["frames"]}
    assert errors == {
        "a.png": None,
        "notes.txt": "UnsupportedUpload",
        "nested.zip": "UnsupportedUpload",
        "lying.png": "UnreadableUpload",
        "huge.png": "UploadTooLarge",
        "deadly.png": "ProcessStopped",
        "slow.png": "ProcessStopped",
        "empty.png": "UnreadableUpload",
        "z.jpg": None,
    }
    assert decode["summary"]["frames_failed"] == 7
    assert client.get(f"{answer.headers['location']}/annotated.jpg?frame=1").status_code == 404


def test_a_frame_of_another_size_than_the_camera_is_named(client: httpx.Client) -> None:
    context = {"camera": {"horizontal_fov_deg": 70.0, "width_px": 96, "height_px": 64}}
    answer = post_frame(client, pack({"fits.png": GOOD, "other.png": png(corner_frame(100, 80))}), context)
    first, second = wait_for(client, answer.headers["location"])["frames"]
    assert first["error"] is None
    assert second["error"]["field"] == "camera.width_px"


def _cancel(client: httpx.Client, location: str) -> httpx.Response:
    return client.post(f"/v1/jobs/{location.rpartition('/')[2]}/cancel")


@pytest.mark.slow
def test_a_running_job_can_be_cancelled(impatient: httpx.Client) -> None:
    client = impatient
    slow = png(standin.frame_that(standin.SLEEP))
    answer = post_frame(client, pack({f"{k}.png": slow for k in range(12)}))
    location = answer.headers["location"]
    waiting = post_frame(client, pack({"later.png": GOOD})).headers["location"]
    assert _cancel(client, waiting).json()["state"] == "cancelled"
    wait_until(lambda: client.get(location).json()["state"] != "queued", "the job to start")
    assert _cancel(client, location).json()["state"] == "running"
    decode = wait_for(client, location, "cancelled")
    assert decode["finished_at"]
    assert "readings" not in decode
    assert client.get(f"{location}/annotated.jpg").status_code == 404
    assert _cancel(client, location).json()["state"] == "cancelled"


def test_an_idempotency_key_queues_once(client: httpx.Client, stored: Stored) -> None:
    key = {"Idempotency-Key": "drive-0001"}
    archive = pack({"a.png": GOOD})
    first = post_frame(client, archive, **key)
    wait_for(client, first.headers["location"])
    counts = stored.counts()
    again = post_frame(client, archive, **key)
    assert (again.status_code, again.json()["id"]) == (202, first.json()["id"])
    assert stored.counts() == counts


@pytest.mark.slow
def test_jobs_that_were_cut_off_are_taken_up_at_the_next_start(
    serve: Callable[..., LiveServer], tmp_path: Any, place: Callable[[], dict[str, Any]]
) -> None:
    settings = Settings(data_dir=tmp_path / "var", admin_key=ADMIN_KEY, decode_timeout_s=60.0)
    with LiveServer(create_app(settings, decode=standin.decode)) as first, first.client() as client:
        marker = client.post(
            "/v1/markers", json={"position": place() | {"horizontal_rmse_m": 0.01}, "status": "surveyed"}
        ).json()
        members = {"0.png": GOOD, "1.png": png(standin.frame_that(standin.SLEEP)), "2.png": GOOD}
        stuck = post_frame(client, pack(members), near(marker)).headers["location"]
        queued = post_frame(client, pack({"0.png": GOOD}), near(marker)).headers["location"]
        wait_until(lambda: client.get(stuck).json()["state"] == "running", "the job to start")
    # the server stopped in the middle of a frame; the next one gives up on that frame after five seconds
    settings = settings.model_copy(update={"decode_timeout_s": 5.0})
    with LiveServer(create_app(settings, decode=standin.decode)) as second, second.client() as client:
        decode = wait_for(client, stuck)
        assert decode["attempts"] == 1  # the stop of the server is not counted
        assert [frame["error"] is None for frame in decode["frames"]] == [True, False, True]
        assert wait_for(client, queued)["attempts"] == 1
        rows = Stored(tmp_path / "var").rows("SELECT frame FROM observations WHERE decode_id = :id", id=decode["id"])
        assert sorted(frame for (frame,) in rows) == [0, 2]


def test_a_job_has_its_effect_once_however_often_it_runs(
    server: LiveServer, client: httpx.Client, plate: dict[str, Any], stored: Stored
) -> None:
    answer = post_frame(client, pack({"a.png": GOOD, "b.png": GOOD}), near(plate))
    decode = wait_for(client, answer.headers["location"])
    counts = stored.counts()
    server.app.state.use_cases.jobs.run_job(decode["id"])
    assert stored.counts() == counts
    assert client.get(answer.headers["location"]).json() == decode


# --- what is refused at the door ----------------------------------------------------------------------------------


def bomb() -> bytes:
    """Half a megabyte that expands to 500 MB."""
    return pack({"a.png": b"\x89PNG\r\n\x1a\n" + bytes(500_000_000)})


@pytest.mark.parametrize(
    ("make", "status"),
    [
        (lambda: pack({}), 422),
        (lambda: pack({"folder/": b""}), 422),
        (lambda: pack({"a.png": GOOD})[:-30], 422),
        (lambda: b"PK\x03\x04 and nothing else", 422),
        (lambda: pack({f"{k}.png": b"x" for k in range(21)}), 413),
        (lambda: pack({f"{k}": b"" for k in range(60_000)}, zipfile.ZIP_STORED), 413),
    ],
    ids=["empty", "folders", "cut", "no-directory", "21-members", "60000-members"],
)
@pytest.mark.usefixtures("unchanged")
def test_bad_archives(client: httpx.Client, make: Callable[[], bytes], status: int) -> None:
    answer = post_frame(client, make())
    assert answer.status_code == status, answer.text
    assert answer.json()["field"] == "file"


@pytest.mark.slow
def test_a_bomb_is_reported_and_costs_no_memory() -> None:
    import tracemalloc

    data = bomb()
    tracemalloc.start()
    [member] = list(read_members(data))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert isinstance(member.error, UploadTooLarge)
    assert peak < 80 * 1024**2


def test_all_members_together_have_a_limit() -> None:
    import os

    limits = ArchiveLimits(total_bytes=250_000, ratio=1e9)
    data = pack({f"{k}": os.urandom(100_000) for k in range(4)}, zipfile.ZIP_STORED)
    with pytest.raises(UploadTooLarge, match="together"):
        list(read_members(data, limits))


def test_encrypted_and_exotic_members_are_named() -> None:
    data = bytearray(pack({"a.png": GOOD}))
    data[data.rfind(b"PK\x01\x02") + 8] |= 1
    [member] = list(read_members(bytes(data)))
    assert isinstance(member.error, UnsupportedUpload)
    [member] = list(read_members(pack({"a.png": GOOD}, zipfile.ZIP_LZMA)))
    assert isinstance(member.error, UnsupportedUpload)


def test_a_member_with_a_false_checksum_or_size() -> None:
    data = bytearray(pack({"a.png": GOOD}, zipfile.ZIP_STORED))
    data[200] ^= 1
    [member] = list(read_members(bytes(data)))
    assert isinstance(member.error, UnreadableUpload)
    # a directory that says one byte while the data hold a megabyte
    data = bytearray(pack({"a.png": bytes(1_000_000)}))
    at = data.rfind(b"PK\x01\x02")
    struct.pack_into("<I", data, at + 24, 1)
    [member] = list(read_members(bytes(data)))
    assert len(member.data) <= 1


def test_names_are_for_people_only() -> None:
    names = ["../../etc/passwd", "C:\\x\\y.png", "a\u202eb.png", "n" * 300, "\ud800"[:0] + "x.png"]
    members = list(read_members(pack(dict.fromkeys(names, GOOD))))
    assert [member.name for member in members] == ["passwd", "y.png", "a?b.png", "n" * 120, "x.png"]
    assert all(member.data == GOOD for member in members)


def test_zip64_is_refused() -> None:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for number in range(65_536):
            archive.writestr(str(number), b"")
    with pytest.raises((UnsupportedUpload, UploadTooLarge)):
        count_members(out.getvalue())


@pytest.mark.parametrize("seed", range(40))
def test_mutilated_archives_raise_only_our_errors(seed: int) -> None:
    import random

    chance = random.Random(seed)
    data = bytearray(pack({"a.png": GOOD, "b.jpg": jpeg(corner_frame(64, 48))}))
    for _ in range(chance.randint(1, 8)):
        data[chance.randrange(len(data))] = chance.randrange(256)
    try:
        for member in read_members(bytes(data)):
            assert member.error is not None or zlib.crc32(member.data) >= 0
    except UnreadableUpload:
        pass
