"""Magnets: spacing, vehicles served by clearance, codes that stay distinguishable, and the distance to events."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import scipy

from app.encoders.magnet.codebook import CodebookRules, codebook_capacity, list_conflicts
from app.geodesy.ellipsoid import ecef_from_wgs84
from app.markers.checks import Verdict
from app.markers.magnet import MAX_LINE_SPACING_M, MIN_GAP_M
from app.planning.alignment import Floats
from app.planning.magnet_checks import HALF_BAR_M, READABLE_CLEARANCE_M, vehicle_clearances
from app.planning.placement.site import distance_ahead_m
from app.planning.plan import Plan, PlanFinding, PlannedLineMagnet, PlannedMarker, PlannedTag
from app.planning.plan_checks.finding import compare
from app.planning.rules import TagRules

_SERVED = (
    0.95  # share of a kind of vehicle that must have a readable clearance; source: as app/planning/magnet_checks.py
)
_COUNTED = 2_000  # codes of a codebook that are counted; source: chosen by hand, bounds the time


def check_magnets(plan: Plan) -> Iterator[PlanFinding]:
    """All checks of line magnets and tags."""
    lines = [marker for marker in plan.markers if isinstance(marker.detail, PlannedLineMagnet)]
    tags = [marker for marker in plan.markers if isinstance(marker.detail, PlannedTag)]
    if lines:
        yield from _line_spacing(lines)
        yield from _unknown_styles(plan)
    if tags:
        assert plan.rules.tags is not None
        yield _clearance(plan.rules.tags)
        yield from _codebook(plan)
        yield _reaction(plan, tags, plan.rules.tags)
    if lines or tags:
        yield _neighbours(lines, tags)


def _line_spacing(lines: list[PlannedMarker]) -> Iterator[PlanFinding]:
    """Farthest neighbours of the same line; gaps around avoided areas included."""
    by_line: dict[tuple[str, int], list[PlannedMarker]] = defaultdict(list)
    for marker in lines:
        assert isinstance(marker.detail, PlannedLineMagnet)
        by_line[marker.lane, marker.detail.side].append(marker)
    worst, farthest = lines[0], 0.0
    for line in by_line.values():
        points = _ecef(line)
        apart = np.linalg.norm(np.diff(points, axis=0), axis=1)
        if len(apart) and float(apart.max()) > farthest:
            farthest, worst = float(apart.max()), line[int(apart.argmax())]
    yield compare(
        "line-spacing", farthest, "<=", MAX_LINE_SPACING_M + 0.005, "m", "METRO section 6.3",
        "farthest neighbours of a painted line", worst, missed=Verdict.WARN,
    )  # fmt: skip


def _unknown_styles(plan: Plan) -> Iterator[PlanFinding]:
    unknown = {
        (marker.lane, marker.detail.side.name.lower())
        for marker in plan.markers
        if isinstance(marker.detail, PlannedLineMagnet) and marker.detail.style.value == "unknown"
    }
    if unknown:
        names = ", ".join(f"{side} of lane {lane}" for lane, side in sorted(unknown)[:5])
        yield compare(
            "line-style", len(unknown), "<=", 0, "lines", "METRO section 6.3: N on solid, S on dashed lines",
            f"lines whose paint the road's file does not state, taken as solid: {names}", missed=Verdict.WARN,
        )  # fmt: skip


def _clearance(rules: TagRules) -> PlanFinding:
    known = vehicle_clearances()
    name = rules.clearance_class
    if name not in known:
        return compare(
            "clearance", 0, ">=", 1, "classes", "METRO figure 14a", f"{name[:40]!r} is none of {', '.join(known)}"
        )
    mean_m, std_m = known[name]
    served = float(scipy.special.ndtr((READABLE_CLEARANCE_M - mean_m) / std_m))
    return compare(
        f"clearance {name}", mean_m + float(scipy.special.ndtri(_SERVED)) * std_m, "<=", READABLE_CLEARANCE_M, "m",
        "METRO figure 14a, section 7.3", f"{_SERVED:.0%} have less ground clearance; {served:.0%} can read the tags",
        missed=Verdict.WARN,
    )  # fmt: skip


def _codebook(plan: Plan) -> Iterator[PlanFinding]:
    book = plan.codebook
    assert book is not None
    used = len(book.entries)
    capacity = max(codebook_capacity(book.design, CodebookRules(), max_count=_COUNTED), used)
    least = "at least " if capacity == _COUNTED else ""
    yield compare(
        "codebook-room", used / capacity, "<=", 1.0, "share", "METRO equation 2 and figure 17",
        f"{used} of {least}{capacity} codes that stay distinguishable are used",
    )  # fmt: skip
    near = list_conflicts(book, CodebookRules())
    yield compare(
        "distinguishable-codes", len(near), "<=", 0, "pairs", "docs/magnets.md: confused once in 1,000 readings",
        "pairs of codes that are nearer to each other than the decoder's error allows",
    )  # fmt: skip


def _reaction(plan: Plan, tags: list[PlannedMarker], rules: TagRules) -> PlanFinding:
    """Distance from a tag's last magnet to its event, less the needed one; at most 0 where tags had to move back."""
    worst, least = tags[0], np.inf
    for marker in tags:
        detail = marker.detail
        assert isinstance(detail, PlannedTag)
        if detail.event.kind.value == "arrow":
            continue
        lane = plan.alignment.lane(marker.lane)
        needed = distance_ahead_m(lane, detail.event.chainage_m, rules)
        spare = detail.event.chainage_m - detail.magnets[-1][0] - needed
        if spare < least:
            worst, least = marker, spare
    spare_m = float(least) if np.isfinite(least) else 0.0
    return compare(
        "reaction-distance", spare_m, ">=", -0.01, "m", "AASHTO Green Book (2018), section 3.2.2",
        "distance from a tag's last magnet to its event beyond what reaction and deceleration need", worst,
    )  # fmt: skip


def _neighbours(lines: list[PlannedMarker], tags: list[PlannedMarker]) -> PlanFinding:
    """Nearest two magnets of different markers, and nearest two of one tag."""
    magnets: list[tuple[float, float]] = [(marker.lon_deg, marker.lat_deg) for marker in lines]
    owners = list(lines)
    gaps = [np.inf]
    for marker in tags:
        assert isinstance(marker.detail, PlannedTag)
        gaps += [b[0] - a[0] for a, b in pairwise(marker.detail.magnets)]
        magnets += [(lon, lat) for _, lon, lat in marker.detail.magnets]
        owners += [marker] * len(marker.detail.magnets)
    points = ecef_from_wgs84(*(np.array(values) for values in zip(*magnets, strict=True)))
    if len(points) < 2:
        return compare("magnet-spacing", MIN_GAP_M, ">=", MIN_GAP_M, "m", "METRO figure 17a", "there is one magnet")
    distance = np.asarray(scipy.spatial.cKDTree(points).query(points, k=2)[0])
    k = int(distance[:, 1].argmin())
    return compare(
        "magnet-spacing", float(distance[k, 1]), ">=", MIN_GAP_M - 0.001, "m", "METRO figure 17a",
        f"nearest two magnets; a bar reads {HALF_BAR_M:.2f} m to each side", owners[k],
    )  # fmt: skip


def _ecef(markers: list[PlannedMarker]) -> Floats:
    return ecef_from_wgs84(np.array([m.lon_deg for m in markers]), np.array([m.lat_deg for m in markers]))
