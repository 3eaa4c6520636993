"""Evidence of an observation on its marker's health: to the stored detail, and back to a pass."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Any

from typing_extensions import TypedDict

from app.health import Pass
from app.registry.decodes import NewObservation
from app.registry.health import NewUnregistered

EVIDENCE = "evidence"
"""Member of an observation's detail."""
MISSED = "missed"


class EvidenceDocument(TypedDict, total=False):
    """Measured values of one pass of one marker; `app.health.Pass` describes them."""

    family: str
    place_deg: list[float]
    expected: float
    along: float
    offset_m: list[float]
    sigma_m: float
    position_sigma_m: float
    offset_is_absolute: bool
    survey_m: float
    heading_deg: float
    reversed: bool
    quality: float
    quality_is_relative: bool
    elsewhere_deg: list[float]
    two_places: bool


@dataclass(frozen=True, slots=True)
class FrameHealth:
    """What one frame shows of the health of markers.

    Attributes
    ----------
    of_readings : tuple of dict
        Evidence of each reading; empty where there is none.
    in_view : mapping of str to dict
        Evidence of markers that are in view at a readable size, whether they were read or not.
    unregistered : tuple of NewUnregistered
    """

    of_readings: tuple[dict[str, Any], ...] = ()
    in_view: Mapping[str, dict[str, Any]] = field(default_factory=dict)
    unregistered: tuple[NewUnregistered, ...] = ()


def passes_of(rows: Iterable[NewObservation]) -> list[tuple[Pass, NewObservation]]:
    """One pass for each marker of a decode that has evidence, with one of its observations."""
    by_marker: dict[str, list[NewObservation]] = defaultdict(list)
    for row in rows:
        if row.detail and row.detail.get(EVIDENCE):
            by_marker[row.marker_id].append(row)
    return [(_pass(marker_id, several), several[0]) for marker_id, several in sorted(by_marker.items())]


def _pass(marker_id: str, rows: Sequence[NewObservation]) -> Pass:
    """The frames of a decode that show a marker share its errors: their values are averaged, sigma stays."""
    found = [row.detail[EVIDENCE] for row in rows]
    read = [row.what != MISSED for row in rows]
    offsets = [one["offset_m"] for one in found if "offset_m" in one]
    position = [one["position_sigma_m"] for one in found if "position_sigma_m" in one]
    directions = [one["reversed"] for one in found if "reversed" in one]
    qualities = [one["quality"] for one in found if "quality" in one]
    headings = [one["heading_deg"] for one in found if "heading_deg" in one]
    elsewhere = next((one["elsewhere_deg"] for one in found if "elsewhere_deg" in one), None)
    return Pass(
        marker_id,
        found[0]["family"],
        any(read),
        expected=max(one.get("expected", 0.0) for one in found),
        along=found[0].get("along", 0.0),
        offset_m=(_mean(offsets, 0), _mean(offsets, 1)) if offsets else None,
        sigma_m=min((one.get("sigma_m", 0.0) for one in found if "offset_m" in one), default=0.0),
        position_sigma_m=min(position) if position else None,
        offset_is_absolute=any(one.get("offset_is_absolute", False) for one in found),
        survey_m=found[0].get("survey_m", 0.0),
        heading_deg=headings[0] if headings else None,
        reversed=2 * sum(directions) > len(directions) if directions else None,
        quality=median(qualities) if qualities else None,
        quality_is_relative=any(one.get("quality_is_relative", False) for one in found),
        elsewhere=None if elsewhere is None else (elsewhere[0], elsewhere[1]),
        two_places=any(one.get("two_places", False) for one in found),
    )


def _mean(values: Sequence[Sequence[float]], axis: int) -> float:
    return math.fsum(value[axis] for value in values) / len(values)


def rounded(evidence: Mapping[str, Any]) -> dict[str, Any]:
    """Evidence as it is stored: values that no figure of a sensor has are left out."""
    kept: dict[str, Any] = {}
    for name, value in evidence.items():
        if value is None:
            continue
        digits = 9 if name.endswith("_deg") and name != "heading_deg" else 4
        kept[name] = _rounded(value, digits)
    return kept


def _rounded(value: Any, digits: int) -> Any:
    if isinstance(value, float):
        return round(value, digits)
    if isinstance(value, tuple | list):
        return [round(float(part), digits) for part in value]
    return value
