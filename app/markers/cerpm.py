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
from typing import Annotated

from cryptography.hazmat.primitives.ciphers.algorithms import AES
from cryptography.hazmat.primitives.cmac import CMAC
from cryptography.hazmat.primitives.kdf.kbkdf import KBKDFCMAC, CounterLocation, Mode
from pydantic import Field, with_config

from app.errors import InvalidParameter
from app.geodesy import check_lon_lat
from app.inputs import INPUT

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
    """Which boundary of the lane a marker is on, seen in the direction of travel."""

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


@with_config(INPUT)
@dataclass(frozen=True, slots=True)
class SpeedLimit:
    """A speed limit as it is posted."""

    value: Annotated[int, Field(strict=True, ge=1, le=MAX_SPEED_LIMIT)]
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

    Raises
    ------
    InvalidParameter
        A value does not fit its field.
    """

    number: int  # of the marker within its agency
    # `lon_deg`, `lat_deg`: [deg] WGS 84 / ITRF
    lon_deg: float
    lat_deg: float
    height_m: float | None = None  # [m] above the ellipsoid
    side: LaneSide = LaneSide.UNKNOWN
    speed_limit: SpeedLimit | None = None
    sequence: int = 0  # number of the transmission

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


# === Keys of CERPMs and the tag of their messages: AES-CMAC throughout, the same for both directions.
#
# Sources: RFC 4493 (AES-CMAC), NIST SP 800-108r1 section 4.1 (key derivation in counter mode), NIST SP 800-38B appendix
# A (short tags). Decision 0015 has the reasons for the length of the tag and the limits on guesses.


AGENCY_KEY_BYTES = (16, 32)  # [bytes] source: AES-128 and AES-256
KEY_LABEL = b"waymark cerpm v1"  # purpose of the derived keys; another message version needs another label
MAX_INVALID_TAGS_PER_LOG = 1_000
"""Tags that may fail in one log before the rest is left unchecked. Source: one transmitter at SF7 and 125 kHz sends 972
messages of 24 bytes in a minute, about as long as a vehicle is within its range (decision 0015)."""
MAX_INVALID_TAGS_PER_DAY = 10_000
"""The same for all logs of one API key in a day (UTC). Source: ten logs as above; with it one key forges a message in a
year with a probability of 0.085 % (decision 0015)."""
_COUNTER_BYTES = 4  # [bytes] source: NIST SP 800-108r1, section 4.1, r = 32


def derive_marker_key(agency_key: bytes, number: int) -> bytes:
    """The key of one marker, from its agency's.

    Parameters
    ----------
    agency_key : bytes
        16 or 32 of them; never leaves the server.
    number : int
        Of the marker within its agency.

    Returns
    -------
    bytes
        16 of them, programmed into the marker. Whoever opens a marker learns only its own key.

    Raises
    ------
    InvalidParameter
        The agency's key has another length, or the number does not fit 32 bits.

    Notes
    -----
    NIST SP 800-108r1 in counter mode with AES-CMAC. For the one block of 128 bits that is needed this is
    ``CMAC(agency_key, 00000001 || "waymark cerpm v1" || 00 || number || 00000080)``, integers of 4 bytes, big endian.
    """
    if len(agency_key) not in AGENCY_KEY_BYTES:
        raise InvalidParameter(
            f"an agency's key has {len(agency_key)} bytes",
            field="agency_key",
            limit="16 or 32 bytes",
            cure="make one from 16 or 32 random bytes",
        )
    if not 1 <= number <= MAX_NUMBER:
        raise InvalidParameter(f"number is {number}", field="number", limit=f"1 to {MAX_NUMBER}")
    derivation = KBKDFCMAC(
        algorithm=AES,
        mode=Mode.CounterMode,
        length=KEY_BYTES,
        rlen=_COUNTER_BYTES,
        llen=_COUNTER_BYTES,
        location=CounterLocation.BeforeFixed,
        label=KEY_LABEL,
        context=number.to_bytes(4),
        fixed=None,
    )
    return derivation.derive(agency_key)


def message_tag(key: bytes, body: bytes) -> bytes:
    """The tag of a message: the first four bytes of AES-CMAC over its body.

    Parameters
    ----------
    key : bytes
        The marker's own, 16 bytes.
    body : bytes
        Bytes 0 to 19 of a message.

    Returns
    -------
    bytes
        4 of them. Compare tags with `hmac.compare_digest`.

    Raises
    ------
    InvalidParameter
        The key or the body has another length.

    Notes
    -----
    RFC 4493, section 2.4, which recommends at least 64 bits. The message has room for 32 (decision 0015): one guess in
    2^32 is right, and the number of guesses is limited.
    """
    for name, value, length in (("key", key, KEY_BYTES), ("body", body, BODY_BYTES)):
        if len(value) != length:
            raise InvalidParameter(
                f"the {name} has {len(value)} bytes",
                field=name,
                limit=f"{length} bytes",
                cure="tags are made over bytes 0 to 19 of a message, with the key of its marker",
            )
    return aes_cmac(key, body)[:TAG_BYTES]


def forgery_probability(invalid_tags: float, tag_bytes: int = TAG_BYTES) -> float:
    """Probability that at least one of a number of guessed tags is valid.

    Parameters
    ----------
    invalid_tags : float
        Guesses that the limits allow, >= 0.
    tag_bytes : int
        Length of a tag. [bytes]

    Notes
    -----
    NIST SP 800-38B, appendix A.2: each guess is right with the probability 2^-bits, independently of the others.
    """
    return -math.expm1(invalid_tags * math.log1p(-(2.0 ** (-8 * tag_bytes))))


def aes_cmac(key: bytes, data: bytes) -> bytes:
    """AES-CMAC of RFC 4493, 16 bytes."""
    mac = CMAC(AES(key))
    mac.update(data)
    return mac.finalize()
