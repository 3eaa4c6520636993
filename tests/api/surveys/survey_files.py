"""The same eight points in files of every format."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Sequence
from pathlib import Path

import ezdxf
import numpy as np
import shapely
from pyogrio import raw
from pyproj import Transformer

LON, LAT = 8.416412345, 49.0051
STEP = 0.00015

POINTS = [(str(k), LON + k * STEP, LAT, 160.0 + k / 10) for k in range(1, 9)]


def geojson() -> bytes:
    features = [
        {"type": "Feature", "properties": {"number": n}, "geometry": {"type": "Point", "coordinates": [x, y, z]}}
        for n, x, y, z in POINTS
    ]
    return json.dumps({"type": "FeatureCollection", "features": features}).encode()


def kml() -> bytes:
    marks = "".join(
        f"<Placemark><name>{n}</name><Point><altitudeMode>absolute</altitudeMode>"
        f"<coordinates>{x},{y},{z}</coordinates></Point></Placemark>"
        for n, x, y, z in POINTS
    )
    return f'<kml xmlns="http://www.opengis.net/kml/2.2"><Document>{marks}</Document></kml>'.encode()


def utm() -> list[tuple[str, float, float, float]]:
    transform = Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True).transform
    return [(n, *transform(x, y), z) for n, x, y, z in POINTS]


def landxml() -> bytes:
    points = "".join(f'<CgPoint name="{n}">{y:.4f} {x:.4f} {z}</CgPoint>' for n, x, y, z in utm())
    return (
        '<LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2"><Units><Metric linearUnit="meter"/></Units>'
        f'<CoordinateSystem epsgCode="32632"/><CgPoints>{points}</CgPoints></LandXML>'
    ).encode()


def dxf() -> bytes:
    document = ezdxf.new("R2010", units=6)
    block = document.blocks.new("MARKER")
    block.add_attdef("NUMBER", (0, 0))
    for number, *place in utm():
        document.modelspace().add_blockref("MARKER", place).add_auto_attribs({"NUMBER": number})
    text = io.StringIO()
    document.write(text)
    return text.getvalue().encode()


def pnezd() -> bytes:
    return "\n".join(f"{n},{y:.4f},{x:.4f},{z},M,left" for n, x, y, z in utm()).encode()


def layer(tmp_path: Path, driver: str, name: str) -> Path:
    shapes = shapely.to_wkb(shapely.points([p[1:] for p in POINTS]))
    numbers = np.array([p[0] for p in POINTS], dtype=object)
    path = tmp_path / name
    raw.write(path, shapes, [numbers], ["number"], driver=driver, geometry_type="Point Z", crs="EPSG:4326")
    return path


def shapefile(tmp_path: Path) -> bytes:
    layer(tmp_path, "ESRI Shapefile", "survey.shp")
    return _packed(tmp_path)


COUNTY_GRID = (
    'PROJCS["County_Grid_Feet",GEOGCS["{base}",DATUM["{datum}",SPHEROID["GRS_1980",6378137.0,298.257222101]],'
    'PRIMEM["Greenwich",0.0],UNIT["Degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],'
    'PARAMETER["False_Easting",500000.0],PARAMETER["False_Northing",0.0],PARAMETER["Central_Meridian",-93.1],'
    'PARAMETER["Scale_Factor",1.00003],PARAMETER["Latitude_Of_Origin",44.0],UNIT["Foot_US",0.3048006096012192]]'
)
"""WKT of ESRI of a projection that the EPSG registry does not list."""


def county_shapefile(tmp_path: Path, feet: Sequence[tuple[float, ...]], prj: str) -> bytes:
    """Points in feet of a grid, with the text of their .prj."""
    numbers = np.array([str(k + 1) for k in range(len(feet))], dtype=object)
    shapes = shapely.to_wkb(shapely.points(feet))
    path = tmp_path / "survey.shp"
    raw.write(
        path,
        shapes,
        [numbers],
        ["number"],
        driver="ESRI Shapefile",
        geometry_type="Point Z" if len(feet[0]) > 2 else "Point",
        crs="EPSG:4326",
    )
    (tmp_path / "survey.prj").write_text(prj)
    return _packed(tmp_path)


def _packed(tmp_path: Path) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for part in tmp_path.glob("survey.*"):
            archive.write(part, part.name)
    return packed.getvalue()


def kmz() -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("doc.kml", kml())
    return packed.getvalue()


def gpx() -> bytes:
    points = "".join(f'<wpt lat="{y}" lon="{x}"><ele>{z}</ele><name>{n}</name></wpt>' for n, x, y, z in POINTS)
    return f'<gpx xmlns="http://www.topografix.com/GPX/1/1" version="1.1" creator="a">{points}</gpx>'.encode()


def jobxml() -> bytes:
    points = "".join(
        f"<Point><Name>{n}</Name><Grid><North>{y}</North><East>{x}</East><Elevation>{z}</Elevation></Grid></Point>"
        for n, x, y, z in utm()
    )
    return f'<JOBFile version="5.74"><Reductions>{points}</Reductions></JOBFile>'.encode()


def gsi() -> bytes:
    """In units of 0.01 mm."""
    lines = [
        f"*11{k:04d}+{int(n):016d} "
        + " ".join(f"{index}..08+{round(value * 1e5):016d}" for index, value in zip((81, 82, 83), place, strict=True))
        for k, (n, *place) in enumerate(utm(), 1)
    ]
    return "\r\n".join([*lines, ""]).encode()
