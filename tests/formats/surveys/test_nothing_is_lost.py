"""Points, heights and systems that a file states in a less usual way are read, or their loss is reported."""

from __future__ import annotations

from typing import Any

import pytest
import shapely

from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.read import read_survey
from app.formats.surveys.table import SurveyTable


def _read(data: str | bytes, **declared: Any) -> SurveyTable:
    content = data if isinstance(data, bytes) else data.encode()
    return read_survey(content, ImportDeclaration(**declared))


# --- WKT and WKB of PostGIS -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cell", "height"),
    [
        ("SRID=25832;POINTM(457000 5428000 77)", None),
        ("SRID=25832;POINT M (457000 5428000 77)", None),
        ("SRID=25832;MULTIPOINTM((457000 5428000 77))", None),
        ("SRID=25832;POINTZM(457000 5428000 130.5 77)", 130.5),
        ("SRID=25832;POINT ZM (457000 5428000 130.5 77)", 130.5),
        ("SRID=25832;POINTZ(457000 5428000 130.5)", 130.5),
        ("SRID=25832;POINT(457000 5428000 130.5 77)", 130.5),  # ST_AsEWKT has no mark where there are both
    ],
)
def test_marks_of_z_and_m(cell: str, height: float | None) -> None:
    read = _read(f"id,geom\n1,{cell}\n2,{cell}", vertical_datum="ellipsoid")
    assert (read.crs, read.first[1], read.second[1]) == ("EPSG:25832", 457000, 5428000)
    assert (None if read.height is None else read.height.tolist()) == (None if height is None else [height] * 2)
    assert not read.faults.counts


def test_bytea() -> None:
    """The text of PostgreSQL for bytes, with M, which is no height, and with z."""
    for wkt, height in (("POINT M (457000 5428000 77)", None), ("POINT Z (457000 5428000 130.5)", 130.5)):
        point = shapely.set_srid(shapely.from_wkt(wkt), 25832)
        cell = "\\x" + shapely.to_wkb(point, hex=True, include_srid=True, output_dimension=4).lower()
        read = _read(f"id,geom\n1,{cell}\n2,{cell}", vertical_datum="ellipsoid")
        assert (read.crs, read.first[1], read.second[1]) == ("EPSG:25832", 457000, 5428000)
        assert (None if read.height is None else read.height[0]) == height


# --- JobXML -----------------------------------------------------------------------------------------------------------


def test_points_that_were_deleted_in_a_job_are_left_out() -> None:
    point = (
        "<Point><Name>{}</Name><Classification>{}</Classification>"
        "<Grid><North>5428000</North><East>457000</East><Elevation>112.5</Elevation></Grid></Point>"
    )
    kinds = (("101", "Normal"), ("102", "DeletedNormal"), ("103", "DeletedControl"))
    points = "".join(point.format(*kind) for kind in kinds)
    read = _read(f"<JOBFile><Reductions>{points}</Reductions></JOBFile>", crs="EPSG:25832", vertical_datum="ellipsoid")
    assert list(read.texts["point"]) == ["101"]
    others = next(one for one in read.detected if one.what == "other points")
    assert (others.value, others.evidence) == ("2 left out", "2 deleted in the job: 102, 103")
