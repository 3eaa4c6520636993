"""The web UI as a visitor meets it: in a real browser against a real server with the real decoder."""

from __future__ import annotations

import json
import os
import re
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

from app.demo.cerpms import build_lane, drive_lane_and_judge, list_lane_drives
from app.demo.drive import drive_over, list_plates, registered_code
from tests.api.fleet.board_photos import good_photos, jpeg
from tests.browser import Browser
from tests.conftest import ADMIN_KEY, LiveServer

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def page(server: LiveServer, tmp_path: Path) -> Iterator[Browser]:
    """The page with the admin's key entered."""
    chromium = shutil.which("chromium")
    if chromium is None:
        if os.environ.get("CI"):
            pytest.fail("chromium is not installed")
        pytest.skip("chromium is not installed")
    with Browser(chromium, tmp_path / "profile") as browser:
        browser.open(f"{server.url}/")
        assert "Enter an API key" in browser.until("document.querySelector('#status').textContent")
        browser.fill("#key", ADMIN_KEY)
        browser.click("#key-form button")
        browser.until("sessionStorage.getItem('waymark-key')")
        browser.complaints.clear()
        yield browser


def test_the_page_lets_nothing_in_from_elsewhere(server: LiveServer) -> None:
    with server.client(None) as client:
        answer = client.get("/")
        assert answer.headers["content-type"].startswith("text/html")
        names = re.findall(r'(?:src|href)="(/static/[^"]+)"', answer.text)
        assert len(names) >= 3
        for name in ["/", *names]:
            answer = client.get(name)
            assert answer.status_code == 200, name
            policy = answer.headers["content-security-policy"]
            assert "default-src 'none'" in policy
            assert "unsafe" not in policy
        for outside in ("/static/../pyproject.toml", "/static/none.js"):
            assert client.get(outside).status_code == 404
    for file in (ROOT / "static").glob("*.*"):
        text = file.read_text()
        assert not re.search(r"https?://(?!www\.w3\.org/2000/svg)", text), file.name
        assert not re.search(r"<script(?![^>]*src=)|\son\w+=\"|\sstyle=\"|innerHTML|insertAdjacentHTML|eval\(", text), (
            file.name
        )


def test_a_refused_plate_is_explained(page: Browser) -> None:
    page.click("a[href='#register']")
    page.fill("[name='position.lon_deg']", "22.304")
    page.fill("[name='position.lat_deg']", "114.179")
    page.click("#register-form button")
    shown = page.until("!document.querySelector('#problem').hidden && document.querySelector('#problem').innerText")
    for part in ("lat_deg is 114.179", "position.lat_deg", "-90 to 90 deg", "swapped axes"):
        assert part in shown
    assert page.run("document.querySelector('[aria-invalid]').name") == "position.lat_deg"


def test_a_plate_is_registered_and_its_artwork_shown(page: Browser) -> None:
    page.click("a[href='#register']")
    page.fill("[name='position.lon_deg']", "12.345678")
    page.fill("[name='position.lat_deg']", "45.678912")
    scheme = "document.querySelector(\"[name='code.scheme']\")"
    for wanted, unit_mm in (("position-robust", "27"), ("id", "35")):
        page.run(f"{scheme}.value = '{wanted}', {scheme}.dispatchEvent(new Event('change', {{bubbles: true}})), 0")
        assert page.run("document.querySelector(\"[name='geometry.unit_mm']\").value") == unit_mm
        assert page.run("document.querySelector('#side').textContent") == "325 mm"
    page.fill("[name='geometry.gap_mm']", "6")
    assert page.run("document.querySelector('#side').textContent") == "334 mm"
    page.click("#register-form button")
    detail = page.until(
        "/Read back/.test(document.querySelector('#detail').innerText) && document.querySelector('#detail').innerText"
    )
    assert "id, number" in detail
    assert "334 mm square" in detail
    assert page.until("document.querySelector('.preview').naturalWidth") > 100
    assert page.run("document.querySelectorAll('#map .marker').length") >= 1
    assert page.run("document.querySelector('#bundle-form button').disabled")
    page.click("#marker-rows input")
    assert not page.run("document.querySelector('#bundle-form button').disabled")
    assert page.complaints == []


