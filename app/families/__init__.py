"""The families of markers. A family is one object, and this is the one list of them."""

from __future__ import annotations

import operator
from collections.abc import Iterable
from datetime import datetime
from functools import reduce
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Discriminator

from app.families.cerpm import CERPM
from app.families.family import AnyFamily
from app.families.fiducial import FIDUCIAL
from app.families.magnet.magnets import MAGNET
from app.families.plate.plates import PLATE
from app.families.surveys import PLANNED, Commitment, MarkerRules
from app.markers.reading import MarkerRow
from app.planning.plan import Plan
from app.planning.plan_checks.families import radio_settings
from app.radio.settings import RadioSettings
from app.registry.column_types import row_of

FAMILIES: tuple[AnyFamily, ...] = (PLATE, MAGNET, CERPM, FIDUCIAL)
FAMILY_NAMES = tuple(family.name for family in FAMILIES)
_BY_NAME = {family.name: family for family in FAMILIES}

if TYPE_CHECKING:
    FamilyName = str
else:
    FamilyName = Literal[FAMILY_NAMES]  # for the schemas of requests


def get_family(name: str) -> AnyFamily:
    """The family with a name that the registry stores."""
    return _BY_NAME[name]


def rows_of_plan(plan: Plan, now: datetime) -> dict[int, MarkerRow]:
    """Rows of a plan's markers as its commit stores them, by their numbers in the plan, which are their ids too.

    The row of a line of magnets has the number of its first magnet.
    """
    radio = plan.radio or radio_settings(plan) or RadioSettings()
    commitment = Commitment("", plan.alignment, MarkerRules(), now, radio=radio, installation=plan.rules.installation)
    same = {"status": PLANNED, "version": 1, "created_at": now, "updated_at": now}
    rows = {}
    for family in FAMILIES:
        own = [marker for marker in plan.markers if marker.family == family.name]
        for planned in family.planned_rows(commitment, own) if own else ():
            columns = {**same, **planned.columns, "id": str(planned.number), "family": family.name}
            rows[planned.number] = row_of(MarkerRow, columns)
    return rows


def union_of(shapes: Iterable[Any]) -> Any:
    """The union of a shape that each family declares, for the schemas of requests and responses."""
    return reduce(operator.or_, shapes)


def union_of_documents(documents: Iterable[Any]) -> Any:
    """The union of the documents of families; the member `family` distinguishes them."""
    return Annotated[union_of(documents), Discriminator("family")]
