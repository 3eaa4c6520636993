"""What magnetometer traces and packet logs show of the health of markers and of stretches of road."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import datetime
from itertools import combinations, pairwise

import numpy as np
import numpy.typing as npt
import scipy
import sqlalchemy as sa

from app.decoders.cerpm.merge import Disagreement
from app.decoders.cerpm.signal import SignalProfile
from app.decoders.cerpm.verify import Verdict
from app.decoders.magnet.identify import ReadTag, ReadTrace, RegisteredTag, TagFix
from app.decoders.magnet.readings import TagReading
from app.decoding.recordings import DriveFiles, ReadPackets, radio_of, side_of
from app.geodesy import enu_from_wgs84, wgs84_from_enu
from app.health import StretchDrive, stretch_drive
from app.health.states import LonLat
from app.lanes.smooth_line import lengths_along, mean_fixes, plane_from_wgs84, wgs84_from_plane
from app.lanes.types import Lane
from app.markers.cerpm import LaneSide
from app.markers.reading import MarkerRow, horizontal_rmse_m
from app.planning.predict.rates import tag_rate
from app.registry.decodes import NewObservation
from app.registry.markers import list_near
from app.registry.spatial import distances_m
from app.sensors.magnetometer_bar import MagnetometerBar
from app.sensors.pose_track import PoseTrack
from app.services.decodes.packet_documents import MAX_PATH_SIGMA_M, claimed_place
from app.services.health.record import EVIDENCE, MISSED, STRETCH, rounded
from app.values import JsonObject

# === What a packet log shows of the health of CERPMs: those it received, and those that it passed and did not receive.


NEAR_M = 60.0
"""[m] from a marker, within which its packets are strong enough. Source: the CERPM paper, section 4.1: at most
340 m. A sixth of it, so that only collisions lose packets."""
RECEIVED_SHARE = 0.7
"""Share of strong transmissions that are received. Source: 0.72 by ALOHA in `cerpm-radio` (docs/benchmarks.md)."""
MAX_PROBABILITY = 0.97
"""Of receiving a marker at all. A truck beside the vehicle shades it."""
MIN_TRANSMISSIONS = 2.0
"""Near a marker, without which a miss is no evidence."""
TWO_PLACES_M = 5.0
"""[m] between places in messages of one number, from where they are of two markers. A marker that is programmed again
after a better survey moves by less."""
SEEN, MOVED, CLONED, WRONG_WAY = "seen", "moved", "cloned", "wrong-way"
"""What was observed of a marker."""
MAX_TRACK_M = 50_000.0
MAX_MARKERS = 1000
MESSAGE_SIGMA_M = 0.1
"""[m] each axis, by which positions in messages are rounded and of other epochs."""
CERPM_SURVEY_SIGMA_M = 0.35
"""[m] each axis, without a stated accuracy: markers agree with messages within half a metre (`MergeRules.apart_m`)."""
MIN_LEVEL_SIGMA_DB = 2.0
"""[dB] least standard deviation of a level between drives: another car, another lane. Source: `WEAK_DB` is -6 dB."""
LANE_M, MIN_OF_A_SIDE, SIDE_SHARE = 4.0, 2, 0.8
"""[m] beside the vehicle, within which a marker is of its lane; markers of each side that show a direction, and the
share of each that must agree. A lane is at most 3.75 m wide, and half a lane of error hides a side."""
_ON_ROAD = frozenset({"built", "surveyed", "active", "suspect"})
_MAX_STEP_S = 2.0  # [s] between two poses of the track, for the time near a marker


def packet_evidence(
    read: ReadPackets, row: MarkerRow, kind: Disagreement | None, files: DriveFiles
) -> dict[str, object]:
    """Evidence of a registered marker whose packets were authentic."""
    number = int(row.digits)
    profile = read.signal.profiles[number]
    evidence: dict[str, object] = {**_about(row), "along": _heard_at_s(read, number)}
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
        evidence |= {"offset_m": (float(east), float(north)), "sigma_m": MESSAGE_SIGMA_M, "offset_is_absolute": True}
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
    )
    ahead = np.array([east[2] - east[0], north[2] - north[0]])
    length_m = float(np.hypot(*ahead))
    return float(ahead[1] * east[1] - ahead[0] * north[1]) / length_m if length_m > 0.0 else None


def missed_cerpms(
    connection: sa.Connection, agency_id: str, read: ReadPackets, files: DriveFiles, at: datetime
) -> list[NewObservation]:
    """Markers that the vehicle passed closely, for several transmissions, and of which it received nothing."""
    track = files.track
    received = {packet.number for packet in read.verification.packets}
    if track is None or len(track.time_s) < 2 or not read.signal.profiles:
        return []
    lon_deg, lat_deg = float(np.median(track.lon_deg)), float(np.median(track.lat_deg))
    reach_m = float(distances_m(lon_deg, lat_deg, track.lon_deg, track.lat_deg).max()) + NEAR_M
    if reach_m > MAX_TRACK_M:
        return []
    rows = []
    for row in list_near(connection, agency_id, ("cerpm",), lon_deg, lat_deg, reach_m, limit=MAX_MARKERS):
        if int(row.digits) in received or row.status not in _ON_ROAD:
            continue
        expected = _expected(row, track)
        if expected > 0.0:
            nearest = int(np.argmin(distances_m(row.lon_deg, row.lat_deg, track.lon_deg, track.lat_deg)))
            evidence = {**_about(row), "expected": expected, "along": float(track.time_s[nearest])}
            rows.append(NewObservation(row.id, 0, at, MISSED, {EVIDENCE: rounded(evidence)}))
    return rows


def _about(row: MarkerRow) -> dict[str, object]:
    rmse_m = horizontal_rmse_m(row)
    survey_m = CERPM_SURVEY_SIGMA_M if rmse_m is None else rmse_m / math.sqrt(2)
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


def _quality(profile: SignalProfile) -> dict[str, object]:
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
    rows: Sequence[NewObservation], evidence: dict[str, dict[str, object]], directions: dict[str, bool]
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


# === What a packet log shows of the stretches that were driven: how the vehicle's track lies beside the markers' path.


STRETCH_M = 500.0
"""[m] length of a stretch: of the measure of its road, or of a cell of the map where markers have none. A receiver's
error is the same over it, and a survey or a datum seldom changes within it."""
_STRETCH_STEP_M = 5.0  # [m] between places that are compared
_MAX_BESIDE_M = 20.0  # [m] places further from the path are of another road; one drive shows larger shifts
_MAX_FROM_MARKER_M = 100.0  # [m] places further from all markers belong to no stretch
_MIN_PLACES = 10  # on the stretch, without which a drive shows nothing of it
_CELL_DEG = STRETCH_M / 111_320.0  # [deg] of latitude


def with_stretches(
    observed: Sequence[NewObservation], rows: Sequence[MarkerRow], lane: Lane, track: PoseTrack | None
) -> list[NewObservation]:
    """Observations, with the evidence of each stretch that was driven in the detail of one of its markers.

    Parameters
    ----------
    rows : sequence of MarkerRow
        Registered markers that were received.
    lane : Lane
        The path through their positions.
    """
    first: dict[str, str] = {}
    for row in rows:
        first.setdefault(_stretch_of(row)[0], row.id)
    found = {first[document["subject"]]: document for document in _stretch_documents(rows, lane, track)}
    return [
        one._replace(detail={**one.detail, STRETCH: found.pop(one.marker_id)}) if one.marker_id in found else one
        for one in observed
    ]


def _stretch_of(row: MarkerRow) -> tuple[str, float | None]:
    """Subject of the test of a marker's stretch, and the measure where the stretch begins; None without a road. [m]"""
    if row.road is not None and row.measure_m is not None:
        number = math.floor(row.measure_m / STRETCH_M)
        return f"stretch:{row.road[:160]}:{number}", number * STRETCH_M
    north = math.floor(row.lat_deg / _CELL_DEG)
    east = math.floor(row.lon_deg * math.cos(math.radians((north + 0.5) * _CELL_DEG)) / _CELL_DEG)
    return f"stretch:{east},{north}", None


