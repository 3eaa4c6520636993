"""One place a marker: held against the registry, each other and the vehicle's track."""

from __future__ import annotations

import math
from dataclasses import replace
from time import process_time

import numpy as np
import pytest

from app.decoders.cerpm.merge import (
    Disagreement,
    MergedMarkers,
    MergeRules,
    RegisteredMarker,
    distances_m,
    merge_markers,
    offsets_m,
    vehicle_positions,
)
from app.decoders.cerpm.verify import VerifiedPacket, verify_packets
from app.errors import InvalidParameter
from app.markers.cerpm import LaneSide
from app.sensors.pose_track import PlainClaim, PoseTrack, ReceivedPacket
from tests.decoders.cerpm.payloads import LAT_DEG, LON_DEG, START_S, body, key_of, signed

M_EAST, M_NORTH = 1 / (111_320 * math.cos(math.radians(LAT_DEG))), 1 / 111_080


def place(number: int) -> tuple[float, float]:
    """Markers stand 12 m apart towards the east."""
    return LON_DEG + 12 * number * M_EAST, LAT_DEG


def say(
    number: int,
    sequence: int,
    at_s: float,
    *,
    east_m: float = 0.0,
    north_m: float = 0.0,
    swap: bool = False,
    head: int = 0x14,
) -> ReceivedPacket:
    """A signed packet with a position this far off."""
    lon, lat = place(number)
    lon, lat = lon + east_m * M_EAST, lat + north_m * M_NORTH
    content = body(number, *((lat, lon) if swap else (lon, lat)), sequence=sequence, head=head)
    return ReceivedPacket(sequence, START_S + at_s, signed(content))


def heard(*packets: ReceivedPacket) -> list[VerifiedPacket]:
    """With verdicts."""
    return verify_packets(packets, key_of).packets


def registry(
    *numbers: int, side: LaneSide = LaneSide.UNKNOWN, sigma_m: float = math.nan
) -> dict[int, RegisteredMarker | None]:
    """Markers where they belong."""
    return {n: RegisteredMarker(*place(n), side=side, sigma_m=sigma_m) for n in numbers}


def track(first: int = 0, last: int = 40, *, north_m: float = 0.0) -> PoseTrack:
    """A drive along the markers, one a second."""
    n = np.arange(first, last, dtype=float)
    lon = np.array([place(int(k))[0] for k in n])
    nothing = np.full(len(n), np.nan)
    return PoseTrack(START_S + n, lon, np.full(len(n), LAT_DEG + north_m * M_NORTH), nothing, nothing)


def kinds(merged: MergedMarkers) -> dict[int, Disagreement]:
    """Of each number that was named."""
    return {finding.number: finding.kind for finding in merged.findings}


def drive(count: int = 6, **off: float) -> list[ReceivedPacket]:
    """Each marker is received twice."""
    return [say(n, 100 + k, n + 0.1 * k, **off) for n in range(1, count + 1) for k in range(2)]  # type: ignore[arg-type]


def test_rows_are_of_the_registry_or_the_newest_message() -> None:
    known = {1: RegisteredMarker(*place(1), side=LaneSide.RIGHT, speed_limit_kmh=80.0, sigma_m=0.05)}
    merged = merge_markers(heard(*drive(2), say(2, 110, 5, east_m=0.1)), known, track())
    assert merged.number.tolist() == [1, 2]
    assert (merged.lon_deg[0], merged.lat_deg[0]) == place(1)
    assert merged.lon_deg[1] == pytest.approx(place(2)[0] + 0.1 * M_EAST, abs=1e-7)
    assert merged.side.tolist() == [LaneSide.RIGHT, LaneSide.LEFT]
    assert merged.speed_limit_kmh.tolist() == [80.0, 50.0]
    assert merged.sigma_m.tolist() == [0.05, 0.02]
    assert merged.packets.tolist() == [2, 3]
    assert merged.registered.tolist() == [True, False]
    assert kinds(merged) == {1: Disagreement.OTHER_SIDE}
    assert not merged.left_out


