"""The demo, as a stranger runs it."""

from __future__ import annotations

import copy
import csv
import itertools
import json
import math
import re
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from app.demo.drive import DATA, drive_over, list_lane_places, list_plates
from app.demo.magnets import LENGTH_M, TAGS_M, Built, Lane, build, drive_and_judge, judge_drive, list_drives
from app.demo.server import LocalServer
from app.demo.table import Pass, draw_table, draw_trace_table
from app.geodesy import enu_from_wgs84
from app.markers.plate import PlateCode
from app.simulation.magnetic.drive import simulate_drive
from benchmarks.readme import DEMO, find_demo
from tests.http import WITHIN_S

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]


def comparable(text: str) -> list[tuple[str, list[float]]]:
    """Lines of a demo's output without what every run changes: their text with numbers left out, and the numbers."""
    text = re.sub(r"127\.0\.0\.1:\d+|(?<=is proved\. )\d+ s", "", text)
    lines = [re.sub(r"-{3,}", "-", " ".join(line.split())) for line in text.strip().splitlines()]
    number = re.compile(r"\d+(?:,\d{3})*(?:\.\d+)?")
    return [(number.sub("#", line), [float(n.replace(",", "")) for n in number.findall(line)]) for line in lines]


def assert_documented(printed: str) -> None:
    """docs/demo.md shows what the demo prints: the same lines, with figures within 30 % or 2.5 of their last unit.

    The README shows some of these lines as they are there (`tests/test_docs.py`). ``python -m benchmarks --only demo``
    and ``python -m benchmarks.readme bench-out/demo.md`` put them into both.
    """
    shown, got = comparable(find_demo(DEMO.read_text())), comparable(printed)
    assert [line for line, _ in got] == [line for line, _ in shown]
    for (line, expected), (_, numbers) in zip(shown, got, strict=True):
        assert numbers == pytest.approx(expected, rel=0.3, abs=2.5), line


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("6 plates", "5 tags"),
        ("40 ft", "60 ft"),
        ("Registered 6 plates", "Registered 6 plates\nand 7"),
        ("0 failed", "4 failed"),
    ],
)
def test_a_stale_demo_in_the_documents_is_noticed(old: str, new: str) -> None:
    shown = find_demo(DEMO.read_text())
    assert_documented(shown.replace("127.0.0.1:2", "127.0.0.1:3"))
    with pytest.raises(AssertionError):
        assert_documented(shown.replace(old, new, 1))


