"""Plates as clients register them: schemas of requests, and the rows that they become."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

from pydantic import ConfigDict, Field, JsonValue

from app.errors import naming
from app.families.documents import POSITION_EXAMPLE, Headed, MarkerIn, Number, PositionIn, StrictModel, Text, Whole
from app.families.surveys import NewMarker
from app.markers.plate import RECOMMENDED_SCHEME, PlateCode, PlateGeometry, PlateScheme, recommended_geometry
from app.registry.marker_rows import MarkerRow

# === The row of a plate as values of the core.


def plate_code(row: MarkerRow) -> PlateCode:
    """Code of a plate's row."""
    return PlateCode(row.digits, PlateScheme(row.scheme), row.n, row.check_digits or 1)


def plate_geometry(row: MarkerRow) -> PlateGeometry:
    """Geometry of a plate's row."""
    return PlateGeometry(row.n, row.unit_mm, row.gap_mm, row.thickness_mm)


# === A plate that is to be registered, as its use case knows it.


@dataclass(frozen=True, slots=True)
class CodeInput:
    """The code that a plate is to have."""

    scheme: PlateScheme = RECOMMENDED_SCHEME
    digits: str | None = None
    check_digits: int | None = None
    registry_number: int | None = None
    allow_mismatched_digits: bool = False


@dataclass(frozen=True, slots=True)
class NewPlate(NewMarker):
    """A plate to register."""

    family: ClassVar[str] = "plate"
    position: PositionIn
    code: CodeInput = field(default_factory=CodeInput)
    geometry: PlateGeometry = field(default_factory=PlateGeometry)
    heading_deg: float | None = None


# === Schemas of requests that register plates.


SchemeName = Literal["id", "position-robust", "position-check", "position"]
RECOMMENDED_SCHEME_NAME: SchemeName = RECOMMENDED_SCHEME.value
SCHEME_DESCRIPTION = (
    "`id`: a registry number; `position-robust`: the position, on 10 x 10 or 12 x 12 units; both correct wrong cells. "
    "`position-check` and `position` correct none."
)


class CodeIn(StrictModel):
    """The plate's code; without digits they follow from the position or the registry number."""

    scheme: SchemeName = Field(RECOMMENDED_SCHEME_NAME, description=SCHEME_DESCRIPTION)
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

    n: Whole | None = Field(
        None, description="Units along a side: 8, 10 or 12. Without: 10 for the scheme `position-robust`, else 8."
    )
    unit_mm: Number | None = Field(
        None, description="Side of a unit, 20 to 50. Without: 27 for `position-robust` on 10 x 10, else 35. [mm]"
    )
    gap_mm: Number = Field(5.0, description="Gap between units and round the border, 2 to 10. [mm]")
    thickness_mm: Number = Field(20.0, description="Thickness of the base plate, 5 to 50. [mm]")

    def geometry(self, scheme: PlateScheme) -> PlateGeometry:
        """The dimensions as the core knows them, of a plate of a scheme."""
        with naming("geometry"):
            return recommended_geometry(
                scheme, n=self.n, unit_mm=self.unit_mm, gap_mm=self.gap_mm, thickness_mm=self.thickness_mm
            )


PLATE_EXAMPLES: list[JsonValue] = [
    {"position": POSITION_EXAMPLE, "heading_deg": 78.5, "status": "surveyed", "road": "Cheong Wan Road"},
    {"position": POSITION_EXAMPLE, "code": {"scheme": "position-robust"}},
    {"position": POSITION_EXAMPLE, "code": {"scheme": "position-check", "check_digits": 2}, "geometry": {"n": 10}},
    {
        "position": POSITION_EXAMPLE,
        "code": {"scheme": "position", "digits": "023792168411", "allow_mismatched_digits": True},
    },
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
            geometry=self.geometry.geometry(PlateScheme(code.scheme)),
            heading_deg=self.heading_deg,
            **self.shared(),
        )
