"""Schemas of print grades."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field, JsonValue

from app.api.http.dependencies import Identifier, Number, Text
from app.errors import InvalidParameter, naming
from app.families.inputs import StrictModel
from app.families.plate.inputs import RECOMMENDED_SCHEME_NAME, SCHEME_DESCRIPTION, GeometryIn, SchemeName
from app.markers.plate import PlateCode, PlateScheme
from app.markers.recommended_plate import RECOMMENDED_SCHEME, recommended_geometry
from app.planning.rules import CameraRules
from app.services.markers.print_grades import PrintDeclaration

PRINT_EXAMPLE: dict[str, JsonValue] = {
    "code": {"scheme": "position", "digits": "023792168411"},
    "geometry": {"n": 8, "unit_mm": 35.0, "gap_mm": 5.0},
    "speed_kmh": 60.0,
}


class PrintCodeIn(StrictModel):
    """The code that the plate should have."""

    scheme: SchemeName = Field(RECOMMENDED_SCHEME_NAME, description=SCHEME_DESCRIPTION)
    digits: Text = Field(min_length=1, max_length=64, description="One hexadecimal digit a cell, row by row.")
    check_digits: Annotated[int, Field(strict=True, ge=1, le=2)] = Field(1, description="For `position-check`.")

    def code(self, n: int) -> PlateCode:
        """The code as the core knows it."""
        with naming("code"):
            return PlateCode(self.digits, PlateScheme(self.scheme), n, self.check_digits)


class PrintGradeIn(StrictModel):
    """What the photo should show, and the design speed. Without a code, the plate is what the photo shows."""

    model_config = ConfigDict(json_schema_extra={"examples": [PRINT_EXAMPLE, {"speed_kmh": 80.0}]})

    marker_id: Identifier | None = Field(None, description="The registered plate; in place of `code` and `geometry`.")
    code: PrintCodeIn | None = None
    geometry: GeometryIn | None = Field(None, description="Of the drawing; that of the scheme if left out.")
    camera: CameraRules = Field(default_factory=CameraRules, description="Camera of the vehicles.")
    speed_kmh: Number = Field(60.0, ge=5.0, le=250.0, description="Design speed. [km/h]")

    def given(self) -> PrintDeclaration:
        """The declaration as the use case knows it.

        Raises
        ------
        InvalidParameter
            A marker and a code, or digits that the plate cannot hold.
        """
        if self.marker_id is not None and (self.code is not None or self.geometry is not None):
            raise InvalidParameter(
                "the declaration names a marker and gives a code or a geometry too", field="marker_id",
                limit="a marker, or a code and a geometry", cure="leave code and geometry out: the marker has them",
            )  # fmt: skip
        scheme = PlateScheme(self.code.scheme) if self.code is not None else RECOMMENDED_SCHEME
        geometry = None if self.geometry is None else self.geometry.geometry(scheme)
        if self.code is not None and geometry is None:
            geometry = recommended_geometry(scheme)
        code = None if self.code is None or geometry is None else self.code.code(geometry.n)
        return PrintDeclaration(self.marker_id, code, geometry, self.camera, self.speed_kmh)