def _stretch_documents(rows: Sequence[MarkerRow], lane: Lane, track: PoseTrack | None) -> list[JsonObject]:
    if track is None or not rows or len(lane.station_m) < 2 or not np.isfinite(lane.heading_deg).all():
        return []
    origin = (lane.origin_lon_deg, lane.origin_lat_deg)
    vehicle_m = mean_fixes(plane_from_wgs84(track.lon_deg, track.lat_deg, origin), _STRETCH_STEP_M)
    if len(vehicle_m) < _MIN_PLACES:
        return []
    along_m = lengths_along(vehicle_m)
    lons_deg, lats_deg = np.array([(row.lon_deg, row.lat_deg) for row in rows]).T
    marker_m = plane_from_wgs84(lons_deg, lats_deg, origin)
    beside_m, at = (np.asarray(one) for one in scipy.spatial.cKDTree(lane.position_enu_m).query(vehicle_m))
    from_marker_m, marker = (np.asarray(one) for one in scipy.spatial.cKDTree(marker_m).query(vehicle_m))
    taken = (at > 0) & (at < len(lane.station_m) - 1) & (beside_m <= _MAX_BESIDE_M)
    taken &= (from_marker_m <= _MAX_FROM_MARKER_M) & (lane.sigma_m[at] <= MAX_PATH_SIGMA_M)
    taken &= np.isfinite(lane.width_m[at])  # else the path is by the usual width, which is the same error each time
    for stretch in lane.stretches:
        if stretch.lane or stretch.changing:
            taken &= (lane.station_m[at] < stretch.from_m) | (lane.station_m[at] > stretch.to_m)
    stretches = [_stretch_of(row) for row in rows]
    documents = []
    for subject, measure_m in sorted(set(stretches), key=lambda one: one[0]):
        own = np.array([stretch[0] == subject for stretch in stretches])
        here = taken & own[marker]
        if here.sum() < _MIN_PLACES:
            continue
        yaw = np.radians(90.0 - lane.heading_deg[at[here]])
        normal = np.stack([-np.sin(yaw), np.cos(yaw)], axis=1)
        path_m = lane.position_enu_m[at[here]]
        information, weighted = stretch_drive(vehicle_m[here], path_m, normal, along_m[here], track.usual_accuracy_m)
        lon_deg, lat_deg = (float(one[0]) for one in wgs84_from_plane(path_m.mean(axis=0)[None], origin))
        heading_deg = math.degrees(math.atan2(float(np.cos(yaw).mean()), float(np.sin(yaw).mean()))) % 360.0
        registered = [row for row, stretch in zip(rows, stretches, strict=True) if stretch[0] == subject]
        stated_m = [rmse_m for row in registered if (rmse_m := horizontal_rmse_m(row)) is not None]
        survey_m = float(np.median(stated_m)) / math.sqrt(2) if stated_m else 0.0
        drive = StretchDrive(lon_deg, lat_deg, heading_deg, information, weighted, survey_m)
        documents.append(
            {"subject": subject, "road": registered[0].road, "measure_m": measure_m, "drive": drive.document()}
        )
    return documents


