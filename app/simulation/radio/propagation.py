"""Mean strength of a marker by two rays, the direct one and one reflected by the road, and a vehicle's antenna pattern.

Both are options of `Radio`; without them strength falls with the logarithm of distance, alike in all directions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter
from app.radio.airtime import check_between
from app.radio.link import MIN_DISTANCE_M, NEAR_DBM, NEAR_M

Floats = npt.NDArray[np.float64]
Complexes = npt.NDArray[np.complex128]

ANTENNA_M = 1.5  # [m] height of the antenna above the road; source: assumed, the roof of a car
_MARKER_M = 0.05  # [m] height of a marker's antenna; source: assumed, of a raised pavement marker
_FREQUENCY_HZ = 915e6  # [Hz] source: middle of the US band of 902 to 928 MHz
_PERMITTIVITY = 5.0  # relative, of asphalt; source: assumed, between dry and wet in tables of ground-penetrating radar
_CONDUCTIVITY_S_M = 0.005  # [S/m] of asphalt; source: assumed, as above
_LIGHT_M_S = 299_792_458.0  # [m/s] source: definition
_VACUUM_F_M = 8.8541878128e-12  # [F/m] permittivity of vacuum; source: CODATA 2018


@dataclass(frozen=True, slots=True)
class TwoRay:
    """Direct and reflected ray between a marker and an antenna, both vertically polarised.

    Attributes
    ----------
    antenna_m, marker_m : float
        Heights above the road, 0.01 to 30. [m]
    frequency_hz : float
        100 MHz to 10 GHz. [Hz]
    permittivity : float
        Relative permittivity of the road, 1 to 100.
    conductivity_s_m : float
        Of the road, 0 to 10. [S/m]
    near_dbm : float
        Level at 50 m along the road: the CERPM paper's by default. [dBm]

    Raises
    ------
    InvalidParameter
        A value is outside its limits.

    Notes
    -----
    Rappaport, Wireless Communications, 2nd edition 2002, sections 4.5 and 4.6, with the exact lengths of both rays.
    Beyond 4 antenna_m marker_m / wavelength, a metre for a marker in the road, strength falls with the fourth power
    of distance. The surface wave, which fills up the field below a tenth of a metre, is left out.
    """

    antenna_m: float = ANTENNA_M
    marker_m: float = _MARKER_M
    frequency_hz: float = _FREQUENCY_HZ
    permittivity: float = _PERMITTIVITY
    conductivity_s_m: float = _CONDUCTIVITY_S_M
    near_dbm: float = NEAR_DBM

    def __post_init__(self) -> None:
        check_between("two_ray.antenna_m", self.antenna_m, 0.01, 30.0, "m")
        check_between("two_ray.marker_m", self.marker_m, 0.01, 30.0, "m")
        check_between("two_ray.frequency_hz", self.frequency_hz, 1e8, 1e10, "Hz")
        check_between("two_ray.permittivity", self.permittivity, 1.0, 100.0, "")
        check_between("two_ray.conductivity_s_m", self.conductivity_s_m, 0.0, 10.0, "S/m")
        check_between("two_ray.near_dbm", self.near_dbm, -150.0, 0.0, "dBm")

    def mean_rssi_dbm(self, ground_m: npt.ArrayLike) -> Floats:
        """Mean level at distances along the road, of any shape; below 1 m as at 1 m. [dBm]"""
        level = self.near_dbm + self._gain_db(np.asarray(ground_m, float)) - self._gain_db(np.array(NEAR_M))
        return np.asarray(level)

    def reflection(self, elevation_rad: npt.ArrayLike) -> Complexes:
        """Fresnel coefficient of the road by the angle of a ray above it, of any shape; vertical polarisation."""
        sine = np.sin(np.asarray(elevation_rad, float))
        loss = self.conductivity_s_m / (2 * math.pi * self.frequency_hz * _VACUUM_F_M)
        permittivity = complex(self.permittivity, -loss)
        root = np.sqrt(permittivity - 1 + sine**2)
        return np.asarray((permittivity * sine - root) / (permittivity * sine + root))

    def _gain_db(self, ground_m: Floats) -> Floats:
        """Power of both rays against that of the direct one at 1 m. [dB]"""
        ground = np.maximum(ground_m, MIN_DISTANCE_M)
        direct = np.hypot(ground, self.antenna_m - self.marker_m)
        reflected = np.hypot(ground, self.antenna_m + self.marker_m)
        coefficient = self.reflection(np.arctan2(self.antenna_m + self.marker_m, ground))
        longer_rad = 2 * math.pi * self.frequency_hz / _LIGHT_M_S * (reflected - direct)
        field = 1 / direct + coefficient * np.exp(-1j * longer_rad) / reflected
        return np.asarray(20 * np.log10(np.abs(field)))


class Notch(NamedTuple):
    """Where an antenna is weak: azimuth from the vehicle's front, left positive [deg], depth [dB], and width [deg]."""

    azimuth_deg: float
    depth_db: float
    width_deg: float


_NOTCHES = (Notch(180.0, 12.0, 35.0), Notch(90.0, 6.0, 15.0), Notch(-90.0, 6.0, 15.0))
"""Behind and to both sides. [deg, dB, deg] Source: assumed; published patterns of antennas on cars differ by some 10 dB
around the vehicle."""


@dataclass(frozen=True, slots=True)
class AntennaPattern:
    """Gain of a vehicle's antenna by azimuth: 0 dB but for Gaussian notches.

    Attributes
    ----------
    notches : tuple of Notch
        Each with a depth of 0 to 60 dB and a width (standard deviation) of 1 to 180 degrees.

    Raises
    ------
    InvalidParameter
        A depth or a width is outside its limits.
    """

    notches: tuple[Notch, ...] = _NOTCHES

    def __post_init__(self) -> None:
        for notch in self.notches:
            if not (0 <= notch.depth_db <= 60 and 1 <= notch.width_deg <= 180 and math.isfinite(notch.azimuth_deg)):
                raise InvalidParameter(
                    f"a notch of {notch.depth_db:g} dB, {notch.width_deg:g} degrees wide",
                    field="antenna_pattern.notches",
                    limit="0 to 60 dB, 1 to 180 degrees",
                )

    def gain_db(self, azimuth_deg: npt.ArrayLike) -> Floats:
        """Gain at azimuths of any shape, from the vehicle's front, left positive. [dB]"""
        azimuth = np.asarray(azimuth_deg, float)
        gain = np.zeros_like(azimuth)
        for notch in self.notches:
            away = (azimuth - notch.azimuth_deg + 180.0) % 360.0 - 180.0
            gain = gain - notch.depth_db * np.exp(-((away / notch.width_deg) ** 2) / 2)
        return gain
