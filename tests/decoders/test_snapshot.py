"""Snapshots: what goes in comes out, and nothing that was tampered with, cut, aged or made later is read."""

from __future__ import annotations

import base64
import math
import uuid
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from app.decoders.magnet.identify import TagFormat
from app.decoders.snapshot import Snapshot, open_snapshot
from app.encoders.snapshot import write_snapshot
from app.errors import InvalidParameter
from app.markers import snapshot as layout
from app.markers.magnet import parse_tag
from app.markers.magnet_codebook import Codebook, Meaning, MeaningKind
from app.markers.magnet_design import TagDesign
from app.markers.plate import PlateCode, PlateScheme

NOW = datetime(2026, 5, 4, 8, 0, 0, tzinfo=UTC)
KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
PUBLIC = KEY.public_key().public_bytes_raw()
AREA = (8.0, 48.0, 9.0, 50.0)


def _plate(lon_deg: float, lat_deg: float, code: PlateCode | None = None, **more: Any) -> dict[str, Any]:
    code = code or PlateCode.from_position(lon_deg, lat_deg)
    return {
        "id": str(uuid.uuid4()), "family": "plate", "status": "surveyed", "code": code.digits, "lon_deg": lon_deg,
        "lat_deg": lat_deg, "height_m": 120.3456, "vertical_datum": "ellipsoid", "heading_deg": 359.99996,
        "horizontal_rmse_m": 0.0121, "vertical_rmse_m": None, "heading_rmse_deg": 0.2, "localization_grade": "exact",
        "kind": {
            "scheme": str(code.scheme), "n": code.n, "unit_mm": 35.0, "gap_mm": 5.0, "thickness_mm": 20.0,
            "check_digits": None,
        },
        **more,
    }  # fmt: skip


def _cerpm(number: int, lon_deg: float, lat_deg: float, **more: Any) -> dict[str, Any]:
    limit = {"value": 50, "unit": "mph"} if number % 2 else None
    more = {"kind": {"side": "left", "speed_limit": limit}, **more}
    return _plate(lon_deg, lat_deg, family="cerpm", code=None, **more) | {"code": str(number)}


def _tag(text: str, lon_deg: float, lat_deg: float, **more: Any) -> dict[str, Any]:
    return _plate(lon_deg, lat_deg, family="magnet", **{"kind": {}, **more}) | {"code": text}


def _write(markers: list[dict[str, Any]], hours: float = 24.0, **more: Any) -> bytes:
    return write_snapshot(
        markers, agency_id=str(uuid.UUID(int=7)), area_deg=AREA, made_at=NOW,
        expires_at=NOW + timedelta(hours=hours), key=KEY, **more,
    )  # fmt: skip


def _open(data: bytes, now: datetime = NOW) -> Snapshot:
    return open_snapshot(data, PUBLIC, now)


def test_what_goes_in_comes_out() -> None:
    plate = _plate(8.4, 49.0)
    bare = _plate(
        8.4001, 49.0, height_m=None, heading_deg=None, horizontal_rmse_m=None, heading_rmse_deg=None,
        localization_grade="approximate, not for localization", vertical_datum="EPSG:5703",
    )  # fmt: skip
    snapshot = _open(_write([plate, bare]))
    first, second = snapshot.near("plate", 8.4, 49.0, 100.0)
    assert len(snapshot) == 2
    assert snapshot.area_deg == AREA
    assert snapshot.agency_id == str(uuid.UUID(int=7))
    assert (first.marker_id, first.code, first.status) == (plate["id"], plate["code"], "surveyed")
    assert (first.lon_deg, first.lat_deg, first.height_m) == (8.4, 49.0, 120.346)
    assert (first.heading_deg, first.heading_rmse_deg, first.vertical_rmse_m) == (0.0, 0.2, None)
    assert first.horizontal_rmse_m == 0.013  # never better than it is
    assert (first.exact, first.ellipsoidal, second.exact, second.ellipsoidal) == (True, True, False, False)
    assert (second.height_m, second.heading_deg, second.horizontal_rmse_m) == (None, None, None)
    assert first.distance_m == pytest.approx(0.0, abs=1e-3)
    assert second.distance_m == pytest.approx(7.317, abs=0.01)
    assert first.plate_code == PlateCode.from_position(8.4, 49.0)


