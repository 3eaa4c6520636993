"""Events on lanes: those of the file at the nearest lane, changes of the speed limit, and curves."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import scipy

from app.errors import InvalidParameter
from app.formats.alignments.geometry import AlignmentFile, EventGeometry, EventKind, LaneGeometry
from app.planning.alignment import Lane, RoadEvent
from app.planning.road.ground_line import steps_m
from app.planning.rules import RoadRules
from app.values import Floats

REACH_M = 15.0
"""Farthest distance of an event from its lane. [m] Signs stand beside four lanes."""
_GAP_M = 10.0  # [m] parts of a bend that are nearer are one; two seconds of steering at 20 km/h
_EARTH_M = 6_371_000.0  # [m] mean radius; source: IUGG


def find_events(
    file: AlignmentFile,
    geometries: Sequence[LaneGeometry],
    lanes: Sequence[Lane],
    places_deg: Floats,
    rules: RoadRules,
    warnings: list[str],
) -> list[RoadEvent]:
    """Events by lane and chainage.

    Parameters
    ----------
    geometries : sequence of LaneGeometry
        That the lanes were made of.
    places_deg : ndarray, shape (N, 2)
        Longitude and latitude of the file's events.
    warnings : list of str
        Gets a sentence for each event that lies on no lane.

    Raises
    ------
    InvalidParameter
        An event names a lane that the file does not have.
    """
    events = _stated_events(file, lanes, places_deg, warnings)
    by_name = {geometry.name: geometry for geometry in geometries}
    curved = {event.lane for event in events if event.kind is EventKind.CURVE}
    limited = {event.lane for event in events if event.kind is EventKind.SPEED_LIMIT}
    for lane in lanes:
        if lane.name not in curved:
            events += find_curves(lane, rules.curve_radius_m, rules.curve_turn_deg)
        if lane.name not in limited and by_name[lane.name].speed_limit_m_s is not None and not rules.override_speed:
            events += _speed_changes(lane)
    order = {lane.name: k for k, lane in enumerate(lanes)}
    return sorted(events, key=lambda event: (order[event.lane], event.chainage_m))


def find_curves(lane: Lane, radius_m: float, turn_deg: float) -> list[RoadEvent]:
    """Bends with a smaller radius that turn by more than an angle, at their start.

    Parameters
    ----------
    radius_m : float
        [m]
    turn_deg : float
        [deg]

    Returns
    -------
    list of RoadEvent
        Values are turns, left positive. [deg]
    """
    bent = np.where(np.abs(lane.curvature_per_m) > 1 / radius_m, np.sign(lane.curvature_per_m), 0.0)
    found = np.flatnonzero(bent)
    if not len(found):
        return []
    far = np.diff(lane.chainage_m[found]) > _GAP_M
    starts = np.flatnonzero(np.concatenate([[True], far | (np.diff(bent[found]) != 0)]))
    ends = np.append(starts[1:], len(found)) - 1
    turned = np.concatenate([[0.0], np.cumsum((lane.curvature_per_m[1:] + lane.curvature_per_m[:-1]) / 2)])
    turned = np.degrees(turned * lane.step_m)
    first, last = found[starts], found[ends]
    values = turned[last] - turned[first]
    return [
        RoadEvent(EventKind.CURVE, lane.name, float(lane.chainage_m[a]), round(float(value), 2))
        for a, value in zip(first.tolist(), values.tolist(), strict=True)
        if abs(value) >= turn_deg
    ]


def _speed_changes(lane: Lane) -> list[RoadEvent]:
    changes = np.flatnonzero(np.abs(np.diff(lane.design_speed_m_s)) > 0.01) + 1  # never where a speed is unknown
    return [
        RoadEvent(
            EventKind.SPEED_LIMIT, lane.name, float(lane.chainage_m[k]), round(float(lane.design_speed_m_s[k]) * 3.6, 3)
        )
        for k in changes.tolist()
    ]


def _stated_events(
    file: AlignmentFile, lanes: Sequence[Lane], places_deg: Floats, warnings: list[str]
) -> list[RoadEvent]:
    if not file.events:
        return []
    known = {geometry.name for geometry in file.lanes}
    trees: dict[str | None, tuple[scipy.spatial.cKDTree, list[Lane], Floats]] = {}
    events = []
    for event, (lon, lat) in zip(file.events, places_deg.tolist(), strict=True):
        if event.lane is not None and event.lane not in known:
            raise InvalidParameter(
                f"the {event.kind.value} at {lon:.7f}, {lat:.7f} is on lane {event.lane!r}, which is not in the file",
                field="file",
                limit=", ".join(sorted(known))[:200],
                cure="correct the lane of the event, or leave it out for the nearest one",
            )
        if not (math.isfinite(lon) and math.isfinite(lat)):
            raise InvalidParameter(
                f"the {event.kind.value} at {event.point[0]:.9g}, {event.point[1]:.9g} cannot be placed",
                field="file",
                limit="finite coordinates in the area of use of the CRS",
                cure="correct or remove the event",
            )
        chosen = [lane for lane in lanes if event.lane in (None, lane.name)]
        if not chosen:
            continue  # its lane is not planned
        if event.lane not in trees:
            trees[event.lane] = _tree(chosen)
        found = _nearest(event, lon, lat, *trees[event.lane])
        if found is None:
            warnings.append(
                f"the {event.kind.value} at {lon:.7f}, {lat:.7f} is left out: no planned lane is within {REACH_M:g} m"
            )
        else:
            events.append(found)
    return events


def _tree(lanes: list[Lane]) -> tuple[scipy.spatial.cKDTree, list[Lane], Floats]:
    """Samples of lanes to search in, and the number of the first sample of each lane."""
    places = np.concatenate([_sphere_m(lane.lon_deg, lane.lat_deg) for lane in lanes])
    return (
        scipy.spatial.cKDTree(places),
        lanes,
        np.cumsum([0, *(len(lane.lon_deg) for lane in lanes)]).astype(np.float64),
    )


def _nearest(
    event: EventGeometry, lon: float, lat: float, tree: scipy.spatial.cKDTree, lanes: list[Lane], firsts: Floats
) -> RoadEvent | None:
    away, sample = tree.query(_sphere_m(np.array([lon]), np.array([lat]))[0])
    if away > REACH_M:
        return None
    number = int(np.searchsorted(firsts, sample, side="right")) - 1
    lane, k = lanes[number], int(sample - firsts[number])
    across = (lon - lane.lon_deg[k] + 180.0) % 360.0 - 180.0
    east, north = steps_m(np.array([0.0, across]), np.array([lane.lat_deg[k], lat]))
    heading = math.radians(float(lane.heading_deg[k]))
    along = float(east[0]) * math.sin(heading) + float(north[0]) * math.cos(heading)
    chainage = min(max(float(lane.chainage_m[k]) + along, 0.0), lane.length_m)
    return RoadEvent(event.kind, lane.name, chainage, event.value)


def _sphere_m(lon_deg: Floats, lat_deg: Floats) -> Floats:
    lon, lat = np.radians(lon_deg), np.radians(lat_deg)
    across = np.cos(lat)
    return _EARTH_M * np.stack([across * np.cos(lon), across * np.sin(lon), np.sin(lat)], axis=1)
