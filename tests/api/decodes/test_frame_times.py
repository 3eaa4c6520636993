"""ZIPs of frames with a time and a pose of their own: each frame is matched where it was taken."""

from __future__ import annotations

from typing import Any

import httpx
from pyproj import Geod

from tests.api.decodes.conftest import near, post_frame
from tests.api.decodes.test_archives import GOOD, pack, wait_for
from tests.http import finished

DISTANCE_DEG = 0.05
"""About 5.5 km of latitude."""


def _plates(client: httpx.Client, plate: dict[str, Any]) -> list[dict[str, Any]]:
    first = plate["position"]
    position = {"lon_deg": first["lon_deg"], "lat_deg": first["lat_deg"] + DISTANCE_DEG, "horizontal_rmse_m": 0.01}
    answer = client.post("/v1/markers", json={"position": position, "heading_deg": 30.0, "status": "surveyed"})
    assert answer.status_code == 201, answer.text
    return [plate, answer.json()]


def _row(name: str, plate: dict[str, Any], second: float) -> str:
    position = plate["position"]
    return f"{name},2026-05-04T08:30:{second:06.3f}Z,{position['lon_deg']},{position['lat_deg']},30,0.5"


def test_each_frame_is_matched_from_its_own_position(client: httpx.Client, plate: dict[str, Any]) -> None:
    first, second = _plates(client, plate)
    rows = ["file,time,lon,lat,heading,accuracy", _row("a.png", first, 0), _row("b.png", second, 50)]
    archive = pack({"a.png": GOOD, "b.png": GOOD, "frames.csv": "\n".join(rows).encode()})
    answer = post_frame(client, archive, {}, name="drive.zip")
    assert answer.status_code == 202, answer.text
    decode = wait_for(client, answer.headers["location"])
    assert [reading["match"]["marker_id"] for reading in decode["readings"]] == [first["id"], second["id"]]
    assert [frame["captured_at"] for frame in decode["frames"]] == ["2026-05-04T08:30:00Z", "2026-05-04T08:30:50Z"]
    pose = decode["frames"][0]["pose"]
    assert (pose["source"], pose["heading_deg"], pose["accuracy_m"]) == ("list", 30.0, 0.5)
    assert decode["gaps"] == []
    assert decode["warnings"] == []
    seen = client.get("/v1/observations", params={"marker_id": second["id"]})
    if seen.status_code == 200:
        assert seen.json()["items"][0]["at"].startswith("2026-05-04T08:30:50")


def test_what_is_missing_or_jumps_is_stated(client: httpx.Client, plate: dict[str, Any]) -> None:
    rows = ["file,time,lon,lat,heading,accuracy", _row("a.png", plate, 5), _row("b.png", plate, 4)]
    rows += [_row("c.png", plate, 5), _row("d.png", plate, 50), _row("gone.png", plate, 51)]
    pictures = dict.fromkeys(("a.png", "b.png", "c.png", "d.png", "e.png"), GOOD)
    answer = post_frame(client, pack(pictures | {"frames.csv": "\n".join(rows).encode()}), near(plate), name="d.zip")
    decode = wait_for(client, answer.headers["location"])
    assert [frame["pose"]["source"] for frame in decode["frames"]] == ["list"] * 4 + ["context"]
    assert decode["frames"][4]["captured_at"] is None
    text = " ".join(decode["warnings"])
    assert "gone.png" in text
    assert "e.png" in text
    assert "time of frame 1 lies before" in text
    assert [(gap["after_frame"], gap["before_frame"], gap["seconds"]) for gap in decode["gaps"]] == [(2, 3, 45.0)]


def test_a_track_and_a_frame_rate(client: httpx.Client, plate: dict[str, Any]) -> None:
    lon, lat = plate["position"]["lon_deg"], plate["position"]["lat_deg"]
    track = "time,lon,lat\n" + "".join(f"2026-05-04T08:30:{k:02d}Z,{lon},{lat + (k - 2) * 1e-4}\n" for k in range(5))
    archive = pack({f"{k}.png": GOOD for k in range(3)} | {"poses.csv": track.encode()})
    context = {"captured_at": "2026-05-04T08:30:01.5Z", "frames": {"rate_hz": 2.0, "poses": {"accuracy_m": 1.0}}}
    decode = wait_for(client, post_frame(client, archive, context, name="d.zip").headers["location"])
    frames = decode["frames"]
    assert [frame["captured_at"][17:] for frame in frames] == ["01.500000Z", "02Z", "02.500000Z"]
    poses = [frame["pose"] for frame in frames]
    assert {pose["source"] for pose in poses} == {"track"}
    assert abs(poses[0]["lat_deg"] - (lat - 0.5e-4)) < 1e-8
    speed_m_s = Geod(ellps="WGS84").inv(lon, lat - 1e-4, lon, lat)[2]  # in a second; it depends on the latitude
    assert abs(poses[1]["speed_m_s"] - speed_m_s) < 0.01
    assert min(poses[1]["heading_deg"], 360 - poses[1]["heading_deg"]) < 0.01
    assert all(reading["match"]["marker_id"] == plate["id"] for reading in decode["readings"])


