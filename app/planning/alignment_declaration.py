"""What is declared of a file with a road, as for surveys: CRS, realization, epoch, heights, units, or an origin."""

from __future__ import annotations

import math
from dataclasses import dataclass

from app.errors import InvalidParameter
from app.formats.surveys.declaration import METRES
from app.geodesy import check_lon_lat

MAX_EPOCH = (1900.0, 2100.0)
"""Plausible coordinate epochs. [decimal year] Source: chosen by hand."""


@dataclass(frozen=True, slots=True)
class AlignmentDeclaration:
    """What is declared of a file with a road.

    Attributes
    ----------
    crs : str, optional
        CRS of the coordinates; one that contradicts the file is an error.
    realization : str, optional
        Frame, e.g. ``ITRF2014``.
    epoch : float, optional
        Coordinate epoch. [decimal year]
    vertical_datum : str, optional
        ``ellipsoid``, or the datum of the heights, e.g. ``EPSG:5703``; needed where a file with a CRS has heights.
    unit, height_unit : str, optional
        ``m``, ``ft-us`` or ``ft-intl``; those of the file or of its CRS without.
    ignore_heights : bool
        Leave heights out.
    origin : tuple of two floats, optional
        Longitude and latitude of the origin of local coordinates. [deg]
    bearing_deg : float
        Direction of the local y axis, clockwise from true north; only with `origin`. [deg]

    Raises
    ------
    InvalidParameter
        A value is not allowed, or both a CRS and an origin are declared.
    """

    crs: str | None = None
    realization: str | None = None
    epoch: float | None = None
    vertical_datum: str | None = None
    unit: str | None = None
    height_unit: str | None = None
    ignore_heights: bool = False
    origin: tuple[float, float] | None = None
    bearing_deg: float = 0.0

    def __post_init__(self) -> None:
        for field, value in (("unit", self.unit), ("height_unit", self.height_unit)):
            if value not in (None, *METRES):
                raise InvalidParameter(
                    f"there is no unit {str(value)[:40]!r}",
                    field=field,
                    limit=", ".join(METRES),
                    cure="declare another",
                )
        if self.epoch is not None and not MAX_EPOCH[0] <= self.epoch <= MAX_EPOCH[1]:
            raise InvalidParameter(
                f"the epoch is {self.epoch}",
                field="epoch",
                limit=f"{MAX_EPOCH[0]:g} to {MAX_EPOCH[1]:g}",
                cure="declare the epoch as a decimal year, e.g. 2010.0",
            )
        if not math.isfinite(self.bearing_deg) or abs(self.bearing_deg) > 360:
            raise InvalidParameter(
                f"the bearing is {self.bearing_deg}",
                field="bearing_deg",
                limit="-360 to 360 deg",
                cure="declare another",
            )
        if self.origin is not None:
            check_lon_lat(*self.origin, field="origin")
        if self.origin is not None and self.crs is not None:
            raise InvalidParameter(
                "both a CRS and an origin are declared",
                field="origin",
                limit="one of the two",
                cure="declare crs for coordinates on Earth, origin for local ones",
            )
        if self.origin is None and self.bearing_deg:
            raise InvalidParameter(
                "a bearing is declared without an origin",
                field="bearing_deg",
                limit="only with origin",
                cure="declare the origin that the road is turned about",
            )
