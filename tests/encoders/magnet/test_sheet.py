"""Drilling sheets read back: CSV by csv, GeoJSON by shapely and pyproj, PDF by pikepdf and poppler."""

from __future__ import annotations

import csv
import io
import itertools
import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pikepdf
import pytest
from pyproj import Geod
from shapely.geometry import shape

from app.encoders.magnet import DrillingSheet, SheetFormat, place_line, place_tag, write_sheet
from app.encoders.magnet.sheets import HOLE_LINE_MM, PAGE_MM, plan_scale
from app.markers.magnet import InformationTag, LineStyle
from app.markers.magnet_design import Meaning, MeaningKind
from app.planning.magnet_checks import Neighbour, Site, drilling_sheet
from app.roads.lane_line import LaneLine

WGS84 = Geod(ellps="WGS84")
TAG = InformationTag.from_gaps("SNS", 0.1, [10, 30])
SEVEN = InformationTag.from_gaps("NSNSNSN", 0.5, [1, 2, 1, 4, 1, 3])
LONG = InformationTag.from_gaps("NNS", 0.5, [1, 59])
MM_PER_POINT = 25.4 / 72
FORMULAS = ["=1+1", "+1+1", "-1-1", "@SUM(A1)", "＝1+1"]


def tag_sheet(
    lane: LaneLine, tag: InformationTag = TAG, name: str = "tag 7", meaning: Meaning | None = None
) -> DrillingSheet:
    site = Site(13.41, 140.0, ("sedan", "van"), readable_clearance_m=0.3)
    near = Neighbour("near", *lane.lon_lat(lane.at(90.0)))
    return drilling_sheet(place_tag(lane, tag, 70.0, name=name, meaning=meaning), site, (near,))


def line_sheet(lane: LaneLine) -> DrillingSheet:
    return drilling_sheet(place_line(lane, LineStyle.DASHED, name="line 3"))


def rows_of(sheet: DrillingSheet) -> list[dict[str, str]]:
    content = write_sheet(sheet, SheetFormat.CSV).decode("utf-8")
    return list(csv.DictReader(io.StringIO(content, newline="")))


def document_of(sheet: DrillingSheet) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(write_sheet(sheet, SheetFormat.GEOJSON))
    return document


def distances(positions: list[tuple[float, float]]) -> np.ndarray:
    return np.array([WGS84.inv(*a, *b)[2] for a, b in itertools.pairwise(positions)])


# --- csv and geojson --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tag", [TAG, SEVEN])
def test_holes_of_the_csv_are_where_the_code_wants_them(bend: LaneLine, tag: InformationTag) -> None:
    rows = rows_of(tag_sheet(bend, tag))
    on_earth = distances([(float(r["lon_deg"]), float(r["lat_deg"])) for r in rows])
    np.testing.assert_allclose(on_earth, tag.gaps_m, atol=0.001)
    on_plane = np.array([(float(r["east_m"]), float(r["north_m"])) for r in rows])
    np.testing.assert_allclose(np.linalg.norm(np.diff(on_plane, axis=0), axis=1), tag.gaps_m, atol=0.0003)
    np.testing.assert_allclose([float(r["from_previous_m"]) for r in rows], [0, *tag.gaps_m], atol=0.0001)
    np.testing.assert_allclose([float(r["from_first_m"]) for r in rows], tag.offsets_m, atol=0.0001)
    assert "".join(r["polarity"] for r in rows) == "".join(tag.polarities)
    assert {r["phi_deg"] for r in rows} == {"0"}
    bearings = [float(r["north_pole_bearing_deg"]) for r in rows]
    positions = [(float(r["lon_deg"]), float(r["lat_deg"])) for r in (rows[0], rows[-1])]
    forward = WGS84.inv(*positions[0], *positions[1])[0]
    for row, bearing in zip(rows, bearings, strict=True):
        wanted = forward + (0 if row["polarity"] == "N" else 180)
        assert abs((bearing - wanted + 180) % 360 - 180) < 0.02
        assert 0 <= bearing < 360


def test_holes_of_a_line_follow_it(bend: LaneLine) -> None:
    rows = rows_of(line_sheet(bend))
    on_earth = distances([(float(r["lon_deg"]), float(r["lat_deg"])) for r in rows])
    np.testing.assert_allclose(on_earth, [float(r["from_previous_m"]) for r in rows[1:]], atol=0.001)
    assert on_earth.max() <= 6.0
    assert {(r["polarity"], r["phi_deg"], r["north_pole"], r["north_pole_bearing_deg"]) for r in rows} == {
        ("S", "90", "down", "")
    }


