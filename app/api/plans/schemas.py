"""Bodies of requests on alignments and plans."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from app.families.documents import Identifier, Text
from app.formats.alignments.read import RoadLanes
from app.planning.alignment import AlignmentDeclaration
from app.planning.proof import ProofTerms

Name = Annotated[Text, Field(min_length=1, max_length=80)]
MAX_RULES_TEXT = 50_000
"""Longest text of rules. [characters] 25 times the examples; as YAML it takes seconds."""


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid")


@dataclass(frozen=True, slots=True, kw_only=True)
class AlignmentIn(AlignmentDeclaration):
    """What is declared of a file with a road, and the name of the alignment."""

    name: Name


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
