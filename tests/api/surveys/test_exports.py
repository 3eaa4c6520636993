"""Markers as files: read back by GDAL, ezdxf and our own import; formulas harmless; streams whole."""

from __future__ import annotations

import csv
import io
import json
import re
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import ezdxf
import httpx
import pyarrow as pa
import pytest
import shapely
from pyarrow import parquet
from pyogrio import raw, read_info
from pyproj import CRS

from app.formats import exports as formats
from app.formats.exports import FIELDS, NUMBERS, SHAPEFILE_NAMES, TEXTS, write_csv
from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.read import read_survey
from app.registry import markers as bulk
from app.services.surveys import exports
from app.surveys.georeference import georeference_survey
from tests.conftest import LiveServer
from tests.machine import require_tool

pytestmark = pytest.mark.both_databases

LON, LAT = 8.416412345, 49.005112345


@pytest.fixture
def markers(client: httpx.Client) -> list[dict[str, float]]:
    """Three CERPMs, one with a road that a spreadsheet would run."""
    made = []
    for k in range(3):
        position = {"lon_deg": LON + k * 2e-4, "lat_deg": LAT, "height_m": 160.25 + k, "horizontal_rmse_m": 0.01}
        road = "=HYPERLINK(1)" if k == 0 else "B 10"
        marker = {"family": "cerpm", "position": position, "side": "left", "road": road}
        answer = client.post("/v1/markers", json=marker)
        assert answer.status_code == 201, answer.text
        made.append(position)
    return made


@pytest.mark.slow
def test_csv_is_harmless_and_its_numbers_are_exact(client: httpx.Client, markers: list[dict[str, float]]) -> None:
    answer = client.get("/v1/exports/csv", params={"family": "cerpm"})
    assert answer.headers["content-type"].startswith("text/csv")
    rows = list(csv.DictReader(io.StringIO(answer.text)))
    assert [float(row["lon_deg"]) for row in rows] == [m["lon_deg"] for m in markers]
    assert rows[0]["road"] == "'=HYPERLINK(1)"
    assert rows[1]["road"] == "B 10"
    assert tuple(rows[0]) == FIELDS


@pytest.mark.parametrize("text", ["=1", "+1+1", "-1-1", "@A1", "\t=1"])
def test_texts_like_formulas_get_an_apostrophe_and_numbers_none(text: str) -> None:
    record = dict.fromkeys(FIELDS) | {"road": text, "lon_deg": -77.15, "lat_deg": 1e-9}
    row = next(csv.DictReader(io.StringIO(b"".join(write_csv([[record]])).decode())))
    assert (row["road"], row["lon_deg"], row["lat_deg"]) == ("'" + text, "-77.15", "1e-09")


def test_geojson_comes_whole_also_when_empty(client: httpx.Client) -> None:
    empty = client.get("/v1/exports/geojson").json()
    assert empty == {"type": "FeatureCollection", "features": []}


@pytest.mark.parametrize("kind", ["geojson", "gpkg", "shapefile", "kml", "landxml", "dxf"])
def test_what_is_exported_can_be_imported(client: httpx.Client, markers: list[dict[str, float]], kind: str) -> None:
    answer = client.get(f"/v1/exports/{kind}")
    assert answer.status_code == 200, answer.text
    declaration = ImportDeclaration(
        family="cerpm", vertical_datum="ellipsoid", crs="EPSG:32632" if kind == "dxf" else None
    )
    table = read_survey(answer.content, declaration)
    assert table.format == kind
    placed = georeference_survey(table, declaration, 0.1).placed
    assert placed.lon_deg == pytest.approx([m["lon_deg"] for m in markers], abs=2e-9)
    assert placed.lat_deg == pytest.approx([m["lat_deg"] for m in markers], abs=2e-9)
    if kind != "kml":
        assert placed.height_m == pytest.approx([m["height_m"] for m in markers])
    named = table.texts["point" if kind == "landxml" else "code"]
    assert list(named) == ["1", "2", "3"]