def test_geojson_is_rfc_7946(bend: LaneLine) -> None:
    sheet = tag_sheet(bend, SEVEN, meaning=Meaning(MeaningKind.BEND_RIGHT, 125))
    document = document_of(sheet)
    assert document["type"] == "FeatureCollection"
    assert "crs" not in document
    positions = []
    for i, feature in enumerate(document["features"]):
        assert set(feature) == {"type", "id", "geometry", "properties"}
        assert feature["type"] == "Feature"
        assert feature["properties"]["hole"] == i + 1
        point = shape(feature["geometry"])
        positions.append((point.x, point.y))
    assert -77.2 < positions[0][0] < -77.1  # longitude first
    np.testing.assert_allclose(distances(positions), SEVEN.gaps_m, atol=0.001)
    about = document["waymark"]
    assert (about["code"], about["meaning"]) == (SEVEN.text, {"kind": "bend-right", "value": 125.0})
    assert about["bill"]["materials"][0]["high_usd"] == 7.0
    assert {check["name"]: check["passed"] for check in about["checks"]} == {c.name: c.passed for c in sheet.checks}
    assert about["passed"] is False  # vans
    assert all(check["source"] and check["limit"] is not None for check in about["checks"])


@pytest.mark.parametrize("text", FORMULAS)
def test_no_text_is_a_formula(bend: LaneLine, text: str) -> None:
    rows = rows_of(tag_sheet(bend, name=text, meaning=Meaning(MeaningKind.NOTICE, text)))
    assert {rows[0]["layout"], rows[0]["meaning"]} == {f"'{text}"}


def test_names_with_separators_survive_the_csv(bend: LaneLine) -> None:
    assert rows_of(tag_sheet(bend, name='a, "b"; c'))[0]["layout"] == 'a, "b"; c'


# --- pdf --------------------------------------------------------------------------------------------------------------


def hole_lines_mm(pdf: bytes) -> list[list[tuple[float, float]]]:
    """Places (x, y) of the holes' cross lines on each page: what is drawn with their width. [mm]"""
    pages = []
    with pikepdf.open(io.BytesIO(pdf)) as document:
        for page in document.pages:
            width, at, found = 0.0, (0.0, 0.0), []
            for operands, operator in pikepdf.parse_content_stream(page):
                values = [float(v) for v in operands] if str(operator) in ("w", "m", "l", "cm") else []
                if str(operator) == "cm":
                    assert values == [1, 0, 0, 1, 0, 0]
                elif str(operator) == "w":
                    width = values[0] * MM_PER_POINT
                elif str(operator) == "m":
                    at = (values[0] * MM_PER_POINT, values[1] * MM_PER_POINT)
                elif str(operator) == "l" and width == pytest.approx(HOLE_LINE_MM, abs=0.002):
                    assert values[0] * MM_PER_POINT == pytest.approx(at[0])
                    found.append(at)
            pages.append(found)
    return pages


@pytest.mark.parametrize(("tag", "scale"), [(TAG, 20), (SEVEN, 25)])
def test_the_plan_is_true_to_scale(bend: LaneLine, tag: InformationTag, scale: int) -> None:
    sheet = tag_sheet(bend, tag)
    assert plan_scale(sheet) == scale
    lines = hole_lines_mm(write_sheet(sheet, SheetFormat.PDF))[0]
    x_mm = np.array([x for x, _ in lines])[::2]  # above and below each magnet
    np.testing.assert_allclose(np.diff(x_mm) * scale / 1000, tag.gaps_m, atol=0.0005 * scale)
    assert x_mm.min() > 10
    assert x_mm.max() < PAGE_MM[0] - 10


def test_the_longest_tag_fits_the_plan() -> None:
    straight = LaneLine.from_lon_lat([(8.0, 49.0), (8.0, 49.003)])
    sheet = drilling_sheet(place_tag(straight, LONG, 0.0, name="long"))
    assert plan_scale(sheet) == 125
    x_mm = [x for x, _ in hole_lines_mm(write_sheet(sheet, SheetFormat.PDF))[0]][::2]
    np.testing.assert_allclose(np.diff(x_mm) * 0.125, [0.5, 29.5], atol=0.05)


