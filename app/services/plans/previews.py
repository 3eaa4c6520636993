"""Plans that are placed and checked to see what rules do; nothing is stored."""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from typing import Any, cast

import orjson

from app.errors import InvalidParameter
from app.services.access.access import Caller
from app.services.plans.documents import PlanPreview, PreviewedMarker
from app.services.plans.making import IMMEDIATE_LANES_M, PlanMaking
from app.services.plans.plans import Plans
from app.services.plans.tasks import MadePlan

_NAME = "preview"
MAX_MARKERS = 10_000
"""Markers of a page: 1.7 MB. Source: chosen by hand, as pages of features."""
_KEPT = 4  # previews whose further pages need no computation; a large one takes 5 MB compressed; chosen by hand


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
        self._kept: OrderedDict[bytes, MadePlan] = OrderedDict()
        self._lock = threading.Lock()

    def preview(
        self, caller: Caller, alignment_id: str, rules: dict[str, Any], *, after: int = 0, limit: int = MAX_MARKERS
    ) -> tuple[PlanPreview, int | None]:
        """Counts, checks, costs and a page of markers of a plan by these rules, and where the next page begins.

        Parameters
        ----------
        caller : Caller
        alignment_id : str
        rules : dict
        after : int, optional
            Markers of the pages before. The first page is always computed anew; the pages after it are those of the
            last preview with the same rules, as long as this process keeps it.
        limit : int, optional
            Most markers of the page.

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
        key = hashlib.sha256(orjson.dumps([caller.agency_id, alignment_id, rules])).digest()
        with self._lock:
            made = self._kept.get(key) if after else None
        if made is None:
            made = self._plans.place(caller, _NAME, alignment_id, rules)
            with self._lock:
                self._kept[key] = made
                self._kept.move_to_end(key)
                if len(self._kept) > _KEPT:
                    self._kept.popitem(last=False)
        count = made.features.count
        members = PreviewedMarker.__annotations__ if count else ()
        columns = {name: made.features.values(name)[after : after + limit] for name in members}
        rows = zip(*columns.values(), strict=True)
        markers = [dict(zip(columns, row, strict=True)) for row in rows]
        onward = after + limit if after + limit < count else None
        return cast("PlanPreview", {**made.summary, "markers": markers}), onward