# === What a magnetometer trace shows of the health of tags: those it read, and those it passed over and did not read.


MIN_TAGS = 4
"""Tags of a drive from which the odometer's scale is known. Of three, one may have moved."""
MAX_GAP_M = 300.0
"""[m] between tags whose path between them is known."""
ODOMETER_SHARE = 0.002
"""Standard deviation of the odometer over a distance, after its scale is taken out."""
SURVEY_SIGMA_M = 0.7
"""[m] each axis, without a stated accuracy. Source: `ASSUMED_HORIZONTAL_RMSE_M`, both axes together."""
WANDER_M, WANDER_PER_M = 0.1, 0.002
"""[m, 1] standard deviation of the path between two tags from the curve through both."""
MAX_BEND = 0.02
"""Share by which the way driven may exceed the straight line between two tags. 0.7 rad of a bend."""
SIGNAL_SIGMA = 0.06
"""Standard deviation of the logarithm of a tag's mean moment between passes. Twice the 0.03 of simulated passes at a
clearance of 28 cm (0.02 at 16 cm); the decoder reads tags down to about 0.65 of their moment."""
FAR_M = 50.0
"""[m] from its place, from where a tag is elsewhere. Source: `app.health.marker_tests.SAME_PLACE_M`; a bend that
`MAX_BEND` allows between tags `MAX_GAP_M` apart is 41 m beside the straight line."""