def test_gdal_reads_every_field(client: httpx.Client, markers: list[dict[str, float]], tmp_path: Path) -> None:
    path = tmp_path / "markers.gpkg"
    path.write_bytes(client.get("/v1/exports/gpkg").content)
    meta, _, geometry, _ = raw.read(path)
    assert tuple(meta["fields"]) == FIELDS
    assert shapely.get_x(shapely.from_wkb(geometry)) == pytest.approx([m["lon_deg"] for m in markers])


def test_a_shapefile_has_the_fixed_names(client: httpx.Client, markers: list[dict[str, float]], tmp_path: Path) -> None:
    with zipfile.ZipFile(io.BytesIO(client.get("/v1/exports/shapefile").content)) as archive:
        archive.extractall(tmp_path)
    meta, *_ = raw.read(tmp_path / "markers.shp")
    assert list(meta["fields"]) == [SHAPEFILE_NAMES[name] for name in FIELDS]
    assert all(len(name) <= 10 for name in SHAPEFILE_NAMES.values())
    assert len(set(SHAPEFILE_NAMES.values())) == len(SHAPEFILE_NAMES) >= len(FIELDS)


def test_dxf_is_in_metres(client: httpx.Client, markers: list[dict[str, float]]) -> None:
    document = ezdxf.read(io.StringIO(client.get("/v1/exports/dxf").text))
    assert document.header["$INSUNITS"] == 6
    assert len(document.modelspace()) == 3
    audited = document.audit()
    assert (audited.errors, audited.fixes) == ([], [])
    texts = [{a.dxf.tag: (a.dxf.text, a.dxf.insert) for a in inserted.attribs} for inserted in document.modelspace()]
    assert [text["CODE"][0] for text in texts] == ["1", "2", "3"]
    assert [text["CODE"][1].z for text in texts] == [160.25, 161.25, 162.25]
    assert len({inserted.dxf.handle for inserted in document.modelspace()}) == 3


