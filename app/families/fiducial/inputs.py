"""Schemas of requests that register fiducial signs."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import ConfigDict, Field, JsonValue

from app.errors import naming
from app.families.fiducial.registration import NewFiducial
from app.families.inputs import POSITION_EXAMPLE, Headed, MarkerIn, Number, PositionIn, StrictModel, Text
from app.markers.fiducial import FiducialCode, FiducialGeometry, Mounting, get_dictionary


class FiducialCodeIn(StrictModel):
    """The code of a sign."""

    dictionary: Text = Field(max_length=40, description="Such as `apriltag-36h11` or `aruco-4x4-50`.")
    number: Annotated[int, Field(strict=True, ge=0)] = Field(description="Of the codeword in the dictionary, from 0.")

    def code(self) -> FiducialCode:
        """The code as the core knows it."""
        with naming("code"):
            return FiducialCode(self.dictionary, self.number)


class FiducialGeometryIn(StrictModel):
    """Dimensions and mounting of a sign."""

    side_mm: Number = Field(description="Outer edge of the black border, 30 to 3000. [mm]")
    quiet_mm: Number | None = Field(
        None, description="White zone round the border; as wide as a module if left out, at most 1000. [mm]"
    )
    mounting: Literal["upright", "lying"] = Field(
        "upright", description="Facing the traffic, or flat on the road with its upper edge in the direction of travel."
    )

    def geometry(self, code: FiducialCode) -> FiducialGeometry:
        """The dimensions as the core knows them."""
        module_mm = self.side_mm / (get_dictionary(code.dictionary).modules + 2)
        with naming("geometry"):
            quiet_mm = module_mm if self.quiet_mm is None else self.quiet_mm
            return FiducialGeometry(self.side_mm, quiet_mm, Mounting(self.mounting))


FIDUCIAL_EXAMPLES: list[JsonValue] = [
    {
        "family": "fiducial",
        "position": POSITION_EXAMPLE,
        "code": {"dictionary": "apriltag-36h11", "number": 17},
        "geometry": {"side_mm": 400, "mounting": "upright"},
        "heading_deg": 78.5,
        "status": "surveyed",
    }
]


class FiducialIn(Headed, MarkerIn):
    """An ArUco or AprilTag sign to register; its position is that of the sign's centre."""

    model_config = ConfigDict(json_schema_extra={"examples": FIDUCIAL_EXAMPLES})

    family: Literal["fiducial"]
    position: PositionIn
    code: FiducialCodeIn
    geometry: FiducialGeometryIn

    def new(self) -> NewFiducial:
        """The sign as the use cases know it."""
        code = self.code.code()
        return NewFiducial(
            position=self.position,
            code=code,
            geometry=self.geometry.geometry(code),
            heading_deg=self.heading_deg,
            **self.shared(),
        )
