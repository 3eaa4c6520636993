"""Schemas of requests that register magnet markers."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, ConfigDict, Field, JsonValue, WithJsonSchema, model_validator

from app.errors import InvalidParameter
from app.families.inputs import (
    Height,
    Identifier,
    MarkerIn,
    Metres,
    Number,
    PositionIn,
    ProvenanceIn,
    StrictModel,
    Text,
)
from app.families.magnet.layouts import LaneInput, PlacedLine, PlacedTag
from app.families.magnet.registration import LineInput, NewMagnets, TagInput
from app.markers.magnet import LineStyle

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


class MeaningIn(StrictModel):
    """What a tag means."""

    kind: Text = Field(
        max_length=40,
        description="arrow, stop-line-ahead [m], speed-limit-kmh, speed-limit-mph, bend-left, bend-right [deg], notice",
    )
    value: MeaningValue = Field(description="A number in the kind's unit, the arrow, or the text of the notice.")

    @property
    def pair(self) -> tuple[str, float | str]:
        """As the use cases know it."""
        return self.kind, self.value


class LineStringIn(StrictModel):
    """A GeoJSON LineString (RFC 7946) in the direction of travel."""

    type: Literal["LineString"]
    coordinates: list[Annotated[list[Number], Field(min_length=2, max_length=3)]] = Field(
        min_length=2,
        max_length=MAX_LANE_POINTS,
        description="Longitude and latitude of each vertex [deg]; heights are left out.",
    )


class LaneIn(ProvenanceIn):
    """The line that chainages are measured on, in the direction of legal travel, and where it comes from."""

    geometry: LineStringIn | None = Field(None, description="Longitude and latitude in a geographic CRS.")
    points_m: list[Annotated[list[Metres], Field(min_length=2, max_length=2)]] | None = Field(
        None, min_length=2, max_length=MAX_LANE_POINTS, description="Easting and northing in a projected CRS. [m]"
    )
    height_m: Height | None = Field(None, description="Height of the road, at which distances are true. [m]")

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

    def lane(self) -> LaneInput:
        """The lane as the use cases know it."""
        projected = self.geometry is None
        points = self.points_m if self.geometry is None else self.geometry.coordinates
        return LaneInput(
            coordinates=tuple((p[0], p[1]) for p in points or ()),
            projected=projected,
            field="points_m" if projected else "geometry.coordinates",
            provenance=PositionIn(**self.model_dump(exclude={"geometry", "points_m"})),
        )


class TagIn(StrictModel):
    """An information tag, by its code or by what it means in a codebook, and where its first magnet lies."""

    code: Text | None = Field(
        None, min_length=1, max_length=64, description="Polarities, length [m], segment [m], gaps: SNS_4_0.1_10-30."
    )
    codebook_id: Identifier | None = Field(None, description="Codebook of the meaning, or that the code must be in.")
    meaning: MeaningIn | None = Field(None, description="What the tag means; its code is the codebook's.")
    chainage_m: Number = Field(description="Of the first magnet, along the lane. [m]")
    offset_m: Number = Field(0.0, description="Of the tag from the lane, left positive, up to 50. [m]")


class LineIn(StrictModel):
    """Line tags along the lane, which is the painted line."""

    style: LineStyle = Field(description="What is painted.")
    from_m: Number = Field(0.0, description="Chainage of the first magnet. [m]")
    to_m: Number | None = Field(None, description="Chainage of the last magnet; the end of the line if left out. [m]")
    spacing_m: Number = Field(
        6.0, description="Most that neighbours may be apart, 0.5 to 6; it is evened out over the section. [m]"
    )


class SiteIn(StrictModel):
    """What the checks need to know of the road and its traffic."""

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


class MagnetIn(MarkerIn):
    """An information tag, or a line of line tags, to register."""

    model_config = ConfigDict(json_schema_extra={"examples": MAGNET_EXAMPLES})

    family: Literal["magnet"]
    lane: LaneIn
    tag: TagIn | None = None
    line: LineIn | None = None
    site: SiteIn = Field(default_factory=lambda: SiteIn())

    @model_validator(mode="after")
    def _tag_or_line(self) -> MagnetIn:
        if (self.tag is None) == (self.line is None):
            raise InvalidParameter(
                "magnets are an information tag or a line of line tags",
                field="tag",
                limit="one of tag, line",
                cure="send exactly one of the two",
            )
        return self

    def new(self) -> NewMagnets:
        """The marker as the use cases know it."""
        return NewMagnets(
            lane=self.lane.lane(),
            what=self._what(),
            site={**self.site.model_dump(), "vehicles": tuple(self.site.vehicles)},
            **self.shared(),
        )

    def _what(self) -> TagInput | LineInput:
        if self.line is not None:
            line = self.line
            return LineInput(PlacedLine(line.from_m, line.to_m, line.spacing_m), line.style)
        assert self.tag is not None
        tag = self.tag
        meaning = tag.meaning.pair if tag.meaning is not None else None
        return TagInput(PlacedTag(tag.chainage_m, tag.offset_m), tag.code, tag.codebook_id, meaning)
