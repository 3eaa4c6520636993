"""Installation drawings: strips that fit their rows, and what is printed on the sheets."""

from __future__ import annotations

import io
import subprocess
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pikepdf
import pytest

from app.errors import InvalidParameter
from app.formats.alignments.geometry import StationEquation, Stationing
from app.planning.outputs.drawing_sheet import PAGE_MM, TitleBlock
from app.planning.outputs.strip_layout import ROW_MM, SCALES, STRIP_MM, Strip, cut_strips
from app.planning.outputs.strip_map import NOT_SURVEYED, Drawings
from app.planning.plan import Plan
from tests.machine import require_tool
from tests.planning.outputs.made import ALL, full_plan, plan_of
from tests.planning.roads import GEOD, bend, lane_of_curvature, opposite, road, straight


def texts(data: bytes, tmp_path: Path) -> list[str]:
    """Text of each page by poppler."""
    path = tmp_path / "drawings.pdf"
    path.write_bytes(data)
    run = subprocess.run([require_tool("pdftotext"), "-raw", path, "-"], capture_output=True, text=True, check=True)
    return [" ".join(page.split()) for page in run.stdout.split("\f")[:-1]]


def drawn(plan: Plan, **options: Any) -> bytes:
    drawings = Drawings(plan, **options)
    assert drawings.names == ("drawings.pdf",)
    return drawings.write("drawings.pdf")


def heights_mm(strip: Strip) -> float:
    points = np.concatenate([np.concatenate([p.left_mm, p.right_mm]) for p in strip.pieces()])
    return float(np.ptp(points[:, 1]))


@pytest.mark.parametrize("scale", [None, *SCALES])
def test_strips_show_every_marker_once_without_gaps(scale: int | None) -> None:
    plan = full_plan()
    strips = cut_strips(plan, scale)
    assert sorted(np.concatenate([strip.markers for strip in strips])) == list(range(len(plan.markers)))
    assert strips[0].from_m == 0
    assert strips[-1].to_m == pytest.approx(plan.alignment.lanes[0].length_m)
    for a, b in pairwise(strips):
        assert a.to_m == b.from_m
        assert a.continued_right
        assert b.continued_left
    for strip in strips:
        assert (strip.to_m - strip.from_m) * 1000 / strip.scale <= STRIP_MM * 1.03
        assert heights_mm(strip) <= ROW_MM


def test_places_on_paper_are_to_scale_with_the_road_along_x() -> None:
    plan = full_plan()
    for strip in cut_strips(plan, 500):
        chosen = [plan.markers[k] for k in strip.markers]
        paper = strip.to_paper(np.array([m.lon_deg for m in chosen]), np.array([m.lat_deg for m in chosen]))
        first, last = chosen[0], chosen[-1]
        metres = GEOD.inv(first.lon_deg, first.lat_deg, last.lon_deg, last.lat_deg)[2]
        assert np.hypot(*(paper[-1] - paper[0])) == pytest.approx(metres * 1000 / 500, abs=0.01)
        ends = next(strip.pieces()).centre_mm[[0, -1]]
        assert ends[0, 1] == pytest.approx(ends[1, 1], abs=2.0)
        assert ends[0, 0] < ends[1, 0], "stations grow to the right"


def test_match_lines_lie_on_round_stations() -> None:
    lane = straight(1000)
    lane = replace(lane, station_m=lane.station_m + 37.3)
    strips = cut_strips(plan_of(road(lane), plates={}), 250)
    stations = [strip.stations_m[1] for strip in strips[:-1]]
    assert stations == pytest.approx([round(station / 5) * 5 for station in stations], abs=1e-6)


def test_a_lane_of_falling_stations_is_drawn_with_growing_ones() -> None:
    lane = straight(300)
    lane = replace(lane, station_m=lane.station_m[::-1].copy())
    strips = cut_strips(plan_of(road(lane), plates={}))
    assert [strip.stations_m[0] for strip in strips] == sorted(strip.stations_m[0] for strip in strips)
    assert strips[0].bearing_deg == pytest.approx(
        lane.heading_deg[0] - 180 if lane.heading_deg[0] > 180 else 260, abs=0.1
    )


def test_a_tight_bend_is_cut_into_shorter_strips() -> None:
    curvature = np.full(400, 1 / 25.0)
    strips = cut_strips(plan_of(road(lane_of_curvature(curvature, speed_kmh=20)), lines={}))
    assert all(heights_mm(strip) <= ROW_MM for strip in strips)
    assert max(strip.to_m - strip.from_m for strip in strips) < 0.8 * STRIP_MM / 1000 * strips[0].scale


