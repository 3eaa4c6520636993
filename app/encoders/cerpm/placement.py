"""Where a lane's markers go: pairs across from each other on its boundaries, closer in bends."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.encoders.cerpm.cross_sections import CrossSections, cut_lane
from app.errors import InvalidParameter
from app.markers.cerpm import LaneSide

Floats = npt.NDArray[np.float64]

SPACING_M = 12.192
"""40 feet: the cycle of a broken line, N, and the paper's spacing. [m]"""
MIN_SPACING_M = 1.0
SAGITTA_M = 0.15
"""How far a chord between neighbours may leave the lane's arc before they stand closer. [m]"""
MAX_PER_SIDE = 100_000
_BEND_REACH_M = 6.0


@dataclass(frozen=True, slots=True)
class MarkerPlace:
    """Where one marker goes.

    Attributes
    ----------
    side : LaneSide
        LEFT or RIGHT.
    chainage_m : float
        Along the lane's centre line; the same for both of a pair. [m]
    point_m : tuple of float
        East and north in the frame of the boundaries, on the boundary. [m]
    heading_deg : float
        Direction of travel there, clockwise from north of the frame. [deg]
    """

    side: LaneSide
    chainage_m: float
    point_m: tuple[float, float]
    heading_deg: float


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
        Half the spacing where the chord between neighbours would leave the arc by more than 0.15 m: at 40 ft, where the
        radius is below 124 m.
    markers_per_side : int, optional
        So many pairs at even distances instead, as the paper's ten; spacing and bends are then not looked at.

    Returns
    -------
    tuple of MarkerPlace
        By chainage, left before right. The first pair is where both boundaries have begun, the last before one ends.

    Raises
    ------
    InvalidParameter
        The boundaries are no lane (see `cut_lane`), the spacing is below 1 m or longer than the lane, or a side would
        have fewer than two markers or more than 100,000.

    Notes
    -----
    The spacing follows the US practice for raised markers: N = 40 ft, the cycle of a broken line; along edge lines and
    in sharp curves half of what the straight has (FHWA, Roadway Delineation Practices Handbook; MUTCD 3B.11 to 3B.14).
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
    if not 2 <= count <= MAX_PER_SIDE or length_m / (count - 1) < MIN_SPACING_M:
        raise InvalidParameter(
            f"{count} markers a side on {length_m:.1f} m",
            field="markers_per_side",
            limit=f"2 to {MAX_PER_SIDE}, at least {MIN_SPACING_M:g} m apart",
        )
    return np.linspace(0.0, length_m, count)


def _spaced(lane: CrossSections, spacing_m: float, closer_in_bends: bool) -> Floats:
    """Chainages so that the density, integrated along the lane, rises by one from pair to pair."""
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
    """Size of the turn over a stretch around each cut, a metre: a kink alone is not a bend. [1/m]"""
    low, high = np.maximum(lane.chainage_m - reach_m, 0), np.minimum(lane.chainage_m + reach_m, lane.length_m)
    turn = np.interp(high, lane.chainage_m, lane.yaw_rad) - np.interp(low, lane.chainage_m, lane.yaw_rad)
    return np.asarray(np.abs(turn) / np.maximum(high - low, 1e-9))
