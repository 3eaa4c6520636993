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
from app.families.cerpm.message import radio_of
from app.geodesy import enu_from_wgs84
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
MAX_TRACK_M = 50_000.0
MAX_MARKERS = 1000
MESSAGE_SIGMA_M = 0.1
"""[m] each axis, by which positions in messages are rounded and of other epochs. Source: by hand."""
SURVEY_SIGMA_M = 0.35
"""[m] each axis, without a stated accuracy: markers agree with messages within half a metre (`MergeRules.apart_m`)."""
MIN_LEVEL_SIGMA_DB = 2.0
"""[dB] least standard deviation of a level between drives: another car, another lane. Source: `WEAK_DB` is -6 dB."""
_ON_ROAD = frozenset({"built", "surveyed", "active", "suspect"})
_MAX_STEP_S = 2.0  # [s] between two poses of the track, for the time near a marker; source: by hand


def packet_evidence(read: ReadPackets, row: MarkerRow, kind: Disagreement | None, files: DriveFiles) -> dict[str, Any]:
    """Evidence of a registered marker whose packets were authentic."""
    number = int(row.digits)
    profile = read.signal.profiles[number]
    evidence: dict[str, Any] = {**_about(row), "along": _heard_at_s(read, number)}
    if kind is Disagreement.TWO_PLACES:
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


def with_evidence(rows: Sequence[NewObservation], evidence: dict[str, dict[str, Any]]) -> list[NewObservation]:
    """Observations with the evidence of their markers in the detail."""
    return [
        row._replace(detail={**row.detail, EVIDENCE: evidence[row.marker_id]}) if evidence.get(row.marker_id) else row
        for row in rows
    ]
