"""Plans that are placed and checked to see what rules do; nothing is stored."""

from __future__ import annotations

from typing import Any, cast

from app.errors import InvalidParameter
from app.services.access.access import Caller
from app.services.plans.documents import PlanPreview, PreviewedMarker
from app.services.plans.making import IMMEDIATE_LANES_M, PlanMaking
from app.services.plans.plans import Plans

_NAME = "preview"


class PlanPreviews:
    """Shows what rules would place.

    Parameters
    ----------
    plans : Plans
    making : PlanMaking
        Decides which roads are too long.
    """

    def __init__(self, plans: Plans, making: PlanMaking) -> None:
        self._plans, self._making = plans, making

    def preview(self, caller: Caller, alignment_id: str, rules: dict[str, Any]) -> PlanPreview:
        """Counts, checks, costs and markers of a plan by these rules.

        Raises
        ------
        NotFound
            There is no such alignment.
        InvalidParameter
            The rules are invalid, or do not fit the road; or the road is too long for an immediate response.
        """
        if self._making.is_long(caller, alignment_id):
            raise InvalidParameter(
                "the road is too long for a preview",
                field="alignment_id",
                limit=f"{IMMEDIATE_LANES_M / 1000:g} km of lanes",
                cure="make the plan, which is a job then",
            )
        made = self._plans.place(caller, _NAME, alignment_id, rules)
        members = PreviewedMarker.__annotations__ if made.features.count else ()
        columns = {name: made.features.values(name) for name in members}
        rows = zip(*columns.values(), strict=True)
        markers = [dict(zip(columns, row, strict=True)) for row in rows]
        return cast("PlanPreview", {**made.summary, "markers": markers})