def test_a_tag_is_planned_from_a_meaning_and_its_layout_shown(page: Browser, server: LiveServer) -> None:
    book = {
        "name": "Page",
        "design": {"magnets": 3, "length_m": 4, "segment_m": 0.1},
        "meanings": [{"kind": "arrow", "value": "left"}, {"kind": "bend-right", "value": 125}],
    }
    with server.client() as client:
        entry = client.post("/v1/codebooks", json=book).json()["entries"][1]
    page.click("a[href='#magnets']")
    page.until("document.querySelectorAll(\"[name='tag.meaning'] option\").length === 2")
    page.run("document.querySelector(\"[name='tag.meaning']\").value = 1")
    page.fill("[name='tag.chainage_m']", "60")
    page.fill("[name='lane.geometry']", "-84.48, 42.7263\n-84.4776, 42.7263")
    page.fill("[name='site.design_speed_mps']", "200")
    page.click("#magnets-form button")
    shown = page.until("!document.querySelector('#problem').hidden && document.querySelector('#problem').innerText")
    assert "0.5 to 70 m/s" in shown
    assert page.run("document.querySelector('[aria-invalid]').name") == "site.design_speed_mps"
    page.complaints.clear()  # the browser itself reports the 422 as an error
    page.fill("[name='site.design_speed_mps']", "13.4")
    page.fill("[name='site.stop_line_chainage_m']", "100")
    page.click("#magnets-form button")
    detail = page.until(
        "/Checks/.test(document.querySelector('#detail').innerText) && document.querySelector('#detail').innerText"
    )
    for part in (entry["code"], "bend right 125 deg", "warning reaction-distance: 36 >= 59.9059 m", "3.00 USD"):
        assert part in detail
    assert page.run("document.querySelectorAll('#detail .map .marker').length") == 3
    assert page.run("[...document.querySelectorAll('#detail .buttons button')].map((b) => b.textContent).join()") == (
        "PDF,CSV,GEOJSON"
    )
    assert page.run("document.querySelectorAll('#marker-rows tr.chosen input').length") == 0
    page.run("window.saved = []; HTMLAnchorElement.prototype.click = function () { window.saved.push(this.download); }")
    page.click("#detail .buttons button")
    assert page.until("window.saved[0]").endswith("-r1.pdf")
    assert page.complaints == []


@pytest.mark.slow
def test_a_frame_is_decoded_and_the_vehicle_shown(page: Browser, server: LiveServer, tmp_path: Path) -> None:
    plate = list_plates(np.random.default_rng(1))[0]
    with server.client() as client:
        client.timeout = httpx.Timeout(280)
        marker = client.post("/v1/markers", json=plate.body).json()
        frames = list(drive_over(plate.place, registered_code(marker), np.random.default_rng(1)))
        frame = min(frames, key=lambda frame: abs(frame.rows - 60))
        # the first frame waits for the decoder, which may have to be compiled
        assert client.post("/v1/decodes", files={"file": ("frame.jpg", frame.jpeg)}).status_code == 201
    (tmp_path / "frame.jpg").write_bytes(frame.jpeg)
    page.click("a[href='#decode']")
    page.click("#decode-form button")
    assert "Choose a picture" in page.until("document.querySelector('#problem').innerText")
    page.choose_file("#file", tmp_path / "frame.jpg")
    page.run("document.querySelector('#file').dispatchEvent(new Event('change'))")
    for part, value in (
        ("coarse_position.lon_deg", frame.context["coarse_position"]["lon_deg"]),
        ("coarse_position.lat_deg", frame.context["coarse_position"]["lat_deg"]),
        ("coarse_position.accuracy_m", 10),
        ("camera.horizontal_fov_deg", 70),
    ):
        page.fill(f"[name='{part}']", str(value))
    page.click("#decode-form button")
    assert page.until("document.querySelector('#annotated').naturalWidth") == 1920
    assert marker["code"]["digits"] in page.run("document.querySelector('#readings').innerText")
    assert page.run("document.querySelectorAll('.cells b').length") == len(marker["code"]["digits"])
    assert "Grade" in page.run("document.querySelector('#fix').innerText")
    assert page.run("document.querySelectorAll('#fix-map .vehicle').length") == 1
    assert page.complaints == []


