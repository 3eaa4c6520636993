"""Schemas of roads and of linear references."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Path
from pydantic import ConfigDict, Field, JsonValue

from app.api.http.dependencies import Identifier, Number, Text
from app.api.http.schemas_geojson import AnyLine
from app.families.inputs import Metres, StrictModel
from app.services.roads.input import CalibrationInput, LinesInput

MAX_CALIBRATION = 5_000
MAX_POSITIONS = 1_000
MAX_REACH_M = 1_000.0
MAX_OFFSET_M = 1_000.0

RoadId = Annotated[Identifier, Path(description="Id of the road.")]
Reason = Annotated[Text, Field(min_length=1, max_length=500, description="Why; goes into the history.")]
Offset = Annotated[float, Field(allow_inf_nan=False, ge=-MAX_OFFSET_M, le=MAX_OFFSET_M)]
Count = Annotated[int, Field(strict=True, ge=0, lt=2**31)]


class StationIn(StrictModel):
    """A calibration point: a place with a known measure. The place is a vertex, a position or a chainage."""

    measure_m: Metres = Field(description="Measure there, coming from before. [m]")
    ahead_m: Metres | None = Field(None, description="At an equation of stationing: the measure going on. [m]")
    part: Count = Field(0, description="Line of a MultiLineString, from 0; with `vertex` or `chainage_m`.")
    vertex: Count | None = Field(None, description="Vertex of the line, from 0.")
    position: Annotated[list[Number], Field(min_length=2, max_length=2)] | None = Field(
        None, description="Instead of a vertex: a position within 50 m of the axis, in the road's CRS."
    )
    chainage_m: Metres | None = Field(
        None, description="Instead of a vertex: distance along the axis from the start of its first line. [m]"
    )

    def given(self) -> CalibrationInput:
        """The point as the use cases know it."""
        position = (self.position[0], self.position[1]) if self.position is not None else None
        return CalibrationInput(self.measure_m, self.ahead_m, self.part, self.vertex, position, self.chainage_m)


class _AxisIn(StrictModel):
    crs: Text | None = Field(None, max_length=100, description="EPSG code or URN of the geometry; WGS 84 if left out.")
    realization: Text | None = Field(None, min_length=1, max_length=64)
    epoch: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=1900, le=2200)] | None = None
    measure_markers: Annotated[bool, Field(strict=True)] = Field(
        True, description="Give the markers that name the road the measure and offset of their position."
    )
    dry_run: Annotated[bool, Field(strict=True)] = Field(False, description="Say what would happen; store nothing.")
    reason: Reason | None = None

    def lines(self, geometry: AnyLine) -> LinesInput:
        """The geometry as the use cases know it."""
        several = geometry.type == "MultiLineString"
        parts: list[Any] = geometry.coordinates if several else [geometry.coordinates]
        return LinesInput(
            tuple(tuple((p[0], p[1]) for p in part) for part in parts),
            self.crs,
            self.realization,
            self.epoch,
            several,
        )


ROAD_EXAMPLE: dict[str, JsonValue] = {
    "name": "A 5 northbound",
    "crs": "EPSG:25832",
    "geometry": {"type": "LineString", "coordinates": [[456000, 5427000], [456060, 5427210], [456150, 5427400]]},
    "calibration": [{"measure_m": 612000, "vertex": 0}, {"measure_m": 612430, "vertex": 2}],
}


class RoadIn(_AxisIn):
    """A road to register."""

    model_config = ConfigDict(json_schema_extra={"examples": [ROAD_EXAMPLE]})

    name: Text = Field(min_length=1, max_length=200, description="As the markers on it say in `road`.")
    geometry: AnyLine = Field(description="The axis in the direction of rising measures; heights are left out.")
    calibration: Annotated[list[StationIn], Field(max_length=MAX_CALIBRATION)] = Field(
        default_factory=list, description="Known measures; without, true metres from 0."
    )


class RoadPatch(_AxisIn):
    """Members to change; one that is left out stays. A new geometry comes with its calibration."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{"calibration": [{"measure_m": 612000, "vertex": 0}], "reason": "new kilometre posts"}]
        },
    )

    geometry: AnyLine | None = None
    calibration: Annotated[list[StationIn], Field(max_length=MAX_CALIBRATION)] | None = None


class PositionsIn(StrictModel):
    """Positions to find on a road."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"positions": [[8.4012, 49.0003]], "max_offset_m": 20}]})

    positions: Annotated[
        list[Annotated[list[Number], Field(min_length=2, max_length=2)]],
        Field(min_length=1, max_length=MAX_POSITIONS, description="Longitude and latitude of each. [deg]"),
    ]
    max_offset_m: Annotated[float, Field(allow_inf_nan=False, gt=0, le=MAX_REACH_M)] = 100.0


class ReferenceIn(StrictModel):
    """A place along a road."""

    measure_m: Metres
    offset_m: Offset = 0.0


class ReferencesIn(StrictModel):
    """Places along a road."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"references": [{"measure_m": 612100, "offset_m": -3.5}]}]}
    )

    references: Annotated[list[ReferenceIn], Field(min_length=1, max_length=MAX_POSITIONS)]
