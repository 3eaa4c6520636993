"""The plates that are recommended: one size on the road, 325 mm, and checks that survive dirt."""

from __future__ import annotations

from typing import Final

from app.markers.plate import PlateGeometry, PlateScheme, check_size

RECOMMENDED_SCHEME: Final = PlateScheme.ID
"""Of a plate that the registry knows. Source: docs/decisions/0008-plate-codes.md."""
RECOMMENDED_POSITION_SCHEME: Final = PlateScheme.POSITION_ROBUST
"""Of a plate that must carry its position itself. Source: the same."""
ROBUST_GEOMETRY = PlateGeometry(n=10, unit_mm=27.0, gap_mm=5.0)
"""325 mm, as the paper's 8 x 8 units of 35 mm. Source: the same."""
EXPECTED_GEOMETRIES = (PlateGeometry(8), ROBUST_GEOMETRY, PlateGeometry(12))
"""Of plates that no registry names. Source: the recommended ones, and 12 x 12 units of 35 mm."""


def recommended_geometry(
    scheme: PlateScheme,
    *,
    n: int | None = None,
    unit_mm: float | None = None,
    gap_mm: float = 5.0,
    thickness_mm: float = 20.0,
) -> PlateGeometry:
    """Dimensions of a plate of a scheme, where some of them are chosen.

    Parameters
    ----------
    scheme : PlateScheme
    n : int, optional
        Units along a side; without, 10 for ``position-robust`` and 8 for the others.
    unit_mm : float, optional
        Side of a unit; without, 27 for ``position-robust`` on 10 x 10 and 35 for the others. [mm]
    gap_mm, thickness_mm : float
        [mm]

    Raises
    ------
    InvalidParameter
        A dimension is outside the limits, or the scheme does not exist on this size.
    """
    usual = ROBUST_GEOMETRY if scheme is PlateScheme.POSITION_ROBUST else PlateGeometry()
    n = usual.n if n is None else n
    check_size(n, scheme)
    if unit_mm is None:
        unit_mm = usual.unit_mm if n == usual.n else PlateGeometry().unit_mm
    return PlateGeometry(n, unit_mm, gap_mm, thickness_mm)
