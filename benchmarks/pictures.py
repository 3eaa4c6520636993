"""``python -m benchmarks.pictures``: make the pictures in docs/images. Needs Chromium for those of pages."""

from __future__ import annotations

import argparse
import io
import json
import shutil
import subprocess
import sys
import tempfile
import zipfile
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np

import app.demo
from app.demo.cerpms import build_lane, drive_lane_and_judge, list_lane_drives
from app.demo.drive import drive_over, list_plates, registered_code
from app.demo.road_plan import ORIGIN_DEG, ROAD, RULES, plan_road
from app.demo.server import LocalServer
from app.formats.format import SpooledFile
from app.markers.magnet import InformationTag, Polarity, parse_tag
from app.services.decodes.trace_tasks import decode_recording
from app.simulation.magnetic.drive import Course, Scene, Vehicle, simulate_drive
from app.simulation.magnetic.recorder import write_recorder_files
from app.simulation.magnetic.road import PlacedTag, Road, line_magnets
from app.simulation.radio.drive import drive_past
from tests.web.browsing import chromium, watched_page

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
_SEED = 3
_FRAME_ROWS = 75.0
_MAP_SETTLES_MS = 3000
_CHOSEN = 2  # the plate with the paper's digits


def main() -> None:
    """Make them all."""
    argparse.ArgumentParser(prog="python -m benchmarks.pictures", description=__doc__).parse_args()
    IMAGES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, LocalServer(Path(folder)) as server, server.client() as client:
        plates = list_plates(np.random.default_rng(_SEED))
        markers = [client.post("/v1/markers", json=plate.body).raise_for_status().json() for plate in plates]
        _write_plate(client, markers[_CHOSEN]["id"])
        code = registered_code(markers[0])
        frames = list(drive_over(plates[0].place, code, np.random.default_rng(_SEED)))
        frame = min(frames, key=lambda frame: abs(frame.rows - _FRAME_ROWS))
        small = _recoded(frame.jpeg, 1.0, 62)
        (IMAGES / "frame.jpg").write_bytes(small)
        (IMAGES / "frame.json").write_text(json.dumps(frame.context, indent=2) + "\n")
        parts: dict[str, tuple[str, bytes] | tuple[str, bytes, str]]
        parts = {"file": ("frame.jpg", small, "image/jpeg"), "context": ("c", json.dumps(frame.context).encode())}
        decode = client.post("/v1/decodes", files=parts).raise_for_status().json()
        print(decode["summary"]["text"], markers[0]["position"], markers[0]["heading_deg"])
        annotated = client.get(decode["links"]["annotated"]).raise_for_status().content
        (IMAGES / "drive.jpg").write_bytes(_recoded(annotated, 0.5, 85))
        _write_pages(server, client, markers)
        _write_lane(client)
    _write_trace()
    _write_strip_map()


def _write_strip_map() -> None:
    """The first strips of the demo's plan, as the drawings have them."""
    poppler = shutil.which("pdftoppm")
    if poppler is None:
        print("there is no pdftoppm here: the picture of the strip map stays as it is")
        return
    data = Path(app.demo.__file__).parent / "data"
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "plan"
        command = [
            sys.executable, "-c", "from app.cli import main; main()", "plan", str(data / ROAD), "--rules",
            str(data / RULES), "--origin", ",".join(map(str, ORIGIN_DEG)), "--out", str(out),
        ]  # fmt: skip
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        page = ["-r", "100", "-f", "2", "-l", "2", "-singlefile", "-png"]
        subprocess.run([poppler, *page, str(out / "drawings.pdf"), str(IMAGES / "strip-map")], check=True)


