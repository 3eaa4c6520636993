"""Uploading files of every kind in the browser, resuming, what their results show, exports and the history."""

from __future__ import annotations

import csv
import io
import json
import re
import time
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import httpx
import numpy as np
import pytest
from playwright.sync_api import Page, Route, expect

from app.demo.cerpms import build_lane, drive_lane_and_judge, list_lane_drives
from app.demo.drive import DemoFrame, drive_over, list_plates, registered_code
from app.markers.plate import PlateCode, PlateScheme
from tests.api.decodes.videos import DECLARED, video_past
from tests.conftest import LiveServer
from tests.http import finished
from tests.web.browsing import DESKTOP, PHONE, Watched, until
from tests.web.conftest import OpenPage
from tests.web.test_pages import audit, wait_until_quiet

ROOT = Path(__file__).resolve().parents[2]
TRACE = ROOT / "docs/images/drive.zip"
LANE = [[8.416841693, 49.005889355], [8.417251732, 49.006356579]]  # of the drive in docs/images
TAG = "SNS_4_0.1_10-30"
PLACE = {"lon_deg": 8.417, "lat_deg": 49.006, "accuracy_m": 50.0}
PART_BYTES = 512 * 1024


@pytest.fixture(scope="module")
def api(server: LiveServer) -> Iterator[httpx.Client]:
    """A client that waits for kernels that may have to be compiled, with a registered tag on the lane of the trace."""
    with server.client() as client:
        client.timeout = httpx.Timeout(280)
        body = {
            "family": "magnet", "status": "surveyed", "tag": {"code": TAG, "chainage_m": 42.0},
            "lane": {"geometry": {"type": "LineString", "coordinates": LANE}, "horizontal_rmse_m": 0.01},
        }  # fmt: skip
        assert client.post("/v1/markers", json=body).status_code == 201
        yield client


@pytest.fixture(scope="module")
def plate(api: httpx.Client) -> dict[str, Any]:
    """A registered plate."""
    document: dict[str, Any] = api.post("/v1/markers", json=list_plates(np.random.default_rng(1))[0].body).json()
    return document


@pytest.fixture(scope="module")
def frames(plate: dict[str, Any]) -> list[DemoFrame]:
    """Frames of a drive over it."""
    place = list_plates(np.random.default_rng(1))[0].place
    return list(drive_over(place, registered_code(plate), np.random.default_rng(1)))


@pytest.fixture(scope="module")
def near(frames: list[DemoFrame]) -> DemoFrame:
    """The frame in which the plate has about 60 rows."""
    return min(frames, key=lambda frame: abs(frame.rows - 60))


@pytest.fixture(scope="module")
def archive(frames: list[DemoFrame]) -> bytes:
    """A ZIP of frames with their times, larger than a few parts of an upload."""
    out = io.BytesIO()
    rows = ["file,time"]
    with zipfile.ZipFile(out, "w") as packed:
        for k, frame in enumerate(frames[:8]):
            packed.writestr(f"{k:04d}.jpg", frame.jpeg)
            rows.append(f"{k:04d}.jpg,2026-06-01T08:00:{k:02d}Z")
        packed.writestr("frames.csv", "\n".join(rows))
    assert len(out.getvalue()) > 3 * PART_BYTES
    return out.getvalue()


def decoded(client: httpx.Client, name: str, data: bytes, context: dict[str, Any]) -> dict[str, Any]:
    """A decode of a file, once it is done."""
    answer = client.post("/v1/decodes", files={"file": (name, data)}, data={"context": json.dumps(context)})
    assert answer.status_code in (201, 202), answer.text
    decode = finished(client, answer.json()["links"]["self"])
    assert decode["state"] == "done", decode["error"]
    return decode


@pytest.fixture(scope="module")
def trace(api: httpx.Client) -> dict[str, Any]:
    """The decode of a trace over the registered tag."""
    context = {"coarse_position": PLACE, "trace": {}, "captured_at": "2026-06-01T08:00:00Z"}
    return decoded(api, "drive.zip", TRACE.read_bytes(), context)


@pytest.fixture(scope="module")
def drive(api: httpx.Client, near: DemoFrame, archive: bytes) -> dict[str, Any]:
    """The decode of the ZIP of frames."""
    return decoded(api, "frames.zip", archive, near.context)


