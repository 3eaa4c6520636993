"""What the row of a magnet marker has in its column `spec`."""

from __future__ import annotations

from typing import Literal

from typing_extensions import TypedDict

from app.markers.magnet_codebook import Meaning, MeaningKind


class StoredMeaning(TypedDict):
    """The kind of a meaning and its value."""

    kind: str
    value: float | str


class TagPlaceDocument(TypedDict):
    """Where an information tag lies on its lane."""

    chainage_m: float
    offset_m: float


class LinePlaceDocument(TypedDict):
    """Which part of a line carries magnets."""

    from_m: float
    to_m: float | None
    spacing_m: float


class StoredLane(TypedDict):
    """Vertices in WGS 84, and in `given` the coordinates that were sent where they were of another system."""

    points_deg: list[list[float]]
    height_m: float | None
    given: list[list[float]] | None


class SiteDocument(TypedDict):
    """What the checks know of the road and its traffic."""

    design_speed_mps: float | None
    stop_line_chainage_m: float | None
    vehicles: list[str]
    readable_clearance_m: float
    reaction_s: float
    deceleration_mps2: float


class StoredNeighbour(TypedDict):
    """The nearest magnet of another marker with an orientation."""

    name: str
    lon_deg: float
    lat_deg: float
    phi_deg: int


class MagnetSpec(TypedDict):
    """What the layout of a magnet marker follows from."""

    kind: Literal["information-tag", "line-tag"]
    tag: str
    codebook_id: str | None
    meaning: StoredMeaning | None
    lane: StoredLane
    place: TagPlaceDocument | LinePlaceDocument
    site: SiteDocument
    neighbours: list[StoredNeighbour]


def meaning_of(spec: MagnetSpec) -> Meaning | None:
    """What the tag means, if it is in a codebook."""
    stored = spec["meaning"]
    return None if stored is None else Meaning(MeaningKind(stored["kind"]), stored["value"])
