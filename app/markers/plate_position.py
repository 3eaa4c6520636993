"""Full coordinates of a position plate, whose code holds the decimals only, and the schemes that digits may have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from app.geodesy import check_lon_lat
from app.markers.plate import PlateCode, PlateScheme, is_codeword


@dataclass(frozen=True, slots=True)
class ResolvedPosition:
    """A position plate's full coordinates.

    Attributes
    ----------
    lon_deg, lat_deg : float
        The candidate nearest to the coarse position. [deg]
    distance_deg : float
        How far it is from the coarse position, per axis at most. [deg]
    next_distance_deg : float
        How far the second candidate is on the axis where the two are closest. [deg]
    """

    lon_deg: float
    lat_deg: float
    distance_deg: float
    next_distance_deg: float


def resolve_position(code: PlateCode, coarse_lon_deg: float, coarse_lat_deg: float) -> ResolvedPosition:
    """Complete a position plate's decimals with the integer degrees and sign from a coarse position.

    Notes
    -----
    The decimals are those of the magnitude, and rounding may have carried into the integer, so the neighbouring
    integers of both signs are tried and the nearest is taken; longitude wraps at the antimeridian.
    """
    check_lon_lat(coarse_lon_deg, coarse_lat_deg, field="coarse_position")
    lon_decimals, lat_decimals = code.decimals
    lon, lon_d, lon_next = _nearest_degree(lon_decimals, coarse_lon_deg, 180.0, wraps=True)
    lat, lat_d, lat_next = _nearest_degree(lat_decimals, coarse_lat_deg, 90.0, wraps=False)
    return ResolvedPosition(lon, lat, max(lon_d, lat_d), min(lon_next, lat_next))


def _nearest_degree(decimals: str, coarse_deg: float, bound: float, *, wraps: bool) -> tuple[float, float, float]:
    whole = int(abs(coarse_deg))
    candidates: dict[float, float] = {}
    for integer in range(max(whole - 1, 0), whole + 2):
        for sign in (1.0, -1.0):
            value = sign * float(f"{integer}.{decimals}")
            if abs(value) > bound:
                continue
            if wraps and value == -bound:
                value = bound
            difference = abs(value - coarse_deg)
            candidates[value + 0.0] = min(difference, 360.0 - difference) if wraps else difference
    ranked = sorted(candidates.items(), key=lambda item: item[1])
    return ranked[0][0], ranked[0][1], ranked[1][1] if len(ranked) > 1 else float("inf")


def decimal_codes(symbols: Sequence[int], n: int = 8) -> tuple[PlateCode, ...]:
    """Codes of the schemes without Reed-Solomon checks that show these symbols, the one with fewest check digits first.

    The plate does not say which it is: one check digit holds by accident for one plain position in ten, two for one in
    a hundred.
    """
    kinds = ((PlateScheme.POSITION, 1), (PlateScheme.POSITION_CHECK, 1), (PlateScheme.POSITION_CHECK, 2))
    return tuple(
        PlateCode.from_symbols(symbols, scheme, n, checks)
        for scheme, checks in kinds
        if is_codeword(symbols, scheme, n, checks)
    )
