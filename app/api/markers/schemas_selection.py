"""Schema of a selection of markers."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from app.api.http.dependencies import Identifier, Number
from app.errors import InvalidParameter
from app.families.inputs import StrictModel
from app.markers.status import Status
from app.registry.markers import MarkerFilter
from app.services.markers.search_boxes import checked_box
from app.services.markers.selection import Selection


class SelectionIn(StrictModel):
    """Markers by id or by filter."""

    marker_ids: list[Identifier] | None = Field(None, min_length=1, description="Ids, up to 5 000.")
    bbox: Annotated[list[Number], Field(min_length=4, max_length=4)] | None = Field(
        None, description="west, south, east, north. [deg]"
    )
    status: Status | None = Field(None, description="Only markers with this status.")

    @model_validator(mode="after")
    def _by_id_or_by_filter(self) -> SelectionIn:
        if (self.marker_ids is None) == (self.bbox is None and self.status is None):
            raise InvalidParameter(
                "markers are selected by id, or by a filter",
                field="marker_ids",
                limit="marker_ids; or bbox, status or both",
                cure="send one of the two",
            )
        return self

    def selection(self) -> Selection:
        """The selection as the use cases know it."""
        box = checked_box(*self.bbox) if self.bbox is not None else None
        return Selection(tuple(self.marker_ids or ()), MarkerFilter(box=box, status=self.status))