def test_the_demo_reads_every_plate_and_tag(tmp_path: Path) -> None:
    command = [sys.executable, "-c", "from app.cli import main; main()", "demo", "--out", str(tmp_path / "out")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=WITHIN_S)
    assert done.returncode == 0, done.stdout + done.stderr
    assert_documented(done.stdout.replace(str(tmp_path / "out"), "demo-out"))
    rows = re.findall(r"^\d +[\w-]+ +\w+ +(\d+) +(\d+) +(\d+) +(\d+) +([\d.]+)", done.stdout, re.MULTILINE)
    assert len(rows) == 6
    for in_view, decoded, wrong, matched, error_cm in rows:
        assert int(in_view) >= int(decoded) == int(matched) >= 4
        assert int(wrong) == 0
        assert float(error_cm) < 10
    assert re.search(r"paper, figure 10 .* 11 +4", done.stdout)
    drives = re.findall(
        r"^[a-z, ]+ (\d+) cm +\d+ +(\d+) of (\d+) +5 of 5 +5 +0 +([05]) +([01]\.\d+) ± \S+ +([\d.]+) +([\d.]+) "
        r" .* (\d+)$",
        done.stdout,
        re.MULTILINE,
    )
    assert [(row[0], row[3]) for row in drives] == [("16", "0"), ("30", "0"), ("16", "5")]
    for _clearance, found, passed, _flagged, ratio, along_cm, across_cm, false in drives:
        assert int(found) == int(passed) >= 15
        assert int(false) == 0
        assert abs(float(ratio) - 1) < 0.01
        assert float(along_cm) < 3
        assert float(across_cm) < 3
    assert re.search(r"^ordinary .* 1 of 1 +1 of 1 ", done.stdout, re.MULTILINE)
    lanes = re.findall(
        r"^([a-z0-9, ]+?) +40 +(\d+) +(\d+) +(\d+) +(-|\d+) +([\d.]+) +([\d.]+) +([\d.]+) % +([\d.]+) +([\d.]+)$",
        done.stdout,
        re.MULTILINE,
    )
    assert [row[0] for row in lanes] == ["ordinary", "forged, replayed", "a marker moved", "2 m positions"]
    assert [row[4] != "-" for row in lanes] == [False, False, True, False]
    for name, packets, accepted, refused, _out, rms_cm, _worst, coverage, _own, steering_cm in lanes:
        assert int(packets) == int(accepted) + int(refused)
        assert int(refused) == (400 if name.startswith("forged") else 0)
        assert float(rms_cm) < 5
        assert float(coverage) > 99.5
        assert float(steering_cm) < 8
    assert re.search(
        r"Placed 30 plates, 735 line magnets, \d+ CERPMs on 2\.93 km .* EUR at\nthe .* Checks: .*, 0 failed\.",
        done.stdout,
    )
    proofs = re.findall(r"^(?:day|wear) +(plates|line magnets) +(\d+) +(\d+) +\d+ %", done.stdout, re.MULTILINE)
    assert [kind for kind, _passes, _read in proofs] == ["line magnets", "line magnets", "plates", "plates"]
    assert all(int(read) >= 0.7 * int(passes) > 0 for _kind, passes, read in proofs)
    assert "Wrong readings: 0. The plan is proved." in done.stdout
    assert re.search(r"METRO, curvy road .* 0\.965 ± 0\.044", done.stdout)
    out = tmp_path / "out"
    assert len(list((out / "layouts").glob("*.pdf"))) == 7
    assert (out / "trace.svg").read_text().startswith("<svg")
    assert len(zipfile.ZipFile(out / "drive.zip").namelist()) == 3
    assert {path.suffix for path in (out / "artwork").iterdir()} == {".svg", ".pdf", ".dxf", ".png"}
    assert "023792168411.pdf" in {path.name for path in (out / "artwork").iterdir()}
    assert len(json.loads(zipfile.ZipFile(out / "artwork.zip").read("manifest.json"))["plates"]) == 6
    assert (out / "plan/drawings.pdf").read_bytes()[:5] == b"%PDF-"
    with (out / "plan/bill.csv").open() as file:
        assert [row["cost"] for row in csv.DictReader(file) if row["section"] == "total"] != [""]
    assert (out / "annotated.jpg").read_bytes()[:2] == b"\xff\xd8"
    with (out / "frames.csv").open() as file:
        assert sum(row["decoded"] == "True" for row in csv.DictReader(file)) == sum(int(row[1]) for row in rows)


def test_places_lie_in_the_middle_of_the_lane_and_point_along_it() -> None:
    lane = json.loads((DATA / "lane.geojson").read_text())
    sides = {f["properties"]["side"]: np.array(f["geometry"]["coordinates"]) for f in lane["features"]}
    places = list_lane_places(lane, [30.0, 60.0, 120.0], 165.0)
    for place in places:
        origin = (place.lon_deg, place.lat_deg, 165.0)
        gaps = {}
        for side, line in sides.items():
            points = np.array([enu_from_wgs84(lon, lat, 165.0, origin)[:2] for lon, lat in line])
            dense = np.concatenate(
                [np.linspace(a, b, 400) for a, b in itertools.pairwise(points)]
            )  # fmt: skip
            nearest = dense[np.argmin(np.linalg.norm(dense, axis=1))]
            heading = math.radians(place.heading_deg)
            gaps[side] = float(nearest @ (-math.cos(heading), math.sin(heading)))  # to the left of travel
        assert gaps["L"] == pytest.approx(-gaps["R"], abs=0.1)
        assert 1.2 < gaps["L"] < 2.0
    ahead = enu_from_wgs84(places[1].lon_deg, places[1].lat_deg, 165.0, (places[0].lon_deg, places[0].lat_deg, 165.0))
    assert np.linalg.norm(ahead) == pytest.approx(30.0, abs=0.3)


def test_the_drive_is_the_same_every_time() -> None:
    plate = list_plates(np.random.default_rng(5))[0]
    frames = [next(drive_over(plate.place, PlateCode("023792168411"), np.random.default_rng(5))) for _ in range(2)]
    assert frames[0] == frames[1]
    coarse = frames[0].context["coarse_position"]
    origin = (frames[0].lon_deg, frames[0].lat_deg, 0.0)
    assert 2.0 <= np.linalg.norm(enu_from_wgs84(coarse["lon_deg"], coarse["lat_deg"], 0.0, origin)[:2]) <= 5.0


