"""Schemas of calibration boards and calibrations."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import ConfigDict, Field, JsonValue

from app.api.http.dependencies import Number, Whole
from app.families.inputs import StrictModel
from app.sensors.calibration_board import CalibrationBoard

DECLARATION_EXAMPLE: dict[str, JsonValue] = {
    "board": {"columns": 7, "rows": 10, "square_mm": 25.0, "marker_mm": 18.0},
}


class BoardIn(StrictModel):
    """A board: squares across and down, the upper left one black, and their sides as measured on the print."""

    columns: Whole = Field(7, description="Squares across, 4 to 24.")
    rows: Whole = Field(10, description="Squares down, 4 to 24; at most 200 squares.")
    square_mm: Number = Field(25.0, description="Side of a square, 8 to 250. [mm]")
    marker_mm: Number = Field(18.0, description="Side of a marker, 0.5 to 0.85 of a square. [mm]")

    def given(self) -> CalibrationBoard:
        """The board as the core knows it."""
        return CalibrationBoard(self.columns, self.rows, self.square_mm, self.marker_mm)


class CalibrationIn(StrictModel):
    """What is declared of the photos."""

    model_config = ConfigDict(json_schema_extra={"examples": [DECLARATION_EXAMPLE]})

    board: BoardIn = Field(default_factory=BoardIn)
    coefficients: Annotated[Literal[4, 5, 8] | None, Field(description="Of the distortion; chosen if left out.")] = None
