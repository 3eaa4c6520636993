"""Roads of the registry as sources of alignments: an axis with its calibration, and the lanes that are declared for it.

The document is written by `write_registered_road`. It is read again for each plan, as files are.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pyproj import Geod

from app.errors import InvalidParameter, UnreadableUpload
from app.formats.alignments.features import SPEEDS_KMH
from app.formats.alignments.geometry import (
    MAX_VERTICES,
    AlignmentFile,
    BoundaryStyle,
    EarlierTransformation,
    Floats,
    LaneGeometry,
    StationEquation,
)
from app.roads.axis import Axis
from app.roads.measures import CalibrationPoint, Measures, calibrate
from app.roads.parallel import cut_edges, parallel_line

ROAD_FORMAT: Final = "waymark-road/1"
MAX_LANES = 8
"""Lanes of one direction. Source: chosen by hand, wider than any motorway."""
_SAME_STATION_M = 5e-4  # [m] jumps of the station that drawings do not show; source: half a millimetre
_GEOD = Geod(ellps="WGS84")


Longitude = Annotated[float, Field(ge=-180.0, le=180.0)]
Latitude = Annotated[float, Field(ge=-90.0, le=90.0)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class RoadLanes(_Part):
    """Lanes on both sides of a road's axis, which is the line between the two directions; on a road of one direction it
    is the middle of the carriageway.
    """

    forward: Annotated[int, Field(ge=0, le=MAX_LANES, description="Lanes in the direction of the axis.")] = 1
    backward: Annotated[int, Field(ge=0, le=MAX_LANES, description="Lanes against it.")] = 1
    width_m: Annotated[float, Field(ge=1.5, le=12.0, description="Of each lane. [m]")] = 3.5
    speed_limit_kmh: Annotated[float, Field(ge=SPEEDS_KMH[0], le=SPEEDS_KMH[1])]
    driving_side: Literal["right", "left"] = "right"
    centre_style: Annotated[BoundaryStyle, Field(description="Paint between the directions.")] = BoundaryStyle.UNKNOWN
    lane_style: Annotated[BoundaryStyle, Field(description="Paint between lanes one way.")] = BoundaryStyle.UNKNOWN
    edge_style: Annotated[BoundaryStyle, Field(description="Paint at the edges.")] = BoundaryStyle.UNKNOWN


class RoadStation(_Part):
    """A calibration point; `chainage_m` runs along all parts, `ahead_m` is the measure after a jump. [m]"""

    part: int
    chainage_m: float
    measure_m: float
    ahead_m: float | None = None


class RegisteredRoad(_Part):
    """A road of the registry with its lanes.

    Attributes
    ----------
    road_id, version
        Of the registry.
    parts : list of lines of (lon, lat)
        In WGS 84 / ITRF. [deg]
    exact : bool
        Whether a transformation with a stated accuracy brought them there; otherwise they are not for localization.
    accuracy_m : float or None
        Of the positions' reference frame; None in documents that were written without it. [m]
    note : str or None
        How they were transformed before.
    """

    format: Literal["waymark-road/1"] = ROAD_FORMAT
    road_id: str
    version: int
    name: str
    exact: bool
    note: str | None
    accuracy_m: float | None = None
    lanes: RoadLanes
    calibration: list[RoadStation]
    parts: list[list[tuple[Longitude, Latitude]]]


def write_registered_road(road: RegisteredRoad) -> bytes:
    """The document of a road."""
    return road.model_dump_json().encode()


def read_registered_road(data: bytes) -> AlignmentFile:
    """The lanes of a document that `write_registered_road` wrote.

    Raises
    ------
    UnreadableUpload
        It is no such document.
    InvalidParameter
        It has no lanes, its axis is none that could be registered, or there are too many vertices.
    """
    try:
        road = RegisteredRoad.model_validate_json(data)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        place = ".".join(str(part) for part in first["loc"])
        raise UnreadableUpload(
            f"this is no document of a registered road: {place}: {first['msg']}",
            field="file",
            limit=ROAD_FORMAT,
            cure="make the alignment from the road again",
        ) from None
    ranges_m = Axis(road.parts).part_ranges_m
    axes = [cut_edges(np.array(part).reshape(-1, 2)) for part in road.parts]
    lanes = road.lanes
    count = (lanes.forward + lanes.backward) * sum(map(len, axes))
    if not 0 < count <= MAX_VERTICES:
        raise InvalidParameter(
            f"the lanes of the road have {count} vertices",
            field="lanes",
            limit=f"1 to {MAX_VERTICES} vertices of all lanes",
            cure="declare lanes, or register the sections of the road as roads of their own",
        )
    chainages, start_m = [], 0.0
    for axis in axes:
        lengths = np.asarray(_GEOD.inv(axis[:-1, 0], axis[:-1, 1], axis[1:, 0], axis[1:, 1])[2])
        chainages.append(start_m + np.concatenate([[0.0], np.cumsum(lengths)]))
        start_m = float(chainages[-1][-1])
    points = [CalibrationPoint(p.part, p.chainage_m, p.measure_m, p.ahead_m) for p in road.calibration]
    measures = calibrate(ranges_m, points)
    earlier = EarlierTransformation(road.exact, road.note, road.accuracy_m)
    return AlignmentFile(
        "road",
        tuple(_lanes(road, axes, chainages)),
        "OGC:CRS84",
        station_equations=tuple(_equations(measures)),
        start_station_m=float(measures.sections[0].measures_m[0]),
        unit_m=None,
        earlier=earlier,
    )


def _lanes(road: RegisteredRoad, axes: list[Floats], chainages: list[Floats]) -> Iterator[LaneGeometry]:
    """Lanes of both directions, numbered from the axis outward."""
    lanes = road.lanes
    right = -1.0 if lanes.driving_side == "right" else 1.0
    both = lanes.forward > 0 and lanes.backward > 0
    # without the other direction the axis is the middle of the carriageway
    shift = 0.0 if both else -max(lanes.forward, lanes.backward) / 2
    for part, (axis, chainage) in enumerate(zip(axes, chainages, strict=True), 1):
        where = f"part {part} " if len(axes) > 1 else ""
        for name, count, side, step in (("forward", lanes.forward, right, 1), ("backward", lanes.backward, -right, -1)):
            for k in range(count):
                line = parallel_line(axis, side * (k + 0.5 + shift) * lanes.width_m)[::step]
                inner = lanes.lane_style if k > 0 else lanes.centre_style if both else lanes.edge_style
                outer = lanes.lane_style if k + 1 < count else lanes.edge_style
                styles = (inner, outer) if lanes.driving_side == "right" else (outer, inner)
                yield LaneGeometry(
                    f"{where}{name} {k + 1}",
                    centre=np.column_stack([line, np.full(len(line), np.nan)]),
                    width_m=np.full(len(line), lanes.width_m),
                    speed_limit_mps=np.full(len(line), lanes.speed_limit_kmh / 3.6),
                    station_m=chainage[::step],
                    left_style=styles[0],
                    right_style=styles[1],
                    road=road.name,
                )


def _equations(measures: Measures) -> Iterator[StationEquation]:
    """Where the displayed station jumps so that it is the measure again."""
    shown_m = float(measures.sections[0].measures_m[0]) - float(measures.sections[0].chainages_m[0])
    for section in measures.sections:
        for chainage, measure in zip(section.chainages_m[:-1].tolist(), section.measures_m[:-1].tolist(), strict=True):
            back = shown_m + chainage
            if abs(measure - back) > _SAME_STATION_M:
                yield StationEquation(chainage, back, measure)
                shown_m = measure - chainage
