"""A drive past the CERPMs of a stretch of lane: packets, the path that follows from them, and its errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy

from app.decoders.cerpm.merge import merge_markers
from app.decoders.cerpm.merged_markers import RegisteredMarker
from app.decoders.cerpm.verify import verify_packets
from app.encoders.cerpm.payload import encode_message
from app.lanes.estimate import Lane as LanePathEstimate
from app.lanes.estimate import LaneMarkers, fit_lane
from app.markers.cerpm import DEGREE_STEP, CerpmMessage, LaneSide
from app.markers.cerpm_keys import derive_marker_key
from app.planning.alignment import Floats, Lane
from app.planning.plan import PlannedCerpm, PlannedMarker
from app.planning.proof.results import LanePath
from app.radio.settings import RadioSettings
from app.simulation.radio.drive import drive_past
from app.simulation.radio.driving import Driver, SatelliteReceiver
from app.simulation.radio.lanes import TrueLane, lane_from_wgs84
from app.simulation.radio.link import Radio
from app.simulation.radio.markers import InstalledMarkers

AUDIBLE_M, ASIDE_M = 350.0, 50.0
"""[m] beyond a stretch and beside it, within which markers send while it is driven. Source: the preview of the CERPM
paper, 340 m; four lanes."""
BEYOND_M = 150.0
"""[m] of lane before and after a stretch that are driven too, so that its ends are no ends of the path. Source: the
`bridge_m` of `LaneRules`."""
NEAR_M = 1.0
"""[m] a place of the centre line is covered if the path is within this. Source: benchmarks/cerpm/path_errors.py."""
PLACING_SD_M = 0.01
"""[m] of placing a marker, each axis. Source: app/simulation/radio/markers.py."""
_KEY = bytes(range(16))  # of the simulated agency; the proof needs authentic packets, not secret ones
_STEP_M = 1.0  # [m] between points of a boundary; source: the alignment's own step
_MAX_JITTER = 0.45  # source: `Radio` needs less than half
_MIN_ACCURACY_M = 1e-3  # [m] of a survey, so that its weight is finite; source: by hand


@dataclass(frozen=True, slots=True, eq=False)
class LanePass:
    """A drive along a stretch of a lane.

    Attributes
    ----------
    lane : Lane
    from_m, to_m : float
        Of the lane, in which errors count. [m]
    markers : sequence of (PlannedMarker, float, float)
        CERPMs within reach of the radio, with chainage and offset on the lane; missing ones are left out. [m]
    own : frozenset of int
        Registry numbers of those that are registered on the boundaries of the lane: the path is fitted to them.
    radio : Radio
    speed_m_s, survey_rmse_m : float
    rng : numpy.random.Generator
    """

    lane: Lane
    from_m: float
    to_m: float
    markers: Sequence[tuple[PlannedMarker, float, float]]
    own: frozenset[int]
    radio: Radio
    speed_m_s: float
    survey_rmse_m: float
    rng: np.random.Generator


def drive_cerpms(one: LanePass) -> LanePath:
    """Drive, verify and merge the packets, fit the lane's path, and compare it with the true centre line."""
    low, high = max(one.from_m - BEYOND_M, 0.0), min(one.to_m + BEYOND_M, one.lane.length_m)
    true = true_lane(one.lane, low, high)
    installed = install(one, true, low)
    simulated = drive_past(
        true, installed, one.rng, sign=_sign, radio=one.radio, driver=Driver(speed_m_s=one.speed_m_s),
        receiver=SatelliteReceiver.rtk(),
    )  # fmt: skip
    registered = _registered(installed, one.survey_rmse_m)
    verified = verify_packets(simulated.packets, {int(number): _key_of(int(number)) for number in installed.number})
    merged = merge_markers(verified.packets, registered, simulated.track)
    at = dict(zip(installed.number.tolist(), installed.chainage_m.tolist(), strict=True))
    used = np.array([n in one.own and 0.0 <= at[n] <= high - low for n in merged.number.tolist()], bool)
    columns = (merged.number, merged.lon_deg, merged.lat_deg, merged.side, merged.sigma_m, merged.speed_limit_km_h)
    path = fit_lane(LaneMarkers(*(column[used] for column in columns)), simulated.track)
    inside = np.isin(installed.number, list(one.own))
    inside &= (installed.chainage_m + low >= one.from_m) & (installed.chainage_m + low <= one.to_m)
    heard = np.isin(installed.number[inside], merged.number)
    return judge_path(path, true, one, low, (int(heard.sum()), int(inside.sum())))


def simulated_radio(settings: RadioSettings) -> Radio:
    """The radio as it is simulated: on one channel, so that settings with several fare worse than they would."""
    return Radio(
        spreading_factor=settings.spreading_factor,
        bandwidth_hz=settings.bandwidth_hz,
        interval_s=settings.interval_s,
        jitter=min(settings.jitter_share, _MAX_JITTER),
        preamble_symbols=settings.preamble_symbols,
    )


