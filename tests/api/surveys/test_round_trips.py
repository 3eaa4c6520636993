"""Coordinates come out of the registry as they went in: 26 systems, in every format that can carry them."""

from __future__ import annotations

import csv
import io
import json
import re
import struct
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import ezdxf
import httpx
import numpy as np
import pytest
import shapely
from pyarrow import parquet
from pyogrio import raw
from pyproj import CRS, Transformer

from app.errors import ReferenceSystemError
from app.formats.exports import ExportFrame, frame_records
from app.formats.surveys.coordinates import crs_unit
from app.formats.surveys.declaration import METRES
from app.geodesy import place_position, reference_system, use_grids
from app.geodesy.place import _height_transformer, heights_above
from app.values import Floats
from tests.machine import require_tool


class Declared(NamedTuple):
    """What an agency declares of its survey."""

    crs: str
    realization: str | None = None
    epoch: float | None = None


SYSTEMS = (
    Declared("EPSG:25832", "ETRF2000", 2026.4),  # Germany
    Declared("EPSG:25833", "ETRF2014", 2026.4),
    Declared("EPSG:25831"),  # ETRS89 without a realization
    Declared("EPSG:2154", "RGF93 v1", 2026.0),  # France
    Declared("EPSG:27700"),  # Great Britain
    Declared("EPSG:28992"),  # Netherlands
    Declared("EPSG:31370"),  # Belgium
    Declared("EPSG:2056"),  # Switzerland
    Declared("EPSG:31256"),  # Austria
    Declared("EPSG:31287"),  # Austria, one cone for the whole country
    Declared("EPSG:2180", "ETRF2000-PL", 2026.0),  # Poland
    Declared("EPSG:2178"),  # Poland, with the zone in the eastings
    Declared("EPSG:5514"),  # Czechia, axes to the south and west
    Declared("EPSG:3067", "ETRF2000", 2026.4),  # Finland
    Declared("EPSG:3006", "SWEREF99", 2026.0),  # Sweden
    Declared("EPSG:5110"),  # Norway
    Declared("EPSG:3763", "ETRF2000", 2026.4),  # Portugal
    Declared("EPSG:6539", "NAD83(2011)", 2010.0),  # New York, US survey feet
    Declared("EPSG:2992"),  # Oregon, international feet
    Declared("EPSG:7855", "GDA2020", 2026.4),  # Australia
    Declared("EPSG:2193"),  # New Zealand
    Declared("EPSG:6677"),  # Japan, northing first
    Declared("EPSG:5179"),  # Korea
    Declared("EPSG:2326"),  # Hong Kong
    Declared("EPSG:31983"),  # Brazil
    Declared("EPSG:32632", "WGS 84 (G2139)", 2026.4),  # UTM of WGS 84
)
FORMATS = ("csv", "geojson", "gpkg", "geoparquet", "flatgeobuf", "shapefile", "landxml", "dxf")
LIMIT_MM = 1.0


def places(crs: str) -> Floats:
    """Easting, northing in the unit of the system, and height [m], of three points in its area, shape (3, 3)."""
    system = reference_system(crs)
    area = system.area_of_use
    lon = area.west + 0.45 * ((area.east - area.west) % 360.0)
    lat = area.south + 0.55 * (area.north - area.south)
    x, y = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(lon, lat)
    unit = 1 / METRES[crs_unit(system)]
    steps = np.array([(0.0, 0.0, 0.0), (37.1234, 12.3456, 1.25), (-21.9876, 80.4321, -2.5)])
    table = np.round(np.array([x, y, 130.0]) + steps * [unit, unit, 1.0], 4)
    return np.asarray(table)


def survey(table: Floats, first: int) -> bytes:
    lines = [f"{first + k},{x:.4f},{y:.4f},{z:.4f}" for k, (x, y, z) in enumerate(table.tolist())]
    return "\n".join(["number,easting,northing,height", *lines]).encode()


