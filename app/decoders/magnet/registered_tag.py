"""What matching and localization need to know of a registered information tag."""

from __future__ import annotations

from dataclasses import dataclass

from app.markers.magnet import InformationTag
from app.markers.magnet_codebook import Meaning


@dataclass(frozen=True, slots=True)
class RegisteredTag:
    """What the registry knows of an information tag.

    Attributes
    ----------
    marker_id, status : str
    tag : InformationTag
    lon_deg, lat_deg : float
        Of its first magnet, WGS 84 / ITRF. [deg]
    height_m : float or None
    bearing_deg : float
        Of the tag in the east, north, up frame at `lane_lon_deg`, `lane_lat_deg`; clockwise from north. [deg]
    lane_lon_deg, lane_lat_deg : float
        Where its lane begins. [deg]
    horizontal_rmse_m : float or None
        Of both axes together; None where it is not stated. [m]
    grade : str
        A `LocalizationGrade`.
    localization_warnings : tuple of str
        What makes its position unfit for localization.
    meaning : Meaning or None
    """

    marker_id: str
    status: str
    tag: InformationTag
    lon_deg: float
    lat_deg: float
    height_m: float | None
    bearing_deg: float
    lane_lon_deg: float
    lane_lat_deg: float
    horizontal_rmse_m: float | None
    grade: str
    localization_warnings: tuple[str, ...] = ()
    meaning: Meaning | None = None