def tag_evidence(trace: ReadTrace) -> dict[str, dict[str, object]]:
    """Evidence of the registered tags that a trace read, by marker; of one that was passed twice, of the first.

    A tag that was read far from its place is evidence of where it was read; one that was read at its place too is in
    two places.
    """
    at_place, far = _by_place(trace)
    read: dict[str, ReadTag] = {}
    for tag in at_place:
        read.setdefault(_marker_id(tag), tag)
    along = _along_offsets(list(read.values()))
    found = {
        marker_id: rounded(_evidence(tag, offset) | ({"two_places": True} if marker_id in far else {}))
        for (marker_id, tag), offset in zip(read.items(), along, strict=True)
    }
    for marker_id, (tag, place) in far.items():
        about = _about_tag(_registered(tag)) | {"along": tag.reading.start_s, "elsewhere_deg": place}
        found.setdefault(marker_id, rounded(about))
    return found


def missed_tags(
    trace: ReadTrace, nearby: Sequence[RegisteredTag], complete: bool, bar: MagnetometerBar, at: datetime
) -> list[NewObservation]:
    """Tags that lie on the path between two tags that were read, within the width of the bar."""
    if not complete:
        return []
    read = {_marker_id(tag) for tag in trace.tags if tag.match is not None and tag.match.tag is not None}
    others = {tag.match.others for tag in trace.tags if tag.match is not None}
    doubtful = {marker_id for several in others for marker_id in several}
    rows: dict[str, NewObservation] = {}
    fixed = [tag for tag in _by_place(trace)[0] if tag.fix is not None]
    for first, second in pairwise(fixed):
        assert first.fix is not None
        assert second.fix is not None
        gap_m = second.reading.magnets[0].odometer_m - first.reading.magnets[-1].odometer_m
        if not 0.0 < gap_m <= MAX_GAP_M:
            continue
        for tag in nearby:
            if tag.marker_id in read or tag.marker_id in doubtful or tag.status not in _ON_ROAD:
                continue
            clearance_m = _distance_m(first.reading) - _registered(first).depth_m
            rate = tag_rate(clearance_m + tag.depth_m, tag.tag.magnet_count)
            expected = rate * _inside_probability(first.fix, second.fix, gap_m, tag, bar)
            if expected > 0.0 and tag.marker_id not in rows:
                along = 0.5 * (first.reading.start_s + second.reading.start_s)
                evidence = rounded({**_about_tag(tag), "expected": expected, "along": along})
                rows[tag.marker_id] = NewObservation(tag.marker_id, 0, at, MISSED, {EVIDENCE: evidence})
    return list(rows.values())


def _registered(tag: ReadTag) -> RegisteredTag:
    """The registered tag of a reading that has one."""
    assert tag.match is not None
    assert tag.match.tag is not None
    return tag.match.tag


def _marker_id(tag: ReadTag) -> str:
    return _registered(tag).marker_id


def _by_place(trace: ReadTrace) -> tuple[list[ReadTag], dict[str, tuple[ReadTag, LonLat]]]:
    """Readings of registered tags at their place; and by marker the first one far from it, with where it was."""
    matched = [tag for tag in trace.tags if tag.match is not None and tag.match.tag is not None]
    at_place: list[ReadTag] = []
    far: dict[str, tuple[ReadTag, LonLat]] = {}
    for number, tag in enumerate(matched):
        place = _elsewhere_deg(matched, number)
        if place is None:
            at_place.append(tag)
        else:
            far.setdefault(_marker_id(tag), (tag, place))
    return at_place, far


