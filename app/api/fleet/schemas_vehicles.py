"""Schemas of vehicles and their sensor profiles: a profile has the members of a decode's context."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import ConfigDict, Field, JsonValue, field_validator

from app.api.decodes.schemas import CameraIn, FramesIn
from app.api.decodes.schemas_packets import PacketsIn
from app.api.decodes.schemas_traces import TraceIn
from app.api.http.dependencies import Identifier, Number, Text
from app.errors import InvalidParameter
from app.families.inputs import Flag, StrictModel
from app.services.fleet.documents import VehicleStatus
from app.services.fleet.vehicles import VehicleChange

Name = Annotated[Text, Field(min_length=1, max_length=80)]
Note = Annotated[Text, Field(max_length=500)]

PROFILE_EXAMPLE: dict[str, JsonValue] = {
    "camera": {
        "width_px": 1920, "height_px": 1080, "fx_px": 1371.0, "fy_px": 1371.0, "cx_px": 959.5, "cy_px": 539.5,
        "height_m": 1.57, "depression_deg": 23.0, "forward_m": 1.2,
    },
    "trace": {"axes": "FRD", "unit": "uT", "bar": {"forward_m": 0.4}, "rate_hz": 350.0},
    "packets": {
        "receiver": {"sensitivity_dbm": -129.0, "antenna_height_m": 1.6},
        "poses": {"forward_m": 0.9, "left_m": 0.0, "accuracy_m": 0.5},
    },
}  # fmt: skip


class VehicleCameraIn(CameraIn):
    """A vehicle's camera: that of a context; intrinsics may come later, from a calibration."""

    calibration_id: Identifier | None = Field(None, description="Calibration that the intrinsics are of.")


class ProfileIn(StrictModel):
    """What stays the same from upload to upload, in the members of a decode's context."""

    model_config = ConfigDict(json_schema_extra={"examples": [PROFILE_EXAMPLE]})

    camera: VehicleCameraIn | None = None
    thermal: Flag | None = Field(None, description="The camera is thermal.")
    thermal_range: Annotated[list[Number], Field(min_length=2, max_length=2)] | None = Field(
        None, description="Counts of 16-bit thermal frames that become 0 and 255."
    )
    frames: FramesIn | None = Field(None, description="Rate and clock of the frames of drives.")
    trace: TraceIn | None = Field(None, description="Magnetometer bar, axes, unit and rate; {} for METRO's own.")
    packets: PacketsIn | None = Field(None, description="Receiver, poses and clock of packet logs; {} for the usual.")

    def given(self) -> dict[str, Any]:
        """What was said and nothing else."""
        return self.model_dump(exclude_unset=True, exclude_none=True)

    def sections(self) -> dict[str, Any]:
        """Sections that were named; None for those to take out."""
        said = self.given()
        return {name: said.get(name) for name in self.model_fields_set}


def _checked_name(name: str) -> str:
    if name != name.strip() or not name.isprintable() or (len(name) == 36 and name.count("-") == 4):
        raise InvalidParameter(
            "a vehicle's name is printable, does not begin or end with a space, and is no id",
            field="name",
            limit="1 to 80 printable characters",
            cure="send a fleet number or a plate, e.g. BUS-7",
        )
    return name


class VehicleIn(StrictModel):
    """A vehicle of the fleet."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"name": "BUS-7", "profile": PROFILE_EXAMPLE}]})

    name: Name = Field(description="What uploads call it; each name once in an agency.")
    note: Note | None = Field(None, description="Make, number plate, whatever distinguishes it.")
    profile: ProfileIn = Field(default_factory=ProfileIn)

    @field_validator("name")
    @classmethod
    def _name(cls, name: str) -> str:
        return _checked_name(name)


class VehiclePatch(StrictModel):
    """Members to change. A section of the profile is replaced as a whole; one that is null is taken out."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"profile": {"trace": {"axes": "FRD", "unit": "uT"}}, "reason": "new bar"}]},
    )

    name: Name = Field("", description="New name.")
    status: VehicleStatus = Field("active", description="A retired vehicle's uploads are refused.")
    note: Note | None = Field(None, description="New note; null clears it.")
    profile: ProfileIn = Field(default_factory=ProfileIn)
    reason: Note | None = Field(None, description="Why; appears in the history.")

    @field_validator("name")
    @classmethod
    def _name(cls, name: str) -> str:
        return _checked_name(name)

    def change(self) -> VehicleChange:
        """The change as the use cases know it."""
        named = self.model_fields_set
        values = self.model_dump(include=named & {"name", "status", "note"})
        profile = self.profile.sections() if "profile" in named else {}
        if not values and not profile:
            raise InvalidParameter(
                "the patch changes nothing", field="body", limit="at least one member", cure="name what to change"
            )
        return VehicleChange(values, profile, self.reason)


class CalibrationChoice(StrictModel):
    """Which calibration a vehicle's camera shall have."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"calibration_id": "019cb624-0000-7000-8000-00000000aaaa"}]},
    )

    calibration_id: Identifier