def _write_lane(client: httpx.Client) -> None:
    """A drive past CERPMs: its lane, the lane over a frame, and a log in clear for the tour."""
    built = build_lane(client, np.random.default_rng(_SEED))
    drive = next(drive for drive in list_lane_drives() if drive.moved)
    _result, decode, _recording, _context, _heard = drive_lane_and_judge(
        client, built, drive, 0, (), np.random.default_rng(_SEED)
    )
    print(decode["summary"]["text"])
    (IMAGES / "lane.svg").write_bytes(client.get(decode["links"]["plot"]).raise_for_status().content)
    overlay = client.get(decode["links"]["overlay"]).raise_for_status().content
    (IMAGES / "overlay.jpg").write_bytes(_recoded(overlay, 0.5, 80))
    heard = drive_past(built.lane, built.installed, np.random.default_rng(_SEED), sign=None)
    rows = ["id,latitude,longitude,altitude,side,rssi,snr,timestamp"]
    first = {packet.claim.number: packet for packet in reversed(heard.packets) if packet.claim is not None}
    for number, packet in sorted(first.items()):
        at, claim = datetime.fromtimestamp(packet.received_at_s, UTC), packet.claim
        assert claim is not None
        rows.append(
            f"{number},{claim.lat_deg:.7f},{claim.lon_deg:.7f},0.0,{claim.side.name.lower()},{packet.rssi_dbm:.0f},"
            f"{packet.snr_db:.2f},{at.isoformat(timespec='milliseconds')}"
        )
    (IMAGES / "packets.csv").write_text("\n".join(rows) + "\n")


def _write_trace() -> None:
    """A drive of four seconds over one tag and a dashed line, as METRO's recorder writes it, and its plot."""
    tag = parse_tag("SNS_4_0.1_10-30")
    assert isinstance(tag, InformationTag)
    line = line_magnets(50.0, 58.0, 4.0, 0.7, Polarity.S)
    scene = Scene(
        Road(60.0), Vehicle.compact(), Course(speed_m_s=15.0), tags=[PlacedTag(tag, 42.0)], lines=line
    )  # fmt: skip
    drive = simulate_drive(scene, np.random.default_rng(_SEED))
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, data in write_recorder_files(drive.trace).items():
            archive.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_DEFLATED)
    (IMAGES / "drive.zip").write_bytes(packed.getvalue())
    result = decode_recording("drive.zip", SpooledFile.of(packed.getvalue()), tags=(tag.text,))
    (IMAGES / "trace.svg").write_bytes(result.plot)


def _recoded(jpeg: bytes, scale: float, quality: int) -> bytes:
    pixels = np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR))
    smaller = cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return bytes(cv2.imencode(".jpg", smaller, [cv2.IMWRITE_JPEG_QUALITY, quality])[1])


def _write_plate(client: httpx.Client, marker_id: str) -> None:
    png = client.get(f"/v1/markers/{marker_id}/artwork.png", params={"resolution_dpi": 72}).raise_for_status().content
    pixels = np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR))
    scale = 640 / pixels.shape[0]
    smaller = cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(IMAGES / "plate.png"), smaller)


def _write_pages(server: LocalServer, client: httpx.Client, markers: list[dict[str, Any]]) -> None:
    """The page of the markers, and that of the demo's plan before its proof."""
    if shutil.which("chromium") is None:
        print("there is no chromium here: the pictures of the pages stay as they are")
        return
    with chromium() as browser, watched_page(browser, server.url, server.key, (1200, 860)) as watched:
        page = watched.open(f"/markers/{markers[_CHOSEN]['id']}")
        page.locator(".artwork").wait_for()
        page.locator(".map-tools").wait_for()
        page.get_by_text(f"{len(markers)} markers on the map").wait_for()
        page.wait_for_timeout(_MAP_SETTLES_MS)
        page.screenshot(path=IMAGES / "page.png")
        with tempfile.TemporaryDirectory() as folder:
            plan = plan_road(client, Path(folder)).plan
        page.set_viewport_size({"width": 1200, "height": 1120})
        page = watched.open(f"/plans/{plan['id']}")
        page.locator(".strip svg").first.wait_for()
        page.wait_for_timeout(_MAP_SETTLES_MS)
        page.screenshot(path=IMAGES / "plan-page.png")


if __name__ == "__main__":
    main()