def test_every_family_feeds_its_decoder() -> None:
    rare = PlateCode.from_registry_number(4711, n=10)
    markers = [
        _plate(8.4, 49.0), _plate(8.4002, 49.0, rare), _plate(8.9, 49.0), _tag("SNS_4_0.1_10-30", 8.4, 49.0),
        _tag("N_90", 8.4, 49.0), _cerpm(1, 8.4, 49.0), _cerpm(2, 8.4, 49.0),
    ]  # fmt: skip
    snapshot = _open(_write(markers))
    assert snapshot.plate_codebook(8.4, 49.0, 100.0) == (PlateCode.from_position(8.4, 49.0), rare)
    assert {g.n for g in snapshot.plate_geometries(8.4, 49.0, 100.0)} == {8, 10}
    assert [tag.text for tag in snapshot.tags(8.4, 49.0, 100.0)] == ["SNS_4_0.1_10-30"]
    cerpms = snapshot.registered_cerpms(8.4, 49.0, 100.0)
    assert sorted(cerpms) == [1, 2]
    assert cerpms[1].speed_limit_km_h == pytest.approx(80.4672)
    assert np.isnan(cerpms[2].speed_limit_km_h)
    found = snapshot.match_plate(rare, 8.4, 49.0, 100.0)
    assert found is not None
    assert (found.marker_id, found.kind["scheme"]) == (markers[1]["id"], PlateScheme.ID)
    assert snapshot.match_plate(rare, 8.9, 49.0, 100.0) is None
    assert snapshot.covers(8.5, 49.0)
    assert not snapshot.covers(9.5, 49.0)


def test_over_the_antimeridian() -> None:
    snapshot = _open(_write([_plate(179.99999, 1.0), _plate(-179.99999, 1.0)]))
    assert len(snapshot.near("plate", 180.0, 1.0, 5.0)) == 2
    assert len(snapshot.near("plate", -179.9999, 1.0, 50.0)) == 2


def test_an_empty_area_is_a_snapshot() -> None:
    snapshot = _open(_write([]))
    assert len(snapshot) == 0
    assert snapshot.near("plate", 8.4, 49.0, 1e6) == []


def test_a_flipped_bit_anywhere_is_refused() -> None:
    data = _write([_plate(8.4, 49.0), _cerpm(3, 8.4, 49.0)])
    for place in range(len(data)):
        broken = bytearray(data)
        broken[place] ^= 1 << place % 8
        with pytest.raises(layout.SnapshotRefused):
            _open(bytes(broken))


def test_a_cut_or_longer_one_is_refused() -> None:
    data = _write([_plate(8.4, 49.0)])
    for count in range(1, len(data)):
        with pytest.raises(layout.TruncatedSnapshot if count > 8 else layout.SnapshotRefused):
            _open(data[:count])
    with pytest.raises(layout.TruncatedSnapshot):
        _open(data + b"\x00")


def test_each_refusal_has_its_name() -> None:
    data = _write([_plate(8.4, 49.0)])
    with pytest.raises(layout.NoSnapshot):
        _open(b"")
    with pytest.raises(layout.NoSnapshot):
        _open(b"SQLite format 3\x00" + data[16:])
    with pytest.raises(layout.FutureSnapshot, match="version 3"):
        _open(data[:8] + b"\x03\x00" + data[10:])
    other = Ed25519PrivateKey.generate()
    with pytest.raises(layout.ForeignSnapshot):
        open_snapshot(data, other.public_key().public_bytes_raw(), NOW)
    forged = data[:-64] + other.sign(data[:-64])
    with pytest.raises(layout.ForgedSnapshot):
        _open(forged)
    with pytest.raises(layout.ForgedSnapshot):
        _open(data[:-70] + b"\x00" * 6 + data[-64:])
    assert len(_open(data, NOW + timedelta(hours=24) - timedelta(seconds=1))) == 1
    with pytest.raises(layout.ExpiredSnapshot):
        _open(data, NOW + timedelta(hours=24))
    with pytest.raises(layout.ExpiredSnapshot, match="future"):
        _open(data, NOW - timedelta(hours=1))


def test_too_many_markers_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(layout, "MAX_MARKERS", 1)
    with pytest.raises(InvalidParameter) as caught:
        _write([_plate(8.4, 49.0), _plate(8.5, 49.0)])
    assert caught.value.field == "bbox"


def test_the_layout_is_as_documented() -> None:
    """docs/snapshots.md gives these numbers; a change of any is another version."""
    first = [
        ("magic", 0), ("version", 8), ("reserved", 10), ("markers", 12), ("made_at_s", 16), ("expires_at_s", 24),
        ("key_id", 32), ("agency_id", 40), ("west_deg", 56), ("south_deg", 64), ("east_deg", 72), ("north_deg", 80),
        ("kinds_bytes", 88), ("codes_bytes", 92), ("body_bytes", 96),
    ]  # fmt: skip
    places = {
        version: [(name, form.fields[name][1]) for name in form.names] for version, form in layout.HEADERS.items()
    }
    assert places == {1: first, 2: [*first, ("books_bytes", 100)]}
    assert {version: form.itemsize for version, form in layout.HEADERS.items()} == {1: 100, 2: 104}
    assert (layout.row_bytes(1), layout.row_bytes(2)) == (51, 91)


