"""How iron differs from magnets: it seldom has one pole, and its poles stand in no row."""

from __future__ import annotations

import math
from collections.abc import Sequence

from app.decoders.magnet.window import LIMIT_MISFIT, LIMIT_PRIOR, Dipole

_REACH_M = 2.0
"""Along the road; covers, plates and mesh are so long."""
BEYOND_M = 0.05
"""How far beyond the bar's outermost sensors a magnet is read."""
_NEAREST_M = 0.4
_CROWD_M = 0.8
_MIXED_M = 0.9
"""Lines and tags keep apart by more than this. [m]"""
_POLE_ENERGY = 40.0
_CROWD_SHARE, _POLE_SHARE = 0.1, 0.05
_ROW_M, _BESIDE_M = 0.25, 0.3
_ENOUGH = 4
FORGET_M, _PIECE_M, _ABREAST_M = 4.0, 3.0, 1.2
"""Length of a piece of iron (plates over trenches), and distance along the road up to which poles are abreast;
poles further back than the first don't count."""


def rows_beside(dipole: Dipole, others: Sequence[Dipole], half_width_m: float, reach_m: float = _REACH_M) -> int:
    """Rows of poles under the bar that pass a dipole on its left and right; of the road's magnets at most one does."""
    s, y = float(dipole.params[0]), float(dipole.params[1])
    least = max(_POLE_ENERGY, _POLE_SHARE * dipole.explained)
    beside = sorted(
        float(o.params[1])
        for o in others
        if abs(o.params[0] - s) < reach_m
        and abs(o.params[1] - y) > _BESIDE_M
        and abs(o.params[1]) < half_width_m + BEYOND_M
        and o.explained > least
    )
    return sum(i == 0 or b - beside[i - 1] > _ROW_M for i, b in enumerate(beside))


def is_iron(dipoles: Sequence[Dipole], half_width_m: float) -> bool:
    """Whether so many dipoles stand beside each other that further ones would only take time."""
    if len(dipoles) < _ENOUGH:
        return False
    return 2 * sum(rows_beside(d, dipoles, half_width_m) > 1 for d in dipoles) >= len(dipoles)


def why_iron(dipole: Dipole, around: Sequence[Dipole], half_width_m: float) -> str | None:
    """Why a dipole is a pole of iron, from those around it; None if it may be a magnet."""
    return _why_crowded(dipole, around, half_width_m) or _why_long(dipole, around, half_width_m)


def _why_crowded(dipole: Dipole, around: Sequence[Dipole], half_width_m: float) -> str | None:
    reach = max(_CROWD_M, 3 * float(dipole.params[2]))
    for other in around:
        if other is dipole or other.explained < max(_POLE_ENERGY, _CROWD_SHARE * dipole.explained):
            continue
        along, across = abs(dipole.params[:2] - other.params[:2])
        apart = math.hypot(along, across)
        if apart > reach:
            continue
        mixed = other.kind != dipole.kind and apart < _MIXED_M
        in_row = across < 0.15 and along > _NEAREST_M and abs(other.params[1]) < half_width_m + BEYOND_M
        unlike = other.misfit > 2 * LIMIT_MISFIT or other.prior_cost > 2.5 * LIMIT_PRIOR if in_row else other.unlike
        if unlike or mixed or along < _NEAREST_M or (across > 0.3 and apart < _CROWD_M):
            return f"another pole {100 * apart:.0f} cm away that no magnet has"
    return None


def _why_long(dipole: Dipole, around: Sequence[Dipole], half_width_m: float) -> str | None:
    for other in around:
        apart = abs(float(other.params[0] - dipole.params[0]))
        if apart < _PIECE_M and rows_beside(other, around, half_width_m, _ABREAST_M) > 1:
            return f"poles side by side {100 * apart:.0f} cm along the road"
    rows = rows_beside(dipole, around, half_width_m)
    return (
        f"{rows} rows of poles beside it, within {100 * _REACH_M:.0f} cm of road; lines and tags have 1"
        if rows > 1
        else None
    )
