"""A magnet marker's layout: kept as a lane, a tag and a place on it, from which everything else follows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import orjson

from app.encoders.magnet import (
    Check,
    DrillingSheet,
    LaneLine,
    MagnetLayout,
    Neighbour,
    Site,
    drilling_sheet,
    place_line,
    place_tag,
)
from app.errors import InvalidParameter
from app.geodesy import LocalizationGrade, PlacedPosition, place_position
from app.markers.magnet import InformationTag, LineTag, Orientation, parse_tag
from app.markers.magnet_codebook import Meaning
from app.registry.markers import Row
from app.services.positions import GivenPosition, naming

INFORMATION_TAG = "information-tag"
LINE_TAG = "line-tag"
MAX_MAGNETS = 1000
"""Of one marker, so that no request takes long: six kilometres of a line."""
MAX_RESURVEY_M = 1.0
"""Farthest that a survey may find a tag from its layout: drilling is right to millimetres, GNSS to centimetres. [m]"""
_NEVER_BROKEN = ("magnet-spacing", "line-spacing")
"""Checks whose failure makes a layout unreadable; the others are for the planner to weigh."""


@dataclass(frozen=True, slots=True)
class GivenLane:
    """A line in the direction of travel as it was sent.

    Parameters
    ----------
    coordinates : tuple of (float, float)
        Longitude and latitude [deg], or easting and northing [m] where `projected`.
    field : str
        Name of the coordinates in errors.
    """

    coordinates: tuple[tuple[float, float], ...]
    projected: bool
    field: str
    height_m: float | None = None
    crs: str | None = None
    realization: str | None = None
    epoch: float | None = None
    vertical_datum: str | None = None
    horizontal_rmse_m: float | None = None
    vertical_rmse_m: float | None = None
    survey_method: str | None = None
    check_points: int | None = None
    surveyor: str | None = None
    instrument: str | None = None
    survey_file_sha256: str | None = None

    @property
    def provenance(self) -> GivenPosition:
        """The same as of a position, without coordinates."""
        return GivenPosition(
            height_m=self.height_m,
            crs=self.crs,
            realization=self.realization,
            epoch=self.epoch,
            vertical_datum=self.vertical_datum,
            horizontal_rmse_m=self.horizontal_rmse_m,
            vertical_rmse_m=self.vertical_rmse_m,
            survey_method=self.survey_method,
            check_points=self.check_points,
            surveyor=self.surveyor,
            instrument=self.instrument,
            survey_file_sha256=self.survey_file_sha256,
        )


@dataclass(frozen=True, slots=True)
class PlacedTag:
    """Where an information tag lies on its lane. [m]"""

    chainage_m: float
    offset_m: float = 0.0


@dataclass(frozen=True, slots=True)
class PlacedLine:
    """Which part of a line carries magnets, and how far apart at most. [m]"""

    from_m: float = 0.0
    to_m: float | None = None
    spacing_m: float = 6.0


def place_lane(given: GivenLane, accuracy_m: float) -> list[PlacedPosition]:
    """Every vertex in WGS 84 / ITRF.

    Raises
    ------
    InvalidParameter, ReferenceSystemError
        A vertex is out of range or does not fit the CRS.
    """
    placed = []
    for number, (first, second) in enumerate(given.coordinates):
        try:
            position = place_position(
                first,
                second,
                given.height_m,
                crs=given.crs,
                projected=given.projected,
                realization=given.realization,
                epoch=given.epoch,
                ellipsoidal_height=given.vertical_datum in (None, "ellipsoid"),
                accuracy_m=accuracy_m,
            )
        except InvalidParameter as error:
            error.field = "lane.crs" if error.field == "position.crs" else f"lane.{given.field}.{number}"
            raise
        placed.append(position)
    return placed


def lane_spec(given: GivenLane, placed: list[PlacedPosition]) -> dict[str, Any]:
    """What is kept of a lane: its vertices in WGS 84, and as they came where that was another system."""
    points_deg = [[p.lon_deg, p.lat_deg] for p in placed]
    came = [list(point) for point in given.coordinates]
    return {"points_deg": points_deg, "height_m": given.height_m, "given": came if came != points_deg else None}


def worst_grade(placed: list[PlacedPosition]) -> PlacedPosition:
    """The first vertex that is only approximate, or the first one."""
    return next((p for p in placed if p.grade is not LocalizationGrade.EXACT), placed[0])


def layout_of(row: Row | dict[str, Any]) -> MagnetLayout:
    """Layout of a magnet marker's row."""
    spec = row["spec"]
    return _layout(row["id"], orjson.dumps({name: spec[name] for name in ("lane", "tag", "place", "meaning")}))


def sheet_of(row: Row | dict[str, Any]) -> DrillingSheet:
    """Drilling sheet of a magnet marker's row."""
    return drilling_sheet(layout_of(row), site_of(row["spec"]))


