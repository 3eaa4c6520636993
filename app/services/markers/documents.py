"""Shapes of markers of all families, and of the answers that hold them."""

from __future__ import annotations

import types
from datetime import datetime
from typing import TYPE_CHECKING, Any, NotRequired

from typing_extensions import TypedDict

from app.families import FAMILIES, union_of
from app.families.documents import MarkerDocument
from app.services.version_kinds import VersionKind


class AlongDocument(TypedDict):
    """Where a marker is along the line of a search."""

    distance_m: float
    offset_m: float
    ambiguous: bool


class Found(TypedDict):
    """What a search adds to a marker."""

    distance_m: NotRequired[float]
    along: NotRequired[AlongDocument]


class FoundMarker(MarkerDocument, Found):
    """A marker of any family that a search found; `distance_m` is from the place of the search. [m]"""


def _found(document: Any) -> Any:
    """The shape of a family's markers in the answer to a search."""
    return types.new_class(f"Found{document.__name__}", (document, Found))


if TYPE_CHECKING:
    AnyMarker = MarkerDocument
    AnyMarkerDetail = MarkerDocument
    AnyFoundMarker = FoundMarker
else:
    AnyMarker = union_of(family.document_type for family in FAMILIES)
    AnyMarkerDetail = union_of(family.detail_type for family in FAMILIES)
    AnyFoundMarker = union_of(_found(family.document_type) for family in FAMILIES)


class MarkerPage(TypedDict):
    """A page of markers; the Link header leads to the next one."""

    items: list[AnyFoundMarker]


class VersionDocument(TypedDict):
    """One entry of a marker's history."""

    version: int
    at: datetime
    who: str
    why: str | None
    kind: VersionKind
    sha256: str
    audit_number: int
    marker: AnyMarker


class VersionPage(TypedDict):
    """A page of a marker's history, oldest first."""

    items: list[VersionDocument]