def choose(page: Page, *paths: Path) -> None:
    page.locator("[name=file]").set_input_files(list(paths))


def field(page: Page, name: str, value: object) -> None:
    page.locator(f"main [name='{name}']").first.fill(str(value))


def place(page: Page, position: dict[str, Any]) -> None:
    for name, value in position.items():
        field(page, f"coarse_position.{name}", value)


def upload(page: Page) -> None:
    page.get_by_role("button", name=re.compile("^Upload and decode")).click()


def open_result(page: Page) -> None:
    page.get_by_role("link", name="Open the result").first.click()
    page.wait_for_url("**/decodes/*")
    page.locator(".readings table, .empty-title").first.wait_for()


def drawn(page: Page) -> None:
    """Wait until the frame and what was read in it are drawn."""
    until(page, "document.querySelector('.frame-canvas')?.dataset.drawn !== undefined")


# --- uploads ------------------------------------------------------------------------------------------------------


def test_several_files_are_uploaded_and_each_says_how_it_went(
    watched: Watched, api: httpx.Client, plate: dict[str, Any], near: DemoFrame, tmp_path: Path
) -> None:
    (tmp_path / "frame.jpg").write_bytes(near.jpeg)
    (tmp_path / "notes.csv").write_text("milk,eggs\n1,2\n")
    page = watched.open("/decode")
    page.get_by_role("button", name="Upload and decode", exact=True).click()
    expect(page.locator(".problem")).to_contain_text("No file is selected")
    choose(page, tmp_path / "frame.jpg", TRACE, tmp_path / "notes.csv")
    rows = page.locator(".upload-row")
    rows.nth(2).wait_for()
    for k, kind in enumerate(("frame", "trace", "trace")):
        expect(rows.nth(k).locator("[name=kind]")).to_have_value(kind)
    expect(rows.nth(2)).to_contain_text("please check")
    place(page, near.context["coarse_position"])
    field(page, "camera.horizontal_fov_deg", 70)
    upload(page)
    rows.nth(0).get_by_role("link", name="Open the result").wait_for()
    expect(rows.nth(2).locator(".problem")).to_contain_text("How to fix it")
    rows.nth(1).locator(".upload-summary").wait_for()
    expect(rows.nth(0).locator(".upload-summary")).to_contain_text("1 plate read")
    expect(rows.nth(1).locator(".upload-summary")).to_contain_text("magnets")
    watched.complaints.clear()  # the browser itself reports the refusal
    rows.nth(2).get_by_role("button", name="Remove notes.csv").click()
    expect(rows).to_have_count(2)
    page.get_by_role("link", name="Show 2 together").click()
    page.locator(".decode-signals > section").nth(1).wait_for()


def test_bad_options_are_shown_at_their_field(watched: Watched, near: DemoFrame, tmp_path: Path) -> None:
    (tmp_path / "frame.jpg").write_bytes(near.jpeg)
    (tmp_path / "empty.jpg").write_bytes(b"")
    page = watched.open("/decode")
    choose(page, tmp_path / "frame.jpg")
    place(page, {"lon_deg": 22.3, "lat_deg": 114.2, "accuracy_m": 10})
    upload(page)
    page.locator("[name='coarse_position.lat_deg'][aria-invalid=true]").wait_for()
    expect(page.locator(".upload-row .problem")).to_contain_text("-90 to 90")
    watched.complaints.clear()
    page.get_by_role("button", name="Remove frame.jpg").click()
    field(page, "coarse_position.lat_deg", 22.3)
    choose(page, tmp_path / "empty.jpg")
    upload(page)
    page.locator(".upload-row .problem", has_text="empty").wait_for()
    watched.complaints.clear()


