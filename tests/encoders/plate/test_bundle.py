"""A selection becomes one ZIP whose manifest is true."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import zipfile
from collections.abc import Callable
from typing import Any

import pikepdf
import pytest

from app.encoders.plate import ArtworkFormat, ArtworkOptions, BundleOptions, PlateOrder, safe_names, write_bundle
from app.errors import ProofFailed
from app.markers.plate import PlateCode
from tests.encoders.plate.test_proof import sampling_reader


class Pipe(io.RawIOBase):
    """A target that can only be written to, like a socket."""

    def __init__(self) -> None:
        super().__init__()
        self.content = bytearray()

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return False

    def write(self, data: Any) -> int:
        self.content += data
        return len(data)


def _orders(make_order: Callable[..., PlateOrder], count: int, **fields: object) -> list[PlateOrder]:
    return [make_order(PlateCode(f"{(k + 1) * 7919:012d}"), **({"plate_id": f"K-{k}"} | fields)) for k in range(count)]


def _bundle(orders: list[PlateOrder], **arguments: Any) -> tuple[zipfile.ZipFile, dict[str, Any]]:
    buffer = io.BytesIO()
    returned = write_bundle(orders, buffer, **arguments)
    archive = zipfile.ZipFile(buffer)
    assert archive.testzip() is None
    manifest = json.loads(archive.read("manifest.json"))
    assert manifest == json.loads(json.dumps(returned))
    return archive, manifest


@pytest.mark.slow
def test_the_manifest_accounts_for_every_file(make_order: Callable[..., PlateOrder]) -> None:
    options = BundleOptions(formats=tuple(ArtworkFormat), sheet_mm=(800.0, 900.0), dpi=72)
    archive, manifest = _bundle(_orders(make_order, 5), options=options, read=sampling_reader)
    listed = {entry["name"]: entry for entry in manifest["files"]}
    assert set(listed) == set(archive.namelist()) - {"manifest.json"}
    for name, entry in listed.items():
        content = archive.read(name)
        assert entry["size"] == len(content)
        assert entry["sha256"] == hashlib.sha256(content).hexdigest()
    assert manifest["proved"] is True
    assert [plate["proof"]["read_back"] for plate in manifest["plates"]] == [
        plate["code"]["digits"] for plate in manifest["plates"]
    ]
    for plate in manifest["plates"]:
        assert [name.rsplit(".")[1] for name in plate["files"]] == ["svg", "pdf", "dxf", "png"]
        assert set(plate["files"]) <= set(listed)
        assert plate["geometry"]["side_mm"] == 325
    assert sum(name.startswith("sheets/") for name in listed) == 8


def test_without_a_reader_the_manifest_says_that_nothing_was_proved(make_order: Callable[..., PlateOrder]) -> None:
    _, manifest = _bundle(_orders(make_order, 1))
    assert manifest["proved"] is False
    assert manifest["plates"][0]["proof"] is None


def test_a_plate_that_reads_wrong_stops_the_bundle(make_order: Callable[..., PlateOrder]) -> None:
    read = 0

    def failing(image: Any, geometry: Any) -> Any:
        nonlocal read
        read += 1
        return [] if read == 3 else sampling_reader(image, geometry)

    with pytest.raises(ProofFailed, match="K-2"):
        write_bundle(_orders(make_order, 5), io.BytesIO(), read=failing)


def test_it_streams_reports_progress_and_repeats_byte_for_byte(make_order: Callable[..., PlateOrder]) -> None:
    pipes, done = (Pipe(), Pipe()), []
    for pipe in pipes:
        write_bundle(_orders(make_order, 40), pipe, progress=done.append)
    assert pipes[0].content == pipes[1].content
    assert done == [*range(1, 41)] * 2
    assert len(zipfile.ZipFile(io.BytesIO(pipes[0].content)).namelist()) == 83


def test_the_quality_sheet_has_every_plate(make_order: Callable[..., PlateOrder]) -> None:
    orders = [*_orders(make_order, 4), *_orders(make_order, 1, plate_id="=cmd()", lon_deg=-0.5, lat_deg=51.0)]
    archive, _ = _bundle(orders)
    rows = list(csv.DictReader(io.StringIO(archive.read("quality.csv").decode())))
    assert [row["plate_id"] for row in rows] == ["K-0", "K-1", "K-2", "K-3", "'=cmd()"]
    assert [row["digits"] for row in rows] == [order.code.digits for order in orders]
    assert all(None not in row and None not in row.values() for row in rows)
    assert (rows[0]["side_mm"], rows[0]["marker_mm"], rows[0]["side_tolerance_mm"]) == ("325", "75", "0.5")
    assert rows[4]["lon_deg"] == "-0.500000000"
    assert rows[0]["measured_side_mm"] == rows[0]["date"] == ""
    with pikepdf.open(io.BytesIO(archive.read("quality.pdf"))) as document:
        assert len(document.pages) == 3
        width, height = (float(v) * 25.4 / 72 for v in document.pages[1].MediaBox[2:])
    assert (width, height) == pytest.approx((210, 297), abs=0.01)


def test_colours_are_data_in_the_manifest(make_order: Callable[..., PlateOrder]) -> None:
    _, manifest = _bundle(_orders(make_order, 1), options=BundleOptions(artwork=ArtworkOptions(heaters=True)))
    colours = {entry["layer"]: entry for entry in manifest["colours"]}
    assert {"BASE", "CODE_DARK", "CODE_LIGHT", "MARK_RED", "MARK_GREEN"} == set(colours)
    assert all(entry["ral"].startswith("RAL ") for entry in colours.values())
    assert "D4956" in colours["MARK_RED"]["sheeting"]
    assert "D6628" in colours["CODE_LIGHT"]["marking"]
    assert manifest["options"]["heaters"] is True


def test_file_names_are_safe_and_unique() -> None:
    names = [
        "../../etc/passwd",
        "a/b",
        "A/B",
        "a\\b",
        "con",
        "LPT1.x",
        "路标",
        "",
        ".hidden",
        "x" * 200,
        "x" * 199,
        "é",
    ]
    safe = safe_names(names)
    assert len({name.lower() for name in safe}) == len(names)
    for name in safe:
        assert name.isascii()
        assert 0 < len(name) <= 64
        assert not set(name) & set('/\\:*?"<>| ')
        assert name[0] not in "._-"
        assert name.split(".")[0].lower() not in {"con", "lpt1"}
    assert safe_names(["HK-000123-r2"]) == ["HK-000123-r2"]