def test_a_track_a_week_rollover_behind_is_warned_of(client: httpx.Client, plate: dict[str, Any]) -> None:
    lon, lat = plate["position"]["lon_deg"], plate["position"]["lat_deg"]
    track = "time,lon,lat\n" + "".join(f"2006-09-18T08:30:{k:02d}Z,{lon},{lat + k * 1e-4}\n" for k in range(5))
    archive = pack({"0.png": GOOD, "poses.csv": track.encode()})
    context: dict[str, Any] = {"captured_at": "2026-05-04T08:30:01Z", "frames": {"rate_hz": 2.0}}
    decode = wait_for(client, post_frame(client, archive, context, name="d.zip").headers["location"])
    (warning,) = [text for text in decode["warnings"] if "rollover" in text]
    assert "2006-09-18" in warning
    assert "1024 weeks" in warning
    assert "2026-05-04" in warning
    context["frames"]["poses"] = {"clock": {"offset_s": 619315200}}  # what the warning asks for
    decode = wait_for(client, post_frame(client, archive, context, name="d.zip").headers["location"])
    assert decode["warnings"] == []
    assert decode["frames"][0]["pose"]["source"] == "track"
    listed = pack(
        {"0.png": GOOD, "frames.csv": b"name,time\n0.png,2026-05-04T08:30:01Z\n", "poses.csv": track.encode()}
    )
    context = {"frames": {"poses": context["frames"]["poses"]}}
    decode = wait_for(client, post_frame(client, listed, context, name="d.zip").headers["location"])
    assert decode["frames"][0]["captured_at"] == "2026-05-04T08:30:01Z", "the list has its own clock"
    assert decode["frames"][0]["pose"]["source"] == "track"


def test_frames_outside_the_times_of_their_track_are_reported(client: httpx.Client, plate: dict[str, Any]) -> None:
    """A track in local time, of which its file says nothing, holds no frame."""
    lon, lat = plate["position"]["lon_deg"], plate["position"]["lat_deg"]
    track = "time,lon,lat\n" + "".join(f"2026-05-04T10:30:{k:02d}Z,{lon},{lat + k * 1e-4}\n" for k in range(5))
    archive = pack({"0.png": GOOD, "1.png": GOOD, "poses.csv": track.encode()})
    context = {"captured_at": "2026-05-04T08:30:01Z", "frames": {"rate_hz": 2.0}}
    decode = wait_for(client, post_frame(client, archive, context, name="d.zip").headers["location"])
    (warning,) = decode["warnings"]
    assert "the track is from 2026-05-04T10:30:00Z to 2026-05-04T10:30:04Z, and a frame was taken at" in warning
    assert "utc_offset_s" in warning
    assert decode["frames"][0]["pose"] is None


def test_a_list_that_cannot_be_read_fails_the_job_with_its_reason(client: httpx.Client, plate: dict[str, Any]) -> None:
    answer = post_frame(client, pack({"a.png": GOOD, "frames.csv": b"when,where\n1,2\n"}), near(plate), name="d.zip")
    decode = finished(client, answer.headers["location"])
    assert decode["state"] == "failed"
    assert "no column with the names of the pictures" in decode["error"]["detail"]


def test_a_single_frame_has_the_time_of_its_context(client: httpx.Client, plate: dict[str, Any]) -> None:
    decode = post_frame(client, GOOD, near(plate, captured_at="2026-05-04T08:30:00Z"), name="a.png").json()
    frame = decode["frames"][0]
    assert (frame["captured_at"], frame["pose"]["source"]) == ("2026-05-04T08:30:00Z", "context")
    refused = post_frame(client, GOOD, {"frames": {"rate_hz": 0}}, name="a.png")
    assert refused.status_code == 422
