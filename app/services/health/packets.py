"""What a packet log shows of the health of CERPMs: those it received, and those that it passed and did not receive."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import datetime
from typing import Any

import numpy as np
import sqlalchemy as sa

from app.decoders.cerpm.merged_markers import Disagreement
from app.decoders.cerpm.signal import SignalProfile
from app.decoders.cerpm.verify import Verdict
from app.families.cerpm.message import radio_of, side_of
from app.geodesy import enu_from_wgs84
from app.markers.cerpm import LaneSide
from app.registry.decodes import NewObservation
from app.registry.marker_rows import MarkerRow
from app.registry.markers import list_near
from app.registry.spatial import distances_m
from app.sensors.pose_track import PoseTrack
from app.services.decodes.fixes import horizontal_rmse_m
from app.services.decodes.packet_documents import claimed_place
from app.services.decodes.packet_matching import ReadPackets
from app.services.decodes.packet_task import DriveFiles
from app.services.health.evidence import EVIDENCE, MISSED, rounded

NEAR_M = 60.0
"""[m] from a marker, within which its packets are strong enough. Source: the CERPM paper, section 4.1: at most
340 m; by hand, a sixth of it, so that only collisions lose packets."""
RECEIVED_SHARE = 0.7
"""Share of strong transmissions that are received. Source: 0.72 by ALOHA in `cerpm-radio` (docs/benchmarks.md)."""
MAX_PROBABILITY = 0.97
"""Of receiving a marker at all. Source: by hand; a truck beside the vehicle shades it."""
MIN_TRANSMISSIONS = 2.0
"""Near a marker, without which a miss is no evidence. Source: by hand."""
TWO_PLACES_M = 5.0
"""[m] between places in messages of one number, from where they are of two markers. Source: by hand; a marker that is
programmed again after a better survey moves by less."""
SEEN, MOVED, CLONED, WRONG_WAY = "seen", "moved", "cloned", "wrong-way"
"""What was observed of a marker."""
MAX_TRACK_M = 50_000.0
MAX_MARKERS = 1000
MESSAGE_SIGMA_M = 0.1
"""[m] each axis, by which positions in messages are rounded and of other epochs. Source: by hand."""
SURVEY_SIGMA_M = 0.35
"""[m] each axis, without a stated accuracy: markers agree with messages within half a metre (`MergeRules.apart_m`)."""
MIN_LEVEL_SIGMA_DB = 2.0
"""[dB] least standard deviation of a level between drives: another car, another lane. Source: `WEAK_DB` is -6 dB."""
LANE_M, MIN_OF_A_SIDE, SIDE_SHARE = 4.0, 2, 0.8
"""[m] beside the vehicle, within which a marker is of its lane; markers of each side that show a direction, and the
share of each that must agree. Source: by hand; a lane is at most 3.75 m wide, and half a lane of error hides a side."""
_ON_ROAD = frozenset({"built", "surveyed", "active", "suspect"})
_MAX_STEP_S = 2.0  # [s] between two poses of the track, for the time near a marker; source: by hand


def packet_evidence(read: ReadPackets, row: MarkerRow, kind: Disagreement | None, files: DriveFiles) -> dict[str, Any]:
    """Evidence of a registered marker whose packets were authentic."""
    number = int(row.digits)
    profile = read.signal.profiles[number]
    evidence: dict[str, Any] = {**_about(row), "along": _heard_at_s(read, number)}
    if kind is Disagreement.TWO_PLACES or _is_in_two_places(read, number):
        return rounded({**evidence, "two_places": True})
    if kind is Disagreement.OUT_OF_REACH:
        place = _track_middle(files.track)
        return rounded({**evidence, "elsewhere_deg": place}) if place is not None else {}
    if kind in (Disagreement.DATUM_SHIFT, Disagreement.SWAPPED):
        return rounded(evidence)
    lon_deg, lat_deg = claimed_place(number, read)
    if lon_deg is not None and lat_deg is not None:
        east, north, _up = enu_from_wgs84(lon_deg, lat_deg, 0.0, (row.lon_deg, row.lat_deg, 0.0))
        evidence |= {
            "offset_m": (float(east), float(north)), "sigma_m": MESSAGE_SIGMA_M, "offset_is_absolute": True,
        }  # fmt: skip
    evidence["expected"] = _expected(row, files.track)
    return rounded({**evidence, **_quality(profile)})


def lane_directions(rows: Sequence[MarkerRow], track: PoseTrack | None) -> dict[str, bool]:
    """Whether the markers of the vehicle's lane were met against its direction, by id; empty where that is not shown.

    A vehicle between the left and the right markers of a lane has the left ones on its left. It is on the wrong way if
    both are on the other side: one of them alone may be the boundary of the next lane.
    """
    found: dict[LaneSide, dict[str, bool]] = {LaneSide.LEFT: {}, LaneSide.RIGHT: {}}
    if track is None or len(track.time_s) < 3:
        return {}
    for row in rows:
        left_m = _left_of_vehicle_m(row, track)
        if side_of(row) is not LaneSide.UNKNOWN and left_m is not None and abs(left_m) <= LANE_M:
            found[side_of(row)][row.id] = (left_m > 0.0) != (side_of(row) is LaneSide.LEFT)
    if any(len(seen) < MIN_OF_A_SIDE for seen in found.values()):
        return {}
    reversed_shares = [sum(seen.values()) / len(seen) for seen in found.values()]
    if max(reversed_shares) > 1.0 - SIDE_SHARE and min(reversed_shares) < SIDE_SHARE:
        return {}
    return dict.fromkeys((marker_id for seen in found.values() for marker_id in seen), min(reversed_shares) > 0.5)


def _left_of_vehicle_m(row: MarkerRow, track: PoseTrack) -> float | None:
    """A marker's distance to the left of the vehicle when it passed; None where it stood or did not pass. [m]"""
    nearest = int(np.argmin(distances_m(row.lon_deg, row.lat_deg, track.lon_deg, track.lat_deg)))
    if not 0 < nearest < len(track.time_s) - 1:
        return None
    beside = slice(nearest - 1, nearest + 2)
    east, north, _up = enu_from_wgs84(
        track.lon_deg[beside], track.lat_deg[beside], 0.0, (row.lon_deg, row.lat_deg, 0.0)
    )  # fmt: skip
    ahead = np.array([east[2] - east[0], north[2] - north[0]])
    length_m = float(np.hypot(*ahead))
    return float(ahead[1] * east[1] - ahead[0] * north[1]) / length_m if length_m > 0.0 else None


