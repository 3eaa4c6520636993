"""Schemas of magnet markers."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, JsonValue, WithJsonSchema, model_validator

from app.api.dependencies import Identifier, Number, Text
from app.api.schemas_markers import Accuracy, CheckPoints, Height, Metres, PlacementIn, PositionOut, Sha256, Status
from app.errors import InvalidParameter
from app.markers.magnet import LineStyle
from app.services.magnet_layouts import GivenLane, PlacedLine, PlacedTag
from app.services.magnet_markers import GivenLine, GivenTag, NewMagnets

MAX_LANE_POINTS = 2000


def _number_or_text(value: Any) -> float | str:
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise InvalidParameter(
            "a meaning's value is a number or a text", limit="a number, or up to 80 characters", cure="send one of them"
        )
    return value


MeaningValue = Annotated[
    Any,
    AfterValidator(_number_or_text),
    WithJsonSchema({"anyOf": [{"type": "number"}, {"type": "string", "maxLength": 80}]}),
]


class MeaningIn(BaseModel):
    """What a tag tells."""

    model_config = ConfigDict(extra="forbid")

    kind: Text = Field(
        max_length=40,
        description="arrow, stop-line-ahead [m], speed-limit-kmh, speed-limit-mph, bend-left, bend-right [deg], notice",
    )
    value: MeaningValue = Field(description="A number in the kind's unit, the arrow, or the text of the notice.")

    @property
    def given(self) -> tuple[str, float | str]:
        """As the use cases know it."""
        return self.kind, self.value


class LineStringIn(BaseModel):
    """A GeoJSON LineString (RFC 7946) in the direction of travel."""

    model_config = ConfigDict(extra="forbid")

    type: Literal["LineString"]
    coordinates: list[Annotated[list[Number], Field(min_length=2, max_length=3)]] = Field(
        min_length=2,
        max_length=MAX_LANE_POINTS,
        description="Longitude and latitude of each vertex [deg]; heights are left out.",
    )


class LaneIn(BaseModel):
    """The line that chainages are measured on, in the direction of legal travel, and where it comes from."""

    model_config = ConfigDict(extra="forbid")

    geometry: LineStringIn | None = Field(None, description="Longitude and latitude in a geographic CRS.")
    points_m: list[Annotated[list[Metres], Field(min_length=2, max_length=2)]] | None = Field(
        None, min_length=2, max_length=MAX_LANE_POINTS, description="Easting and northing in a projected CRS. [m]"
    )
    height_m: Height | None = Field(None, description="Height of the road, at which distances are true. [m]")
    crs: Text | None = Field(None, max_length=100, description="EPSG code or URN; WGS 84 if left out.")
    realization: Text | None = Field(None, min_length=1, max_length=64, description="Reference frame, e.g. ITRF2014.")
    epoch: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=1900, le=2200)] | None = Field(
        None, description="Coordinate epoch. [decimal year]"
    )
    vertical_datum: Text | None = Field(
        None, min_length=1, max_length=64, description="`ellipsoid` (default) or the datum of the height."
    )
    horizontal_rmse_m: Accuracy | None = Field(None, description="Horizontal accuracy, RMSE. [m]")
    vertical_rmse_m: Accuracy | None = Field(None, description="Vertical accuracy, RMSE. [m]")
    survey_method: Text | None = Field(None, min_length=1, max_length=200, description="How it was surveyed.")
    check_points: CheckPoints | None = Field(None, description="Independent points that the RMSE was tested at.")
    surveyor: Text | None = Field(None, min_length=1, max_length=200, description="Who surveyed.")
    instrument: Text | None = Field(None, min_length=1, max_length=200, description="With what.")
    survey_file_sha256: Sha256 | None = Field(None, description="SHA-256 of the survey's file, lower-case hex.")

    @model_validator(mode="after")
    def _one_line(self) -> LaneIn:
        if (self.geometry is None) == (self.points_m is None):
            raise InvalidParameter(
                "a lane is a geometry of longitudes and latitudes, or points_m with a projected crs",
                field="lane",
                limit="one of geometry, points_m",
                cure="send exactly one of the two",
            )
        return self

    def given(self) -> GivenLane:
        """The lane as the use cases know it."""
        projected = self.geometry is None
        points = self.points_m if self.geometry is None else self.geometry.coordinates
        return GivenLane(
            coordinates=tuple((p[0], p[1]) for p in points or ()),
            projected=projected,
            field="points_m" if projected else "geometry.coordinates",
            **self.model_dump(exclude={"geometry", "points_m"}),
        )


class TagIn(BaseModel):
    """An information tag, by its code or by what it means in a codebook, and where its first magnet lies."""

    model_config = ConfigDict(extra="forbid")

    code: Text | None = Field(
        None, min_length=1, max_length=64, description="Polarities, length [m], segment [m], gaps: SNS_4_0.1_10-30."
    )
    codebook_id: Identifier | None = Field(None, description="Codebook of the meaning, or that the code must be in.")
    meaning: MeaningIn | None = Field(None, description="What the tag tells; its code is the codebook's.")
    chainage_m: Number = Field(description="Of the first magnet, along the lane. [m]")
    offset_m: Number = Field(0.0, description="Of the tag from the lane, left positive, up to 50. [m]")


class LineIn(BaseModel):
    """Line tags along the lane given, which is the painted line."""

    model_config = ConfigDict(extra="forbid")

    style: LineStyle = Field(description="What is painted.")
    from_m: Number = Field(0.0, description="Chainage of the first magnet. [m]")
    to_m: Number | None = Field(None, description="Chainage of the last magnet; the end of the line if left out. [m]")
    spacing_m: Number = Field(
        6.0, description="Most that neighbours may be apart, 0.5 to 6; it is evened out over the section. [m]"
    )


class SiteIn(BaseModel):
    """What the checks need to know of the road and its traffic."""

    model_config = ConfigDict(extra="forbid")

    design_speed_mps: Number | None = Field(None, description="Design speed, 0.5 to 70. [m/s]")
    stop_line_chainage_m: Number | None = Field(None, description="Of the stop line that the tag announces. [m]")
    vehicles: list[Text] = Field(
        ["sedan", "utility"], max_length=8, description="Vehicles to be served: sedan, utility, van, heavy truck."
    )
    readable_clearance_m: Number = Field(0.30, description="Clearance up to which vehicles read, 0.05 to 1. [m]")
    reaction_s: Number = Field(2.5, description="Reaction time of the driver or the system, 0 to 10. [s]")
    deceleration_mps2: Number = Field(3.4, description="Comfortable deceleration, 0.5 to 10. [m/s2]")


_LANE_EXAMPLE: dict[str, JsonValue] = {
    "geometry": {"type": "LineString", "coordinates": [[-84.48, 42.7263], [-84.4776, 42.7263]]},
    "horizontal_rmse_m": 0.02,
    "realization": "ITRF2014",
    "survey_method": "GNSS RTK",
}
MAGNET_EXAMPLES: list[JsonValue] = [
    {
        "family": "magnet",
        "lane": _LANE_EXAMPLE,
        "tag": {"code": "SNS_4_0.1_10-30", "chainage_m": 60.0},
        "site": {"design_speed_mps": 13.4, "stop_line_chainage_m": 130.0},
        "road": "Farm Lane",
    },
    {
        "family": "magnet",
        "lane": {
            "geometry": {"type": "LineString", "coordinates": [[-84.48, 42.72635], [-84.4776, 42.72635]]},
        },
        "line": {"style": "dashed", "from_m": 10.0, "to_m": 100.0, "spacing_m": 6.0},
    },
]


class MagnetMarkerIn(PlacementIn):
    """An information tag, or a line of line tags, to register."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": MAGNET_EXAMPLES})

    family: Literal["magnet"]
    status: Status = "planned"
    lane: LaneIn
    tag: TagIn | None = None
    line: LineIn | None = None
    site: SiteIn = Field(default_factory=lambda: SiteIn())

    @model_validator(mode="after")
    def _tag_or_line(self) -> MagnetMarkerIn:
        if (self.tag is None) == (self.line is None):
            raise InvalidParameter(
                "magnets are an information tag or a line of line tags",
                field="tag",
                limit="one of tag, line",
                cure="send exactly one of the two",
            )
        return self

    def given(self) -> NewMagnets:
        """The marker as the use cases know it."""
        return NewMagnets(
            lane=self.lane.given(),
            what=self._what(),
            site={**self.site.model_dump(), "vehicles": tuple(self.site.vehicles)},
            **self.model_dump(exclude={"family", "lane", "tag", "line", "site"}),
        )

    def _what(self) -> GivenTag | GivenLine:
        if self.line is not None:
            line = self.line
            return GivenLine(PlacedLine(line.from_m, line.to_m, line.spacing_m), line.style)
        assert self.tag is not None
        tag = self.tag
        meaning = tag.meaning.given if tag.meaning is not None else None
        return GivenTag(PlacedTag(tag.chainage_m, tag.offset_m), tag.code, tag.codebook_id, meaning)


