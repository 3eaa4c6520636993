"""Magnet markers as clients see them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, cast

from typing_extensions import TypedDict

from app.encoders.magnet import DrillingSheet
from app.encoders.magnet.sheets import sheet_document
from app.families.documents import MarkerDocument, marker_head, marker_place
from app.families.magnet.layouts import LinePlace, TagPlace, site_of
from app.markers.magnet import Installation, LineStyle, LineTag, parse_tag
from app.markers.magnet_design import MagnetSpec, Meaning, StoredMeaning, installation_of, meaning_of
from app.markers.reading import Check, MarkerRow
from app.planning.magnet_checks import Site
from app.values import JsonObject


class MeaningDocument(StoredMeaning):
    """What a code means: its kind, its value, and both in words."""

    unit: str
    text: str


class InformationTagDocument(TypedDict):
    """The code of an information tag."""

    scheme: Literal["information-tag"]
    text: str
    tuple: str
    polarities: str
    length_m: float
    segment_m: float
    gaps_m: list[float]
    ratios: list[float]
    codebook_id: str | None
    meaning: MeaningDocument | None


class LineTagDocument(TypedDict):
    """The code of a line tag."""

    scheme: Literal["line-tag"]
    text: str
    tuple: str
    style: LineStyle


class MagnetDocument(MarkerDocument):
    """A magnet marker in a list; its position is that of the first magnet."""

    family: Literal["magnet"]
    code: InformationTagDocument | LineTagDocument
    layout: TagPlace | LinePlace
    installation: Installation
    depth_m: float
    """Of the magnets' centres below the road; negative above it. [m]"""


class LaneGeometryDocument(TypedDict):
    """A GeoJSON LineString."""

    type: Literal["LineString"]
    coordinates: list[list[float]]


class LaneDocument(TypedDict):
    """The lane in WGS 84, and in `given` the coordinates that were sent where they were of another system."""

    geometry: LaneGeometryDocument
    length_m: float
    height_m: float | None
    given: list[list[float]] | None


class HoleDocument(TypedDict):
    """One magnet to be set."""

    number: int
    lon_deg: float
    lat_deg: float
    chainage_m: float
    offset_m: float
    from_first_m: float
    east_m: float
    north_m: float
    polarity: Literal["N", "S"]
    phi_deg: Literal[0, 90]
    north_pole: str
    north_pole_bearing_deg: float | None


class CostDocument(TypedDict):
    """A quantity of something and what it costs."""

    item: str
    quantity: float
    unit: str
    low_usd: float
    high_usd: float
    source: str


class UnpricedDocument(TypedDict):
    """A quantity of something that nobody publishes a price of."""

    item: str
    quantity: float
    unit: str


class BillDocument(TypedDict):
    """Materials, what else could mark the road, and the total of the materials at the highest price.

    What is `without_price` is no part of the total.
    """

    materials: list[CostDocument]
    without_price: list[UnpricedDocument]
    alternatives: list[CostDocument]
    total_usd: float


class MagnetDetailDocument(MagnetDocument):
    """A magnet marker with its lane, magnets, checks and costs. `warnings` names the checks that failed."""

    length_m: float
    lane: LaneDocument
    site: Site
    magnets: list[HoleDocument]
    passed: bool
    checks: Sequence[Check]
    warnings: list[str]
    bill: BillDocument


def magnet_document(row: MarkerRow) -> MagnetDocument:
    """A magnet marker as lists and histories show it: without what follows from its layout."""
    spec: MagnetSpec = row.spec
    return {
        **marker_head(row),
        "family": "magnet",
        "code": _tag_document(spec),
        "layout": cast("TagPlace | LinePlace", spec["place"]),
        "installation": (installation := installation_of(spec)),
        "depth_m": installation.depth_m,
        **marker_place(row),
    }


def magnet_detail(row: MarkerRow, sheet: DrillingSheet) -> MagnetDetailDocument:
    """A magnet marker by itself: with its lane, its magnets, its checks and its costs."""
    written = sheet_document(sheet)
    summary, spec = written["waymark"], cast(MagnetSpec, row.spec)
    return {
        **magnet_document(row),
        "length_m": summary["length_m"],
        "lane": {
            "geometry": {"type": "LineString", "coordinates": spec["lane"]["points_deg"]},
            "length_m": round(sheet.layout.lane.length_m, 4),
            "height_m": spec["lane"]["height_m"],
            "given": spec["lane"]["given"],
        },
        "site": site_of(spec),
        "magnets": [_hole_document(hole) for hole in written["features"]],
        "passed": sheet.passed,
        "checks": sheet.checks,
        "warnings": [check.name for check in sheet.checks if not check.passed],
        "bill": {
            "materials": summary["bill"]["materials"],
            "without_price": summary["bill"]["without_price"],
            "alternatives": summary["bill"]["alternatives"],
            "total_usd": sheet.bill.total_usd,
        },
    }


def _hole_document(hole: JsonObject) -> HoleDocument:
    """A hole of the drilling sheet's GeoJSON as a flat document."""
    lon_deg, lat_deg = hole["geometry"]["coordinates"]
    properties = {
        name: value + 0.0 if isinstance(value, float) else value for name, value in hole["properties"].items()
    }
    for name in ("layout", "code", "hole", "depth_m"):
        del properties[name]
    return cast(HoleDocument, {"number": hole["id"], "lon_deg": lon_deg, "lat_deg": lat_deg, **properties})


def _tag_document(spec: MagnetSpec) -> InformationTagDocument | LineTagDocument:
    tag = parse_tag(spec["tag"])
    if isinstance(tag, LineTag):
        return {"scheme": "line-tag", "text": tag.text, "tuple": tag.tuple_text, "style": tag.style}
    meaning = meaning_of(spec)
    return {
        "scheme": "information-tag",
        "text": tag.text,
        "tuple": tag.tuple_text,
        "polarities": "".join(tag.polarities),
        "length_m": tag.length_m,
        "segment_m": tag.segment_m,
        "gaps_m": list(tag.gaps_m),
        "ratios": list(tag.ratios),
        "codebook_id": spec["codebook_id"],
        "meaning": None if meaning is None else meaning_document(meaning),
    }


def meaning_document(meaning: Meaning) -> MeaningDocument:
    """A meaning as clients see it."""
    return {"kind": meaning.kind.value, "value": meaning.value, "unit": meaning.unit, "text": meaning.text}
