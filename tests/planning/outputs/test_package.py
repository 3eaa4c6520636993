"""The package of a plan: everything that is built from it, in any order of parts, the same every time."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import pytest
from pyproj import Geod

from app.decoders.plate.reader import decode_plates
from app.encoders.packer import file_entry
from app.encoders.plate import ArtworkFormat
from app.errors import InvalidParameter, ProofFailed
from app.planning.outputs.package import Package, PackageOptions, PartKind, plan_files
from app.planning.plan import PlannedTag
from tests.planning.outputs.made import ALL, full_plan, plan_of, two_lanes

GEOD = Geod(ellps="WGS84")


def read(image: Any, geometry: Any) -> Sequence[Any]:
    return decode_plates(image, geometries=(geometry,))


@pytest.fixture(scope="module")
def package() -> Package:
    """Of a plan with all families and the agency's holes."""
    rules = ALL | {"installation": {"hole_diameter_mm": 25, "hole_depth_mm": 60}}
    return Package(plan_of(two_lanes(), **rules), PackageOptions(formats=(ArtworkFormat.SVG,)))


@pytest.fixture(scope="module")
def files(package: Package) -> dict[str, bytes]:
    """Names and contents."""
    found = [file for part in package.parts() for file in package.write(part, read)]
    assert len(dict(found)) == len(found), "a name occurs twice"
    return dict(found)


@pytest.mark.slow
def test_it_has_every_file_every_plate_every_tag_and_every_line(package: Package, files: dict[str, bytes]) -> None:
    plan = package.plan
    plain = {file.name: file.write() for file in plan_files(plan)}
    assert {name: files[name] for name in plain} == plain
    plates = [m for m in plan.markers if m.family == "plate"]
    assert {name for name in files if name.startswith("artwork/plate")} == {
        f"artwork/plate-{m.number:05d}.svg" for m in plates
    }
    assert len(list(csv.DictReader(io.StringIO(files["artwork/quality.csv"].decode())))) == len(plates)
    tags = [m for m in plan.markers if isinstance(m.detail, PlannedTag)]
    sheets = {name for name in files if name.startswith("drilling/tag")}
    assert sheets == {f"drilling/tag-{m.number:05d}.{form}" for m in tags for form in ("pdf", "csv")}
    lines = [name for name in files if name.startswith("drilling/line") and name.endswith(".csv")]
    holes = sum(len(list(csv.DictReader(io.StringIO(files[name].decode())))) for name in lines)
    assert holes == plan.counts["magnet"] - len(tags)


def test_drilling_sheets_have_the_holes_of_the_plan(package: Package, files: dict[str, bytes]) -> None:
    for marker in package.plan.markers:
        if not isinstance(marker.detail, PlannedTag):
            continue
        rows = list(csv.DictReader(io.StringIO(files[f"drilling/tag-{marker.number:05d}.csv"].decode())))
        for row, (_, lon, lat) in zip(rows, marker.detail.magnets, strict=True):
            assert GEOD.inv(float(row["lon_deg"]), float(row["lat_deg"]), lon, lat)[2] < 0.005
    sheet = package.write(next(part for part in package.parts() if part.kind is PartKind.TAGS), read)[0][1]
    bare = Package(full_plan(), package.options)
    other = bare.write(next(part for part in bare.parts() if part.kind is PartKind.TAGS), read)[0][1]
    assert sheet != other, "diameter and depth of the holes are on the sheet"


@pytest.mark.slow
def test_parts_give_the_same_in_any_order_and_the_manifest_has_their_hashes(
    package: Package, files: dict[str, bytes]
) -> None:
    again = Package(package.plan, package.options)
    assert {k: v for part in reversed(again.parts()) for k, v in again.write(part, read)} == files
    entries = [file_entry(name, content) for name, content in files.items()]
    manifest = json.loads(package.manifest(entries))
    assert manifest["files"] == entries
    assert manifest["counts"] == package.plan.counts
    assert manifest["read_back"] == package.plan.counts["plate"]


def test_a_plate_that_reads_otherwise_is_not_packed(package: Package) -> None:
    part = next(part for part in package.parts() if part.kind is PartKind.PLATES)
    with pytest.raises(ProofFailed):
        package.write(part, lambda image, geometry: read(np.full_like(image, 90), geometry))


def test_options_that_do_not_fit_are_refused(package: Package) -> None:
    for options in (
        PackageOptions(scale=300),
        PackageOptions(crs="EPSG:1"),
        PackageOptions(unit=cast(Any, "ell")),
    ):
        with pytest.raises(InvalidParameter):
            Package(package.plan, options).check()
    package.check()