class MeaningOut(BaseModel):
    """What a code tells."""

    kind: str
    value: MeaningValue
    unit: str
    text: str


class InformationTagOut(BaseModel):
    """The code of an information tag."""

    scheme: Literal["information-tag"]
    text: str
    tuple: str
    polarities: str
    length_m: float
    segment_m: float
    gaps_m: list[float]
    ratios: list[float]
    codebook_id: str | None
    meaning: MeaningOut | None


class LineTagOut(BaseModel):
    """The code of a line tag."""

    scheme: Literal["line-tag"]
    text: str
    tuple: str
    style: LineStyle


class TagPlaceOut(BaseModel):
    """Where an information tag lies on its lane."""

    chainage_m: float
    offset_m: float


class LinePlaceOut(BaseModel):
    """Which part of a line carries magnets."""

    from_m: float
    to_m: float | None
    spacing_m: float


class MagnetMarkerSummary(BaseModel):
    """A magnet marker in a list; its position is that of the first magnet."""

    id: str
    family: Literal["magnet"]
    status: Status
    version: int
    code: InformationTagOut | LineTagOut
    layout: TagPlaceOut | LinePlaceOut
    position: PositionOut
    heading_deg: float
    heading_rmse_deg: float | None
    road: str | None
    measure_m: float | None
    offset_m: float | None
    created_at: str
    updated_at: str


