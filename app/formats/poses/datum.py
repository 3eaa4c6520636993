"""The datum of a track: positions must be in WGS 84 / ITRF."""

from __future__ import annotations

import re

from app.errors import InvalidParameter, ReferenceSystemError
from app.geodesy import place_position, reference_system
from app.geodesy.systems import is_global

_WGS84_NAME = re.compile(r"(WGS[ _-]?(19)?84|ITRF|IGS|W84)", re.IGNORECASE)
_EPSG_NUMBER = re.compile(r"\d{4,6}\Z", re.ASCII)
_CURE_DATUM = "transform the track to WGS 84 (EPSG:4326) with a stated accuracy before it is sent"


def check_datum(crs: str, lon_deg: float = 0.0, lat_deg: float = 0.0) -> None:
    """Refuse a coordinate reference system that is not WGS 84 / ITRF.

    Raises
    ------
    ReferenceSystemError
    """
    text = crs.strip()
    if not text or _WGS84_NAME.match(text):
        return
    name = f"EPSG:{text}" if _EPSG_NUMBER.match(text) else text
    with_cure = f"positions are in {text[:60]!r}, which is not WGS 84 / ITRF"
    try:
        place_position(lon_deg, lat_deg, crs=name)
        known = is_global(reference_system(name))
    except InvalidParameter as error:
        raise ReferenceSystemError(with_cure, field="poses.crs", limit="WGS 84", cure=_CURE_DATUM) from error
    if not known:
        raise ReferenceSystemError(with_cure, field="poses.crs", limit="WGS 84", cure=_CURE_DATUM)