def test_too_many_markers_are_refused_before_one_is_read(
    client: httpx.Client, markers: list[dict[str, float]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(exports.MAX_WHOLE, "kml", 2)
    monkeypatch.delattr(bulk, "list_records")
    problem = client.get("/v1/exports/kml").json()
    assert (problem["status"], problem["field"], problem["limit"]) == (422, "bbox", "2 markers")
    assert problem["detail"] == "3 markers are too many for one file"


@pytest.mark.slow
def test_filters_and_refusals(client: httpx.Client, markers: list[dict[str, float]]) -> None:
    box = f"{LON - 1e-5},{LAT - 1e-5},{LON + 1e-5},{LAT + 1e-5}"
    found = json.loads(client.get("/v1/exports/geojson", params={"bbox": box}).text)["features"]
    assert len(found) == 1
    assert client.get("/v1/exports/gpkg", params={"status": "retired"}).status_code == 422
    assert client.get("/v1/exports/gpkg", params={"bbox": "1,2"}).json()["field"] == "bbox"
    assert client.get("/v1/exports/exe").status_code == 422


@pytest.mark.slow
def test_the_filters_are_those_of_the_list(client: httpx.Client, markers: list[dict[str, float]]) -> None:
    around = f"POLYGON(({LON - 1e-4} 49, {LON + 1e-4} 49, {LON + 1e-4} 49.1, {LON - 1e-4} 49.1, {LON - 1e-4} 49))"
    for wanted, params in (
        (["2", "3"], {"road": "B 10"}),
        (["2"], {"code": "2"}),
        (["1"], {"polygon": around}),
        ([], {"family": "plate"}),
        (["1", "2", "3"], {"status": "planned", "family": "cerpm"}),
    ):
        rows = list(csv.DictReader(io.StringIO(client.get("/v1/exports/csv", params=params).text)))
        assert [row["code"] for row in rows] == wanted, params
        listed = client.get("/v1/markers", params=params).json()["items"]
        assert [row["id"] for row in rows] == [marker["id"] for marker in listed]
    assert client.get("/v1/exports/csv", params={"from_m": 3}).json()["field"] == "road"
    assert client.get("/v1/exports/csv", params={"road": "A", "to_m": "nan"}).status_code == 422


@pytest.mark.parametrize("kind", ["gpkg", "flatgeobuf", "shapefile"])
def test_files_of_several_pages_hold_every_value(
    server: LiveServer, client: httpx.Client, markers: list[dict[str, float]], kind: str,
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
) -> None:  # fmt: skip
    monkeypatch.setattr(exports, "_PAGE", 2)
    monkeypatch.setattr(formats, "_GIS_PAGE", 2)
    monkeypatch.setattr(
        server.app.state.use_cases.exports, "_write", formats.write_file
    )  # other processes have another _GIS_PAGE
    low = {"family": "cerpm", "position": {"lon_deg": -77.15, "lat_deg": -1e-9}, "road": "Straße =1"}
    assert client.post("/v1/markers", json=low).status_code == 201
    path = tmp_path / {"gpkg": "markers.gpkg", "flatgeobuf": "markers.fgb", "shapefile": "markers.zip"}[kind]
    path.write_bytes(client.get(f"/v1/exports/{kind}").content)
    meta, _, geometry, fields = raw.read(path)
    names = {name: SHAPEFILE_NAMES[name] if kind == "shapefile" else name for name in FIELDS}
    order = fields[list(meta["fields"]).index("code")].argsort()  # FlatGeobuf is in the order of its spatial index
    of = {name: fields[list(meta["fields"]).index(given)][order].tolist() for name, given in names.items()}
    assert of["code"] == ["1", "2", "3", "4"]
    assert of["road"] == ["=HYPERLINK(1)", "B 10", "B 10", "Straße =1"]
    assert of["side"][:1] == ["left"]
    assert of["lon_deg"] == pytest.approx([*(m["lon_deg"] for m in markers), -77.15], abs=1e-9)
    assert of["horizontal_rmse_m"][:3] == pytest.approx([0.01] * 3)
    points = shapely.from_wkb(geometry)[order]
    assert shapely.get_y(points) == pytest.approx([m["lat_deg"] for m in markers] + [-1e-9], abs=1e-12)
    info = read_info(path)
    assert info["features"] == 4
    # a height that is unknown is none, not zero
    assert info["geometry_type"] == ("Point Z" if kind == "gpkg" else "Point")
    assert shapely.has_z(points).tolist() == [kind == "gpkg"] * 3 + [False]
    if kind == "gpkg":
        assert shapely.get_z(points[:3]).tolist() == [160.25, 161.25, 162.25]


def test_geoparquet_is_as_its_standard_has_it(client: httpx.Client, markers: list[dict[str, float]]) -> None:
    """GeoParquet 1.1.0: required members, geometry as ISO WKB, and a column of boxes that the metadata name."""
    low = {"family": "cerpm", "position": {"lon_deg": -77.15, "lat_deg": -1e-9}, "road": "Straße =1"}
    assert client.post("/v1/markers", json=low).status_code == 201
    answer = client.get("/v1/exports/geoparquet")
    assert answer.headers["content-type"] == "application/vnd.apache.parquet"
    assert "markers.parquet" in answer.headers["content-disposition"]
    file = parquet.ParquetFile(io.BytesIO(answer.content))
    assert file.metadata.row_group(0).column(0).compression == "ZSTD"
    table = file.read()
    assert table.column_names == [*FIELDS, "bbox", "geometry"]
    assert {table.schema.field(name).type for name in TEXTS} == {pa.string()}
    assert {table.schema.field(name).type for name in NUMBERS} == {pa.float64()}
    columns = table.to_pydict()
    assert columns["code"] == ["1", "2", "3", "4"]
    assert columns["road"] == ["=HYPERLINK(1)", "B 10", "B 10", "Straße =1"]
    assert columns["height_m"] == [160.25, 161.25, 162.25, None]
    assert columns["lon_deg"] == [*(m["lon_deg"] for m in markers), -77.15]
    assert [row["id"] for row in csv.DictReader(io.StringIO(client.get("/v1/exports/csv").text))] == columns["id"]
    points = shapely.from_wkb(columns["geometry"])
    assert [int.from_bytes(wkb[1:5], "little") for wkb in columns["geometry"]] == [1001, 1001, 1001, 1]
    assert shapely.get_z(points[:3]).tolist() == [160.25, 161.25, 162.25]
    bounds = shapely.bounds(points).tolist()
    assert [[box[name] for name in ("xmin", "ymin", "xmax", "ymax")] for box in columns["bbox"]] == bounds
    geo = json.loads(file.metadata.metadata[b"geo"])
    assert (geo["version"], geo["primary_column"], list(geo["columns"])) == ("1.1.0", "geometry", ["geometry"])
    about = geo["columns"]["geometry"]
    assert (about["encoding"], about["geometry_types"], about["edges"]) == ("WKB", ["Point", "Point Z"], "planar")
    assert CRS.from_json_dict(about["crs"]) == CRS("EPSG:4326")
    assert about["covering"] == {"bbox": {name: ["bbox", name] for name in ("xmin", "ymin", "xmax", "ymax")}}
    assert about["bbox"] == [-77.15, -1e-9, 160.25, markers[2]["lon_deg"], LAT, 162.25]
    assert "epoch" not in about


def test_geoparquet_has_a_row_group_for_each_page(
    client: httpx.Client, markers: list[dict[str, float]], tmp_path: Path
) -> None:
    """Its metadata are those of all pages together."""
    features = client.get("/v1/exports/geojson").json()["features"]
    records = []
    for feature in features:
        place = dict(zip(("lon_deg", "lat_deg"), feature["geometry"]["coordinates"], strict=False))
        record = {"id": feature["id"], **feature["properties"], **place}
        records.append({name: record[name] for name in FIELDS})
    written = []
    for name, pages in (("one", [records]), ("two", [records[:2], records[2:]])):
        path = tmp_path / f"{name}.parquet"
        assert formats.write_geoparquet(pages, path).left_out == ()
        written.append(parquet.ParquetFile(path))
    assert [file.metadata.num_row_groups for file in written] == [1, 2]
    assert written[0].read().equals(written[1].read())
    assert written[0].metadata.metadata[b"geo"] == written[1].metadata.metadata[b"geo"]


def test_geoparquet_needs_its_library(
    client: httpx.Client, markers: list[dict[str, float]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)  # as where the extra is not installed
    answers = client.get("/v1/exports/geoparquet"), client.post("/v1/exports", json={"format": "geoparquet"})
    for answer in answers:
        assert (answer.status_code, answer.json()["field"]) == (422, "format"), answer.text
        assert "waymark-roads[parquet]" in answer.json()["cure"]


@pytest.mark.parametrize("kind", ["shapefile", "flatgeobuf"])
def test_a_height_that_is_unknown_is_not_zero(client: httpx.Client, tmp_path: Path, kind: str) -> None:
    """Points of one file all have z or none; with a frame, heights above any datum are z."""
    for k, height in enumerate(({"height_m": 160.5, "vertical_datum": "EPSG:7837"}, {})):
        position = {"lon_deg": LON + k * 1e-3, "lat_deg": LAT, **height}
        assert client.post("/v1/markers", json={"family": "cerpm", "position": position, "road": f"{k}"}).is_success
    path = tmp_path / f"markers.{'shp.zip' if kind == 'shapefile' else 'fgb'}"
    for road, asked, z in (
        (None, {"crs": "EPSG:32632"}, [None, None]),
        ("0", {"crs": "EPSG:32632"}, [160.5]),
        ("0", {}, [None]),
    ):
        answer = client.get(f"/v1/exports/{kind}", params={**asked, **({"road": road} if road else {})})
        assert answer.status_code == 200, answer.text
        path.write_bytes(answer.content)
        points = shapely.from_wkb(raw.read(f"/vsizip/{path}" if kind == "shapefile" else path)[2])
        assert [shapely.get_z(point) if point.has_z else None for point in points] == z, (road, asked)


def test_only_ellipsoidal_heights_are_in_geometries(client: httpx.Client, tmp_path: Path) -> None:
    """RFC 7946 section 4; heights above another datum are attributes, and GDAL's own tools show no other z."""
    datums = ("ellipsoid", "EPSG:7837", None)
    for k, datum in enumerate(datums):
        height = {} if datum is None else {"height_m": 160.5, "vertical_datum": datum}
        position = {"lon_deg": LON + k * 1e-3, "lat_deg": LAT, **height}
        marker = {"family": "cerpm", "position": position, "side": "left", "road": datum or "none"}
        assert client.post("/v1/markers", json=marker).status_code == 201
    shown = {}
    for kind, name in (("gpkg", "m.gpkg"), ("geojson", "m.geojson"), ("shapefile", "m.shp.zip")):
        path = tmp_path / name
        path.write_bytes(client.get(f"/v1/exports/{kind}").content)
        source = f"/vsizip/{path}" if kind == "shapefile" else str(path)
        command = [require_tool("ogrinfo"), "-q", "-al", source]
        found = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        shown[kind] = re.findall(r"^ +(POINT.*?) \(", found, re.MULTILINE)
        assert found.count("160.5") == (2 if kind == "shapefile" else 3), found  # attributes of two, z of one
    assert shown == {"gpkg": ["POINT Z", "POINT", "POINT"], "geojson": ["POINT Z", "POINT", "POINT"],
                     "shapefile": ["POINT"] * 3}  # fmt: skip
    items = client.get("/ogc/collections/markers/items").json()["features"]
    assert [len(item["geometry"]["coordinates"]) for item in items] == [3, 2, 2]
    assert [item["properties"]["height_m"] for item in items] == [160.5, 160.5, None]
    only = client.get("/v1/exports/shapefile", params={"road": "ellipsoid"}).content
    (tmp_path / "z.shp.zip").write_bytes(only)
    assert read_info(f"/vsizip/{tmp_path / 'z.shp.zip'}")["geometry_type"] == "Point Z"
    landxml = client.get("/v1/exports/landxml").text
    assert len(re.findall(r">[0-9.]+ [0-9.]+ 160.5000<", landxml)) == 1
    assert "; 160.5000 m above EPSG:7837" in landxml


@pytest.mark.parametrize("kind", ["landxml", "dxf"])
def test_a_distant_marker_is_left_out_and_named(
    client: httpx.Client, markers: list[dict[str, float]], kind: str
) -> None:
    far = {"family": "cerpm", "position": {"lon_deg": -77.15, "lat_deg": 38.9}, "side": "left"}
    marker = client.post("/v1/markers", json=far).json()
    answer = client.get(f"/v1/exports/{kind}")
    assert answer.status_code == 200, answer.text
    assert answer.headers["Waymark-Left-Out"] == f"1; {marker['id']}"
    assert marker["id"] in answer.text
    crs = "EPSG:32632" if kind == "dxf" else None
    declaration = ImportDeclaration(family="cerpm", vertical_datum="ellipsoid", crs=crs)
    assert read_survey(answer.content, declaration).rows == 3
    etag = {"If-Match": f'"{marker["version"]}"'}
    assert client.patch(f"/v1/markers/{marker['id']}", json={"status": "retired"}, headers=etag).status_code == 200
    later = client.get(f"/v1/exports/{kind}")
    assert "Waymark-Left-Out" not in later.headers
    assert marker["id"] not in later.text
    retired = client.get(f"/v1/exports/{kind}", params={"status": "retired"})
    assert marker["id"] in retired.text


def test_no_file_is_left_behind(
    client: httpx.Client, markers: list[dict[str, float]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))  # the server is in this process
    assert client.get("/v1/exports/gpkg").status_code == 200
    assert client.get("/v1/exports/kml", params={"status": "retired"}).status_code == 422
    assert list(tmp_path.iterdir()) == []