def test_nobody_without_a_tag_moves_a_marker() -> None:
    forged = ReceivedPacket(9, START_S + 3, body(1, LON_DEG, LAT_DEG + 1, sequence=200) + b"abcd")
    clear = ReceivedPacket(10, START_S + 3, claim=PlainClaim(1, LON_DEG, LAT_DEG + 1))
    replayed = replace(say(1, 90, 4, east_m=30.0), entry=11)
    merged = merge_markers(heard(*drive(3), forged, clear, replayed), registry(1, 2, 3), track())
    assert merged.lat_deg.tolist() == [place(n)[1] for n in (1, 2, 3)]
    assert not merged.findings


def test_claims_in_clear_are_used_where_that_is_asked_for() -> None:
    clear = [ReceivedPacket(n, START_S + n, claim=PlainClaim(n, *place(n))) for n in (1, 2)]
    assert not len(merge_markers(heard(*clear), {}).number)
    merged = merge_markers(heard(*clear, say(2, 1, 2, east_m=0.2)), {}, None, MergeRules(accept_clear=True))
    assert merged.number.tolist() == [1, 2]
    assert merged.lon_deg[1] == pytest.approx(place(2)[0] + 0.2 * M_EAST, abs=1e-7)


@pytest.mark.parametrize(
    ("off_m", "sigma_m", "named"), [(0.45, 0.02, False), (0.55, 0.02, True), (0.55, 0.3, False), (30.0, 0.3, True)]
)
def test_a_claim_off_its_registered_place_is_named(off_m: float, sigma_m: float, named: bool) -> None:
    packets = [*drive(6), say(7, 1, 7, north_m=off_m)]
    merged = merge_markers(heard(*packets), registry(*range(1, 8), sigma_m=sigma_m), track())
    assert kinds(merged) == ({7: Disagreement.MOVED} if named else {})
    assert (7 in merged.left_out) == named
    assert len(merged.number) == 7 - named
    if named:
        assert merged.findings[0].distance_m == pytest.approx(off_m, rel=0.01)


def test_two_markers_of_one_number_are_named() -> None:
    # the second counts for itself: its packets come between, lower and higher
    between = [say(3, 101 + 2 * k, 2 * k + 1, east_m=20.0) for k in range(3)]
    honest = [say(3, 100 + 2 * k, 2 * k) for k in range(3)]
    for known in ({}, registry(3)):
        merged = merge_markers(heard(*drive(2), *honest, *between), known, track())
        assert kinds(merged) == {3: Disagreement.TWO_PLACES}
        assert merged.number.tolist() == [1, 2]
    behind = [say(3, 10 + k, 5 + k, east_m=20.0) for k in range(3)]
    assert kinds(merge_markers(heard(*drive(2), *honest, *behind), {}, track())) == {3: Disagreement.TWO_PLACES}
    # the registry shows which of both is right, so an old message sent again does not put a marker out of use
    assert kinds(merge_markers(heard(*drive(2), *honest, *behind), registry(3), track())) == {}


def test_a_marker_that_is_programmed_anew_during_a_log() -> None:
    merged = merge_markers(heard(say(1, 1, 0), say(1, 2, 1), say(1, 3, 2, east_m=2.0)), {})
    assert kinds(merged) == {1: Disagreement.REPROGRAMMED}
    assert merged.lon_deg[0] == pytest.approx(place(1)[0] + 2 * M_EAST, abs=1e-7)


def test_markers_out_of_reach_are_named() -> None:
    far = say(9, 5, 10, north_m=2500.0)
    merged = merge_markers(heard(*drive(6), far), {}, track())
    assert kinds(merged) == {9: Disagreement.OUT_OF_REACH}
    assert merged.findings[0].distance_m == pytest.approx(2500, rel=0.01)
    assert not merged.warnings
    away = merge_markers(heard(*drive(6)), {}, track(north_m=5000.0))
    assert len(away.left_out) == 6
    assert "clocks do not fit" in away.warnings[0]
    assert not merge_markers(heard(*drive(6)), {}, track(100, 140)).findings  # no pose at these times


