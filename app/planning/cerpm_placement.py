"""Places of a lane's markers: pairs across from each other on its boundaries, closer in bends."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter
from app.lanes.cross_sections import CrossSections, cut_lane
from app.lanes.types import MarkerPlace
from app.markers.cerpm import LaneSide
from app.values import Floats

SPACING_M = 12.192  # [m] 40 ft; source: the cycle N of a broken line, MUTCD 2009 section 3B.11, and the CERPM paper
MIN_SPACING_M = 1.0  # [m]
SAGITTA_M = 0.15  # [m] of a chord between neighbours, above which they are closer
MAX_PER_SIDE = 100_000  # 1,200 km at 40 ft
_BEND_REACH_M = 6.0  # [m] before and after a bend; source: half the paper's spacing


def place_markers(
    left_m: npt.ArrayLike,
    right_m: npt.ArrayLike,
    *,
    spacing_m: float = SPACING_M,
    closer_in_bends: bool = True,
    markers_per_side: int | None = None,
) -> tuple[MarkerPlace, ...]:
    """Places for a lane's markers, in pairs from its beginning to its end.

    Parameters
    ----------
    left_m, right_m : array_like, shape (L, 2) and (R, 2)
        East and north of the boundaries' vertices in direction of travel, in one local frame. [m]
    spacing_m : float
        Greatest distance between pairs, along the centre line. [m]
    closer_in_bends : bool
        Half the spacing where the chord between neighbours would leave the arc by more than 0.15 m: at 40 ft, for
        radii below 124 m.
    markers_per_side : int, optional
        Number of pairs at even distances instead, ten in the paper; spacing and bends are then not used.

    Returns
    -------
    tuple of MarkerPlace
        By chainage, left before right. The first pair is where both boundaries have begun, the last before one ends.

    Raises
    ------
    InvalidParameter
        The boundaries are not a lane (see `cut_lane`), the spacing is below 1 m or longer than the lane, or a side
        would have fewer than two markers or more than 100,000.

    Notes
    -----
    The spacing follows the US practice for raised markers: N = 40 ft, the cycle of a broken line, and in sharp curves
    half of what the straight has (MUTCD 2009, sections 3B.11 to 3B.14, 3B.14 to 3B.17 in the edition of 2023).
    Only plans of whole roads (`app.planning.placement.place`) are closer on transitions too.
    Pairs stand across from each other as in the paper's section 3.2 (Kadav et al., Sensors 2024, 24, 2327).
    """
    lane = cut_lane(left_m, right_m)
    if markers_per_side is not None:
        at = _even(lane.length_m, markers_per_side)
    else:
        at = _spaced(lane, spacing_m, closer_in_bends)
    places = []
    for chainage in at:
        yaw = float(np.interp(chainage, lane.chainage_m, lane.yaw_rad))
        heading_deg = math.degrees(math.pi / 2 - yaw) % 360.0
        for side, line in ((LaneSide.LEFT, lane.left_m), (LaneSide.RIGHT, lane.right_m)):
            east, north = (float(np.interp(chainage, lane.chainage_m, line[:, k])) for k in range(2))
            places.append(MarkerPlace(side, float(chainage), (east, north), heading_deg))
    return tuple(places)


def _even(length_m: float, count: int) -> Floats:
    """Chainages at even distances."""
    if not 2 <= count <= MAX_PER_SIDE or length_m / (count - 1) < MIN_SPACING_M:
        raise InvalidParameter(
            f"{count} markers a side on {length_m:.1f} m",
            field="markers_per_side",
            limit=f"2 to {MAX_PER_SIDE}, at least {MIN_SPACING_M:g} m apart",
        )
    return np.linspace(0.0, length_m, count)


def _spaced(lane: CrossSections, spacing_m: float, closer_in_bends: bool) -> Floats:
    """Chainages between which the integral of the density along the lane is one."""
    if not (math.isfinite(spacing_m) and MIN_SPACING_M <= spacing_m <= lane.length_m):
        raise InvalidParameter(
            f"a spacing of {spacing_m:g} m on a lane of {lane.length_m:.1f} m",
            field="spacing_m",
            limit=f"{MIN_SPACING_M:g} m to the lane's length",
        )
    step = lane.chainage_m[1]
    density = np.full(len(lane.chainage_m) - 1, 1.0 / spacing_m)
    if closer_in_bends:
        bent = _mean_curvature(lane, spacing_m / 2) * spacing_m**2 / 8 > SAGITTA_M
        reach = max(round(_BEND_REACH_M / step), 1)  # the pair before a bend belongs to it
        near = np.convolve(bent.astype(float), np.ones(2 * reach + 1), mode="same") > 0.5
        density[near[1:] | near[:-1]] *= 2.0
    count = np.concatenate([[0.0], np.cumsum(density) * step])
    pairs = max(math.ceil(count[-1] - 1e-6), 1) + 1  # stretched evenly, so that the last pair is at the lane's end
    if pairs > MAX_PER_SIDE:
        raise InvalidParameter(
            f"{pairs} markers a side", field="spacing_m", limit=f"at most {MAX_PER_SIDE}", cure="give the lane in parts"
        )
    return np.interp(np.linspace(0.0, count[-1], pairs), count, lane.chainage_m)


def _mean_curvature(lane: CrossSections, reach_m: float) -> Floats:
    """Mean curvature over a stretch around each cut, so that a single kink is not a bend. [1/m]"""
    low, high = np.maximum(lane.chainage_m - reach_m, 0), np.minimum(lane.chainage_m + reach_m, lane.length_m)
    turn = np.interp(high, lane.chainage_m, lane.yaw_rad) - np.interp(low, lane.chainage_m, lane.yaw_rad)
    return np.asarray(np.abs(turn) / np.maximum(high - low, 1e-9))
