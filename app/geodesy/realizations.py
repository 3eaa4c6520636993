"""Realizations of reference systems: which one is stated, and how far apart those of a system are."""

from __future__ import annotations

import re
from functools import lru_cache

from pyproj.database import query_crs_info
from pyproj.enums import PJType

from app.geodesy.systems import is_global, named_system

TARGET = "ITRF2014"
WGS84_ENSEMBLE_M = 2.0
"""Accuracy of WGS 84 without a realization. [m] Source: EPSG registry, datum ensemble 6326."""
_RECENT_M, _OLD_M = 0.01, 0.2
"""Horizontal distance of a realization from ITRF2014: since ITRF2005, IGS05 and WGS 84 (G1674), and before. [m]
Source: parameters from ITRF2014 to past ITRFs (itrf.ign.fr), at most 3 mm and 1 ppb back to ITRF2005 and 155 mm and 11
ppb back to ITRF88."""
_RECENT_YEAR, _RECENT_WEEK = 2005, 1674
_ITRF = re.compile(r"(?:ITRF|IGS|IGB)(?P<year>\d{4}|\d{2})(?:@.*)?")
_WGS84 = re.compile(r"(?:WGS84)?\(?G(?P<week>\d{3,4})\)?")
_UNSTATED = ("WGS84", "ITRF", "ITRS", "WGS1984")


def accuracy_of_global(realization: str | None) -> float | None:
    """Distance of a realization of WGS 84 or the ITRS from ITRF2014; None if it is not one of these. [m]

    Without a realization, it is that of WGS 84 with all its realizations.
    """
    name = _plain(realization or "WGS84")
    if name in _UNSTATED:
        return WGS84_ENSEMBLE_M
    if name == TARGET:
        return 0.0
    if found := _ITRF.fullmatch(name):
        year = int(found["year"])
        if year < 100:
            year += 1900 if year > 80 else 2000
        return _RECENT_M if year >= _RECENT_YEAR else _OLD_M
    if found := _WGS84.fullmatch(name):
        return _RECENT_M if int(found["week"]) >= _RECENT_WEEK else _OLD_M
    return None


def is_stated(realization: str | None) -> bool:
    """Whether it names more than the system."""
    return realization is not None and _plain(realization) not in _UNSTATED


def realization_of_system(name: str) -> str | None:
    """Realization that a global system is by itself, such as that of EPSG:7912; None of WGS 84."""
    geodetic = named_system(name).geodetic_crs
    if geodetic is None or geodetic.datum is None or geodetic.datum.type_name == "Datum Ensemble":
        return None
    return str(geodetic.name)


def has_realizations(name: str) -> bool:
    """Whether a system is a datum ensemble, such as ETRS89: its realizations differ, and coordinates may be in any."""
    geodetic = named_system(name).geodetic_crs
    return geodetic is not None and geodetic.datum is not None and geodetic.datum.type_name == "Datum Ensemble"


def system_of_realization(name: str, realization: str | None) -> str | None:
    """Geographic system of a realization of a regional system: EPSG:9067 of ETRS89 and ``ETRF2000``.

    Returns
    -------
    str or None
        ``EPSG:code``; None if there is no such realization of this system.
    """
    if realization is None or is_global(named_system(name)):
        return None
    geodetic = named_system(name).geodetic_crs
    found = _geographic_systems().get(_plain(realization))
    if geodetic is None or geodetic.datum is None or found is None:
        return None
    own = _plain(geodetic.name)
    if _plain(realization).startswith((f"{own}/", f"{own}(")) or _plain(realization) == own:
        return found
    members = {member["name"] for member in geodetic.datum.to_json_dict().get("members", ())}
    datum = named_system(found).datum
    return found if datum is not None and datum.name in members else None


@lru_cache(maxsize=1)
def _geographic_systems() -> dict[str, str]:
    systems = query_crs_info("EPSG", PJType.GEOGRAPHIC_2D_CRS)
    return {_plain(info.name): f"EPSG:{info.code}" for info in systems}


def _plain(name: str) -> str:
    return re.sub(r"[\s_-]", "", name).upper()
