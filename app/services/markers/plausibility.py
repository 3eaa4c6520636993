"""What a stated accuracy means under the standards, and warnings about the position of a single marker."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, TypeAlias

import sqlalchemy as sa
from typing_extensions import TypedDict

from app.errors import InvalidParameter
from app.families.documents import WarningDocument
from app.families.surveys import ColumnValues
from app.formats.surveys.table import Fault
from app.geodesy.systems import WGS84
from app.registry import markers
from app.registry.spatial import box_around
from app.services.surveys.import_rows import places_of
from app.surveys.consistency_checks import check_accuracy
from app.surveys.location_checks import KNOWN_M, NEAR_M, SinglePosition, check_single_position

# === What a survey's RMSE means under the standards that agencies know.


NSSDA_HORIZONTAL = 1.7308
NSSDA_VERTICAL = 1.9600
NSSDA = "FGDC-STD-007.3-1998, Geospatial Positioning Accuracy Standards, part 3: NSSDA, section 3.2 and appendix 3-A"
ASPRS_2014 = "ASPRS Positional Accuracy Standards for Digital Geospatial Data, edition 1 (2014), sections 7.3 and 7.4"
ASPRS_2023 = "ASPRS Positional Accuracy Standards for Digital Geospatial Data, edition 2 (2023)"
NSSDA_CHECK_POINTS = 20
ASPRS_2014_CHECK_POINTS = 20
ASPRS_2023_CHECK_POINTS = 30


class NssdaDocument(TypedDict):
    """Accuracy at 95 % confidence. [m]"""

    horizontal_95_m: float | None
    vertical_95_m: float | None
    is_tested: bool
    needed_check_points: int
    statement: str | None
    source: str


class AsprsDocument(TypedDict):
    """Accuracy classes. [cm]"""

    horizontal_class_cm: float | None
    vertical_class_cm: float | None
    is_tested: bool
    needed_check_points: int
    source: str


class AccuracyDocument(TypedDict):
    """Accuracy figures of a survey, each with its source."""

    horizontal_rmse_m: float | None
    vertical_rmse_m: float | None
    check_points: int | None
    nssda: NssdaDocument
    asprs_2014: AsprsDocument
    asprs_2023: AsprsDocument


def accuracy_document(
    horizontal_rmse_m: float | None, vertical_rmse_m: float | None, check_points: int | None
) -> AccuracyDocument:
    """Accuracy figures of a survey, each with the standard it is from and whether enough points were checked.

    Parameters
    ----------
    horizontal_rmse_m : float or None
        RMSE_r, of both axes together. [m]
    vertical_rmse_m : float or None
        RMSE_z. [m]
    check_points : int or None
        Independent points that they were tested at.

    Notes
    -----
    NSSDA: at 95 % confidence 1.7308 RMSE_r, where the errors of both axes are about equal, and 1.9600 RMSE_z. Classes
    of ASPRS 2014 are RMSE_x = RMSE_y = RMSE_r / sqrt(2) and RMSE_z, those of 2023 are RMSE_H = RMSE_r and RMSE_V; here
    they are rounded up to millimetres.
    """
    across = None if horizontal_rmse_m is None else horizontal_rmse_m / math.sqrt(2.0)
    return {
        "horizontal_rmse_m": horizontal_rmse_m,
        "vertical_rmse_m": vertical_rmse_m,
        "check_points": check_points,
        "nssda": {
            "horizontal_95_m": _times(NSSDA_HORIZONTAL, horizontal_rmse_m),
            "vertical_95_m": _times(NSSDA_VERTICAL, vertical_rmse_m),
            "is_tested": _is_tested(check_points, NSSDA_CHECK_POINTS),
            "needed_check_points": NSSDA_CHECK_POINTS,
            "statement": _statement(horizontal_rmse_m, vertical_rmse_m, check_points),
            "source": NSSDA,
        },
        "asprs_2014": _classes(across, vertical_rmse_m, check_points, ASPRS_2014_CHECK_POINTS, ASPRS_2014),
        "asprs_2023": _classes(horizontal_rmse_m, vertical_rmse_m, check_points, ASPRS_2023_CHECK_POINTS, ASPRS_2023),
    }


def _classes(
    horizontal_m: float | None, vertical_m: float | None, check_points: int | None, needed: int, source: str
) -> AsprsDocument:
    return {
        "horizontal_class_cm": _class_cm(horizontal_m),
        "vertical_class_cm": _class_cm(vertical_m),
        "is_tested": _is_tested(check_points, needed),
        "needed_check_points": needed,
        "source": source,
    }


def _is_tested(check_points: int | None, needed: int) -> bool:
    return check_points is not None and check_points >= needed


def _times(factor: float, rmse_m: float | None) -> float | None:
    return None if rmse_m is None else round(factor * rmse_m, 4)


def _class_cm(rmse_m: float | None) -> float | None:
    """The smallest class in steps of a millimetre that holds."""
    return None if rmse_m is None else math.ceil(round(rmse_m * 1000.0, 6)) / 10.0


def _statement(horizontal_m: float | None, vertical_m: float | None, check_points: int | None) -> str | None:
    """The sentence that section 3.2.3 asks for; one that was not tested as it says does not claim to be."""
    figures = [
        f"{factor * rmse_m:.3f} meters {kind} accuracy at 95% confidence level"
        for kind, factor, rmse_m in (
            ("horizontal", NSSDA_HORIZONTAL, horizontal_m),
            ("vertical", NSSDA_VERTICAL, vertical_m),
        )
        if rmse_m is not None
    ]
    if not figures:
        return None
    text = ", ".join(figures)
    if check_points is not None and check_points >= NSSDA_CHECK_POINTS:
        return f"Tested {text}, from {check_points} check points"
    found = "no check points are stated" if check_points is None else f"only {check_points} check points"
    return f"Not tested to the standard ({found}, {NSSDA_CHECK_POINTS} are needed): {text} if the stated RMSE holds"


# === Warnings about the position of a single marker.


WarningMode: TypeAlias = Literal["store", "refuse"]
"""What warnings mean: the marker is stored, or refused."""
_MAX_NEIGHBOURS = 100  # registered markers that a position is compared with


def check_position(
    connection: sa.Connection, agency_id: str, marker_id: str, values: ColumnValues, mode: WarningMode
) -> list[WarningDocument]:
    """Warnings about a position that is to be stored.

    Parameters
    ----------
    marker_id : str
        Its marker, which is not compared with itself.
    values : dict
        Columns of the marker.
    mode : str
        ``refuse``: raise at the first one.

    Raises
    ------
    InvalidParameter
        There are warnings, and `mode` is ``refuse``; `parts` has those after the first.
    """

    def is_known(lon_deg: float, lat_deg: float) -> bool:
        return markers.is_any_near(connection, agency_id, lon_deg, lat_deg, KNOWN_M, ignoring=marker_id)

    box = box_around(values["lon_deg"], values["lat_deg"], NEAR_M)
    near = markers.list_places_in(connection, agency_id, box, limit=_MAX_NEIGHBOURS, ignoring=marker_id)
    near_lon_deg, near_lat_deg, _ = places_of(near)
    faults = [
        *check_accuracy(values["horizontal_rmse_m"], values["vertical_rmse_m"]),
        *check_single_position(_single_position(values), near_lon_deg, near_lat_deg, is_known),
    ]
    if faults and mode == "refuse":
        raise _refusal(faults)
    return [
        {"field": _field(fault), "code": fault.code, "message": fault.message, "proposal": fault.proposal}
        for fault in faults
    ]


def _single_position(values: ColumnValues) -> SinglePosition:
    """With the coordinates as they were sent; those of a lane's markers in WGS 84."""
    original = values["original"]
    first, second, crs = values["lon_deg"], values["lat_deg"], WGS84
    for names in (("easting_m", "northing_m"), ("lon_deg", "lat_deg")):
        if all(original.get(name) is not None for name in names):
            first, second, crs = original[names[0]], original[names[1]], values["crs"]
            break
    height_m = original.get("height_m", values["height_m"])
    return SinglePosition(values["lon_deg"], values["lat_deg"], first, second, height_m, crs, values["realization"])


def _field(fault: Fault) -> str:
    names = {"position": "position", "height": "position.height_m"}
    return names.get(fault.field, f"position.{fault.field}")


def _refusal(faults: Sequence[Fault]) -> InvalidParameter:
    errors = [
        InvalidParameter(fault.message, field=_field(fault), limit="no warnings", cure=fault.proposal)
        for fault in faults
    ]
    errors[0].parts = tuple(errors[1:])
    return errors[0]
