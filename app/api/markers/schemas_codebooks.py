"""Schemas of codebooks."""

from __future__ import annotations

from pydantic import ConfigDict, Field, JsonValue

from app.api.http.dependencies import Number, Text, Whole
from app.encoders.magnet import CodebookRules
from app.errors import naming
from app.families.inputs import Flag, StrictModel
from app.families.magnet.inputs import MeaningIn
from app.markers.magnet_design import TagDesign
from app.markers.magnet_error import OdometerError, ReadingConditions

MAX_MEANINGS = 100
"""In one request: each takes up to ten milliseconds."""


class DesignIn(StrictModel):
    """What all tags of a book share."""

    magnets: Whole = Field(description="M, 2 to 7.")
    length_m: Number = Field(description="L, from the first magnet to the last, 0.5 to 30. [m]")
    segment_m: Number = Field(description="Seg_d, the grid of the middle magnets; L is a whole number of it. [m]")
    min_gap_m: Number = Field(0.5, description="Least distance between neighbours, 0.5 or more. [m]", ge=0.5)

    def given(self) -> TagDesign:
        """The design as the core knows it."""
        with naming("design"):
            return TagDesign(self.magnets, self.length_m, self.segment_m, self.min_gap_m)


class OdometerIn(StrictModel):
    """Errors of the vehicle's speed that do not cancel in a ratio."""

    quantum_mps: Number = Field(0.01, ge=0, le=5, description="Step of the speed signal. [m/s]")
    rate_hz: Number = Field(10.0, ge=0.1, le=1000, description="Speeds a second. [Hz]")
    drift: Number = Field(0.001, ge=0, le=0.1, description="Relative change of scale from one gap to the next.")


class RulesIn(StrictModel):
    """How far apart codes are kept: for the fastest and highest vehicle to be served."""

    speed_mps: Number = Field(13.4, description="Speed at which codes must be read, 0.5 to 70. [m/s]")
    clearance_m: Number = Field(0.30, description="Clearance at which codes must be read, 0.05 to 1. [m]")
    odometer: OdometerIn = Field(default_factory=lambda: OdometerIn())
    confusion: Number = Field(
        0.001, ge=1e-12, lt=0.5, description="Most probability with which a code is taken for another."
    )
    wrong_way_safe: Flag = Field(False, description="No code is another's reverse, nor its own.")
    survive_missing: Flag = Field(
        False, description="A code is recognised although one magnet is missed; from M = 4 on."
    )

    def given(self) -> CodebookRules:
        """The rules as the core knows them."""
        with naming("rules"):
            odometer = OdometerError(**self.odometer.model_dump())
            conditions = ReadingConditions(self.speed_mps, self.clearance_m, odometer)
            return CodebookRules(conditions, self.confusion, self.wrong_way_safe, self.survive_missing)


_MEANINGS_EXAMPLE: list[JsonValue] = [
    {"kind": "bend-right", "value": 125},
    {"kind": "stop-line-ahead", "value": 20},
    {"kind": "arrow", "value": "straight-left"},
]


class CodebookIn(StrictModel):
    """A codebook to make, with the first meanings to give codes to."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "name": "City streets",
                    "design": {"magnets": 3, "length_m": 4.0, "segment_m": 0.1},
                    "rules": {"speed_mps": 13.4, "clearance_m": 0.3, "wrong_way_safe": True},
                    "meanings": _MEANINGS_EXAMPLE,
                }
            ]
        },
    )

    name: Text = Field(max_length=200, description="1 to 80 characters, each name once in an agency.")
    design: DesignIn
    rules: RulesIn = Field(default_factory=lambda: RulesIn())
    meanings: list[MeaningIn] = Field(default_factory=list, max_length=MAX_MEANINGS)


class CodebookDraftIn(StrictModel):
    """A codebook to see the capacity of before it is made."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"design": {"magnets": 3, "length_m": 4.0, "segment_m": 0.1}}]},
    )

    design: DesignIn
    rules: RulesIn = Field(default_factory=lambda: RulesIn())


class MeaningsIn(StrictModel):
    """Further meanings of a codebook."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"meanings": [{"kind": "speed-limit-mph", "value": 25}]}]},
    )

    meanings: list[MeaningIn] = Field(min_length=1, max_length=MAX_MEANINGS)
