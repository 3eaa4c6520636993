"""Information tags of the registry as the decoder of traces takes them, and which of them a trace saw."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any

import sqlalchemy as sa

from app.decoders.magnet.registered import MAX_TAGS, ReadTrace, RegisteredTag
from app.markers.magnet import InformationTag, parse_tag
from app.markers.magnet_codebook import Meaning
from app.registry import markers as store
from app.registry.markers import MarkerFilter, Row
from app.services.decode_context import CoarsePosition
from app.services.fixes import horizontal_rmse_m, position_doubts
from app.services.magnet_layouts import INFORMATION_TAG


@dataclass(frozen=True, slots=True)
class NearbyTags:
    """The agency's information tags that the drive can have passed."""

    tags: tuple[RegisteredTag, ...] = ()
    complete: bool = True

    @property
    def texts(self) -> tuple[str, ...]:
        """Their codes, without repetitions; none if there are too many to look for."""
        return tuple(dict.fromkeys(tag.tag.text for tag in self.tags)) if self.complete else ()


def find_nearby_tags(
    connection: sa.Connection, agency_id: str, position: CoarsePosition | None, reach_m: float
) -> NearbyTags:
    """Information tags of the agency within the coarse accuracy and the length of a drive."""
    if position is None:
        return NearbyTags()
    near = (position.lon_deg, position.lat_deg, position.accuracy_m + reach_m)
    rows = store.list_markers(
        connection, agency_id, MarkerFilter(near=near, family="magnet"), after=None, limit=4 * MAX_TAGS
    )
    tags = [row for row in rows if row["scheme"] == INFORMATION_TAG and row["status"] != "retired"]
    complete = len(tags) <= MAX_TAGS and len(rows) < 4 * MAX_TAGS
    return NearbyTags(tuple(registered_tag(row) for row in tags[:MAX_TAGS]), complete)


def registered_tag(row: Row) -> RegisteredTag:
    """The information tag of a magnet marker's row."""
    tag, spec = parse_tag(row["digits"]), row["spec"]
    assert isinstance(tag, InformationTag)
    lane_lon_deg, lane_lat_deg = spec["lane"]["points_deg"][0][:2]
    return RegisteredTag(
        str(row["id"]), row["status"], tag, row["lon_deg"], row["lat_deg"], row["height_m"], row["heading_deg"],
        lane_lon_deg, lane_lat_deg, horizontal_rmse_m(row), row["localization_grade"],
        tuple(position_doubts(row, "tag")), None if spec["meaning"] is None else Meaning(**spec["meaning"]),
    )  # fmt: skip


def trace_observations(decode_id: str, trace: ReadTrace, seen_at: datetime) -> list[dict[str, Any]]:
    """One row a registered tag; of one that was passed twice the surer reading counts."""
    rows: dict[str, dict[str, Any]] = {}
    for tag in sorted(trace.tags, key=lambda tag: -tag.reading.confidence):
        if tag.match is None or tag.match.tag is None:
            continue
        reading = tag.reading
        row = {
            "decode_id": decode_id,
            "marker_id": tag.match.tag.marker_id,
            "frame": 0,
            "at": seen_at,
            "what": "wrong-way" if reading.wrong_way else "seen",
            "detail": {
                "confidence": float(reading.confidence),
                "missing_magnets": reading.missing,
                "extra_magnets": reading.extra,
                "lateral_cm": round(float(reading.lateral_cm), 2),
            },
        }
        rows.setdefault(str(row["marker_id"]), row)
    return list(rows.values())