def imported(client: httpx.Client, declared: Declared, table: Floats, road: str, first: int = 1) -> None:
    declaration = {
        "family": "cerpm", "columns": {"code": "number"}, "road": road, "crs": declared.crs,
        "vertical_datum": "ellipsoid", "height_unit": "m",
        **{name: value for name, value in declared._asdict().items() if value is not None},
    }  # fmt: skip
    form = {"declaration": json.dumps(declaration)}
    answer = client.post("/v1/imports", files={"file": ("survey.csv", survey(table, first))}, data=form)
    assert answer.status_code == 201, answer.text


def read_back(kind: str, content: bytes, folder: Path, unit_m: float) -> Floats:
    """Easting, northing and height [m] of each marker by a reader of another program, in the order of their codes."""
    rows: list[tuple[int, float, float, float]] = []
    if kind == "csv":
        for row in csv.DictReader(io.StringIO(content.decode())):
            rows.append((int(row["code"]), float(row["x"]), float(row["y"]), float(row["z_m"])))
    elif kind == "geojson":
        for feature in json.loads(content)["features"]:
            rows.append((int(feature["properties"]["code"]), *feature["geometry"]["coordinates"]))
    elif kind == "geoparquet":
        table = parquet.read_table(io.BytesIO(content)).to_pydict()
        points = shapely.get_coordinates(shapely.from_wkb(table["geometry"]), include_z=True)
        rows = [(int(code), *point) for code, point in zip(table["code"], points.tolist(), strict=True)]
    elif kind in ("gpkg", "flatgeobuf", "shapefile"):
        path = folder / {"gpkg": "a.gpkg", "flatgeobuf": "a.fgb", "shapefile": "a.shp.zip"}[kind]
        path.write_bytes(content)
        meta, _, geometry, fields = raw.read(f"/vsizip/{path}" if kind == "shapefile" else path)
        codes = fields[list(meta["fields"]).index("code")]
        points = shapely.get_coordinates(shapely.from_wkb(geometry), include_z=True)
        rows = [(int(code), *point) for code, point in zip(codes, points.tolist(), strict=True)]
    elif kind == "landxml":
        for point in ElementTree.fromstring(content).iter("{http://www.landxml.org/schema/LandXML-1.2}CgPoint"):
            north, east, up = map(float, str(point.text).split())
            rows.append((int(point.attrib["name"]), east, north, up * unit_m))
    else:
        for inserted in ezdxf.read(io.StringIO(content.decode())).modelspace():
            texts = {attribute.dxf.tag: attribute.dxf.text for attribute in inserted.attribs}
            x, y, z = inserted.dxf.insert
            rows.append((int(texts["CODE"]), x, y, z * unit_m))
    return np.array(sorted(rows), np.float64)[:, 1:]