def missed_cerpms(
    connection: sa.Connection, agency_id: str, read: ReadPackets, files: DriveFiles, at: datetime
) -> list[NewObservation]:
    """Markers that the vehicle passed closely, for several transmissions, and of which it received nothing."""
    track = files.track
    heard = {packet.number for packet in read.verification.packets}
    if track is None or len(track.time_s) < 2 or not read.signal.profiles:
        return []
    lon_deg, lat_deg = float(np.median(track.lon_deg)), float(np.median(track.lat_deg))
    reach_m = float(distances_m(lon_deg, lat_deg, track.lon_deg, track.lat_deg).max()) + NEAR_M
    if reach_m > MAX_TRACK_M:
        return []
    rows = []
    for row in list_near(connection, agency_id, ("cerpm",), lon_deg, lat_deg, reach_m, limit=MAX_MARKERS):
        if int(row.digits) in heard or row.status not in _ON_ROAD:
            continue
        expected = _expected(row, track)
        if expected > 0.0:
            nearest = int(np.argmin(distances_m(row.lon_deg, row.lat_deg, track.lon_deg, track.lat_deg)))
            evidence = {**_about(row), "expected": expected, "along": float(track.time_s[nearest])}
            rows.append(NewObservation(row.id, 0, at, MISSED, {EVIDENCE: rounded(evidence)}))
    return rows


def _about(row: MarkerRow) -> dict[str, Any]:
    rmse_m = horizontal_rmse_m(row)
    survey_m = SURVEY_SIGMA_M if rmse_m is None else rmse_m / math.sqrt(2)
    return {"family": row.family, "place_deg": (row.lon_deg, row.lat_deg), "survey_m": survey_m}


def _is_in_two_places(read: ReadPackets, number: int) -> bool:
    """Whether packets with valid tags of one drive have places far from each other.

    Of two markers with one number, the packets of the one whose count is behind are out of order, and not used. They
    are no packets that an earlier drive received.
    """
    sent = [
        (packet.message.lon_deg, packet.message.lat_deg)
        for packet in read.verification.packets
        if packet.number == number and packet.message and (packet.accepted or packet.verdict is Verdict.OUT_OF_ORDER)
    ]
    if not sent:
        return False
    lon_deg, lat_deg = np.array(sent).T
    return bool(distances_m(*sent[0], lon_deg, lat_deg).max() > TWO_PLACES_M)


def _heard_at_s(read: ReadPackets, number: int) -> float:
    times = [p.packet.received_at_s for p in read.verification.packets if p.number == number and p.accepted]
    known = [time_s for time_s in times if math.isfinite(time_s)]
    return float(np.median(known)) if known else 0.0


def _quality(profile: SignalProfile) -> dict[str, Any]:
    """Level above the fleet's line in standard deviations; without a fleet there is no usual level."""
    level = profile.level_db
    if level is None or profile.compared_with != "fleet":
        return {}
    sigma_db = max((level.high - level.low) / (2 * 1.96), MIN_LEVEL_SIGMA_DB)
    return {"quality": level.value / sigma_db, "quality_is_relative": True}


def _track_middle(track: PoseTrack | None) -> tuple[float, float] | None:
    if track is None or not len(track.time_s):
        return None
    return float(np.median(track.lon_deg)), float(np.median(track.lat_deg))


def _expected(row: MarkerRow, track: PoseTrack | None) -> float:
    """That a vehicle receives a healthy marker which it passes: 0 where it is not near it for two transmissions."""
    if track is None or len(track.time_s) < 2:
        return 0.0
    near = distances_m(row.lon_deg, row.lat_deg, track.lon_deg, track.lat_deg) <= NEAR_M
    steps = np.minimum(np.diff(track.time_s), _MAX_STEP_S)
    near_s = float(steps[near[1:] & near[:-1]].sum())
    transmissions = near_s / radio_of(row).interval_s
    if transmissions < MIN_TRANSMISSIONS:
        return 0.0
    return min(1.0 - (1.0 - RECEIVED_SHARE) ** math.floor(transmissions), MAX_PROBABILITY)


def with_evidence(
    rows: Sequence[NewObservation], evidence: dict[str, dict[str, Any]], directions: dict[str, bool]
) -> list[NewObservation]:
    """Observations with the evidence of their markers in the detail, and what it shows."""
    found = []
    for row in rows:
        is_reversed, own = directions.get(row.marker_id), evidence.get(row.marker_id)
        if own and is_reversed is not None:
            own = {**own, "reversed": is_reversed}
        what = WRONG_WAY if is_reversed and row.what == SEEN else row.what
        what = CLONED if own and own.get("two_places") and row.what in (SEEN, MOVED) else what
        found.append(row._replace(what=what, detail={**row.detail, EVIDENCE: own} if own else row.detail))
    return found
