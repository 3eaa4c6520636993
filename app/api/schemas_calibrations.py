"""Schemas of calibration boards and calibrations."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, JsonValue

from app.api.dependencies import Number, Whole
from app.sensors.calibration_board import CalibrationBoard

DECLARATION_EXAMPLE: dict[str, JsonValue] = {
    "board": {"columns": 7, "rows": 10, "square_mm": 25.0, "marker_mm": 18.0},
}


class BoardIn(BaseModel):
    """A board: squares across and down, the upper left one black, and their sides as measured on the print."""

    model_config = ConfigDict(extra="forbid")

    columns: Whole = Field(7, description="Squares across, 4 to 24.")
    rows: Whole = Field(10, description="Squares down, 4 to 24; at most 200 squares.")
    square_mm: Number = Field(25.0, description="Side of a square, 8 to 250. [mm]")
    marker_mm: Number = Field(18.0, description="Side of a marker, 0.5 to 0.85 of a square. [mm]")

    def given(self) -> CalibrationBoard:
        """The board as the core knows it."""
        return CalibrationBoard(self.columns, self.rows, self.square_mm, self.marker_mm)


class CalibrationIn(BaseModel):
    """What is declared of the photos."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [DECLARATION_EXAMPLE]})

    board: BoardIn = Field(default_factory=BoardIn)
    coefficients: Annotated[Literal[4, 5, 8] | None, Field(description="Of the distortion; chosen if left out.")] = None


class CalibratedCameraOut(BaseModel):
    """Intrinsics and distortion, in the members of a decode's camera; pixel centres at integers."""

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: list[float]


class CameraSigmaOut(BaseModel):
    """Standard deviations of the parameters."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: list[float]


class CoverageOut(BaseModel):
    """Cells of the image, 6 rows of 8, that have a corner in them."""

    share: float
    cells: list[list[int]]


class CalibrationViewOut(BaseModel):
    """What became of a photo."""

    photo: int
    name: str
    used: bool
    reason: str | None
    detail: str | None
    corners: int
    rms_px: float | None
    tilt_deg: float | None
    edge_width_px: float | None


class CalibrationOut(BaseModel):
    """A calibrated camera."""

    id: str
    created_at: str
    who: str
    decoder: str
    summary: str
    camera: CalibratedCameraOut
    sigma: CameraSigmaOut
    rms_px: float
    coverage: CoverageOut
    tilt_spread_deg: float
    board: dict[str, Any]
    views: list[CalibrationViewOut]


class CalibrationPage(BaseModel):
    """A page of calibrations, newest first; the Link header leads to the next one."""

    items: list[CalibrationOut]
