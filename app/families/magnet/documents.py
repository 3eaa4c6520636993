"""Magnet markers as clients see them and send them."""

from __future__ import annotations

from typing import Annotated, Any, Literal, cast

from pydantic import AfterValidator, ConfigDict, Field, JsonValue, WithJsonSchema, model_validator
from typing_extensions import TypedDict

from app.encoders.magnet import DrillingSheet
from app.encoders.magnet.sheets import sheet_document
from app.errors import InvalidParameter
from app.families.documents import (
    Height,
    Identifier,
    MarkerDocument,
    MarkerIn,
    Metres,
    Number,
    PositionIn,
    ProvenanceIn,
    StrictModel,
    Text,
    marker_head,
    marker_place,
)
from app.families.magnet.layouts import (
    LaneInput,
    LineInput,
    LinePlaceDocument,
    MagnetSpec,
    NewMagnets,
    PlacedLine,
    PlacedTag,
    SiteDocument,
    TagInput,
    TagPlaceDocument,
    meaning_of,
)
from app.markers.magnet import LineStyle, LineTag, parse_tag
from app.markers.magnet_design import Meaning
from app.registry.marker_rows import MarkerRow


class MeaningDocument(TypedDict):
    """What a code means: its kind, its value, and both in words."""

    kind: str
    value: float | str
    unit: str
    text: str


class InformationTagDocument(TypedDict):
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
    meaning: MeaningDocument | None


class LineTagDocument(TypedDict):
    """The code of a line tag."""

    scheme: Literal["line-tag"]
    text: str
    tuple: str
    style: LineStyle


class MagnetDocument(MarkerDocument):
    """A magnet marker in a list; its position is that of the first magnet."""

    family: Literal["magnet"]
    code: InformationTagDocument | LineTagDocument
    layout: TagPlaceDocument | LinePlaceDocument


class LaneGeometryDocument(TypedDict):
    """A GeoJSON LineString."""

    type: Literal["LineString"]
    coordinates: list[list[float]]


class LaneDocument(TypedDict):
    """The lane in WGS 84, and in `given` the coordinates that were sent where they were of another system."""

    geometry: LaneGeometryDocument
    length_m: float
    height_m: float | None
    given: list[list[float]] | None


class HoleDocument(TypedDict):
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


class CheckDocument(TypedDict):
    """A check: its figure must stand in `relation` to its limit."""

    name: str
    figure: float
    relation: Literal[">=", "<="]
    limit: float
    unit: str
    passed: bool
    source: str
    note: str


class CostDocument(TypedDict):
    """A quantity of something and what it costs."""

    item: str
    quantity: float
    unit: str
    low_usd: float
    high_usd: float
    source: str


class BillDocument(TypedDict):
    """Materials, what else could mark the road, and the total of the materials at the highest price."""

    materials: list[CostDocument]
    alternatives: list[CostDocument]
    total_usd: float


class MagnetDetailDocument(MagnetDocument):
    """A magnet marker with its lane, magnets, checks and costs. `warnings` names the checks that failed."""

    length_m: float
    lane: LaneDocument
    site: SiteDocument
    magnets: list[HoleDocument]
    passed: bool
    checks: list[CheckDocument]
    warnings: list[str]
    bill: BillDocument


def magnet_document(row: MarkerRow) -> MagnetDocument:
    """A magnet marker as lists and histories show it: without what follows from its layout."""
    spec: MagnetSpec = row.spec
    return {
        **marker_head(row),
        "family": "magnet",
        "code": _tag_document(spec),
        "layout": spec["place"],
        **marker_place(row),
    }


def magnet_detail(row: MarkerRow, sheet: DrillingSheet) -> MagnetDetailDocument:
    """A magnet marker by itself: with its lane, its magnets, its checks and its costs."""
    written = sheet_document(sheet)
    summary, spec = written["waymark"], cast(MagnetSpec, row.spec)
    return {
        **magnet_document(row),
        "length_m": summary["length_m"],
        "lane": {
            "geometry": {"type": "LineString", "coordinates": spec["lane"]["points_deg"]},
            "length_m": round(sheet.layout.lane.length_m, 4),
            "height_m": spec["lane"]["height_m"],
            "given": spec["lane"]["given"],
        },
        "site": spec["site"],
        "magnets": [_hole_document(hole) for hole in written["features"]],
        "passed": summary["passed"],
        "checks": summary["checks"],
        "warnings": [check["name"] for check in summary["checks"] if not check["passed"]],
        "bill": {
            "materials": summary["bill"]["materials"],
            "alternatives": summary["bill"]["alternatives"],
            "total_usd": sheet.bill.total_usd,
        },
    }


def _hole_document(hole: dict[str, Any]) -> HoleDocument:
    """A hole of the drilling sheet's GeoJSON as a flat document."""
    lon_deg, lat_deg = hole["geometry"]["coordinates"]
    properties = {name: _plain(value) for name, value in hole["properties"].items()}
    return {
        "chainage_m": properties["chainage_m"],
        "offset_m": properties["offset_m"],
        "from_first_m": properties["from_first_m"],
        "east_m": properties["east_m"],
        "north_m": properties["north_m"],
        "polarity": properties["polarity"],
        "phi_deg": properties["phi_deg"],
        "north_pole": properties["north_pole"],
        "north_pole_bearing_deg": properties["north_pole_bearing_deg"],
        "number": hole["id"],
        "lon_deg": lon_deg,
        "lat_deg": lat_deg,
    }


def _tag_document(spec: MagnetSpec) -> InformationTagDocument | LineTagDocument:
    tag = parse_tag(spec["tag"])
    if isinstance(tag, LineTag):
        return {"scheme": "line-tag", "text": tag.text, "tuple": tag.tuple_text, "style": tag.style}
    meaning = meaning_of(spec)
    return {
        "scheme": "information-tag",
        "text": tag.text,
        "tuple": tag.tuple_text,
        "polarities": "".join(tag.polarities),
        "length_m": tag.length_m,
        "segment_m": tag.segment_m,
        "gaps_m": list(tag.gaps_m),
        "ratios": list(tag.ratios),
        "codebook_id": spec["codebook_id"],
        "meaning": None if meaning is None else meaning_document(meaning),
    }


def _plain(value: Any) -> Any:
    """The value without a negative zero."""
    return 0.0 if value == 0 and isinstance(value, float) else value


def meaning_document(meaning: Meaning) -> MeaningDocument:
    """A meaning as clients see it."""
    return {"kind": meaning.kind.value, "value": meaning.value, "unit": meaning.unit, "text": meaning.text}


# === Schemas of requests that register magnet markers.


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

    design_speed_m_s: Number | None = Field(None, description="Design speed, 0.5 to 70. [m/s]")
    stop_line_chainage_m: Number | None = Field(None, description="Of the stop line that the tag announces. [m]")
    vehicles: list[Text] = Field(
        ["sedan", "utility"], max_length=8, description="Vehicles to be served: sedan, utility, van, heavy truck."
    )
    readable_clearance_m: Number = Field(0.30, description="Clearance up to which vehicles read, 0.05 to 1. [m]")
    reaction_s: Number = Field(2.5, description="Reaction time of the driver or the system, 0 to 10. [s]")
    deceleration_m_s2: Number = Field(3.4, description="Comfortable deceleration, 0.5 to 10. [m/s2]")


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
        "site": {"design_speed_m_s": 13.4, "stop_line_chainage_m": 130.0},
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
