"""The lines and the calibration of a road as they are sent, brought to WGS 84 and onto the axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter
from app.geodesy import PlacedPositions, place_positions
from app.roads.axis import Axis, Foot
from app.roads.measures import CalibrationPoint

_REACH_M = 50.0
_AMBIGUOUS_M = 1.0
_ROUNDING_M = 0.001  # of chainages that a form shows

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class LinesInput:
    """The axis of a road as it was sent.

    Attributes
    ----------
    parts : tuple of lines of points
        Longitude and latitude [deg], or easting and northing in the unit of the CRS.
    crs, realization, epoch
        As of a marker's position; WGS 84 without.
    several : bool
        It came as a MultiLineString.
    """

    parts: tuple[tuple[Point, ...], ...]
    crs: str | None = None
    realization: str | None = None
    epoch: float | None = None
    several: bool = False


@dataclass(frozen=True, slots=True)
class CalibrationInput:
    """A place with a known measure: a vertex of a part, a position beside the axis in the road's CRS, or a chainage."""

    measure_m: float
    ahead_m: float | None = None
    part: int = 0
    vertex: int | None = None
    position: Point | None = None
    chainage_m: float | None = None


@dataclass(frozen=True, slots=True)
class PlacedLines:
    """Lines in WGS 84 / ITRF, and how good that is."""

    parts: list[list[list[float]]]
    crs: str
    realization: str | None
    epoch: float | None
    transform_accuracy_m: float | None
    grade: str
    note: str | None


def place_lines(lines: LinesInput, accuracy_m: float) -> PlacedLines:
    """Bring lines to WGS 84 / ITRF.

    Raises
    ------
    InvalidParameter, ReferenceSystemError
        The CRS is unknown, or a vertex is out of its range.
    """
    flat = np.array([point for part in lines.parts for point in part], dtype=np.float64)
    placed = _placed(flat, lines, accuracy_m, ["geometry.coordinates"] * len(flat))
    points = np.stack([placed.lon_deg, placed.lat_deg], axis=1).tolist()
    ends = np.cumsum([len(part) for part in lines.parts]).tolist()
    parts = [points[start:end] for start, end in zip([0, *ends[:-1]], ends, strict=True)]
    accuracy, grade = placed.transform_accuracy_m, str(placed.grade)
    return PlacedLines(parts, placed.crs, placed.realization, placed.epoch, accuracy, grade, placed.note)


def resolve_calibration(
    axis: Axis, lines: LinesInput, points: Sequence[CalibrationInput], accuracy_m: float
) -> list[CalibrationPoint]:
    """Calibration points on the axis, in its order.

    Raises
    ------
    InvalidParameter
        A vertex or a part that is not there, or a position that is too far from the axis or beside it twice.
    """
    feet = _feet(axis, lines, points, accuracy_m)
    settled = [_settled(axis, point, feet.get(k, []), f"calibration.{k}") for k, point in enumerate(points)]
    return sorted(settled, key=lambda point: (point.part, point.chainage_m))


def _feet(
    axis: Axis, lines: LinesInput, points: Sequence[CalibrationInput], accuracy_m: float
) -> dict[int, list[Foot]]:
    """Feet of the calibration points that are positions, by the number of the point."""
    positions = {k: point.position for k, point in enumerate(points) if point.position is not None}
    if not positions:
        return {}
    fields = [f"calibration.{k}.position" for k in positions]
    placed = _placed(np.array(list(positions.values()), dtype=np.float64), lines, accuracy_m, fields)
    return dict(zip(positions, axis.locate(placed.lon_deg, placed.lat_deg, _REACH_M), strict=True))


def _settled(axis: Axis, point: CalibrationInput, feet: list[Foot], field: str) -> CalibrationPoint:
    if [point.vertex, point.position, point.chainage_m].count(None) != 2:
        raise InvalidParameter(
            "a calibration point is a vertex, a position or a chainage",
            field=field,
            limit="vertex, position or chainage_m",
            cure="send one of the three",
        )
    if point.chainage_m is not None:
        return _at_chainage(axis, point, point.chainage_m, field)
    if point.vertex is not None:
        vertices_m = axis.vertex_chainages_m
        if point.part >= len(vertices_m) or point.vertex >= len(vertices_m[point.part]):
            raise InvalidParameter(
                f"there is no vertex {point.vertex} in part {point.part}",
                field=f"{field}.vertex",
                limit=f"{len(vertices_m)} parts of {', '.join(str(len(v)) for v in vertices_m[:20])} vertices, from 0",
                cure="count parts and vertices from 0",
            )
        chainage_m = float(vertices_m[point.part][point.vertex])
        return CalibrationPoint(point.part, chainage_m, point.measure_m, point.ahead_m)
    if not feet:
        raise InvalidParameter(
            f"the position of measure {point.measure_m:g} m is not at the road",
            field=f"{field}.position",
            limit=f"{_REACH_M:g} m from the axis",
            cure="give a position on the axis, in the road's own CRS",
        )
    if len(feet) > 1 and feet[1].distance_m - feet[0].distance_m < _AMBIGUOUS_M:
        raise InvalidParameter(
            f"the road passes the position of measure {point.measure_m:g} m more than once",
            field=f"{field}.position",
            limit="one place on the axis",
            cure="give the vertex instead",
        )
    return CalibrationPoint(feet[0].part, feet[0].chainage_m, point.measure_m, point.ahead_m)


def _at_chainage(axis: Axis, point: CalibrationInput, chainage_m: float, field: str) -> CalibrationPoint:
    """The place at a chainage, in the part that was named: where parts touch, both have the chainage."""
    ranges_m = axis.part_ranges_m
    for start_m, end_m in ranges_m[point.part : point.part + 1]:
        if start_m - _ROUNDING_M <= chainage_m <= end_m + _ROUNDING_M:
            return CalibrationPoint(point.part, min(max(chainage_m, start_m), end_m), point.measure_m, point.ahead_m)
    parts = ", ".join(f"{start:.3f} to {end:.3f}" for start, end in ranges_m[:20])
    raise InvalidParameter(
        f"the chainage {chainage_m:g} m is not on part {point.part}",
        field=f"{field}.chainage_m",
        limit=f"along the axis, part by part: {parts} m",
        cure="give the distance along the axis from its start, and its part, from 0",
    )


def _placed(
    points: npt.NDArray[np.float64], lines: LinesInput, accuracy_m: float, fields: Sequence[str]
) -> PlacedPositions:
    try:
        placed = place_positions(
            points[:, 0],
            points[:, 1],
            np.full(len(points), np.nan),
            crs=lines.crs,
            realization=lines.realization,
            epoch=lines.epoch,
            accuracy_m=accuracy_m,
        )
    except InvalidParameter as error:
        error.field = "crs" if error.field == "position.crs" else fields[0]
        raise
    if not placed.placed.all():
        k = int(np.argmin(placed.placed))
        raise InvalidParameter(
            f"vertex {k}, {points[k, 0]:g} {points[k, 1]:g}, is not in the area of {placed.crs}",
            field=fields[k],
            limit=f"coordinates of {placed.crs}, longitude or easting first",
            cure="check the CRS and the order of the axes",
        )
    return placed
