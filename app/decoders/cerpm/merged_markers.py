"""Input and result of merging verified packets: registered markers, one position a marker, and disagreements."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter
from app.markers.cerpm import LaneSide

Floats = npt.NDArray[np.float64]


class Disagreement(StrEnum):
    """How the messages of a marker disagree with each other, the registry or the track."""

    MOVED = "moved"
    TWO_PLACES = "two-places"
    REPROGRAMMED = "reprogrammed"
    OUT_OF_REACH = "out-of-reach"
    SWAPPED = "swapped"
    DATUM_SHIFT = "datum-shift"
    OTHER_SIDE = "other-side"


USED_ANYWAY = frozenset((Disagreement.REPROGRAMMED, Disagreement.OTHER_SIDE))
"""These are reported, and the marker is used."""


@dataclass(frozen=True, slots=True)
class RegisteredMarker:
    """A marker as it is registered.

    Attributes
    ----------
    lon_deg, lat_deg : float
        WGS 84 / ITRF. [deg]
    height_m : float or None
        Above the ellipsoid. [m]
    side : LaneSide
    speed_limit_km_h : float
        NaN where none is posted. [km/h]
    sigma_m : float
        Standard deviation of its survey on each axis; NaN if unknown. [m]
    """

    lon_deg: float
    lat_deg: float
    height_m: float | None = None
    side: LaneSide = LaneSide.UNKNOWN
    speed_limit_km_h: float = math.nan
    sigma_m: float = math.nan


@dataclass(frozen=True, slots=True)
class Finding:
    """A disagreement about one marker.

    Attributes
    ----------
    number : int
    kind : Disagreement
    reason : str
    distance_m : float
        Between the positions that disagree; NaN where there are none. [m]
    """

    number: int
    kind: Disagreement
    reason: str
    distance_m: float = math.nan


@dataclass(frozen=True, slots=True)
class MergeRules:
    """Limits of a disagreement.

    Attributes
    ----------
    apart_m : float
        Positions closer than this to the registered one, or to each other, agree. [m]
    sigmas : float
        They also agree within this many standard deviations of the survey.
    reach_m : float
        No marker is received from further away. [m]
    accept_clear : bool
        Use packets in clear of markers without an authentic packet.
    """

    apart_m: float = 0.5  # [m] source: by hand; a marker that is moved by less still marks the boundary
    sigmas: float = 3.0  # source: three sigma, one false alarm in 370
    reach_m: float = 2000.0  # [m] source: by hand; six times the 340 m of the CERPM paper, section 4.1
    accept_clear: bool = False

    def __post_init__(self) -> None:
        for name in ("apart_m", "sigmas", "reach_m"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InvalidParameter(f"{name} is {getattr(self, name)}", field=name, limit="above 0, finite")


@dataclass(frozen=True, slots=True, eq=False)
class MergedMarkers:
    """One row for each marker that may be used, and the findings on all.

    Attributes
    ----------
    number : ndarray of int, shape (K,)
    lon_deg, lat_deg : ndarray, shape (K,)
        Registered position, or that of the newest authentic message. [deg]
    side : ndarray of int, shape (K,)
        `LaneSide` values.
    sigma_m, speed_limit_km_h : ndarray, shape (K,)
        [m, km/h]
    packets : ndarray of int, shape (K,)
        Accepted ones.
    registered : ndarray of bool, shape (K,)
    left_out : dict of int to str
        Markers without a row, with the reason.
    findings : list of Finding
    shift_m : (float, float) or None
        Common shift of sent against registered positions, east and north, from another datum. [m]
    warnings : list of str
    """

    number: npt.NDArray[np.int64]
    lon_deg: Floats
    lat_deg: Floats
    side: npt.NDArray[np.int64]
    sigma_m: Floats
    speed_limit_km_h: Floats
    packets: npt.NDArray[np.int64]
    registered: npt.NDArray[np.bool_]
    left_out: dict[int, str]
    findings: list[Finding]
    shift_m: tuple[float, float] | None
    warnings: list[str]