def test_an_interrupted_upload_goes_on_after_a_reload(
    watched: Watched, api: httpx.Client, near: DemoFrame, archive: bytes, tmp_path: Path
) -> None:
    (tmp_path / "frames.zip").write_bytes(archive)
    (tmp_path / "other.zip").write_bytes(archive[:-1] + b"x")
    page = watched.open("/decode")
    offsets: list[int] = []
    held: list[Route] = []

    def pass_two(route: Route) -> None:
        if route.request.method != "PATCH":
            route.continue_()
            return
        offsets.append(int(route.request.headers["upload-offset"]))
        if len(offsets) > 2 and not held:
            held.append(route)  # the connection hangs
        else:
            route.continue_()

    page.route("**/v1/uploads/*", pass_two)
    choose(page, tmp_path / "frames.zip")
    page.locator(".upload-row").wait_for()
    expect(page.locator(".upload-row [name=kind]")).to_have_value("frame")
    place(page, near.context["coarse_position"])
    upload(page)
    deadline = time.monotonic() + 60
    while not held:
        assert time.monotonic() < deadline
        page.wait_for_timeout(50)
    page.get_by_role("button", name="Pause").click()
    page.locator(".upload-row", has_text="Paused").wait_for()
    page.reload()
    row = page.locator(".upload-row", has_text="Interrupted")
    row.wait_for()
    expect(row).to_contain_text(f"{100 * 2 * PART_BYTES / len(archive):.0f}\u00a0%")
    row.locator("[name=again]").set_input_files(TRACE)
    page.locator(".upload-row .problem", has_text="another file").wait_for()
    row.locator("[name=again]").set_input_files(tmp_path / "frames.zip")
    page.get_by_role("link", name="Open the result").wait_for()
    assert offsets[:4] == [0, PART_BYTES, 2 * PART_BYTES, 2 * PART_BYTES]
    until(page, "localStorage.getItem('waymark-uploads') === null")
    decode_id = page.get_by_role("link", name="Open the result").get_attribute("href")
    assert api.get(f"/v1{decode_id}").json()["upload_bytes"] == len(archive)
    watched.complaints.clear()


@pytest.mark.parametrize(
    ("name", "content", "kind"),
    [
        ("a.bin", "[0xff, 0xd8, 0xff, 0xe0]", "frame"),
        ("a.dat", "[...new TextEncoder().encode('....ftypisom')]", "frame"),
        ("a", "[...new TextEncoder().encode('PAR1')]", "trace"),
        ("a.csv", "[...new TextEncoder().encode('time,rssi,payload\\n')]", "packets"),
        ("a.csv", "[...new TextEncoder().encode('t_s,s1_x,s1_y\\n')]", "trace"),
        ("a.json", "[...new TextEncoder().encode(' {\\\"data\\\": 1}')]", "packets"),
        ("lora.txt", "[...new TextEncoder().encode('18000000')]", "packets"),
    ],
)
def test_files_are_recognised_by_their_bytes_and_names(watched: Watched, name: str, content: str, kind: str) -> None:
    page = watched.open("/decode")
    found = page.evaluate(
        f"async () => (await import('/static/app/pages/decode_kind.js'))"
        f".recognise(new File([new Uint8Array({content})], '{name}'))"
    )
    assert found["kind"] == kind


def test_the_sample_is_decoded(watched: Watched, api: httpx.Client) -> None:
    assert (ROOT / "static/samples/trace.zip").read_bytes() == TRACE.read_bytes()
    page = watched.open("/decode")
    page.get_by_role("button", name="Try a sample trace").click()
    page.locator(".upload-row", has_text="sample-trace.zip").wait_for()
    expect(page.locator("[name='coarse_position.lon_deg']")).to_have_value("8.417")
    upload(page)
    page.locator(".upload-summary", has_text="1 tag, 1 registered").wait_for()


# --- results ------------------------------------------------------------------------------------------------------


def test_a_frame_shows_corners_bits_and_the_vehicle(
    watched: Watched, api: httpx.Client, plate: dict[str, Any], near: DemoFrame
) -> None:
    decode = decoded(api, "frame.jpg", near.jpeg, near.context)
    page = watched.open(f"/decodes/{decode['id']}")
    drawn(page)
    digits = plate["code"]["digits"]
    expect(page.locator(".cells b")).to_have_count(len(digits))
    expect(page.locator(f".readings a[href='/markers/{plate['id']}']")).to_have_count(1)
    expect(page.locator(".fix")).to_contain_text("Grade")
    expect(page.locator(".place-plot .vehicle")).to_have_count(1)
    code = PlateCode(digits, PlateScheme(plate["code"]["scheme"]), plate["geometry"]["n"])
    dark = page.evaluate(
        "async (reading) => (await import('/static/app/pages/decode_overlay.js')).unitsOf(reading).dark",
        {"family": "plate", "digits": digits},
    )
    assert [[bool(bit) for bit in row] for row in dark] == code.units.astype(bool).tolist()
    page.locator(".readings button.link").click()
    page.get_by_role("button", name="Whole frame").click()
    page.wait_for_url("**reading=*")
    page.reload()
    drawn(page)
    until(page, "!document.querySelector('.frame-tools button:last-child').disabled")  # the reading is chosen again