def true_lane(lane: Lane, from_m: float, to_m: float) -> TrueLane:
    """A stretch of a lane between its boundaries; chainage 0 is its start."""
    at = np.linspace(from_m, to_m, max(math.ceil((to_m - from_m) / _STEP_M), 2) + 1)
    half = lane.value_at(lane.width_m, at) / 2
    left, right = (np.stack(lane.position_at(at, sign * half), 1) for sign in (1.0, -1.0))
    return lane_from_wgs84(left, right)


def install(one: LanePass, true: TrueLane, low_m: float) -> InstalledMarkers:
    """The stretch's markers, placed within a centimetre and surveyed."""
    lon = np.array([marker.lon_deg for marker, _, _ in one.markers])
    lat = np.array([marker.lat_deg for marker, _, _ in one.markers])
    count = len(one.markers)
    point = true.enu_from_wgs84(lon, lat) + one.rng.normal(0, PLACING_SD_M, (count, 2))
    survey = one.rng.normal(0, one.survey_rmse_m / math.sqrt(2), (count, 2))
    surveyed_lon, surveyed_lat = true.wgs84_from_enu(point + survey)
    details = [_planned(marker) for marker, _, _ in one.markers]
    return InstalledMarkers(
        number=np.array([detail.number for detail in details], np.int64),
        side=np.array([int(LaneSide.LEFT if left > 0 else LaneSide.RIGHT) for _, _, left in one.markers], np.int64),
        chainage_m=np.array([at - low_m for _, at, _ in one.markers]),
        point_m=point,
        lon_deg=np.round(surveyed_lon / DEGREE_STEP) * DEGREE_STEP,
        lat_deg=np.round(surveyed_lat / DEGREE_STEP) * DEGREE_STEP,
        broadcast_side=np.array([int(detail.side) for detail in details], np.int64),
        speed_limit=details[0].speed_limit if details else None,
    )


def judge_path(path: LanePathEstimate, true: TrueLane, one: LanePass, low_m: float, heard: tuple[int, int]) -> LanePath:
    """Distances of the true centre line's places from the path, between the first and the last marker."""
    ends = [at - low_m for marker, at, _ in one.markers if _planned(marker).number in one.own] or [0.0]
    inside = (true.chainage_m >= max(one.from_m - low_m, min(ends))) & (
        true.chainage_m <= min(one.to_m - low_m, max(ends))
    )
    result = LanePath(
        places=int(inside.sum()), covered=0, square_sum_m2=0.0, worst_m=0.0, worst_at_m=one.from_m, heard=heard[0],
        markers=heard[1], left_out=sorted({out.number for out in path.left_out}), refusal=path.refusal,
    )  # fmt: skip
    if path.refusal is not None or len(path.lon_deg) < 2 or not inside.any():
        return result
    away = distances_m(true.centre_m[inside], true.enu_from_wgs84(path.lon_deg, path.lat_deg))
    covered = away <= NEAR_M
    if covered.any():
        worst = int(np.argmax(np.where(covered, away, -1.0)))
        result["covered"] = int(covered.sum())
        result["square_sum_m2"] = float((away[covered] ** 2).sum())
        result["worst_m"] = float(away[worst])
        result["worst_at_m"] = float(true.chainage_m[inside][worst] + low_m)
    return result


def distances_m(places_m: Floats, line_m: Floats) -> Floats:
    """Distance of places from a line of close points, shape (K,). [m]"""
    line = line_m[np.concatenate([[True], np.linalg.norm(np.diff(line_m, axis=0), axis=1) > 1e-9])]
    pieces = np.diff(line, axis=0)
    square = (pieces**2).sum(1)
    nearest = scipy.spatial.cKDTree(line).query(places_m)[1]
    away = np.full(len(places_m), np.inf)
    for piece in (np.maximum(nearest - 1, 0), np.minimum(nearest, len(pieces) - 1)):
        beside = places_m - line[piece]
        share = np.clip(np.einsum("ij,ij->i", beside, pieces[piece]) / square[piece], 0.0, 1.0)
        away = np.minimum(away, np.linalg.norm(beside - share[:, None] * pieces[piece], axis=1))
    return away


def _registered(installed: InstalledMarkers, rmse_m: float) -> dict[int, RegisteredMarker | None]:
    sigma_m = max(rmse_m / math.sqrt(2), _MIN_ACCURACY_M)
    return {
        int(number): RegisteredMarker(float(lon), float(lat), side=LaneSide(int(side)), sigma_m=sigma_m)
        for number, lon, lat, side in zip(
            installed.number, installed.lon_deg, installed.lat_deg, installed.broadcast_side, strict=True
        )
    }


@lru_cache(maxsize=200_000)
def _key_of(number: int) -> bytes:
    return derive_marker_key(_KEY, number)


def _sign(message: CerpmMessage) -> bytes:
    return encode_message(message, _key_of(message.number))


def _planned(marker: PlannedMarker) -> PlannedCerpm:
    assert isinstance(marker.detail, PlannedCerpm)
    return marker.detail