VERSION_1 = base64.b64decode(
    "V0FZTUFSS1MBAAAAAwAAAABS+GkAAAAAgKP5aQAAAABWR1qnVGNHTAAAAAAAAAAAAAAAAAAAAAcAAAAAAAAgQAAAAAAAAEhAAAAAAAAAIkAAAAAA"
    "AABJQM8AAAAcAAAA8QAAAHicbY3BSgMxEIazu0cV7x7nHEtqW5Q8hJceRULYTXeHJmkwWUGWfZeeBZ/AF/ABxCfxrkmEli3OMAw/8/3/EDKpYipJ"
    "eaIr8vn2naHT/brvzv7ZV1/FYfbvF4f5659cHyR1el6SsiyrqjovLh8GqDtVb0WDLQYP3PZaU9hIg/oFODgtgwIKrXTCGOCrGaNggd9R8NFoVGJ2"
    "HgPubMRCh/XWKu8zfMMS3VsMWS6ieaTDMbxWT85El8cm5Wi1CUk5pRqh0WAAPmR7PBrXxduz1H1EV2ycBBnZWhVgfFyyY92u79diKdhsLubsesF+"
    "AYV7ZlWWeBkXHJ95xXW+epzzX0c4VbrahLf/+YmDGMHbyDGydvL0NVg/iZZmUlJ2sDgeOMRvB+9FBwlW7qsWVIFENjoL"
)
"""What the writer of version 1 made of a plate, a tag and a CERPM, hours=24 from NOW."""


def test_a_snapshot_of_version_1_is_read() -> None:
    snapshot = _open(VERSION_1)
    assert (snapshot.version, len(snapshot), snapshot.codebooks) == (1, 3, ())
    assert snapshot.plate_codebook(8.4, 49.0, 10.0) == (PlateCode.from_position(8.4, 49.0),)
    (tag,) = snapshot.registered_tags(8.4, 49.0, 10.0)
    assert (tag.tag.text, tag.bearing_deg, tag.meaning) == ("SNS_4_0.1_10-30", 90.0, None)
    known = snapshot.known_cerpms([7, 8])
    assert known.registered[7].speed_limit_km_h == pytest.approx(80.4672)
    assert (known.earlier_spans, known.min_interval_s) == ({}, {})
    forged = VERSION_1[:8] + layout.VERSION.to_bytes(2, "little") + VERSION_1[10:]
    with pytest.raises(layout.SnapshotRefused):
        _open(forged)


# --- what the decoders need besides places ----------------------------------------------------------------------


def test_tags_carry_their_lane_and_meaning_and_books_their_formats() -> None:
    meaning = {"kind": "bend-right", "value": 125.0}
    placed = _tag(
        "SNS_4_0.1_10-30", 8.4, 49.0, kind={"scheme": "information-tag", "meaning": meaning},
        lane_lon_deg=8.3987654321, lane_lat_deg=48.9987654321,
    )  # fmt: skip
    line = _tag("N_90", 8.4, 49.0, kind={"scheme": "line-tag", "meaning": None})
    design = TagDesign(magnets=3, length_m=4.0, segment_m=0.1)
    book = Codebook("streets", design, ((parse_tag("SNS_4_0.1_10-30"), Meaning(MeaningKind.BEND_RIGHT, 125.0)),))
    snapshot = _open(_write([placed, line], codebooks=[book.to_document()]))
    assert snapshot.codebooks == (book,)
    (tag,) = snapshot.registered_tags(8.4, 49.0, 10.0)
    assert (tag.lane_lon_deg, tag.lane_lat_deg) == (8.398765432, 48.998765432)
    assert tag.meaning == Meaning(MeaningKind.BEND_RIGHT, 125.0)
    assert not snapshot.tag_candidates(8.4, 49.0, 10.0).formats
    assert snapshot.tag_candidates(8.5, 49.0, 10.0).formats == (TagFormat(3, 4.0, 0.1),)


def test_cerpms_carry_what_was_heard_of_them() -> None:
    heard = {"first_sequence": 3, "last_sequence": 2**32 - 1, "first_heard_s": 1.7e9 + 0.1234, "last_heard_s": None}
    limit = {"value": 30, "unit": "km/h"}
    kind = {"side": "right", "speed_limit": limit, "min_interval_s": 0.8, "transform_note": "a datum's bound"}
    markers = [
        _cerpm(4_000_000_000, 8.4, 49.0, kind=kind, localization_grade="approximate", **heard),
        _cerpm(5, 8.41, 49.0), _cerpm(6, 8.41, 49.0, status="retired"),
    ]  # fmt: skip
    snapshot = _open(_write(markers))
    assert len(snapshot) == 2
    assert [marker.code for marker in snapshot.near("cerpm", 8.41, 49.0, 10.0)] == ["5"]
    known = snapshot.known_cerpms([4_000_000_000, 5, 6, 7])
    assert sorted(known.registered) == [5, 6, 4_000_000_000]
    (span,) = known.earlier_spans[4_000_000_000]
    assert (span.first_sequence, span.last_sequence, span.first_heard_s) == (3, 2**32 - 1, 1.7e9 + 0.123)
    assert math.isnan(span.last_heard_s)
    assert list(known.earlier_spans) == [4_000_000_000]
    assert known.min_interval_s == {4_000_000_000: 0.8}
    assert known.localization_warnings == {
        4_000_000_000: ("a datum's bound",), 5: (), 6: ("the marker is retired, its position is not surveyed",)
    }  # fmt: skip
    assert known.retired == {6}