def test_one_wrong_reading_fails_the_demo() -> None:
    good = Pass("1", "position", "023792168411", 11, 4, 0, 4, [0.01] * 4, [0.1] * 4)
    wrong = Pass("2", "position", "023792168412", 11, 4, 1, 4, [0.01] * 4, [0.1] * 4)
    unmatched = Pass("3", "position", "023792168413", 11, 4, 0, 3, [0.01] * 4, [0.1] * 4)
    assert [p.is_good for p in (good, wrong, unmatched)] == [True, False, False]
    table = draw_table([good, wrong])
    assert re.search(r"mean of a drive +11\.0 +4\.0 +0\.5 +4\.0 +1\.0 +0\.10", table)


@pytest.fixture(scope="module")
def local_client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """A server of its own."""
    with LocalServer(tmp_path_factory.mktemp("demo")) as server, server.client() as client:
        yield client


@pytest.fixture(scope="module")
def built(local_client: httpx.Client, tmp_path_factory: pytest.TempPathFactory) -> Built:
    """Magnets registered and surveyed."""
    return build(local_client, tmp_path_factory.mktemp("layouts"), np.random.default_rng(3))


def test_a_drive_on_the_wrong_way_is_read_flagged_and_placed(local_client: httpx.Client, built: Built) -> None:
    drive = list_drives()[2]
    result, decode, _recording, _context = drive_and_judge(local_client, built, drive, np.random.default_rng(3))
    assert result.is_good
    assert (result.right, result.matched, result.flagged, result.wrong, result.false) == (5, 5, 5, 0, 0)
    assert result.found == result.passed == 15
    assert max(map(abs, result.along_m + result.across_m)) < 0.04
    assert re.search(r"^wrong way +16 cm +40 +15 of 15 +5 of 5 +5 +0 +5 ", draw_trace_table([result]), re.MULTILINE)
    scene, lane = built.scene(drive)
    simulated = simulate_drive(scene, np.random.default_rng(3))

    def judged(change: Any) -> Any:
        changed = copy.deepcopy(decode)
        change(changed)
        return judge_drive(built, drive, lane, simulated, changed)

    assert judged(lambda d: None) == result
    legal = judged(lambda d: d["tags"][2].update(direction="legal"))
    assert (legal.flagged, legal.is_good) == (4, False)
    other = judged(lambda d: d["tags"][2].update(tag=d["tags"][0]["tag"]))
    assert (other.right, other.wrong, other.is_good) == (4, 1, False)
    stray = judged(lambda d: d["tags"].append({**d["tags"][0], "start_s": 1.0}))
    assert (stray.wrong, stray.is_good) == (1, False)
    astray = judged(lambda d: d["tags"][1]["fix"].update(d["tags"][2]["fix"]))
    assert not astray.is_good
    twice = judged(lambda d: d["magnets"].append(dict(d["magnets"][0])))
    assert (twice.found, twice.false) == (15, 1)
    flipped = judged(lambda d: d["magnets"][0].update(phi_deg=90))
    assert (flipped.found, flipped.false) == (14, 0)


def test_departures_are_told_once_each(local_client: httpx.Client, built: Built) -> None:
    drive = list_drives()[0]
    result, decode, _recording, _context = drive_and_judge(local_client, built, drive, np.random.default_rng(4))
    assert result.is_good
    assert result.departures == {"dashed": (1, 1, 0), "solid": (1, 1, 0)}
    scene, lane = built.scene(drive)
    simulated = simulate_drive(scene, np.random.default_rng(4))
    decode["crossings"][1]["side"] = "left"
    again = judge_drive(built, drive, lane, simulated, {**decode, "crossings": decode["crossings"][1:]})
    assert again.departures == {"dashed": (0, 1, 0), "solid": (0, 1, 1)}


def test_the_lane_driven_backwards_is_the_same_line() -> None:
    lane = Lane.legal()
    back = lane.reversed()
    for at, left in ((0.0, 0.0), (TAGS_M[2], 1.75), (LENGTH_M, -1.75)):
        assert back.lon_lat(LENGTH_M - at, -left) == pytest.approx(lane.lon_lat(at, left), abs=1e-11)
        assert lane.project_m(*lane.lon_lat(at, left)) == pytest.approx((at, left), abs=1e-4)
