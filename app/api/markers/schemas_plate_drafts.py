"""Schemas of drafts of plates."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import ConfigDict, Field, JsonValue

from app.api.http.dependencies import Number
from app.encoders.plate import ArtworkOptions
from app.families.inputs import POSITION_EXAMPLE, Flag, PositionIn, StrictModel
from app.families.plate.inputs import CodeIn, GeometryIn
from app.families.plate.registration import CodeInput
from app.markers.plate import PlateScheme
from app.planning.proof.terms import Condition
from app.planning.rules import CameraRules
from app.services.markers.plate_drafts import Pass, PlateDraft

_PLACE: dict[str, JsonValue] = {name: POSITION_EXAMPLE[name] for name in ("lon_deg", "lat_deg")}
_EXAMPLES: list[JsonValue] = [
    {"position": _PLACE, "code": {"scheme": "position-robust"}},
    {"code": {"scheme": "id", "registry_number": 3237998146}, "geometry": {"unit_mm": 40.0}},
]
_PASS_EXAMPLE: dict[str, JsonValue] = {"camera": {"height_m": 1.4, "exposure_s": 0.002}, "speed_kmh": 50.0}


class PlateDraftIn(StrictModel):
    """A plate to see before it is registered."""

    model_config = ConfigDict(json_schema_extra={"examples": _EXAMPLES})

    position: PositionIn | None = Field(None, description="Centre of the plate; the position schemes need it.")
    code: CodeIn = Field(default_factory=CodeIn)
    geometry: GeometryIn = Field(default_factory=GeometryIn)

    def draft(self) -> PlateDraft:
        """The draft as the use cases know it."""
        code, scheme = self.code, PlateScheme(self.code.scheme)
        wanted = CodeInput(scheme, code.digits, code.check_digits, code.registry_number, code.allow_mismatched_digits)
        return PlateDraft(wanted, self.geometry.geometry(scheme), self.position)


class DraftArtworkIn(PlateDraftIn):
    """A plate to draw before it is registered."""

    heaters: Flag = Field(False, description="Heating tracks under dark units.")
    leds: Flag = Field(False, description="Light sources under light units.")
    resolution_dpi: Annotated[float, Field(ge=20, le=300, allow_inf_nan=False)] = Field(
        150.0, description="Of a PNG. [1/inch]"
    )

    def options(self) -> ArtworkOptions:
        """What else the drawing shows."""
        return ArtworkOptions(heaters=self.heaters, leds=self.leds)


class CameraPassIn(PlateDraftIn):
    """A camera that passes a plate."""

    model_config = ConfigDict(json_schema_extra={"examples": [_PASS_EXAMPLE]})

    camera: CameraRules = Field(default_factory=CameraRules, description="As in the rules of a plan.")
    speed_kmh: Number = Field(60.0, ge=2.0, le=250.0, description="Speed of the vehicle. [km/h]")
    left_m: Number = Field(0.0, ge=-5.0, le=5.0, description="Plate's centre left of the camera's path. [m]")

    def way(self) -> Pass:
        """The pass as the use cases know it."""
        return Pass(self.camera, self.speed_kmh, self.left_m)


class CameraViewIn(CameraPassIn):
    """One frame of a pass."""

    model_config = ConfigDict(json_schema_extra={"examples": [{**_PASS_EXAMPLE, "ahead_m": 4.0}]})

    ahead_m: Number = Field(4.0, ge=0.2, le=18.0, description="From the camera to the plate's centre. [m]")
    condition: Literal["day", "night", "rain", "shade", "wear", "dirt"] = Field(
        "day", description="Light, weather or state of the plate, as in a proof."
    )

    def terms(self) -> Condition:
        """The condition as the use cases know it."""
        return Condition(self.condition)