@pytest.mark.parametrize("with_track", [True, False])
@pytest.mark.parametrize("known", [True, False])
def test_a_swapped_claim_is_named(with_track: bool, known: bool) -> None:
    merged = merge_markers(
        heard(*drive(6), say(7, 1, 7, swap=True)), registry(7) if known else {}, track() if with_track else None
    )
    assert kinds(merged) == {7: Disagreement.SWAPPED}
    assert merged.number.tolist() == [1, 2, 3, 4, 5, 6]


def test_all_claims_swapped_are_named_against_the_track() -> None:
    packets = [say(n, 1, n, swap=True) for n in range(1, 6)]
    assert set(kinds(merge_markers(heard(*packets), {}, track())).values()) == {Disagreement.SWAPPED}


def test_a_shift_of_all_is_another_datum() -> None:
    packets = drive(6, east_m=-0.9, north_m=1.0)
    merged = merge_markers(heard(*packets), registry(1, 2, 3, 4), track())
    assert set(kinds(merged).values()) == {Disagreement.DATUM_SHIFT}
    assert len(merged.left_out) == 6  # those that are not registered are of the same datum
    assert merged.shift_m == pytest.approx((-0.9, 1.0), abs=0.02)
    assert not len(merged.number)
    mixed = merge_markers(heard(*drive(3, east_m=1.3), *[say(n, 1, n) for n in range(4, 7)]), registry(*range(1, 7)))
    assert set(kinds(mixed).values()) == {Disagreement.MOVED}
    assert mixed.shift_m is None


def test_nothing_heard_is_a_result() -> None:
    merged = merge_markers([], {}, track())
    assert len(merged.number) == 0
    assert not merged.findings


def test_rules_are_checked() -> None:
    for values in ({"apart_m": 0.0}, {"reach_m": math.nan}, {"sigmas": -1.0}):
        with pytest.raises(InvalidParameter):
            MergeRules(**values)  # type: ignore[arg-type]


def test_offsets_are_those_of_geodesics() -> None:
    # pyproj's geodesics on WGS 84
    from pyproj import Geod

    start, end = (
        np.array([[LON_DEG, LAT_DEG], [179.99999, -10.0]]),
        np.array([[LON_DEG + 0.01, LAT_DEG - 0.01], [-179.99999, -10.0]]),
    )
    _az, _back, distance = Geod(ellps="WGS84").inv(start[:, 0], start[:, 1], end[:, 0], end[:, 1])
    np.testing.assert_allclose(distances_m(start, end), distance, rtol=1e-5)
    east, north = offsets_m(start, end)[0]
    assert east > 0 > north


def test_places_of_the_vehicle_between_poses() -> None:
    nothing = np.full(4, np.nan)
    around = PoseTrack(
        np.array([0.0, 1, 2, 20]), np.array([179.9999, -179.9999, -179.9998, 0]), np.zeros(4), nothing, nothing
    )
    places = vehicle_positions(around, [-1, 0, 0.5, 1.5, 2, 10, 20, 21, np.nan])
    np.testing.assert_allclose(
        places[:, 0], [np.nan, 179.9999, -180, -179.99985, -179.9998, np.nan, 0, np.nan, np.nan], atol=1e-9
    )


def test_many_markers_take_seconds() -> None:
    packets = [
        VerifiedPacket(packet=p.packet, verdict=p.verdict, number=number, message=p.message)
        for p in heard(say(1, 1, 1))
        for number in range(1, 20_001)
    ]
    began = process_time()
    merge_markers(packets, {n: RegisteredMarker(*place(1)) for n in range(1, 20_001)}, track())
    assert process_time() - began < 3
