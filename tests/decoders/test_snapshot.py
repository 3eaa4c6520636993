"""Snapshots: what goes in comes out, and nothing that was changed, cut, mixed, rolled back or kept too long is read."""

from __future__ import annotations

import contextlib
import math
import uuid
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from app.decoders.magnet.identify import TagFormat
from app.decoders.snapshot import Snapshot, open_snapshot
from app.encoders.snapshot import kind_text, write_snapshot
from app.errors import InvalidParameter
from app.markers import snapshot as layout
from app.markers.magnet import parse_tag
from app.markers.magnet_design import Codebook, Meaning, MeaningKind, TagDesign
from app.markers.plate import PlateCode, PlateScheme

NOW = datetime(2026, 5, 4, 8, 0, 0, tzinfo=UTC)
KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
AGENCY = str(uuid.UUID(int=7))
TRUST = layout.Trust(AGENCY, (KEY.public_key().public_bytes_raw(),))
AREA = (8.0, 48.0, 9.0, 50.0)


def _plate(lon_deg: float, lat_deg: float, code: PlateCode | None = None, **more: Any) -> dict[str, Any]:
    code = code or PlateCode.from_position(lon_deg, lat_deg)
    return {
        "id": str(uuid.uuid4()), "family": "plate", "status": "surveyed", "code": code.digits, "lon_deg": lon_deg,
        "lat_deg": lat_deg, "height_m": 120.3456, "vertical_datum": "ellipsoid", "heading_deg": 359.99996,
        "horizontal_rmse_m": 0.0121, "vertical_rmse_m": None, "heading_rmse_deg": 0.2, "localization_grade": "cm",
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


def _write(markers: list[dict[str, Any]], hours: float = 24.0, made_at: datetime = NOW, **more: Any) -> bytes:
    stated = {"agency_id": AGENCY, "area_deg": AREA, "key": KEY, **more}
    blocks = [_block(markers[k : k + 3]) for k in range(0, len(markers), 3)]
    return write_snapshot(blocks, made_at=made_at, expires_at=made_at + timedelta(hours=hours), **stated)


def _block(markers: list[dict[str, Any]]) -> dict[str, list[Any]]:
    kinds = [kind_text(marker["family"], marker["kind"]) for marker in markers]
    names = {name for marker in markers for name in marker} - {"family"}
    return {name: [marker.get(name) for marker in markers] for name in names} | {"kind": kinds}


def _open(data: bytes, now: datetime = NOW, newest_made_at_ms: int | None = None) -> Snapshot:
    return open_snapshot(data, TRUST, now, newest_made_at_ms=newest_made_at_ms)


def test_what_goes_in_comes_out() -> None:
    plate = _plate(8.4, 49.0)
    bare = _plate(
        8.4001, 49.0, height_m=None, heading_deg=None, horizontal_rmse_m=None, heading_rmse_deg=None,
        localization_grade="unfit", vertical_datum="EPSG:5703",
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
    assert cerpms[1].speed_limit_kmh == pytest.approx(80.4672)
    assert np.isnan(cerpms[2].speed_limit_kmh)
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


@pytest.mark.slow
def test_every_change_of_one_byte_is_refused() -> None:
    """To each of the 255 other values, in each place: header, body and signature."""
    data = _write([])
    broken = bytearray(data)
    accepted = []
    for place, kept in enumerate(data):
        for value in range(256):
            broken[place] = value
            with contextlib.suppress(layout.SnapshotRefused):
                _open(bytes(broken))
                accepted.append((place, value))
        broken[place] = kept
    assert accepted == list(enumerate(data))


def test_parts_of_two_snapshots_are_no_snapshot() -> None:
    """Every cut at which the rest of another snapshot with the same length follows."""
    plate = _plate(8.4, 49.0)
    first, second = _write([plate]), _write([plate], made_at=NOW + timedelta(hours=1))
    assert len(first) == len(second)
    parts = {first[:cut] + second[cut:] for cut in range(len(first) + 1)}
    refused = 0
    for data in parts - {first, second}:
        with pytest.raises(layout.SnapshotRefused):
            _open(data, NOW + timedelta(hours=2))
        refused += 1
    assert refused > layout.SIGNATURE_BYTES
    other = _write([_plate(8.5, 49.0), plate])
    for data in (other[:104] + first[104:], first[:104] + other[104:], first[:-64] + other[-64:]):
        with pytest.raises(layout.SnapshotRefused):
            _open(data)


def test_an_older_snapshot_than_the_newest_is_refused() -> None:
    old, new = _write([]), _write([], made_at=NOW + timedelta(milliseconds=1))
    newest = _open(new, NOW).made_at_ms
    assert _open(new, NOW, newest).made_at_ms == newest
    assert _open(old).made_at_ms == newest - 1
    with pytest.raises(layout.RolledBackSnapshot, match=r"0\.001 s before"):
        _open(old, NOW, newest)


def test_no_snapshot_is_valid_for_more_than_a_week(monkeypatch: pytest.MonkeyPatch) -> None:
    assert _open(_write([], hours=168.0, made_at=NOW + timedelta(microseconds=999_999))) is not None
    with pytest.raises(InvalidParameter, match="too long"):
        _write([], hours=168.001)
    monkeypatch.setattr(layout, "MAX_VALIDITY", timedelta(days=366))
    year = _write([], hours=24.0 * 365)
    monkeypatch.undo()
    with pytest.raises(layout.ExpiredSnapshot, match="too long"):
        _open(year)


def test_two_keys_are_trusted_and_no_third() -> None:
    new, third = (Ed25519PrivateKey.generate() for _ in range(2))
    both = layout.Trust(AGENCY, (*TRUST.public_keys, new.public_key().public_bytes_raw()))
    assert open_snapshot(_write([]), both, NOW) is not None
    assert open_snapshot(_write([], key=new), both, NOW) is not None
    for key in (new, third):
        with pytest.raises(layout.ForeignSnapshot, match="another key"):
            _open(_write([], key=key))
    with pytest.raises(layout.ForeignSnapshot, match="another key"):
        open_snapshot(_write([], key=third), both, NOW)


def test_a_snapshot_of_another_agency_is_refused() -> None:
    with pytest.raises(layout.ForeignSnapshot, match="another agency"):
        _open(_write([], agency_id=str(uuid.UUID(int=8))))


@pytest.mark.parametrize(
    "document",
    [
        None, [], {}, {"agency_id": AGENCY}, {"agency_id": AGENCY, "public_keys": []},
        {"agency_id": "roads", "public_keys": ["00" * 32]}, {"agency_id": AGENCY, "public_keys": ["00" * 31]},
        {"agency_id": AGENCY, "public_keys": ["00" * 32] * 2}, {"agency_id": AGENCY, "public_keys": "00" * 32},
        {"agency_id": AGENCY, "public_keys": ["no"]}, {"agency_id": AGENCY, "public_keys": [7]},
        {"agency_id": AGENCY, "public_keys": ["00" * 32, "01" * 32, "02" * 32]},
    ],
)  # fmt: skip
def test_trust_that_cannot_be(document: object) -> None:
    with pytest.raises(InvalidParameter):
        layout.Trust.from_document(document)


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
    with pytest.raises(layout.FutureSnapshot, match="version 4"):
        _open(data[:8] + b"\x04\x00" + data[10:])
    for version in (0, 1, 2):
        with pytest.raises(layout.OldSnapshot, match=f"version {version}") as refused:
            _open(data[:8] + bytes([version, 0]) + data[10:])
        assert refused.value.cure == "update the server, and fetch the snapshot again"
    other = Ed25519PrivateKey.generate()
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
    assert [(name, layout.HEADER.fields[name][1]) for name in layout.HEADER.names] == [
        ("magic", 0), ("version", 8), ("reserved", 10), ("markers", 12), ("made_at_ms", 16), ("expires_at_s", 24),
        ("key_id", 32), ("agency_id", 40), ("west_deg", 56), ("south_deg", 64), ("east_deg", 72), ("north_deg", 80),
        ("kinds_bytes", 88), ("codes_bytes", 92), ("body_bytes", 96), ("books_bytes", 100),
    ]  # fmt: skip
    assert (layout.HEADER.itemsize, layout.ROW_BYTES) == (104, 91)


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
        _cerpm(4_000_000_000, 8.4, 49.0, kind=kind, localization_grade="unfit", **heard),
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