def test_a_trace_is_zoomed_and_its_time_moves_the_map(watched: Watched, trace: dict[str, Any]) -> None:
    page = watched.open(f"/decodes/{trace['id']}")
    page.locator(".chart canvas").wait_for()
    until(page, "!document.querySelector('main .chart-figure .loading')")
    expect(page.locator(".readings")).to_contain_text(TAG)
    expect(page.locator(".findings")).to_contain_text("dashed line crossed")
    expect(page.locator("p.warning")).to_have_text(
        ["RawSWA_drive_1.csv: the steering wheel's angle is not the heading, and is not used"]
    )
    page.get_by_label("Go to tag").select_option(label=TAG)
    page.wait_for_url("**zoom=*")
    from_s, to_s = map(float, parse_qs(urlsplit(page.url).query)["zoom"][0].split(","))
    assert from_s < trace["tags"][0]["start_s"] < trace["tags"][0]["end_s"] < to_s
    expect(page.locator(".decode-where")).to_have_text(re.compile(r"^-?\d"))
    here = page.locator(".decode-where").inner_text()
    slider = page.get_by_role("slider", name="Timeline")
    slider.focus()
    page.keyboard.press("Home")
    until(page, f"document.querySelector('.decode-where').textContent !== {here!r}")
    expect(page.locator(".timeline-time")).to_have_text(re.compile("^08:00:00"))
    page.get_by_role("button", name="Next reading").click()
    lat_deg = float(here.split(",")[0])  # of the tag; the reading's time is that of its middle, but for a rounding
    until(page, f"Math.abs(parseFloat(document.querySelector('.decode-where').textContent) - {lat_deg}) < 5e-7")
    at = page.locator(".timeline-time").inner_text()
    page.reload()
    page.locator(".chart canvas").wait_for()
    expect(page.locator(".timeline-time")).to_have_text(at)
    page.locator("summary", has_text="Series").click()
    page.get_by_label("sensor 3, z").check()
    page.wait_for_url("**series=*")
    page.locator(".key-2", has_text="sensor 3, z").wait_for()


def test_results_are_exported(watched: Watched, trace: dict[str, Any]) -> None:
    page = watched.open(f"/decodes/{trace['id']}")
    page.locator("summary", has_text="Export").click()
    saved = {}
    for button in (
        "Readings (CSV)",
        "Readings (GeoJSON)",
        "Track (GPX)",
        "Track (CSV)",
        "Plot (SVG)",
        "Whole result (JSON)",
    ):
        with page.expect_download() as download:
            page.get_by_role("button", name=button).click()
        saved[download.value.suggested_filename] = Path(download.value.path()).read_bytes()
    assert set(saved) == {
        "drive-readings.csv", "drive-readings.geojson", "drive-track.gpx", "drive-track.csv", "drive.svg", "drive.json",
    }  # fmt: skip
    (row,) = csv.DictReader(io.StringIO(saved["drive-readings.csv"].decode()))
    assert (row["code"], row["registered"]) == (TAG, "true")
    assert json.loads(saved["drive-readings.geojson"])["features"][0]["properties"]["code"] == TAG
    assert len(ET.fromstring(saved["drive-track.gpx"])) == 1
    assert json.loads(saved["drive.json"])["id"] == trace["id"]


