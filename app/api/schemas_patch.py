"""Schema of changes to a marker of any family."""

from __future__ import annotations

from dataclasses import asdict

from pydantic import ConfigDict, Field

from app.api.schemas_cerpms import DevEui, RadioIn, Side, SpeedLimitIn
from app.api.schemas_markers import POSITION_EXAMPLE, Headed, PositionIn, Status
from app.errors import InvalidParameter
from app.services.markers import MarkerChange
from app.services.positions import GivenPosition


class MarkerPatch(Headed):
    """Members to change; a member that is null is cleared, one that is left out stays."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {"status": "surveyed", "position": POSITION_EXAMPLE, "reason": "as-built survey"},
                {"status": "retired", "reason": "resurfaced"},
            ]
        },
    )

    status: Status = Field("planned", description="New status.")
    position: PositionIn = Field(
        default_factory=PositionIn,
        description="New position; replaces the whole of the old. Of an information tag: where its first magnet was "
        "surveyed; the others follow.",
    )
    side: Side = Field("unknown", description="Of a CERPM.")
    speed_limit: SpeedLimitIn | None = Field(None, description="Of a CERPM.")
    dev_eui: DevEui | None = Field(None, description="Of a CERPM.")
    radio: RadioIn = Field(default_factory=RadioIn, description="Of a CERPM; replaces the whole of the old.")

    def change(self) -> MarkerChange:
        """The change as the use cases know it."""
        named = self.model_fields_set
        values = self.model_dump(include=named - {"position", "kind", "reason", *_SAID})
        spec = {**self.model_dump(include=named & {"side"})}
        if "speed_limit" in named:
            limit = self.speed_limit
            spec["speed_limit"] = None if limit is None else limit.model_dump(mode="json")
        if "dev_eui" in named:
            spec["dev_eui"] = self.dev_eui.lower() if self.dev_eui is not None else None
        if "radio" in named:
            spec["radio"] = asdict(self.radio.given())
        if spec:
            values["spec"] = spec
        position = GivenPosition(**self.position.model_dump()) if "position" in named else None
        if not values and position is None:
            raise InvalidParameter(
                "the patch changes nothing", field="body", limit="at least one member", cure="name what to change"
            )
        return MarkerChange(values, position, self.kind, self.reason)


_SAID = ("side", "speed_limit", "dev_eui", "radio")
