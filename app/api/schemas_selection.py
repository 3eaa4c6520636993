"""Schema of a selection of markers."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, model_validator

from app.api.dependencies import Identifier, Number
from app.api.schemas_markers import Status
from app.errors import InvalidParameter
from app.geodesy import check_lon_lat
from app.registry.markers import MarkerFilter
from app.registry.spatial import Box
from app.services.marker_selection import Selection


class SelectionIn(BaseModel):
    """Markers by id or by filter."""

    model_config = ConfigDict(extra="forbid")

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
        box = None
        if self.bbox is not None:
            west, south, east, north = self.bbox
            check_lon_lat(west, south, field="bbox")
            check_lon_lat(east, north, field="bbox")
            if south > north:
                raise InvalidParameter("bbox has its south above its north", field="bbox", limit="south <= north")
            box = Box(west, south, east, north)
        return Selection(tuple(self.marker_ids or ()), MarkerFilter(box=box, status=self.status))
