"""Vertical datums: what a height is above."""

from __future__ import annotations

import re
from functools import lru_cache

from pyproj import CRS
from pyproj.database import query_crs_info
from pyproj.enums import PJType
from pyproj.exceptions import CRSError

from app.errors import ReferenceSystemError

ELLIPSOID = "ellipsoid"
VERTICAL_RULE = "ellipsoid, or a vertical CRS of the EPSG registry in metres upwards, by code or name"
_CODE = re.compile(r"(?:EPSG:|urn:ogc:def:crs:EPSG:[0-9.]*:)(?P<code>[0-9]{4,6})", re.IGNORECASE)


def is_ellipsoidal(vertical_datum: str | None) -> bool:
    """Whether heights above a datum, as markers keep it, are ellipsoidal; without a datum they are."""
    return vertical_datum in (None, ELLIPSOID)


def normalize_vertical_datum(text: str) -> str:
    """``ellipsoid``, or ``EPSG:code`` of a vertical CRS, from the usual forms of its name.

    Raises
    ------
    ReferenceSystemError
        It is none of these: other names, depths, feet.
    """
    plain = _plain(text)
    if plain == _plain(ELLIPSOID):
        return ELLIPSOID
    found = _CODE.fullmatch(text.strip())
    code = found["code"] if found else _codes().get(plain)
    if code is None or not _is_height_in_metres(int(code)):
        raise ReferenceSystemError(
            f"{text[:64]!r} is not a vertical datum that is known here",
            field="vertical_datum",
            limit=VERTICAL_RULE,
            cure="send ellipsoid, EPSG:5703 (NAVD88), EPSG:7837 (DHHN2016), EPSG:3855 (EGM2008), ...",
        )
    return f"EPSG:{int(code)}"


@lru_cache(maxsize=256)
def _is_height_in_metres(code: int) -> bool:
    try:
        system = CRS.from_epsg(code)
    except CRSError:
        return False
    if not system.is_vertical or system.is_compound or len(system.axis_info) != 1:
        return False
    axis = system.axis_info[0]
    return axis.direction == "up" and axis.unit_conversion_factor == 1.0


@lru_cache(maxsize=1)
def _codes() -> dict[str, str]:
    """Codes of vertical systems by name, with and without the word height."""
    codes: dict[str, str] = {}
    for info in query_crs_info("EPSG", PJType.VERTICAL_CRS):
        codes[_plain(info.name)] = codes[_plain(info.name.removesuffix(" height"))] = info.code
    return codes


def _plain(name: str) -> str:
    return re.sub(r"[\s_-]", "", name).upper()
