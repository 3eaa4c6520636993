"""Videos through the upload route: a job with progress, plates read over frames, refusals."""

from __future__ import annotations

import io
import zipfile
from typing import Any

import av
import httpx
import numpy as np
import pytest

from tests.api.decodes.conftest import near, post_frame
from tests.api.decodes.test_archives import wait_for
from tests.api.decodes.videos import DECLARED, RATE_HZ, SPEED_M_S, video_past
from tests.formats.test_video import HEIGHT, WIDTH, cut_video, turned, video
from tests.http import finished


@pytest.mark.slow
def test_a_video_is_a_job_that_reads_the_plates_it_passes(client: httpx.Client, plate: dict[str, Any]) -> None:
    data = video_past(plate["code"])
    context = near(plate, camera=DECLARED, captured_at="2026-05-04T08:30:00Z")
    answer = post_frame(client, data, context, name="drive.bin")
    assert answer.status_code == 202, answer.text
    decode = wait_for(client, answer.headers["location"])
    assert (decode["kind"], decode["progress"], decode["summary"]["frames"]) == ("video", 1.0, 14)
    (seen,) = decode["plates"]
    assert seen["marker_id"] == plate["id"]
    assert seen["outcome"] == "read"
    assert len(seen["frames"]) >= 4
    assert seen["speed_m_s"] == pytest.approx(SPEED_M_S, rel=0.1)
    fixes = [frame for frame in decode["frames"] if frame["fix"] is not None]
    assert len(fixes) >= 3
    assert {reading["match"]["marker_id"] for reading in decode["readings"] if reading["digits"]} == {plate["id"]}
    first = decode["frames"][0]
    assert first["time_s"] == pytest.approx(first["frame"] / RATE_HZ, abs=1e-4)
    assert first["captured_at"].startswith("2026-05-04T08:30:00")
    assert client.get(f"{answer.headers['location']}/annotated.jpg?frame=499999").status_code == 404


def test_a_video_beside_a_track_has_poses(client: httpx.Client, plate: dict[str, Any]) -> None:
    lon, lat = plate["position"]["lon_deg"], plate["position"]["lat_deg"]
    rows = [f"2026-05-04T08:30:{k:02d}Z,{lon},{lat + k * 1e-4}" for k in range(3)]
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("front.mp4", video(20))
        archive.writestr("poses.csv", "\n".join(["time,lon,lat", *rows]))
    answer = post_frame(client, out.getvalue(), {"captured_at": "2026-05-04T08:30:00Z"}, name="drive.zip")
    decode = wait_for(client, answer.headers["location"])
    assert (decode["kind"], decode["summary"]["frames"]) == ("video", 20)
    assert decode["codebook_plates"] == 1  # looked up along the track


def _encoded(width_px: int, height_px: int, form: str, codec: str, rate_hz: int) -> bytes:
    out = io.BytesIO()
    with av.open(out, "w", format=form) as container:
        stream: Any = container.add_stream(codec, rate=rate_hz)
        stream.width, stream.height = width_px, height_px
        stream.pix_fmt = "yuvj444p" if codec == "mjpeg" else "yuv420p"
        for level in range(6):
            image = np.full((height_px, width_px, 3), 20 * level, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode(None))
    return out.getvalue()


def _without_frames() -> bytes:
    out = io.BytesIO()
    with av.open(out, "w", format="mp4") as container:
        stream: Any = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        container.start_encoding()
    return out.getvalue()


TURNED = turned(video(20), (0, 1, 0, -1, 0, 0, 0, 0, 1))
UPRIGHT = {"width_px": HEIGHT, "height_px": WIDTH, "horizontal_fov_deg": 60.0}


@pytest.mark.parametrize(
    ("data", "camera", "frames", "gaps"),
    [
        pytest.param(cut_video(), None, range(20, 100), ["ends before", "could not be decoded"], id="cut off"),
        pytest.param(video(10, stamps=[0, 1, 3, 4, 6, 7, 9, 10, 12, 13]), None, 10, [], id="variable rate"),
        pytest.param(video(10, stamps=[0, 1, 2, 3, 4, 5, 6, 7, 60, 61]), None, 10, ["jumped"], id="clock jumps"),
        pytest.param(_encoded(161, 121, "avi", "mjpeg", 10), None, 6, [], id="odd size"),
        pytest.param(TURNED, UPRIGHT, 20, [], id="turned"),
    ],
)
def test_odd_videos_are_decoded_and_what_is_missing_is_stated(
    client: httpx.Client, data: bytes, camera: dict[str, Any] | None, frames: Any, gaps: list[str]
) -> None:
    context: dict[str, Any] = {"captured_at": "2026-05-04T08:30:00Z"} | ({"camera": camera} if camera else {})
    answer = post_frame(client, data, context, name="drive.bin")
    assert answer.status_code == 202, answer.text
    decode = wait_for(client, answer.headers["location"])
    searched = decode["summary"]["frames"]
    assert searched in frames if isinstance(frames, range) else searched == frames
    assert len(decode["gaps"]) == len(gaps)
    assert all(reason in gap["reason"] for reason, gap in zip(gaps, decode["gaps"], strict=True)), decode["gaps"]
    assert len(decode["warnings"]) == ("could not be decoded" in gaps)


@pytest.mark.parametrize(
    ("data", "context", "detail"),
    [
        (b"\0\0\0\x18ftypisom" + b"\0" * 500, {}, "no index"),
        (video(5)[:900], {}, "no index"),
        (_without_frames(), {}, "no video"),
        (_encoded(160, 120, "mp4", "mpeg4", 10_000), {}, "not those of a camera"),
        (TURNED, {"camera": UPRIGHT | {"width_px": WIDTH, "height_px": HEIGHT}}, "upright"),
        (b"RIFF\xff\xff\0\0AVI " + b"\0" * 100, {}, ""),
        (video(5), {"camera": {"width_px": 64, "height_px": 64, "horizontal_fov_deg": 60.0}}, "camera"),
    ],
)
def test_videos_that_cannot_be_read_fail_with_their_reason(
    client: httpx.Client, data: bytes, context: dict[str, Any], detail: str
) -> None:
    answer = post_frame(client, data, context, name="upload.mp4")
    assert answer.status_code == 202, answer.text
    decode = finished(client, answer.headers["location"])
    assert decode["state"] == "failed"
    assert detail in decode["error"]["detail"]


def test_a_playlist_that_is_named_a_video_is_refused(client: httpx.Client) -> None:
    answer = post_frame(client, b"ffconcat version 1.0\nfile other.avi\n", {}, name="upload.mp4")
    assert answer.status_code == 415
    assert "playlist" in answer.json()["detail"]
