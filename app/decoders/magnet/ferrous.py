"""Poles of iron among fitted dipoles: iron seldom has one pole, and its poles do not stand in a row."""

from __future__ import annotations

from collections.abc import Sequence

from app.decoders.magnet.fit_window import Dipole

BESIDE_REACH_M = 2.0
"""Distance along the road in which poles stand beside a dipole. [m] Source: length of the covers, plates and pieces of
mesh in `app.simulation.magnetic.clutter`."""
BEYOND_M = 0.05
"""How far beyond the bar's outermost sensors a magnet is read. [m] Source: chosen by hand, a third of METRO's
spacing."""
POLE_ENERGY, POLE_SHARE = 40.0, 0.05
"""Smallest explained energy of a pole, in noise variances and over that of the dipole beside it. Source: chosen by hand
above the detection threshold of 32: noise alone exceeds it with probability 2.5e-10 in a trial (chi-squared with one
degree of freedom); and what a model that errs leaves of a strong magnet must not count."""
ROW_GAP_M, BESIDE_M = 0.25, 0.3
"""Distance across the road between two rows of poles, and from a dipole to a row beside it. [m] Source: chosen by
hand."""
FERROUS_COUNT = 4
"""Fewest dipoles that can be examined for iron as a whole. Source: as in `app.decoders.magnet.detect_dipoles`."""
FORGET_M = 4.0
"""Dipoles further back than this do not count. [m] Source: chosen by hand, more than the length of a piece of iron."""


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