def _elsewhere_deg(tags: Sequence[ReadTag], number: int) -> LonLat | None:
    """Where a tag was read, if that is far from its place: longitude and latitude. [deg]

    The tags that were read before and after it give the place, if their own distance is that of the odometer, and the
    way from one to the other is the direction of one of them.
    """
    tag = tags[number]
    if not 0 < number < len(tags) - 1:
        return None
    before, after = tags[number - 1], tags[number + 1]
    first, second = _registered(before), _registered(after)
    if tag.reading.tag is None or _marker_id(tag) in (first.marker_id, second.marker_id):
        return None
    origin = (first.lon_deg, first.lat_deg, 0.0)
    chord = np.asarray(enu_from_wgs84(second.lon_deg, second.lat_deg, 0.0, origin))
    driven_m = _odometer(after) - _odometer(before)
    if not 0.0 < driven_m <= MAX_GAP_M or not _is_way_between(driven_m, float(np.linalg.norm(chord[:2]))):
        return None
    if not any(fix and chord[:2] @ _direction(fix.heading_deg) > 0.0 for fix in (before.fix, after.fix)):
        return None
    share = (_odometer(tag) - _odometer(before)) / driven_m
    place_m = share * chord[:2]
    registered = _registered(tag)
    own_m = np.asarray(enu_from_wgs84(registered.lon_deg, registered.lat_deg, 0.0, origin))[:2]
    if float(np.linalg.norm(place_m - own_m)) < FAR_M:
        return None
    lon_deg, lat_deg, _up = wgs84_from_enu(np.array([*place_m, 0.0]), origin)
    return float(lon_deg), float(lat_deg)


def _is_way_between(driven_m: float, chord_m: float) -> bool:
    """Whether a way driven fits the straight line between two tags."""
    return chord_m >= 1.0 and abs(driven_m - chord_m) <= MAX_BEND * chord_m + 10.0


def _about_tag(tag: RegisteredTag) -> dict[str, object]:
    survey_m = SURVEY_SIGMA_M if tag.horizontal_rmse_m is None else tag.horizontal_rmse_m / math.sqrt(2)
    return {"family": "magnet", "place_deg": (tag.lon_deg, tag.lat_deg), "survey_m": survey_m}


def _evidence(tag: ReadTag, along: tuple[float, float] | None) -> dict[str, object]:
    reading, registered = tag.reading, _registered(tag)
    evidence = {
        **_about_tag(registered),
        "along": reading.start_s,
        "expected": _read_rate(reading),
        "reversed": reading.wrong_way,
    }
    moment = np.linalg.norm([magnet.moment_am2 for magnet in reading.magnets], axis=1)
    if (moment > 0.0).all():
        evidence["quality"] = float(np.log(moment).mean()) / SIGNAL_SIGMA
    if along is not None:
        offset_m, sigma_m = along
        heading = math.radians(registered.bearing_deg + (180.0 if reading.wrong_way else 0.0))
        evidence |= {
            "offset_m": (offset_m * math.sin(heading), offset_m * math.cos(heading)),
            "sigma_m": sigma_m,
            "heading_deg": math.degrees(heading) % 360.0,
        }
    return evidence


def _read_rate(reading: TagReading) -> float:
    """That a tag is read which the bar passes: the decoder's rate by distance (app/planning/predict/rates.py)."""
    return tag_rate(_distance_m(reading), len(reading.magnets))


def _distance_m(reading: TagReading) -> float:
    """From the bar down to the magnets. [m]"""
    return float(np.median([magnet.clearance_cm for magnet in reading.magnets])) / 100.0