class LaneOut(BaseModel):
    """The lane in WGS 84, and the coordinates given where they were of another system."""

    geometry: dict[str, Any]
    length_m: float
    height_m: float | None
    given: list[list[float]] | None


class MagnetOut(BaseModel):
    """One magnet to be set."""

    number: int
    lon_deg: float
    lat_deg: float
    chainage_m: float
    offset_m: float
    from_first_m: float
    east_m: float
    north_m: float
    polarity: Literal["N", "S"]
    phi_deg: Literal[0, 90]
    north_pole: str
    north_pole_bearing_deg: float | None


class CheckOut(BaseModel):
    """A check: its figure must stand in `relation` to its limit."""

    name: str
    figure: float
    relation: Literal[">=", "<="]
    limit: float
    unit: str
    passed: bool
    source: str
    note: str


class CostRowOut(BaseModel):
    """A quantity of something and what it costs."""

    item: str
    quantity: float
    unit: str
    low_usd: float
    high_usd: float
    source: str


class BillOut(BaseModel):
    """Materials, what else could mark the road, and the total of the materials at the highest price."""

    materials: list[CostRowOut]
    alternatives: list[CostRowOut]
    total_usd: float


class MagnetMarkerOut(MagnetMarkerSummary):
    """A magnet marker with its lane, magnets, checks and costs. `warnings` names the checks that failed."""

    length_m: float
    lane: LaneOut
    site: dict[str, Any]
    magnets: list[MagnetOut]
    passed: bool
    checks: list[CheckOut]
    warnings: list[str]
    bill: BillOut