@pytest.mark.slow
def test_a_trace_is_decoded_with_its_tag_and_line(page: Browser, server: LiveServer) -> None:
    lane = [[8.416841693, 49.005889355], [8.417251732, 49.006356579]]  # of the README's drive
    body = {
        "family": "magnet",
        "status": "surveyed",
        "tag": {"code": "SNS_4_0.1_10-30", "chainage_m": 42.0},
        "lane": {"geometry": {"type": "LineString", "coordinates": lane}, "horizontal_rmse_m": 0.01},
    }
    with server.client() as client:
        assert client.post("/v1/markers", json=body).status_code == 201
    page.click("a[href='#decode']")
    page.choose_file("#file", ROOT / "docs/images/drive.zip")
    page.run("document.querySelector('#file').dispatchEvent(new Event('change'))")
    page.fill("[name='coarse_position.lon_deg']", "8.417")
    page.fill("[name='coarse_position.lat_deg']", "49.006")
    page.fill("[name='coarse_position.accuracy_m']", "50")
    page.click("#decode-form button")
    assert page.until("document.querySelector('#annotated').naturalWidth") > 1000
    shown = page.run("document.querySelector('#readings').innerText")
    assert "SNS_4_0.1_10-30" in shown
    assert "dashed line crossed" in shown
    assert "steering wheel" in shown
    assert "Distance from the tag's line" in page.run("document.querySelector('#fix').innerText")
    assert page.run("document.querySelectorAll('#fix-map .vehicle').length") == 1
    assert page.complaints == []


def test_a_cerpm_is_registered_and_its_message_explained(page: Browser) -> None:
    page.click("a[href='#cerpms']")
    page.run("document.querySelector('#cerpms-form').elements['position.lon_deg'].value = '-85.6436'")
    page.run("document.querySelector('#cerpms-form').elements['position.lat_deg'].value = '42.2531'")
    page.run("document.querySelector('#cerpms-form').elements['speed_limit.value'].value = '300'")
    page.run("document.querySelector('#cerpms-form').elements['number'].value = '4711'")
    page.click("#cerpms-form button")
    shown = page.until("!document.querySelector('#problem').hidden && document.querySelector('#problem').innerText")
    assert "255" in shown
    page.complaints.clear()  # the browser itself reports the 422 as an error
    page.run("document.querySelector('#cerpms-form').elements['speed_limit.value'].value = '25'")
    page.run("document.querySelector('#cerpms-form').elements['speed_limit.unit'].value = 'mph'")
    page.click("#cerpms-form button")
    detail = page.until(
        "/marker's own/.test(document.querySelector('#detail').innerText)"
        " && document.querySelector('#detail').innerText"
    )
    for part in ("CERPM 4711", "left", "25 mph", "-85.6436000 degrees", "marker 4711", "SF7, 500 kHz"):
        assert part in detail
    page.run("window.saved = []; HTMLAnchorElement.prototype.click = function () { window.saved.push(this.download); }")
    page.click("#detail .buttons button")
    assert page.until("window.saved[0]") == "cerpm-4711.bin"
    assert page.complaints == []