def test_packets_show_strength_and_who_was_left_out(watched: Watched, api: httpx.Client) -> None:
    built = build_lane(api, np.random.default_rng(1))
    moved = next(drive for drive in list_lane_drives() if drive.moved)
    judged = drive_lane_and_judge(api, built, moved, 0, (), np.random.default_rng(2))
    recording, context = judged[2], judged[3]
    decode = decoded(api, "packets.zip", recording, context)
    page = watched.open(f"/decodes/{decode['id']}")
    page.locator(".chart canvas").wait_for()
    expect(page.locator(".packets-now tr.chosen")).to_contain_text("dBm")
    before = page.locator(".packets-now tr.chosen").inner_text()
    page.get_by_role("slider", name="Timeline").focus()
    page.keyboard.press("End")
    until(page, f"document.querySelector('.packets-now tr.chosen').innerText !== {before!r}")
    page.get_by_role("button", name=re.compile("Refused or unsure")).click()
    rows = page.locator(".readings tbody tr")
    expect(rows).to_have_count(1)
    expect(rows).to_contain_text("left out")
    expect(rows).to_contain_text("moved")
    for part in ("authentic", "Steering check"):
        expect(page.locator(".findings")).to_contain_text(part)
    expect(page.locator(".fix")).to_contain_text("median ±")


def test_a_video_shows_the_frames_in_which_something_was_read(watched: Watched, api: httpx.Client) -> None:
    position = {"lon_deg": 8.52, "lat_deg": 49.11, "horizontal_rmse_m": 0.01}
    body = {"position": position, "heading_deg": 30.0, "status": "surveyed"}
    plate = api.post("/v1/markers", json=body).json()
    data = video_past(plate["code"])
    coarse = {"lon_deg": 8.52, "lat_deg": 49.11, "accuracy_m": 20.0}
    context = {"coarse_position": coarse, "camera": DECLARED, "captured_at": "2026-05-04T08:30:00Z"}
    decode = decoded(api, "drive.mp4", data, context)
    assert decode["frames"]
    page = watched.open(f"/decodes/{decode['id']}")
    drawn(page)
    expect(page.locator("figcaption").first).to_contain_text("960 × 540 px")
    page.get_by_role("slider", name="Timeline").focus()
    page.keyboard.press("End")
    last = decode["frames"][-1]["frame"]
    page.locator("figcaption", has_text=f"Frame {last}").wait_for()
    page.keyboard.press("Home")
    page.locator("figcaption", has_text=f"Frame {decode['frames'][0]['frame']}").wait_for()
    expect(page.locator(".findings")).to_contain_text("Plates that passed by")


def test_one_timeline_moves_all_decodes_of_a_drive(
    watched: Watched, trace: dict[str, Any], drive: dict[str, Any]
) -> None:
    page = watched.open(f"/decodes/{drive['id']}?with={trace['id']}")
    drawn(page)
    page.locator(".chart canvas").wait_for()
    until(page, "!document.querySelector('main .chart-figure .loading')")
    slider = page.get_by_role("slider", name="Timeline")
    slider.focus()
    page.keyboard.press("Home")
    page.locator("figcaption", has_text="0000.jpg").wait_for()
    moved = "document.querySelector('.chart-cursor').style.transform"
    before = page.evaluate(moved)
    page.get_by_role("button", name="Next reading").click()
    page.get_by_role("button", name="Next reading").click()
    page.locator("figcaption", has_text="0002.jpg").wait_for()
    until(page, f"{moved} !== {before!r}")
    page.get_by_label("Speed").select_option("16")
    page.get_by_role("button", name="Play").click()
    page.locator("figcaption", has_text="0007.jpg").wait_for()
    page.get_by_role("button", name="Remove").click()
    until(page, "document.querySelectorAll('.decode-signals > section').length === 1")
    until(page, "!location.search.includes('with=')")


def test_one_track_is_estimated_from_the_decodes_shown(
    watched: Watched, trace: dict[str, Any], drive: dict[str, Any]
) -> None:
    page = watched.open(f"/decodes/{drive['id']}?with={trace['id']}")
    page.get_by_role("button", name="Estimate one track").click()
    page.wait_for_url("**drive=*")
    page.get_by_role("button", name="Hide this track").wait_for()
    expect(page.locator(".drive-track")).to_contain_text("markers used")
    with page.expect_download() as download:
        page.locator(".drive-track").get_by_role("button", name="Track (GPX)").click()
    assert "<wpt" in Path(download.value.path()).read_text()  # the markers that were used
    page.reload()
    page.get_by_role("button", name="Hide this track").click()
    page.get_by_role("button", name="Estimate one track").wait_for()


# --- history ------------------------------------------------------------------------------------------------------


