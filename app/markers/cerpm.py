"""The message of a chip-enabled raised pavement marker (CERPM), and the layout of its 24 bytes.

Source: CERPM paper (Kadav et al., Sensors 2024, 24, 2327), section 2.2: geospatial information, speed limit and number,
sent by LoRa. Bytes, tag and sequence are Waymark's: the paper names authentication as future work.

==========  =====  =========================================================================================
bytes       field  form (integers are big endian)
==========  =====  =========================================================================================
0           head   version in bits 7-4 (1), side in bits 3-2, unit of the speed limit in bit 1, bit 0 is zero
1-4         number of the marker within its agency, 1 to 2^32 - 1
5-8         longitude, signed, 1e-7 degrees
9-12        latitude, signed, 1e-7 degrees
13-14       height above the ellipsoid, 0.1 m above -1000 m; 65535 where it is not known
15          speed limit in its unit; 0 where none is posted
16-19       sequence, 0 to 2^32 - 1: one more for each transmission, kept through a restart
20-23       the first four bytes of AES-CMAC (RFC 4493) over bytes 0-19 under the marker's own key
==========  =====  =========================================================================================
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum, StrEnum

from app.errors import InvalidParameter
from app.geodesy import check_lon_lat

VERSION = 1
MESSAGE_BYTES = 24  # [bytes] source: the longest packet of SF10 at 125 kHz within the 400 ms of 47 CFR 15.247
TAG_BYTES = 4  # [bytes] source: as long as LoRaWAN's integrity code (docs/decisions/0015-cerpm-messages.md)
BODY_BYTES = MESSAGE_BYTES - TAG_BYTES
KEY_BYTES = 16  # [bytes] source: AES-128
MAX_NUMBER = 2**32 - 1  # source: four bytes
MAX_SEQUENCE = 2**32 - 1  # source: four bytes
MAX_SPEED_LIMIT = 255
DEGREE_STEP = 1e-7  # [deg] at most 1.1 cm on the ground; source: the largest step of 32 bits within a survey's 0.02 m
HEIGHT_STEP_M = 0.1  # [m] source: docs/cerpm-message.md
HEIGHT_M = (-1000.0, 5553.4)  # [m] lowest and highest; source: 65,534 steps of 0.1 m
NO_HEIGHT = 65535  # source: the highest value of 16 bits


class LaneSide(IntEnum):
    """Which boundary of the lane a marker stands on, seen in the direction of travel."""

    UNKNOWN = 0
    LEFT = 1
    RIGHT = 2


class SpeedUnit(StrEnum):
    """Unit of a posted speed limit."""

    KM_H = "km/h"
    MPH = "mph"

    @property
    def km_h(self) -> float:
        """Length of the unit. [km/h]"""
        return 1.0 if self is SpeedUnit.KM_H else 1.609344


@dataclass(frozen=True, slots=True)
class SpeedLimit:
    """A speed limit as it is posted."""

    value: int
    unit: SpeedUnit = SpeedUnit.KM_H

    def __post_init__(self) -> None:
        if not 1 <= self.value <= MAX_SPEED_LIMIT or self.value != int(self.value):
            raise InvalidParameter(
                f"a speed limit of {self.value} {self.unit} does not fit one byte",
                field="speed_limit.value",
                limit=f"a whole number from 1 to {MAX_SPEED_LIMIT}",
                cure="send it as it is posted, in km/h or mph; leave it out where none is posted",
            )

    @property
    def km_h(self) -> float:
        """[km/h]"""
        return self.value * self.unit.km_h


@dataclass(frozen=True, slots=True)
class CerpmMessage:
    """Contents of a message.

    Attributes
    ----------
    number : int
        Of the marker within its agency.
    lon_deg, lat_deg : float
        WGS 84 / ITRF. [deg]
    height_m : float or None
        Above the ellipsoid. [m]
    side : LaneSide
    speed_limit : SpeedLimit or None
    sequence : int
        Number of the transmission.

    Raises
    ------
    InvalidParameter
        A value does not fit its field.
    """

    number: int
    lon_deg: float
    lat_deg: float
    height_m: float | None = None
    side: LaneSide = LaneSide.UNKNOWN
    speed_limit: SpeedLimit | None = None
    sequence: int = 0

    def __post_init__(self) -> None:
        check_lon_lat(self.lon_deg, self.lat_deg)
        for name, value, low, high in (
            ("number", self.number, 1, MAX_NUMBER),
            ("sequence", self.sequence, 0, MAX_SEQUENCE),
        ):
            if not low <= value <= high or value != int(value):
                raise InvalidParameter(
                    f"{name} is {value}",
                    field=name,
                    limit=f"a whole number from {low} to {high}",
                    cure="numbers and sequences are 32 bits; a marker at the end of its sequence needs a new number",
                )
        if self.height_m is not None and not (
            math.isfinite(self.height_m) and HEIGHT_M[0] <= self.height_m <= HEIGHT_M[1]
        ):
            raise InvalidParameter(
                f"height_m is {self.height_m}",
                field="position.height_m",
                limit=f"{HEIGHT_M[0]:g} to {HEIGHT_M[1]:g} m above the ellipsoid",
                cure="leave the height out where it does not fit",
            )