@pytest.mark.slow
def test_a_packet_log_is_decoded_to_its_lane(page: Browser, server: LiveServer, tmp_path: Path) -> None:
    with server.client() as client:
        client.timeout = httpx.Timeout(280)  # the first lane waits for kernels that may have to be compiled
        built = build_lane(client, np.random.default_rng(1))
        drive = next(drive for drive in list_lane_drives() if drive.moved)
        _result, _decode, recording, context, _heard = drive_lane_and_judge(
            client, built, drive, 0, (), np.random.default_rng(2)
        )
    (tmp_path / "packets.zip").write_bytes(recording)
    page.click("a[href='#decode']")
    page.choose_file("#file", tmp_path / "packets.zip")
    page.run("document.querySelector('#file').dispatchEvent(new Event('change'))")
    assert page.run("document.querySelector('#kind').value") == "packets"
    page.run(f"document.querySelector('#context').value = {json.dumps(json.dumps(context))}")
    page.click("#decode-form button")
    assert page.until("document.querySelector('#annotated').naturalWidth") > 1000
    shown = page.run("document.querySelector('#readings').innerText")
    assert "authentic" in shown
    assert "left out CERPM" in shown
    assert "moved" in shown
    assert "Steering check" in shown
    assert "median ±" in page.run("document.querySelector('#fix').innerText")
    assert page.run("document.querySelectorAll('#fix-map .marker').length") > 20
    assert page.complaints == []


def test_a_vehicle_is_added_and_listed(page: Browser, server: LiveServer) -> None:
    page.click("a[href='#fleet']")
    page.until("!document.querySelector('#view-fleet').hidden")
    page.fill("#vehicle-form [name='name']", "BUS <7>")
    page.fill("#vehicle-form [name='profile']", "{")
    page.click("#vehicle-form button")
    shown = page.until("!document.querySelector('#problem').hidden && document.querySelector('#problem').innerText")
    assert "profile cannot be read" in shown
    page.fill("#vehicle-form [name='profile']", '{"camera": {"height_m": 0}}')
    page.click("#vehicle-form button")
    shown = page.until("(t => /height_m must/.test(t) && t)(document.querySelector('#problem').innerText)")
    assert "profile.camera.height_m" in shown
    page.complaints.clear()  # the browser itself reports the 422 as an error
    page.fill("#vehicle-form [name='profile']", '{"camera": {"height_m": 1.4, "horizontal_fov_deg": 70}, "trace": {}}')
    page.click("#vehicle-form button")
    detail = page.until(
        "/70° field of view/.test(document.querySelector('#vehicle').innerText)"
        " && document.querySelector('#vehicle').innerText"
    )
    for part in ("BUS <7>", "active, version 1", "1.4 m above the road", "0.000 km driven", "never"):
        assert part in detail
    assert "BUS <7>" in page.run("document.querySelector('#vehicle-rows').innerText")
    page.click("#vehicle form button")
    assert "Choose photos" in page.until("document.querySelector('#problem').innerText")
    assert page.complaints == []


@pytest.mark.slow
def test_a_camera_is_calibrated_and_its_errors_shown(page: Browser, server: LiveServer, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "photos.zip", "w") as archive:
        for k, grey in enumerate(good_photos()):
            archive.writestr(f"{k}.jpg", jpeg(grey))
        archive.writestr("mirrored.jpg", jpeg(good_photos()[0][:, ::-1].copy()))
    with server.client() as client:
        mount = {"camera": {"height_m": 1.4, "depression_deg": 12.0}}
        vehicle = client.post("/v1/vehicles", json={"name": "To calibrate", "profile": mount}).json()
        page.click("a[href='#fleet']")
        page.run(f"location.hash = '#fleet/{vehicle['id']}'")
        page.until("/To calibrate/.test(document.querySelector('#vehicle').innerText)")
        page.choose_file("#vehicle input[type=file]", tmp_path / "photos.zip")
        page.click("#vehicle form button")
        shown = page.until(
            "document.querySelectorAll('.coverage span').length === 48 && document.querySelector('#vehicle').innerText"
        )
        assert re.search(r"Reprojection error 0\.\d{3} px over 14 of 15 photos", shown)
        assert "mirrored" in shown
        assert "±" in shown
        page.click("#calibration button")
        page.until("/version 2/.test(document.querySelector('#vehicle').innerText)")
        camera = client.get(f"/v1/vehicles/{vehicle['id']}").json()["profile"]["camera"]
    assert camera["fx_px"] == pytest.approx(754.0, rel=0.003)
    assert camera["depression_deg"] == 12.0
    assert page.complaints == []
