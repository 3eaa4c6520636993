"""The coordinate reference systems that features can be asked for in, with the axes in the authority's order."""

from __future__ import annotations

import math
from enum import StrEnum

_RADIUS_M = 6_378_137.0
_MERCATOR_POLE_DEG = 89.999999


class FeatureCrs(StrEnum):
    """A CRS by its URI. All three are WGS 84, so that going from one to another loses nothing."""

    CRS84 = "http://www.opengis.net/def/crs/OGC/1.3/CRS84"
    CRS84H = "http://www.opengis.net/def/crs/OGC/0/CRS84h"
    WGS84 = "http://www.opengis.net/def/crs/EPSG/0/4326"
    WEB_MERCATOR = "http://www.opengis.net/def/crs/EPSG/0/3857"

    @property
    def is_storage(self) -> bool:
        """Whether places are written as longitude and latitude."""
        return self in (FeatureCrs.CRS84, FeatureCrs.CRS84H)

    def from_lon_lat(self, lon_deg: float, lat_deg: float) -> tuple[float, float]:
        """First and second coordinate of a place."""
        if self is FeatureCrs.WGS84:
            return lat_deg, lon_deg
        if self is FeatureCrs.WEB_MERCATOR:
            lat_deg = min(max(lat_deg, -_MERCATOR_POLE_DEG), _MERCATOR_POLE_DEG)
            north = math.asinh(math.tan(math.radians(lat_deg)))
            return _RADIUS_M * math.radians(lon_deg), _RADIUS_M * north
        return lon_deg, lat_deg

    def to_lon_lat(self, first: float, second: float) -> tuple[float, float]:
        """Longitude and latitude of a place. [deg]"""
        if self is FeatureCrs.WGS84:
            return second, first
        if self is FeatureCrs.WEB_MERCATOR:
            north = min(max(second / _RADIUS_M, -20.0), 20.0)
            return math.degrees(first / _RADIUS_M), math.degrees(math.atan(math.sinh(north)))
        return first, second


STORAGE_CRS = FeatureCrs.CRS84
