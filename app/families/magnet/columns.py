"""Columns of a marker that is a tag or a line of magnets."""

from __future__ import annotations

from dataclasses import asdict
from datetime import datetime
from typing import Any, cast

from app.errors import naming
from app.families.magnet.layouts import (
    INFORMATION_TAG,
    LINE_TAG,
    check_never_broken,
    lane_spec,
    layout_of,
    place_lane,
    sheet_of,
    worst_grade,
)
from app.families.magnet.registration import NewMagnets, TagInput
from app.families.magnet.spec import LinePlaceDocument, MagnetSpec, SiteDocument, TagPlaceDocument
from app.families.positions import position_columns
from app.families.rules import MarkerRules
from app.markers.magnet import LineTag, Tag
from app.markers.magnet_codebook import Meaning
from app.planning.magnet_checks import Site
from app.registry.ids import new_id


def magnet_columns(
    new: NewMagnets, tag: Tag, meaning: Meaning | None, rules: MarkerRules, now: datetime
) -> dict[str, Any]:
    """Columns of a tag or a line of magnets that breaks no limit by itself.

    Raises
    ------
    InvalidParameter, ReferenceSystemError
        The lane or the site cannot be, or magnets would stand too near or too far apart.
    """
    placed = place_lane(new.lane, rules.crs_accuracy_m)
    with naming("site"):
        site = asdict(Site(**new.site))
    del site["neighbours"]
    marker_id = new_id(now)
    spec: MagnetSpec = {
        "kind": LINE_TAG if isinstance(tag, LineTag) else INFORMATION_TAG,
        "tag": tag.text,
        "codebook_id": new.what.codebook_id if isinstance(new.what, TagInput) else None,
        "meaning": None if meaning is None else {"kind": meaning.kind.value, "value": meaning.value},
        "lane": lane_spec(new.lane, placed),
        "place": cast(TagPlaceDocument | LinePlaceDocument, asdict(new.what.place)),
        "site": cast(SiteDocument, site),
        "neighbours": [],
    }
    layout, sheet = layout_of(marker_id, spec), sheet_of(marker_id, spec)
    check_never_broken(layout, sheet.checks)
    first = layout.holes[0]
    columns = position_columns(new.lane.provenance, worst_grade(placed))
    placed_at = {name: value for name, value in spec["place"].items() if value is not None}
    return {
        "id": marker_id,
        "spec": spec,
        "family": "magnet",
        "scheme": spec["kind"],
        "digits": tag.text,
        **columns,
        "lon_deg": first.lon_deg,
        "lat_deg": first.lat_deg,
        "heading_deg": layout.bearing_deg % 360.0,
        "original": {**columns["original"], **placed_at},
    }