def test_every_hole_of_a_line_is_drawn_once(bend: LaneLine) -> None:
    sheet = line_sheet(bend)
    pages = hole_lines_mm(write_sheet(sheet, SheetFormat.PDF))
    assert sum(len(page) for page in pages) == 2 * len(sheet.layout.holes)
    rows: dict[float, list[float]] = {}
    for x, y in pages[0][::2]:
        rows.setdefault(round(y, 1), []).append(x)
    for row in rows.values():
        np.testing.assert_allclose(np.diff(row) * 0.2, sheet.layout.holes[1].along_m, atol=0.01)


def test_the_pdf_is_a4_with_embedded_fonts_and_always_the_same(bend: LaneLine) -> None:
    content = write_sheet(tag_sheet(bend), SheetFormat.PDF)
    assert content == write_sheet(tag_sheet(bend), SheetFormat.PDF)
    with pikepdf.open(io.BytesIO(content)) as document:
        for page in document.pages:
            box = [float(v) * MM_PER_POINT for v in page.mediabox]
            assert box == pytest.approx([0, 0, 297, 210], abs=0.01)
            for font in page.resources.Font.values():
                assert "/FontFile2" in font.DescendantFonts[0].FontDescriptor
        assert str(document.docinfo.Title) == "Drilling sheet tag 7"


def pdf_text(content: bytes, tool: str, folder: Path) -> str:
    (folder / "sheet.pdf").write_bytes(content)
    command = [tool, "-layout", str(folder / "sheet.pdf"), "-"]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def test_the_pdf_says_what_the_crew_needs(bend: LaneLine, require_tool: Callable[..., str], tmp_path: Path) -> None:
    sheet = tag_sheet(bend, SEVEN, name="A7 Überholspur", meaning=Meaning(MeaningKind.BEND_RIGHT, 125))
    text = pdf_text(write_sheet(sheet, SheetFormat.PDF), require_tool("pdftotext"), tmp_path)
    for wanted in (
        "A7 Überholspur",
        SEVEN.text,
        "bend right 125 deg",
        "NOT all checks passed",
        "Plan 1 : 25",
        "page 1 of 1",
    ):
        assert wanted in text
    for row in rows_of(sheet):
        assert row["lon_deg"] in text
        assert row["lat_deg"] in text
    for check in sheet.checks:
        assert check.name in text
        assert check.source in text
    assert text.count("FAILED") == sum(not check.passed for check in sheet.checks) == 1
    assert "7.00 USD" in text


@pytest.mark.parametrize("name", ["<b>&amp;</b>", "測試 lane", "W" * 80, "(\\) %"])
def test_names_cannot_break_the_pdf(
    bend: LaneLine, name: str, require_tool: Callable[..., str], tmp_path: Path
) -> None:
    text = pdf_text(write_sheet(tag_sheet(bend, name=name), SheetFormat.PDF), require_tool("pdftotext"), tmp_path)
    assert "".join(c if ord(c) < 256 else "?" for c in name) in text


def test_north_poles_are_red_and_where_they_point(
    bend: LaneLine, require_tool: Callable[..., str], tmp_path: Path
) -> None:
    sheet = tag_sheet(bend)
    content = write_sheet(sheet, SheetFormat.PDF)
    (tmp_path / "sheet.pdf").write_bytes(content)
    per_mm = 8
    dpi = str(per_mm * 25.4)
    subprocess.run(
        [require_tool("pdftoppm"), "-r", dpi, "-png", str(tmp_path / "sheet.pdf"), str(tmp_path / "page")], check=True
    )
    picture = cv2.imread(str(next(tmp_path.glob("page*.png"))))
    lines = hole_lines_mm(content)[0]
    middle_mm = np.mean([y for _, y in lines])
    for hole, (x_mm, _) in zip(sheet.layout.holes, lines[::2], strict=True):
        row = round((PAGE_MM[1] - middle_mm - 2.0) * per_mm)
        ahead, behind = (picture[row, round((x_mm + d) * per_mm)].astype(int) for d in (4.0, -4.0))
        red, blue = (ahead, behind) if hole.polarity == "N" else (behind, ahead)
        assert red[2] > red[0] + 80
        assert blue[0] > blue[2] + 80
