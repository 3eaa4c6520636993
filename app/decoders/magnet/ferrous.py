"""Poles of iron among fitted dipoles: iron seldom has one pole, and its poles do not stand in a row."""

from __future__ import annotations

import math
from collections.abc import Sequence

from app.decoders.magnet.fit_window import MAX_MISFIT, MAX_REGION_PRIOR_COST, Dipole

BESIDE_REACH_M = 2.0
"""Distance along the road in which poles stand beside a dipole. [m] Source: length of the covers, plates and pieces of
mesh in `app.simulation.magnetic.clutter`."""
BEYOND_M = 0.05
"""How far beyond the bar's outermost sensors a magnet is read. [m] Source: chosen by hand, a third of METRO's
spacing."""
MIN_NEIGHBOUR_M = 0.4
"""Two magnets stand at least so far apart along the road. [m] Source: `app.markers.magnet.MIN_GAP_M`, METRO figure 17a,
less the error of two places."""
CROWD_M, CROWD_HEIGHTS = 0.8, 3.0
"""Distance in which another pole rejects a dipole: at least, and in heights. [m, 1] Source: by hand, no measurement
kept."""
PAIR_PRIOR_COST, PAIR_MARGIN = 7.0, 6.0
"""Prior cost below which, and margin above which, two dipoles beside each other are both magnets. Source: 770 pairs of
tags beside lines, of which nine in ten have a prior cost below 3.1, and 319 pairs of poles of iron, whose median is 8
(`benchmarks.magnets.drawn_scenes`)."""
CROWD_ACROSS_M = 0.3
"""Distance across the road from which on two poles so near to each other are iron. [m] Source: chosen by hand."""
MIXED_M = 0.9
"""Lines and tags keep at least so far apart. [m] Source: chosen by hand, half of half a lane."""
ROW_ACROSS_M = 0.15
"""Distance across the road in which poles stand in a row. [m] Source:
`app.decoders.magnet.detect_dipoles.TAG_WIDTH_M`."""
ROW_MISFITS, ROW_PRIOR_COSTS = 2.0, 2.5
"""A neighbour in the row rejects a dipole only if it exceeds the limits of a magnet so many times: the next magnet of a
tag may be fitted badly. Source: chosen by hand ("a row of magnets is no iron"), no measurement kept."""
POLE_ENERGY = 40.0
"""Smallest explained energy of a pole that rejects others. [noise variances] Source: as
`app.decoders.magnet.classify.MIN_ENERGY`."""
CROWD_SHARE, POLE_SHARE = 0.1, 0.05
"""And its smallest share of the dipole's own energy, for a pole near by and for one of a row beside it. Source: chosen
by hand: what a model that errs leaves of a strong magnet must not reject it."""
ROW_GAP_M, BESIDE_M = 0.25, 0.3
"""Distance across the road between two rows of poles, and from a dipole to a row beside it. [m] Source: chosen by
hand."""
FERROUS_COUNT = 4
"""Fewest dipoles that can be examined for iron as a whole. Source: as in `app.decoders.magnet.detect_dipoles`."""
FORGET_M = 4.0
"""Dipoles further back than this do not count. [m] Source: chosen by hand, more than `PIECE_M`."""
PIECE_M = 3.0
"""Length of a piece of iron. [m] Source: chosen by hand, plates over trenches are 2 m long and more."""
ABREAST_M = 1.2
"""Distance along the road up to which poles are side by side. [m] Source: chosen by hand."""


def rows_beside(dipole: Dipole, others: Sequence[Dipole], half_width_m: float, reach_m: float = BESIDE_REACH_M) -> int:
    """Rows of poles under the bar that pass a dipole on its left and right; a magnet of the road has one at most."""
    s, y = float(dipole.params[0]), float(dipole.params[1])
    min_energy = max(POLE_ENERGY, POLE_SHARE * dipole.explained)
    beside = sorted(
        float(o.params[1])
        for o in others
        if abs(o.params[0] - s) < reach_m
        and abs(o.params[1] - y) > BESIDE_M
        and abs(o.params[1]) < half_width_m + BEYOND_M
        and o.explained > min_energy
    )
    return sum(i == 0 or b - beside[i - 1] > ROW_GAP_M for i, b in enumerate(beside))


def is_ferrous(dipoles: Sequence[Dipole], half_width_m: float) -> bool:
    """Whether so many dipoles stand beside each other that further ones would only take time."""
    if len(dipoles) < FERROUS_COUNT:
        return False
    return 2 * sum(rows_beside(d, dipoles, half_width_m) > 1 for d in dipoles) >= len(dipoles)


def ferrous_reason(dipole: Dipole, around: Sequence[Dipole], half_width_m: float) -> str | None:
    """Why a dipole is a pole of iron, from those around it; None if it may be a magnet."""
    return _crowd_reason(dipole, around, half_width_m) or _rows_reason(dipole, around, half_width_m)


def _crowd_reason(dipole: Dipole, around: Sequence[Dipole], half_width_m: float) -> str | None:
    """The pole near by that a magnet would not have."""
    reach = max(CROWD_M, CROWD_HEIGHTS * float(dipole.params[2]))
    for other in around:
        if other is dipole or other.explained < max(POLE_ENERGY, CROWD_SHARE * dipole.explained):
            continue
        along, across = abs(dipole.params[:2] - other.params[:2])
        apart = math.hypot(along, across)
        if apart > reach or (apart > MIN_NEIGHBOUR_M and _are_magnets(dipole, other, half_width_m)):
            continue
        mixed = other.kind != dipole.kind and apart < MIXED_M
        beside = along < MIN_NEIGHBOUR_M or (across > CROWD_ACROSS_M and apart < CROWD_M)
        if mixed or beside or _is_unlike_neighbour(other, along, across, half_width_m):
            return f"another pole {100 * apart:.0f} cm away that no magnet has"
    return None


def _are_magnets(one: Dipole, other: Dipole, half_width_m: float) -> bool:
    """Whether both poles are surely magnets under the bar: a line may pass a tag half a metre beside it."""
    return all(
        d.misfit < MAX_MISFIT
        and d.prior_cost < PAIR_PRIOR_COST
        and d.margin > PAIR_MARGIN
        and abs(d.params[1]) < half_width_m + BEYOND_M
        for d in (one, other)
    )


def _is_unlike_neighbour(other: Dipole, along_m: float, across_m: float, half_width_m: float) -> bool:
    """Whether a pole near by is unlike a magnet; one in the dipole's row may be more so."""
    under_bar = abs(other.params[1]) < half_width_m + BEYOND_M
    if across_m < ROW_ACROSS_M and along_m > MIN_NEIGHBOUR_M and under_bar:
        return other.misfit > ROW_MISFITS * MAX_MISFIT or other.prior_cost > ROW_PRIOR_COSTS * MAX_REGION_PRIOR_COST
    return other.unlike_magnet


def _rows_reason(dipole: Dipole, around: Sequence[Dipole], half_width_m: float) -> str | None:
    """The poles side by side that show a long piece of iron."""
    for other in around:
        apart = abs(float(other.params[0] - dipole.params[0]))
        if apart < PIECE_M and rows_beside(other, around, half_width_m, ABREAST_M) > 1:
            return f"poles side by side {100 * apart:.0f} cm along the road"
    rows = rows_beside(dipole, around, half_width_m)
    if rows > 1:
        return f"{rows} rows of poles beside it, within {100 * BESIDE_REACH_M:.0f} cm of road; lines and tags have 1"
    return None
