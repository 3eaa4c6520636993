"""Schema of changes to a marker of any family."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import BaseModel, ConfigDict, Field, create_model

from app.errors import InvalidParameter
from app.families import FAMILIES
from app.families.inputs import POSITION_EXAMPLE, Headed, PositionIn
from app.markers.status import Status
from app.services.markers.markers import MarkerChange

if TYPE_CHECKING:

    class _FamilyChanges(BaseModel):
        """Members of a change that only one family has, of all families."""

else:
    _FamilyChanges = create_model("_FamilyChanges", __base__=tuple(f.change for f in FAMILIES if f.change is not None))


class MarkerPatch(Headed, _FamilyChanges):
    """Members to change; a member that is null is cleared, one that is left out stays."""

    model_config = ConfigDict(
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

    def change(self) -> MarkerChange:
        """The change as the use cases know it."""
        named = self.model_fields_set
        spec = {
            family.name: members
            for family in FAMILIES
            if family.change is not None and (members := family.change.spec_changes(self, named))  # type: ignore[arg-type]
        }
        values = self.model_dump(include=(named & Headed.model_fields.keys() | named & {"status"}) - {"kind", "reason"})
        position = self.position if "position" in named else None
        if not values and not spec and position is None:
            raise InvalidParameter(
                "the patch changes nothing", field="body", limit="at least one member", cure="name what to change"
            )
        return MarkerChange(values, position, self.kind, self.reason, spec)
