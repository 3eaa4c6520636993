"""The families of markers. A family is one object, and this is the one list of them."""

from __future__ import annotations

import operator
from collections.abc import Iterable
from functools import reduce
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Discriminator

from app.families.cerpm import CERPM
from app.families.family import AnyFamily
from app.families.fiducial import FIDUCIAL
from app.families.magnet.magnets import MAGNET
from app.families.plate.plates import PLATE

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


def union_of(shapes: Iterable[Any]) -> Any:
    """The union of a shape that each family declares, for the schemas of requests and responses."""
    return reduce(operator.or_, shapes)


def union_of_documents(documents: Iterable[Any]) -> Any:
    """The union of the documents of families; the member `family` distinguishes them."""
    return Annotated[union_of(documents), Discriminator("family")]
