"""Schemas of requests that register plates."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import ConfigDict, Field, JsonValue

from app.errors import naming
from app.families.inputs import POSITION_EXAMPLE, Headed, MarkerIn, Number, PositionIn, StrictModel, Text, Whole
from app.families.plate.registration import CodeInput, NewPlate
from app.markers.plate import PlateGeometry, PlateScheme


class CodeIn(StrictModel):
    """The plate's code; without digits they follow from the position or the registry number."""

    scheme: Literal["position", "position-check", "id"] = "position"
    digits: Text | None = Field(None, min_length=1, max_length=64, description="Digits to use instead of derived ones.")
    check_digits: Annotated[int, Field(strict=True, ge=1, le=2)] | None = Field(
        None, description="For `position-check`: 1 (default) or 2."
    )
    registry_number: Annotated[int, Field(strict=True, ge=0, lt=2**64)] | None = Field(
        None, description="For `id`: the number; allocated if left out."
    )
    allow_mismatched_digits: Annotated[bool, Field(strict=True)] = Field(
        False, description="Store digits that do not fit the position; such a plate is found through the registry only."
    )


class GeometryIn(StrictModel):
    """Dimensions of the plate."""

    n: Whole = Field(8, description="Units along a side: 8, 10 or 12.")
    unit_mm: Number = Field(35.0, description="Side of a unit, 20 to 50. [mm]")
    gap_mm: Number = Field(5.0, description="Gap between units and round the border, 2 to 10. [mm]")
    thickness_mm: Number = Field(20.0, description="Thickness of the base plate, 5 to 50. [mm]")

    def geometry(self) -> PlateGeometry:
        """The dimensions as the core knows them."""
        with naming("geometry"):
            return PlateGeometry(self.n, self.unit_mm, self.gap_mm, self.thickness_mm)


PLATE_EXAMPLES: list[JsonValue] = [
    {"position": POSITION_EXAMPLE, "heading_deg": 78.5, "status": "surveyed", "road": "Cheong Wan Road"},
    {"position": POSITION_EXAMPLE, "code": {"scheme": "position-check", "check_digits": 2}, "geometry": {"n": 10}},
    {"position": POSITION_EXAMPLE, "code": {"scheme": "id"}},
    {"position": POSITION_EXAMPLE, "code": {"digits": "023792168411", "allow_mismatched_digits": True}},
]


class PlateIn(Headed, MarkerIn):
    """A plate to register."""

    model_config = ConfigDict(json_schema_extra={"examples": PLATE_EXAMPLES})

    family: Literal["plate"] = "plate"
    position: PositionIn
    code: CodeIn = Field(default_factory=CodeIn)
    geometry: GeometryIn = Field(default_factory=GeometryIn)

    def new(self) -> NewPlate:
        """The plate as the use cases know it."""
        code = self.code
        return NewPlate(
            position=self.position,
            code=CodeInput(
                PlateScheme(code.scheme),
                code.digits,
                code.check_digits,
                code.registry_number,
                code.allow_mismatched_digits,
            ),
            geometry=self.geometry.geometry(),
            heading_deg=self.heading_deg,
            **self.shared(),
        )