def test_coordinates_come_out_as_they_went_in(
    client: httpx.Client, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = []
    for number, declared in enumerate(SYSTEMS):
        system = reference_system(declared.crs)
        unit_m = METRES[crs_unit(system)]
        table, road = places(declared.crs), f"road {number}"
        imported(client, declared, table, road, 3 * number + 1)
        worst_mm: dict[str, float] = {}
        for kind in FORMATS:
            asked = {} if kind in ("landxml", "dxf") else {"crs": declared.crs}
            answer = client.get(f"/v1/exports/{kind}", params={"road": road, **asked})
            assert answer.status_code == 200, f"{declared} {kind}: {answer.text}"
            folder = tmp_path / f"{number}-{kind}"
            folder.mkdir()
            found = read_back(kind, answer.content, folder, unit_m)
            away_mm = np.abs(found - table) * [unit_m * 1000, unit_m * 1000, 1000]
            worst_mm[kind] = float(away_mm.max())
        lines.append(f"| {declared.crs} {system.name} | {declared.realization or '-'} | "
                     + " | ".join(f"{worst_mm[kind]:.2f}" for kind in FORMATS) + " |")  # fmt: skip
        assert max(worst_mm.values()) < LIMIT_MM, (declared, worst_mm)
    with capsys.disabled():
        print(
            "\n".join(
                ["", f"| system | realization | {' | '.join(FORMATS)} |", "|---|---|" + "--:|" * len(FORMATS), *lines]
            )
        )


@pytest.mark.parametrize("declared", [SYSTEMS[0], SYSTEMS[2], SYSTEMS[16], SYSTEMS[20], SYSTEMS[24]])
def test_geoparquet_and_flatgeobuf_state_their_system(client: httpx.Client, tmp_path: Path, declared: Declared) -> None:
    table = places(declared.crs)
    imported(client, declared, table, "a road")
    asked = {"crs": declared.crs}
    file = parquet.ParquetFile(io.BytesIO(client.get("/v1/exports/geoparquet", params=asked).content))
    geometry = json.loads(file.metadata.metadata[b"geo"])["columns"]["geometry"]
    assert CRS.from_json_dict(geometry["crs"]) == CRS(declared.crs)
    assert geometry["geometry_types"] == ["Point Z"]
    assert geometry["bbox"] == pytest.approx([*table.min(0), *table.max(0)], abs=1e-3)
    rows = file.read().to_pydict()
    assert set(rows["geometry_crs"]) == {declared.crs}
    assert set(rows["geometry_epoch"]) == {geometry.get("epoch")}
    assert declared.epoch in (None, geometry.get("epoch"))
    boxes = [[box[name] for name in ("xmin", "ymin", "xmax", "ymax")] for box in rows["bbox"]]
    assert boxes == shapely.bounds(shapely.from_wkb(rows["geometry"])).tolist()
    path = tmp_path / "a.fgb"
    path.write_bytes(client.get("/v1/exports/flatgeobuf", params=asked).content)
    meta, *_ = raw.read(path)
    assert CRS(meta["crs"]) == CRS(declared.crs)
    assert meta["geometry_type"] == "Point Z"


def test_geoparquet_states_an_epoch_only_if_it_is_that_of_all(client: httpx.Client) -> None:
    for number, (epoch, expected) in enumerate(((2024.0, 2024.0), (2026.4, None))):
        declared = Declared("EPSG:25832", "ETRF2000", epoch)
        imported(client, declared, places(declared.crs) + number * 500, f"road {number}", 3 * number + 1)
        for asked, stated in (({"crs": "EPSG:25832"}, expected), ({"crs": "EPSG:25832", "epoch": 2020.0}, 2020.0)):
            content = client.get("/v1/exports/geoparquet", params=asked).content
            metadata = parquet.read_metadata(io.BytesIO(content)).metadata
            assert json.loads(metadata[b"geo"])["columns"]["geometry"].get("epoch") == stated


@pytest.mark.parametrize(
    ("declared", "asked"),
    [
        (Declared("EPSG:25832", "ETRF2000", 2026.4), {"crs": "EPSG:25832", "realization": "ETRF2014"}),
        (Declared("EPSG:32632", "ITRF2014", 2026.4), {"crs": "EPSG:25832", "realization": "ETRF2000"}),
        (Declared("EPSG:6539", "NAD83(2011)", 2010.0), {"crs": "EPSG:32618"}),
    ],
)
def test_other_frames_are_those_of_proj_used_directly(
    client: httpx.Client, tmp_path: Path, declared: Declared, asked: dict[str, str]
) -> None:
    """`cs2cs` with each step in its own coordinates: what is exported is what PROJ gives without this server."""
    cs2cs = require_tool("cs2cs", "proj-bin")
    table = places(declared.crs)
    imported(client, declared, table, "a road")
    unit_m = METRES[crs_unit(reference_system(asked["crs"]))]
    answer = client.get("/v1/exports/csv", params={"road": "a road", **asked})
    found = read_back("csv", answer.content, tmp_path, unit_m)
    codes = {"ETRF2000": "EPSG:7931", "ETRF2014": "EPSG:8403", "NAD83(2011)": "EPSG:6319"}  # geographic, with heights
    own, itrf = CRS(declared.crs).geodetic_crs, "EPSG:7912"
    assert own is not None
    steps: list[tuple[str, str]] = []
    frame, target = codes.get(declared.realization or "", itrf), codes.get(asked.get("realization", ""), itrf)
    lon, lat = Transformer.from_crs(declared.crs, own, always_xy=True).transform(table[:, 0], table[:, 1])
    steps += [(frame, itrf)] * (frame != itrf) + [(itrf, target)] * (target != itrf)
    rows = np.column_stack([lat, lon, table[:, 2]])
    for source, goal in steps:
        given = "\n".join(f"{a:.12f} {b:.12f} {h:.5f} {declared.epoch}" for a, b, h in rows.tolist())
        command = [cs2cs, "-f", "%.12f", source, goal]
        out = subprocess.run(command, input=given, capture_output=True, text=True, check=True, timeout=60).stdout
        rows = np.array([[float(word) for word in line.split()[:3]] for line in out.splitlines()])
    base = CRS(asked["crs"]).geodetic_crs
    assert base is not None
    x, y = Transformer.from_crs(base, asked["crs"], always_xy=True).transform(rows[:, 1], rows[:, 0])
    expected = np.column_stack([x, y, rows[:, 2]])
    assert found * [unit_m, unit_m, 1] == pytest.approx(expected * [unit_m, unit_m, 1], abs=1e-3)
    row = next(csv.DictReader(io.StringIO(answer.text)))
    assert (row["geometry_crs"], float(row["geometry_epoch"])) == (asked["crs"], declared.epoch)
    assert row["geometry_realization"] == asked.get("realization", "")


def test_an_epoch_moves_coordinates_with_their_plate(client: httpx.Client, tmp_path: Path) -> None:
    declared = Declared("EPSG:32632", "ITRF2014", 2020.0)
    table = places(declared.crs)
    imported(client, declared, table, "a road")
    wanted = {"road": "a road", "crs": "EPSG:32632", "epoch": 2030.0}
    moved = read_back("csv", client.get("/v1/exports/csv", params=wanted).content, tmp_path, 1.0) - table
    assert np.hypot(moved[:, 0], moved[:, 1]) == pytest.approx(np.full(3, 0.25), abs=0.03)  # 2.5 cm a year in Europe
    assert (moved[:, :2] > 0).all()  # to the north-east


@pytest.mark.parametrize(
    ("asked", "status", "field", "word"),
    [
        ({"crs": "EPSG:25832", "realization": "NAD83(2011)"}, 422, "realization", "not a realization"),
        ({"crs": "EPSG:25832", "vertical_datum": "EPSG:7837"}, 422, "vertical_datum", "grid"),
        ({"crs": "EPSG:25832", "vertical_datum": "EPSG:99999"}, 422, "vertical_datum", "not a vertical datum"),
        ({"crs": "EPSG:7855"}, 422, "crs", "outside the area"),
        ({"crs": "county"}, 422, "crs", "not a coordinate reference system"),
        ({"realization": "ETRF2000"}, 422, "crs", "without crs"),
        ({"crs": "EPSG:25832", "epoch": 1800}, 422, "epoch", ""),
    ],
)
@pytest.mark.parametrize("kind", ["csv", "gpkg"])
def test_frames_that_cannot_be_written_are_refused(
    client: httpx.Client, kind: str, asked: dict[str, Any], status: int, field: str, word: str
) -> None:
    declared = Declared("EPSG:25832", "ETRF2000", 2026.4)
    imported(client, declared, places(declared.crs), "a road")
    answer = client.get(f"/v1/exports/{kind}", params=asked)
    assert answer.status_code == status, answer.text
    problem = answer.json()
    assert word in problem["detail"]
    assert field in str(problem["field"])
    if word == "grid":
        assert "projsync --file" in problem["cure"]


def test_kml_is_in_wgs_84_and_landxml_is_projected(client: httpx.Client) -> None:
    declared = Declared("EPSG:25832", "ETRF2000", 2026.4)
    imported(client, declared, places(declared.crs), "a road")
    for kind, crs in (("kml", "EPSG:25832"), ("landxml", "EPSG:4258"), ("dxf", "EPSG:4258")):
        assert client.get(f"/v1/exports/{kind}", params={"crs": crs}).json()["field"] == "crs"


GEOGRAPHIC = (
    Declared("EPSG:4979", "ITRF2014", 2026.4),  # longitude, latitude and height
    Declared("EPSG:4326", "ITRF2014", 2026.4),
    Declared("EPSG:4258", "ETRF2000", 2026.4),
    Declared("EPSG:7912", None, 2026.4),
    Declared("OGC:CRS84", "ITRF2014", 2026.4),
)
AGAIN = ("csv", "geojson", "gpkg", "shapefile", "landxml", "dxf")
"""Formats of exports that surveys are read in, with their heights."""


@pytest.mark.parametrize(
    "declared",
    [*GEOGRAPHIC, *(one for one in SYSTEMS if one.crs in (
        "EPSG:25832", "EPSG:2154", "EPSG:27700", "EPSG:2056", "EPSG:31287", "EPSG:2180", "EPSG:5514", "EPSG:6539",
        "EPSG:2992", "EPSG:6677",
    ))],
    ids=lambda declared: declared.crs,
)  # fmt: skip
def test_an_export_is_imported_again(client: httpx.Client, declared: Declared) -> None:
    """With the same declaration: at the same place to 0.1 mm, and LandXML, which has four decimals, to 1 mm."""
    is_projected = reference_system(declared.crs).is_projected
    unit_m = METRES[crs_unit(reference_system(declared.crs))] if is_projected else 111_000.0
    degrees = np.array([(8.4164123451, 49.0051, 130.0), (8.4165123, 49.00523, 131.25), (8.41663, 49.0054, 127.5)])
    table = places(declared.crs) if is_projected else degrees
    declaration = {
        "family": "cerpm", "vertical_datum": "ellipsoid",
        **{name: value for name, value in declared._asdict().items() if value is not None},
    }  # fmt: skip
    names = "easting,northing" if is_projected else "lon,lat"
    lines = [f"{k},{x!r},{y!r},{z!r}" for k, (x, y, z) in enumerate(table.tolist(), 1)]
    data = "\n".join([f"number,{names},height", *lines]).encode()
    first = {**declaration, "columns": {"code": "number"}, "road": "survey", "height_unit": "m"}
    answer = client.post("/v1/imports", files={"file": ("a.csv", data)}, data={"declaration": json.dumps(first)})
    assert answer.status_code == 201, answer.text
    for kind in AGAIN:
        if not is_projected and kind in ("landxml", "dxf"):
            continue
        exported = client.get(f"/v1/exports/{kind}", params={"road": "survey", "crs": declared.crs})
        assert exported.status_code == 200, exported.text
        again = {**declaration, "road": kind, "columns": {"code": None, "road": None}, "duplicates": "store"}
        if kind not in ("landxml", "dxf") and unit_m != 1.0 and is_projected:
            again["height_unit"] = "m"
        form = {"declaration": json.dumps(again)}
        answer = client.post("/v1/imports", files={"file": (kind, exported.content)}, data=form)
        assert answer.status_code == 201, f"{kind}: {answer.text}"
        rows = csv.DictReader(
            io.StringIO(client.get("/v1/exports/csv", params={"road": kind, "crs": declared.crs}).text)
        )
        found = np.array(sorted((float(row["x"]), float(row["y"]), float(row["z_m"])) for row in rows))
        away_mm = np.abs(found - table[np.argsort(table[:, 0])]) * [unit_m * 1000, unit_m * 1000, 1000]
        assert away_mm.max() < (LIMIT_MM if kind == "landxml" else 0.1), (kind, away_mm)


def test_kml_is_imported_again(client: httpx.Client) -> None:
    """In WGS 84 and without heights, also where a WGS 84 with heights is declared."""
    declared = Declared("EPSG:4979", "ITRF2014", 2026.4)
    data = b"number,lon,lat\n1,8.4164123451,49.0051\n2,8.4165123,49.00523\n"
    declaration = {"family": "cerpm", **declared._asdict(), "columns": {"code": None, "road": None}, "road": "a"}
    form = {"declaration": json.dumps(declaration)}
    assert client.post("/v1/imports", files={"file": ("a.csv", data)}, data=form).status_code == 201
    content = client.get("/v1/exports/kml").content
    form = {"declaration": json.dumps({**declaration, "road": "b", "duplicates": "store"})}
    answer = client.post("/v1/imports", files={"file": ("a.kml", content)}, data=form)
    assert answer.status_code == 201, answer.text
    roads = [
        sorted((float(row["lon_deg"]), float(row["lat_deg"])) for row in csv.DictReader(io.StringIO(text)))
        for text in (client.get("/v1/exports/csv", params={"road": road}).text for road in ("a", "b"))
    ]
    assert np.array(roads[0]) == pytest.approx(np.array(roads[1]), abs=1e-9)


@pytest.mark.parametrize(
    ("crs", "lon_deg", "lat_deg", "grid"),
    [
        ("EPSG:27700", -1.5, 52.5, "uk_os_OSTN15_NTv2_OSGBtoETRS.tif"),
        ("EPSG:31287", 14.3, 48.2, "at_bev_AT_GIS_GRID_2021_09_28.tif"),
        ("EPSG:5514", 15.5, 49.8, None),
    ],
)
def test_a_system_without_an_accurate_transformation_is_refused_with_the_reason(
    client: httpx.Client, crs: str, lon_deg: float, lat_deg: float, grid: str | None
) -> None:
    marker = {
        "family": "cerpm", "side": "left",
        "position": {"lon_deg": lon_deg, "lat_deg": lat_deg, "realization": "ITRF2014", "epoch": 2026.4},
    }  # fmt: skip
    assert client.post("/v1/markers", json=marker).status_code == 201
    problem = client.get("/v1/exports/csv", params={"crs": crs}).json()
    assert re.search(r"at most 0.2 m to ITRF2014 is available: '.*' states [0-9.]+ m", problem["detail"]), problem
    assert problem["cure"].startswith(f"projsync --file {grid} " if grid else "choose a system on WGS 84"), problem


@pytest.mark.parametrize(("crs", "lon_deg", "lat_deg"), [("EPSG:2056", 8.2, 46.9), ("EPSG:2154", 2.3, 48.8)])
def test_a_system_is_reached_by_way_of_etrs89(client: httpx.Client, crs: str, lon_deg: float, lat_deg: float) -> None:
    """PROJ relates LV95 and Lambert-93 to ETRS89 within 0.1 m, and ETRS89 to ITRF2014 within 0.1 m."""
    position = {"lon_deg": lon_deg, "lat_deg": lat_deg, "realization": "ITRF2014", "epoch": 2026.4}
    marker = {"family": "cerpm", "side": "left", "position": position}
    assert client.post("/v1/markers", json=marker).status_code == 201
    answer = client.get("/v1/exports/csv", params={"crs": crs})
    row = next(csv.DictReader(io.StringIO(answer.text)))
    etrf = Transformer.from_crs("EPSG:9000", "EPSG:9069", always_xy=True)  # ETRF2014
    base = Transformer.from_crs("EPSG:4258", CRS(crs).geodetic_crs, always_xy=True, allow_ballpark=False)
    project = Transformer.from_crs(CRS(crs).geodetic_crs, crs, always_xy=True)
    expected = project.transform(*base.transform(*etrf.transform(lon_deg, lat_deg, 0.0, 2026.4)[:2]))
    assert (float(row["x"]), float(row["y"])) == pytest.approx(expected, abs=0.1)


def test_a_local_grid_comes_back_by_an_independent_similarity(client: httpx.Client, tmp_path: Path) -> None:
    """Least squares of its four parameters by numpy: shift, rotation and scale of a site's grid."""
    rng = np.random.default_rng(3)
    local = np.round(np.array([(1000.0, 2000.0), (1310.5, 2020.2), (1280.1, 2400.7), (990.3, 2380.9)]), 4)
    turn, scale = np.radians(31.7), 1.00021
    turned = scale * (local - local[0]) @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    known = np.round(turned + np.array([457_000.0, 5_428_000.0]) + rng.normal(0, 0.004, local.shape), 4)
    points = np.round(np.array([(1050.0, 2100.0), (1100.25, 2150.5), (1200.125, 2301.75)]), 4)
    controls = [
        {"point": f"C{k}", "easting": e, "northing": n, "local_easting": x, "local_northing": y}
        for k, ((e, n), (x, y)) in enumerate(zip(known.tolist(), local.tolist(), strict=True))
    ]
    declaration = {
        "family": "cerpm", "columns": {"code": "number"}, "crs": "EPSG:25832", "realization": "ETRF2000",
        "epoch": 2026.4, "local_grid": {"control_points": controls, "scale": "free"}, "road": "site",
    }  # fmt: skip
    lines = [f"{k},{x},{y}" for k, (x, y) in enumerate(points.tolist(), 1)]
    data = "\n".join(["number,easting,northing", *lines]).encode()
    form = {"declaration": json.dumps(declaration)}
    answer = client.post("/v1/imports", files={"file": ("a.csv", data)}, data=form)
    assert answer.status_code == 201, answer.text
    equations = np.array([row for x, y in local.tolist() for row in ((x, -y, 1, 0), (y, x, 0, 1))])
    a, b, east, north = np.linalg.lstsq(equations, known.ravel(), rcond=None)[0]
    x, y = points.T
    expected = np.column_stack([a * x - b * y + east, b * x + a * y + north])
    content = client.get("/v1/exports/csv", params={"crs": "EPSG:25832"}).text
    rows = sorted(csv.DictReader(io.StringIO(content)), key=lambda row: int(row["code"]))
    found = np.array([(float(row["x"]), float(row["y"])) for row in rows])
    assert found == pytest.approx(expected, abs=1e-4)


def test_a_compound_system_comes_back_with_its_heights(client: httpx.Client) -> None:
    table = places("EPSG:25832")
    declaration = {"family": "cerpm", "columns": {"code": "number"}, "crs": "EPSG:5555", "road": "a road"}
    form = {"declaration": json.dumps({**declaration, "realization": "ETRF2000", "epoch": 2026.4})}
    answer = client.post("/v1/imports", files={"file": ("a.csv", survey(table, 1))}, data=form)
    assert answer.status_code == 201, answer.text
    rows = list(csv.DictReader(io.StringIO(client.get("/v1/exports/csv", params={"crs": "EPSG:25832"}).text)))
    found = np.array(sorted((int(row["code"]), float(row["x"]), float(row["y"]), float(row["z_m"])) for row in rows))
    assert found[:, 1:] == pytest.approx(table, abs=1e-4)
    assert {row["geometry_vertical_datum"] for row in rows} == {"EPSG:5783"}
    declaration |= {"vertical_datum": "ellipsoid", "duplicates": "store"}
    form = {"declaration": json.dumps(declaration)}
    problem = client.post("/v1/imports", files={"file": ("a.csv", survey(table, 9))}, data=form).json()
    assert "EPSG:5783" in str(problem), problem


@pytest.mark.parametrize("declared", [SYSTEMS[0], SYSTEMS[17]], ids=lambda declared: declared.crs)
def test_heights_come_back_where_some_rows_have_none(client: httpx.Client, declared: Declared) -> None:
    """Of NAD83(2011) they are 1.3 m from those in the ITRF: before, they were kept where one row had none."""
    table = places(declared.crs)
    lines = survey(table, 1).decode().splitlines()
    lines[2] = lines[2].rpartition(",")[0] + ","
    declaration = {"family": "cerpm", "columns": {"code": "number"}, "vertical_datum": "ellipsoid", "height_unit": "m"}
    form = {"declaration": json.dumps({**declaration, **declared._asdict(), "road": "a road"})}
    answer = client.post("/v1/imports", files={"file": ("a.csv", "\n".join(lines).encode())}, data=form)
    assert answer.status_code == 201, answer.text
    place = client.get("/v1/markers").json()["items"]
    lon, lat = place[0]["position"]["lon_deg"], place[0]["position"]["lat_deg"]
    box = f"{lon - 1e-6},{lat - 1e-6},{lon + 1e-6},{lat + 1e-6}"
    for asked in ({"road": "a road"}, {"bbox": box}):
        content = client.get("/v1/exports/csv", params={"crs": declared.crs, **asked}).text
        for row in csv.DictReader(io.StringIO(content)):
            x, y, z = table[int(row["code"]) - 1].tolist()
            assert (float(row["x"]), float(row["y"])) == pytest.approx((x, y), abs=2e-4)
            assert row["z_m"] == "" if row["code"] == "2" else float(row["z_m"]) == pytest.approx(z, abs=1e-3)


UNDULATION_M = 48.25
"""Constant value of the grid. [m]"""


def geotiff(value: float, *, west: float, north: float, shape: tuple[int, int]) -> bytes:
    """A GeoTIFF 1.1 with one value at all points of a grid of one degree in ETRS89."""
    rows, columns = shape
    data = struct.pack("<f", value) * (rows * columns)
    doubles = struct.pack("<9d", 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, west, north, 0.0)  # size of a pixel, place of the first
    keys = struct.pack("<16H", 1, 1, 0, 3, 1024, 0, 1, 2, 1025, 0, 1, 2, 2048, 0, 1, 4258)
    behind = 8 + 2 + 14 * 12 + 4
    first = behind + len(doubles) + len(keys)
    entries = (
        (256, 4, 1, columns), (257, 4, 1, rows), (258, 3, 1, 32), (259, 3, 1, 1), (262, 3, 1, 1), (273, 4, 1, first),
        (277, 3, 1, 1), (278, 4, 1, rows), (279, 4, 1, len(data)), (284, 3, 1, 1), (339, 3, 1, 3),
        (33550, 12, 3, behind), (33922, 12, 6, behind + 24), (34735, 3, 16, behind + len(doubles)),
    )  # fmt: skip
    head = b"II*\0" + struct.pack("<IH", 8, len(entries))
    return head + b"".join(struct.pack("<HHII", *entry) for entry in entries) + bytes(4) + doubles + keys + data


@pytest.fixture
def quasigeoid(tmp_path: Path) -> Iterator[None]:
    """A GeoTIFF with the name of the German quasigeoid's grid, and one value."""
    (tmp_path / "de_bkg_gcg2016.tif").write_bytes(geotiff(UNDULATION_M, west=5.0, north=56.0, shape=(10, 12)))
    use_grids(tmp_path)
    yield
    use_grids(None)
    _height_transformer.cache_clear()


@pytest.mark.usefixtures("quasigeoid")
@pytest.mark.parametrize(("own", "asked", "sign"), [("EPSG:7837", "ellipsoid", 1), ("ellipsoid", "EPSG:7837", -1)])
def test_heights_are_transformed_with_a_grid(own: str, asked: str, sign: int) -> None:
    """From heights above the quasigeoid to heights above the ellipsoid of ETRS89, and back."""
    height_m, realization, epoch = 112.345, "ETRF2000", 2026.4
    placed = place_position(
        457_000.0, 5_428_000.0, height_m, crs="EPSG:25832", projected=True, realization=realization, epoch=epoch,
        ellipsoidal_height=own == "ellipsoid",
    )  # fmt: skip
    record = {
        "lon_deg": placed.lon_deg, "lat_deg": placed.lat_deg, "height_m": placed.height_m, "vertical_datum": own,
        "epoch": placed.epoch, "origin_crs": "EPSG:25832", "origin_realization": realization,
        "transform_accuracy_m": placed.transform_accuracy_m,
    }  # fmt: skip
    (framed,), problem = frame_records([record], ExportFrame("EPSG:25832", vertical_datum=asked))
    assert problem is None
    assert (framed["x"], framed["y"]) == pytest.approx((457_000.0, 5_428_000.0), abs=1e-4)
    assert framed["z_m"] == pytest.approx(height_m + sign * UNDULATION_M, abs=1e-3)
    assert framed["geometry_vertical_datum"] == asked
    (same,), _ = frame_records([record], ExportFrame("EPSG:25832"))
    assert same["z_m"] == pytest.approx(height_m, abs=1e-4)


def test_a_grid_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    (tmp_path / "us_nga_egm96_15.tif").write_bytes(b"no grid")
    use_grids(tmp_path)
    try:
        with pytest.raises(ReferenceSystemError, match=r"EPSG:5773 .* is installed, but cannot be read"):
            heights_above(*np.array([[8.4], [49.0], [112.0]]), "EPSG:32632", "ellipsoid", "EPSG:5773")
    finally:
        use_grids(None)