def test_stations_that_fall_are_numbered() -> None:
    plan = plan_of(road(straight(300)), plates={})
    turn = Stationing(1000.0, (StationEquation(155.5, 1155.5, 1155.5, -1.0),))
    plan = replace(plan, alignment=replace(plan.alignment, stationing={plan.alignment.lanes[0].road: turn}))
    places, stations = cut_strips(plan)[0].reference.round_stations(10.0)
    wanted = {(at, 1000.0 + at if at < 155.5 else 1311.0 - at) for at in (*range(0, 151, 10), *range(161, 300, 10))}
    assert {(round(at), round(station)) for at, station in zip(places.tolist(), stations.tolist(), strict=True)} == {
        (round(at), round(station)) for at, station in wanted
    }


def test_long_roads_get_smaller_scales_and_few_sheets() -> None:
    scales = [cut_strips(plan_of(road(straight(metres)), plates={}))[0].scale for metres in (500, 15_000, 40_000)]
    assert scales == [250, 500, 1000]


def test_sheets_are_a3_and_say_what_a_crew_needs(tmp_path: Path) -> None:
    plan = full_plan()
    equation = StationEquation(320.0, 320.0, 1000.0)
    stationing = {lane.road: Stationing(0.0, (equation,)) for lane in plan.alignment.lanes}
    plan = replace(plan, alignment=replace(plan.alignment, stationing=stationing, surveyed=False))
    block = TitleBlock("Road Agency", "RA-77", "2026-11-22", "A. Smith", "B. Jones")
    data = drawn(plan, block=block, scale=500)
    with pikepdf.open(io.BytesIO(data)) as file:
        for page in file.pages:
            size = [float(v) * 25.4 / 72 for v in page.MediaBox]
            assert size == pytest.approx([0, 0, *PAGE_MM], abs=0.01)
    pages = texts(data, tmp_path)
    strips = cut_strips(plan, 500)
    assert len(pages) == 1 + -(-len(strips) // 3)
    for number, page in enumerate(pages, 1):
        for text in (
            "Road Agency",
            "RA-77",
            "2026-11-22",
            "A. Smith",
            "B. Jones",
            NOT_SURVEYED,
            f"{number} / {len(pages)}",
        ):
            assert text in page, text
    assert f"{plan.counts['plate']} plates" in pages[0]
    whole = " ".join(pages[1:])
    for text in ("1 : 500", "station equation", "1+000", "bridge", "stop line", "lane 2", "0+100"):
        assert text in whole, text
    assert "MATCH" in whole
    plates = [str(marker.number) for marker in plan.markers if marker.family == "plate"]
    assert all(number in whole.split() for number in plates), "each plate has its number"
    assert "stop line ahead" in whole


def test_a_surveyed_road_has_no_warning(tmp_path: Path) -> None:
    assert not any(NOT_SURVEYED in page for page in texts(drawn(full_plan()), tmp_path))


def test_pages_are_printed_inside_the_frame(tmp_path: Path) -> None:
    path = tmp_path / "drawings.pdf"
    path.write_bytes(drawn(plan_of(road(bend(60), opposite(bend(60), "2")), **ALL), scale=250))
    command = [require_tool("pdftoppm"), "-r", "50", "-gray", path, tmp_path / "page"]
    run = subprocess.run(command, capture_output=True, check=True)
    assert not run.stderr
    pictures = sorted(tmp_path.glob("page*.pgm"))
    assert pictures
    for picture in pictures:
        head, rest = picture.read_bytes().split(b"255\n", 1)
        width, height = (int(v) for v in head.split()[1:3])
        pixels = np.frombuffer(rest, dtype=np.uint8).reshape(height, width)
        dark = np.argwhere(pixels < 200)
        mm = dark[:, ::-1] * 25.4 / 50
        assert mm[:, 0].min() > 14
        assert mm[:, 0].max() < 416
        assert mm[:, 1].min() > 4
        assert mm[:, 1].max() < 293
        assert 0.01 < len(dark) / pixels.size < 0.2


def test_the_same_plan_gives_the_same_bytes() -> None:
    assert drawn(full_plan()) == drawn(full_plan())


def test_many_sheets_become_several_files(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("app.planning.outputs.strip_map.MAX_SHEETS", 2)
    drawings = Drawings(plan_of(road(straight(1500)), plates={}), scale=250)
    assert drawings.names == ("drawings-1.pdf", "drawings-2.pdf", "drawings-3.pdf")
    pages = [page for name in drawings.names for page in texts(drawings.write(name), tmp_path)]
    assert [f"{k} / {len(pages)}" in page for k, page in enumerate(pages, 1)] == [True] * len(pages)
    assert len(pages) == 1 + 6


@pytest.mark.parametrize(("scale", "part"), [(300, "1 : 250, 1 : 500"), (250, "3 strips")])
def test_unusable_scales_are_refused(scale: int, part: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.planning.outputs.strip_layout.MAX_STRIPS", 3)
    with pytest.raises(InvalidParameter) as raised:
        Drawings(full_plan(), scale=scale)
    assert raised.value.field == "scale"
    assert part in str(raised.value.limit)
    assert raised.value.cure
