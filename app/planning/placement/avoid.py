"""Places that keep clear of areas: moved along the lane, or left out with the reason."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import shapely

from app.planning.alignment import Alignment, Floats, Lane
from app.planning.placement.site import Site
from app.planning.plan import LeftOut
from app.planning.rules import AvoidRules

_SHIFT_STEP_M = 0.25  # [m] source: chosen by hand, finer than a crew moves a marker to keep clear of a joint
_M_PER_DEG = 111_195.0  # [m/deg] on a sphere of 6371 km; source: the Earth's mean radius
_EDGE_M = 0.5  # [m] from the ends of a lane, where nothing is placed; source: chosen by hand


class AvoidedAreas:
    """The areas of an alignment that the rules name, with their clearance."""

    def __init__(self, alignment: Alignment, rules: AvoidRules) -> None:
        chosen = [area for area in alignment.areas if area.kind in rules.layers]
        self.rules = rules
        self.kinds = [area.kind for area in chosen]
        self._rings = [_with_clearance(area.ring_deg, rules.clearance_m) for area in chosen]
        self._tree = shapely.STRtree(self._rings)

    def __len__(self) -> int:
        return len(self.kinds)

    def find(self, lon_deg: Floats, lat_deg: Floats) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
        """Number of an area that contains each place, -1 for none, shape (N,)."""
        found = np.full(len(lon_deg), -1, dtype=np.intp)
        if self.kinds:
            place, area = self._tree.query(shapely.points(lon_deg, lat_deg), predicate="intersects")
            found[place] = area
        return found

    def keep_clear(self, lane: Lane, family: str, sites: Sequence[Site]) -> tuple[list[Site], list[LeftOut]]:
        """Sites that are clear, moved along the lane where that helps, and what became of the others."""
        if not self.kinds or not sites:
            return list(sites), []
        chainage = np.array([site.chainage_m for site in sites])
        offset = np.array([site.offset_m for site in sites])
        inside = self.find(*lane.position_at(chainage, offset))
        kept, left_out = [], []
        for site, area in zip(sites, inside.tolist(), strict=True):
            if area < 0:
                kept.append(site)
                continue
            moved_m = self._nearest_clear(lane, site)
            name = f"{self.kinds[area]} within {self.rules.clearance_m:g} m"
            if moved_m is None:
                reason = f"{name}, and no clear place within {self.rules.max_shift_m:g} m along the lane"
                left_out.append(LeftOut(family, lane.name, site.chainage_m, reason))
                continue
            kept.append(replace(site, chainage_m=site.chainage_m + moved_m))
            left_out.append(LeftOut(family, lane.name, site.chainage_m, name, moved_m))
        return kept, left_out

    def _nearest_clear(self, lane: Lane, site: Site) -> float | None:
        """Shift along the lane to the nearest clear place; backwards first, where vehicles come from. [m]"""
        shifts = np.array(list(_shifts(self.rules.max_shift_m)))
        chainage = site.chainage_m + shifts
        on_lane = (chainage >= _EDGE_M) & (chainage <= lane.length_m - _EDGE_M)
        shifts, chainage = shifts[on_lane], chainage[on_lane]
        if not len(shifts):
            return None
        clear = np.flatnonzero(self.find(*lane.position_at(chainage, site.offset_m)) < 0)
        return float(shifts[clear[0]]) if len(clear) else None


def _shifts(max_m: float) -> Iterator[float]:
    for k in range(1, int(max_m / _SHIFT_STEP_M) + 1):
        yield -k * _SHIFT_STEP_M
        yield k * _SHIFT_STEP_M


def _with_clearance(ring_deg: Floats, clearance_m: float) -> shapely.Geometry:
    """The area grown by the clearance, in degrees; grown in a local plane, where a degree of longitude is shorter."""
    shrink = math.cos(math.radians(float(ring_deg[:, 1].mean())))
    scale = np.array([_M_PER_DEG * shrink, _M_PER_DEG])
    grown = shapely.buffer(shapely.make_valid(shapely.Polygon(ring_deg * scale)), clearance_m)
    return shapely.transform(grown, lambda points: points / scale)