def test_the_history_is_filtered_and_decodes_are_shown_together(
    watched: Watched, trace: dict[str, Any], drive: dict[str, Any]
) -> None:
    page = watched.open("/decodes")
    page.get_by_role("link", name="frames.zip").first.wait_for()
    page.locator("#filter-kind").select_option("trace")
    page.wait_for_url("**kind=trace")
    until(page, "!document.querySelector('main tbody').innerText.includes('frames.zip')")
    held: list[Route] = []
    page.route("**/v1/decodes?*", lambda route: held.append(route))
    page.reload()
    expect(page.locator("#filter-kind")).to_have_value("trace")
    page.locator("#filter-vehicle").fill("nobody")
    while not held:
        page.wait_for_timeout(20)
    held[0].continue_()
    page.unroute("**/v1/decodes?*")
    page.get_by_role("link", name="drive.zip").first.wait_for()
    expect(page.locator("#filter-vehicle"), "what is being typed stays when rows arrive").to_have_value("nobody")
    page.locator("#filter-vehicle").press("Tab")
    page.get_by_text("No decode fits these filters").wait_for()
    page.get_by_role("button", name="Show all decodes").click()
    page.get_by_role("link", name="frames.zip").first.wait_for()
    page.get_by_label("Select frames.zip").first.check()
    page.get_by_label("Select drive.zip").first.check()
    page.get_by_role("link", name="Show 2 together").click()
    page.locator(".decode-signals > section").nth(1).wait_for()


# --- speed --------------------------------------------------------------------------------------------------------

DRAW = """async (count) => {
  const { createChart } = await import("/static/app/plot/chart.js");
  const { thin } = await import("/static/app/plot/thin.js");
  const t = Float64Array.from({ length: count }, (_, k) => k / 350);
  const noise = Float64Array.from({ length: count }, (_, k) => 5 * Math.sin(k / 7) + ((k * 7919) % 100) / 30);
  noise[54321] = 900;
  const box = document.createElement("div");
  document.querySelector("main").append(box);
  const columns = [{ label: "a", values: noise, colour: (c) => c.accent }];
  const chart = await createChart(box, { t, columns, height: 300, unit: "", timeText: String });
  const times = [];
  for (let turn = 0; turn < 5; turn += 1) {
    const began = performance.now();
    chart.reset();
    await new Promise((done) => queueMicrotask(done));
    times.push(performance.now() - began);
  }
  const [at, values] = thin(t, [noise], 0, t[count - 1], 1000);
  const rising = at.every((value, k) => !k || value >= at[k - 1]);
  return { times, points: at.length, peak: Math.max(...values), rising };
}"""


def test_a_trace_of_100_000_samples_is_drawn_from_its_extremes(watched: Watched) -> None:
    """Prints how long drawing takes; what must hold on a busy machine, too, is that few points show every peak."""
    page = watched.open("/decode")
    page.locator("main h1").wait_for()
    found = page.evaluate(DRAW, 100_000)
    print(f"100,000 samples: drawn in {min(found['times']):.1f} ms (best of 5), {max(found['times']):.1f} ms (worst)")
    assert found["points"] == 2000
    assert found["peak"] == 900
    assert found["rising"]


@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_axe_finds_nothing_on_results(
    new_page: OpenPage, trace: dict[str, Any], drive: dict[str, Any], size: tuple[int, int]
) -> None:
    watched = new_page(size=size, reduced_motion="reduce")
    for path in (f"/decodes/{drive['id']}?with={trace['id']}&at=1780300805", "/decodes"):
        page = watched.open(path)
        page.locator("main table").first.wait_for()
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme)
            wait_until_quiet(watched)
            assert audit(watched) == []
        if size == PHONE:
            assert page.evaluate("document.scrollingElement.scrollWidth") <= size[0]


def test_results_fit_a_small_window_in_german(new_page: OpenPage, trace: dict[str, Any]) -> None:
    watched = new_page(size=(320, 640), locale="de-DE")
    page = watched.open(f"/decodes/{trace['id']}")
    page.locator(".chart canvas").wait_for()
    wait_until_quiet(watched)
    assert page.evaluate("document.scrollingElement.scrollWidth") <= 320
    for word in ("null", "undefined", "NaN", "[object"):
        expect(page.locator("main")).not_to_contain_text(word)
