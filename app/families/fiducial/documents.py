"""Fiducial signs as clients see them."""

from __future__ import annotations

from typing import Literal

from typing_extensions import TypedDict

from app.families.documents import MarkerDocument, marker_head, marker_place
from app.registry.marker_rows import MarkerRow


class FiducialCodeDocument(TypedDict):
    """The code of a sign: the dictionary, the codeword's number, and both in words."""

    scheme: str
    text: str
    dictionary: str
    number: int


class FiducialGeometryDocument(TypedDict):
    """Dimensions and mounting of a sign."""

    side_mm: float
    quiet_mm: float
    mounting: Literal["upright", "lying"]


class FiducialDocument(MarkerDocument):
    """An ArUco or AprilTag sign."""

    code: FiducialCodeDocument
    geometry: FiducialGeometryDocument


def fiducial_document(row: MarkerRow) -> FiducialDocument:
    """A sign's row as clients see it."""
    spec: FiducialGeometryDocument = row.spec
    return {
        **marker_head(row),
        "code": {
            "scheme": row.scheme,
            "text": row.digits,
            "dictionary": row.scheme,
            "number": int(row.digits.rpartition("-")[2]),
        },
        "geometry": {"side_mm": spec["side_mm"], "quiet_mm": spec["quiet_mm"], "mounting": spec["mounting"]},
        **marker_place(row),
    }
