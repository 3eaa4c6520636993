"""The demo, as a stranger runs it."""

from __future__ import annotations

import csv
import itertools
import json
import math
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from app.demo.drive import DATA, drive_over, list_plates
from app.demo.lane import list_lane_places
from app.demo.table import Pass, draw_table
from app.geodesy import enu_from_wgs84
from app.markers.plate import PlateCode

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.slow
def test_the_demo_reads_every_plate(tmp_path: Path) -> None:
    command = [sys.executable, "-c", "from app.cli import main; main()", "demo", "--out", str(tmp_path / "out")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=290)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = re.findall(r"^\d +[\w-]+ +\w{12} +(\d+) +(\d+) +(\d+) +(\d+) +([\d.]+)", done.stdout, re.MULTILINE)
    assert len(rows) == 6
    for in_view, decoded, wrong, matched, error_cm in rows:
        assert int(in_view) >= int(decoded) == int(matched) >= 4
        assert int(wrong) == 0
        assert float(error_cm) < 10
    assert re.search(r"paper, figure 10 .* 11 +4", done.stdout)
    out = tmp_path / "out"
    assert {path.suffix for path in (out / "artwork").iterdir()} == {".svg", ".pdf", ".dxf", ".png"}
    assert "023792168411.pdf" in {path.name for path in (out / "artwork").iterdir()}
    assert len(json.loads(zipfile.ZipFile(out / "artwork.zip").read("manifest.json"))["plates"]) == 6
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