def site_of(spec: dict[str, Any]) -> Site:
    """What the checks need to know of the road."""
    site = {name: value for name, value in spec["site"].items() if value is not None}
    neighbours = tuple(
        Neighbour(n["name"], n["lon_deg"], n["lat_deg"], Orientation(n["phi_deg"])) for n in spec["neighbours"]
    )
    with naming("site"):
        return Site(**{**site, "vehicles": tuple(spec["site"]["vehicles"])}, neighbours=neighbours)


@lru_cache(maxsize=32)
def _layout(name: str, spec: bytes) -> MagnetLayout:
    """The layout; every spec is laid out several times between its request and its answer."""
    given = orjson.loads(spec)
    lane = _lane(given["lane"])
    tag, place = parse_tag(given["tag"]), given["place"]
    if isinstance(tag, LineTag):
        with naming("line"):
            return _lay_line(lane, tag, PlacedLine(**place), name)
    meaning = Meaning(**given["meaning"]) if given["meaning"] is not None else None
    with naming("tag"):
        return place_tag(lane, tag, place["chainage_m"], name=name, offset_m=place["offset_m"], meaning=meaning)


def _lane(spec: dict[str, Any]) -> LaneLine:
    try:
        return LaneLine.from_lon_lat(spec["points_deg"], spec["height_m"] or 0.0)
    except InvalidParameter as error:
        error.field = "lane.height_m" if error.field == "height_m" else "lane"
        raise


def _lay_line(lane: LaneLine, tag: LineTag, place: PlacedLine, name: str) -> MagnetLayout:
    end_m = lane.length_m if place.to_m is None else place.to_m
    if place.spacing_m > 0 and end_m - place.from_m > place.spacing_m * (MAX_MAGNETS - 1):
        raise InvalidParameter(
            f"{end_m - place.from_m:g} m of line every {place.spacing_m:g} m take more than {MAX_MAGNETS} magnets",
            field="to_m",
            limit=f"{MAX_MAGNETS} magnets in one marker",
            cure="register the line in sections",
        )
    return place_line(lane, tag.style, name=name, from_m=place.from_m, to_m=place.to_m, spacing_m=place.spacing_m)


def check_never_broken(layout: MagnetLayout, checks: tuple[Check, ...]) -> None:
    """Refuse a layout that could not be read.

    Raises
    ------
    InvalidParameter
        Magnets stand too near, or too far apart along a line.
    """
    for check in checks:
        if check.name in _NEVER_BROKEN and not check.passed:
            information = isinstance(layout.tag, InformationTag)
            raise InvalidParameter(
                f"{check.name}: {check.figure:.3f} {check.unit} ({check.note}), the limit is {check.relation} "
                f"{check.limit:g} {check.unit}: {check.source}",
                field="tag.code" if information else "line.spacing_m",
                limit=f"{check.relation} {check.limit:g} {check.unit}",
                cure="choose a code with wider gaps" if information else "choose a spacing between 0.5 and 6 m",
            )


def resurveyed(row: Row | dict[str, Any], lon_deg: float, lat_deg: float) -> dict[str, Any]:
    """The spec of a tag whose first magnet was found at a position.

    Raises
    ------
    InvalidParameter
        It is a line, or lies too far from its layout.
    """
    spec, layout = row["spec"], layout_of(row)
    if isinstance(layout.tag, LineTag):
        raise InvalidParameter(
            "a line of magnets has no single place",
            field="position",
            limit="positions of information tags",
            cure="retire the line and register it along its surveyed course",
        )
    target = layout.lane.from_position(lon_deg, lat_deg)[:2]
    away_m = float(math.dist(target, layout.holes[0].point_enu_m[:2]))
    if away_m > MAX_RESURVEY_M:
        raise InvalidParameter(
            f"the first magnet was surveyed {away_m:.2f} m away from its layout",
            field="position",
            limit=f"within {MAX_RESURVEY_M:g} m",
            cure="check the CRS; a tag somewhere else is another marker: retire this one and register it there",
        )
    place = PlacedTag(**spec["place"])
    for _ in range(20):  # a step is exact on a straight; on a bend the direction of the tag turns with its place
        east, north = (target - layout.holes[0].point_enu_m[:2]).tolist()
        if math.hypot(east, north) < 1e-7:
            break
        h = math.radians(layout.bearing_deg)
        place = PlacedTag(
            place.chainage_m + east * math.sin(h) + north * math.cos(h),
            place.offset_m - east * math.cos(h) + north * math.sin(h),
        )
        spec = {**spec, "place": {"chainage_m": place.chainage_m, "offset_m": place.offset_m}}
        layout = layout_of({"id": row["id"], "spec": spec})
    return dict(spec)
