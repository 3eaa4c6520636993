"""Bodies of requests on alignments and plans."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from app.encoders.plate import ArtworkFormat
from app.families.documents import Flag, Identifier, Number, Text, VerticalDatum
from app.formats.alignments.read import RoadLanes
from app.planning.alignment import AlignmentDeclaration
from app.planning.proof import ProofTerms

Name = Annotated[Text, Field(min_length=1, max_length=80)]
MAX_RULES_TEXT = 50_000
"""Longest text of rules. [characters] 25 times the examples; as YAML it takes seconds."""


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid")


class AlignmentIn(_Body):
    """What is declared of a file with a road; what the file states may be left out."""

    name: Name
    crs: Annotated[Text | None, Field(max_length=64, examples=["EPSG:25832"])] = None
    realization: Annotated[Text | None, Field(max_length=64, examples=["ITRF2014"])] = None
    epoch: Annotated[Number | None, Field(ge=1900, le=2100, description="Decimal year.")] = None
    vertical_datum: Annotated[VerticalDatum | None, Field(examples=["ellipsoid"])] = None
    unit: Literal["m", "ft-us", "ft-intl"] | None = None
    height_unit: Literal["m", "ft-us", "ft-intl"] | None = None
    ignore_heights: bool = False
    origin: Annotated[
        tuple[Number, Number] | None,
        Field(description="Longitude and latitude of the origin of local coordinates. Such a road is not surveyed."),
    ] = None
    bearing_deg: Annotated[
        Number, Field(ge=-360, le=360, description="Direction of the local y axis; only with `origin`.")
    ] = 0.0

    def declaration(self) -> AlignmentDeclaration:
        """The declaration of the file."""
        values = self.model_dump(exclude={"name"})
        return AlignmentDeclaration(**values)


class RoadAlignmentIn(_Body):
    """Lanes along a registered road; they stay as they are when the road is changed."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {
                    "name": "L 560, two lanes",
                    "road_id": "019cb624-0000-7000-8000-0000000000aa",
                    "lanes": {
                        "forward": 1, "backward": 1, "width_m": 3.5, "speed_limit_kmh": 70, "centre_style": "dashed",
                    },
                }
            ]
        },
    )  # fmt: skip

    name: Name
    road_id: Identifier
    lanes: RoadLanes


class PlanIn(_Body):
    """A plan to make: the rules are a document as docs/plans.md describes it."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {
                    "name": "L 560, plates every 100 m",
                    "alignment_id": "019cb624-0000-7000-8000-0000000000aa",
                    "rules": {"version": 1, "plates": {"spacing_m": 100}},
                }
            ]
        },
    )

    name: Name
    alignment_id: Identifier
    rules: dict[str, Any]


class PlanPreviewIn(_Body):
    """Rules to try on an alignment."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {
                    "alignment_id": "019cb624-0000-7000-8000-0000000000aa",
                    "rules": {"version": 1, "plates": {"spacing_m": 50}},
                }
            ]
        },
    )

    alignment_id: Identifier
    rules: dict[str, Any]


class RulesTextIn(_Body):
    """A document of rules as it stands in a file."""

    model_config = ConfigDict(
        extra="forbid", json_schema_extra={"examples": [{"text": "version: 1\nplates:\n  spacing_m: 50\n"}]}
    )

    text: str = Field(max_length=MAX_RULES_TEXT, description="YAML 1.2 or JSON.")


class PlanPatch(_Body):
    """What to change of a plan; new rules place and check it again."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [{"rules": {"version": 1, "plates": {"spacing_m": 50}}, "reason": "closer in the bends"}]
        },
    )

    name: Name | None = None
    rules: dict[str, Any] | None = None
    reason: Annotated[Text | None, Field(max_length=500)] = None


class ProofIn(ProofTerms):
    """What is driven, and how; every member has a default."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"drives": 20, "seed": 7, "conditions": ["day", "night+rain"]}, {}]}
    )


class TitleBlockIn(_Body):
    """What the title block of the drawings states; empty fields are left to be filled in by hand."""

    owner: Annotated[Text, Field(max_length=80)] = ""
    number: Annotated[Text, Field(max_length=80, description="Identification number of the set.")] = ""
    date: Annotated[Text, Field(max_length=80, description="Date of issue.")] = ""
    creator: Annotated[Text, Field(max_length=80)] = ""
    approver: Annotated[Text, Field(max_length=80)] = ""
    title: Annotated[Text, Field(max_length=80, description="Without, the name of the plan.")] = ""


class PackageIn(_Body):
    """How a plan is handed out; every member may be left out."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {
                    "crs": "EPSG:25832",
                    "scale": 500,
                    "title_block": {"owner": "Example Road Agency", "date": "2026-11-22"},
                    "formats": ["pdf", "dxf"],
                },
                {},
            ]
        },
    )

    crs: Annotated[Text | None, Field(max_length=64, description="Projected CRS of the stakeout.")] = None
    unit: Literal["m", "ft-us", "ft-intl"] | None = None
    scale: Annotated[
        int | None, Field(strict=True, ge=1, le=100_000, description="Of the drawings: 250, 500, 1000, 2000 or 5000.")
    ] = None
    title_block: TitleBlockIn = TitleBlockIn()
    formats: Annotated[list[ArtworkFormat], Field(min_length=1, max_length=4, description="Of each plate.")] = [
        ArtworkFormat.PDF,
        ArtworkFormat.SVG,
    ]
    heaters: Annotated[Flag, Field(description="Heating tracks under dark units.")] = False
    leds: Annotated[Flag, Field(description="Light sources under light units.")] = False

    def options(self) -> dict[str, Any]:
        """The options as JSON."""
        return self.model_dump(mode="json")