def _along_offsets(tags: Sequence[ReadTag]) -> list[tuple[float, float] | None]:
    """Where each tag was met along the road, less where it is registered, with the standard deviation. [m]

    The odometer measures distances from tag to tag, and the registry has them too. Its scale is the median over all
    pairs of tags (Theil and Sen), which one tag that has moved does not change.
    """
    if len(tags) < MIN_TAGS:
        return [None] * len(tags)
    places, odometer = np.array([_middle(tag) for tag in tags]), np.array([_odometer(tag) for tag in tags])
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    registered = np.concatenate([[0.0], np.cumsum(steps)])
    pairs = [(i, j) for i, j in combinations(range(len(tags)), 2) if registered[j] - registered[i] > 1.0]
    if not pairs:
        return [None] * len(tags)
    scale = float(np.median([(odometer[j] - odometer[i]) / (registered[j] - registered[i]) for i, j in pairs]))
    # distances from the nearest tags, as an odometer's error grows along the road; four also at the ends, of which one
    # that has moved does not change the median
    offsets: list[tuple[float, float] | None] = []
    for k in range(len(tags)):
        beside = sorted((j for j in range(len(tags)) if j != k), key=lambda j: abs(j - k))[:4]
        apart = [(odometer[k] - odometer[j]) / scale - (registered[k] - registered[j]) for j in beside]
        gap_m = float(np.median([abs(registered[k] - registered[j]) for j in beside]))
        along_std_m = tags[k].reading.magnets[0].along_std_m or 0.0
        offsets.append((float(np.median(apart)), ODOMETER_SHARE * gap_m + along_std_m))
    return offsets


def _middle(tag: ReadTag) -> tuple[float, float]:
    """The middle of a registered tag, east and north of where its lane begins. [m]"""
    registered = _registered(tag)
    east, north, _up = enu_from_wgs84(
        registered.lon_deg, registered.lat_deg, 0.0, (registered.lane_lon_deg, registered.lane_lat_deg, 0.0)
    )
    half_m, bearing = 0.5 * registered.tag.length_m, math.radians(registered.bearing_deg)
    return float(east) + half_m * math.sin(bearing), float(north) + half_m * math.cos(bearing)


def _odometer(tag: ReadTag) -> float:
    """Where the middle of a tag was met. [m]"""
    return 0.5 * (tag.reading.magnets[0].odometer_m + tag.reading.magnets[-1].odometer_m)


def _inside_probability(first: TagFix, second: TagFix, gap_m: float, tag: RegisteredTag, bar: MagnetometerBar) -> float:
    """That a tag between two fixes lies within the bar; 0 elsewhere.

    The path is the cubic curve through both positions in both headings (Hermite).
    """
    origin = (first.lon_deg, first.lat_deg, 0.0)
    end = np.asarray(enu_from_wgs84(second.lon_deg, second.lat_deg, 0.0, origin))[:2]
    there = np.asarray(enu_from_wgs84(tag.lon_deg, tag.lat_deg, 0.0, origin))[:2]
    chord_m = float(np.linalg.norm(end))
    if not _is_way_between(gap_m, chord_m):
        return 0.0
    share = np.linspace(0.0, 1.0, 201)[:, None]
    starts, ends = (chord_m * _direction(fix.heading_deg) for fix in (first, second))
    path = (
        (share**3 - 2 * share**2 + share) * starts + (3 * share**2 - 2 * share**3) * end + (share**3 - share**2) * ends
    )
    nearest = int(np.argmin(np.linalg.norm(path - there, axis=1)))
    if not 2 <= nearest <= len(path) - 3:
        return 0.0
    left = path[nearest + 1] - path[nearest - 1]
    left = np.array([-left[1], left[0]]) / np.linalg.norm(left)
    aside_m = float((there - path[nearest]) @ left)
    array = bar.positions_m[bar.array][:, 1]
    low, high = float(array.min()), float(array.max())
    sigma_m = WANDER_M + WANDER_PER_M * min(gap_m, chord_m)
    return float(scipy.stats.norm.cdf((high - aside_m) / sigma_m) - scipy.stats.norm.cdf((low - aside_m) / sigma_m))


def _direction(heading_deg: float) -> npt.NDArray[np.float64]:
    return np.array([math.sin(math.radians(heading_deg)), math.cos(math.radians(heading_deg))])
