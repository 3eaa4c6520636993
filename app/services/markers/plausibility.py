"""Warnings about the position of a single marker: the checks of surveys, on a survey of one row."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Literal, TypeAlias

import numpy as np
import sqlalchemy as sa

from app.errors import InvalidParameter
from app.families.documents import WarningDocument
from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.table import Fault, SurveyTable
from app.geodesy import PlacedPositions, reference_system
from app.geodesy.systems import WGS84
from app.registry import bulk
from app.registry.spatial import box_around
from app.services.surveys.import_neighbours import places_of
from app.surveys.consistency_checks import check_accuracy, check_consistency
from app.surveys.georeference import GeoreferencedSurvey
from app.surveys.location_checks import KNOWN_M, NEAR_M, Neighbours, check_location

WarningMode: TypeAlias = Literal["store", "refuse"]
"""What warnings mean: the marker is stored, or refused."""
_OF_SURVEYS = ("place_unchecked", "place_by_area_only", "beside_the_registered_line")
"""Faults that are evidence only in many rows: a single marker in a new place would always have one of them."""
_MAX_NEIGHBOURS = 100  # registered markers that a position is compared with; chosen by hand


def check_position(
    connection: sa.Connection, agency_id: str, marker_id: str, values: Mapping[str, Any], mode: WarningMode
) -> list[WarningDocument]:
    """Warnings about a position that is to be stored.

    Parameters
    ----------
    marker_id : str
        Its marker, which is not compared with itself.
    values : mapping
        Columns of the marker.
    mode : str
        ``refuse``: raise at the first one.

    Raises
    ------
    InvalidParameter
        There are warnings, and `mode` is ``refuse``; `parts` has those after the first.
    """
    lon_deg, lat_deg = values["lon_deg"], values["lat_deg"]
    survey = _survey_of(values)
    box = box_around(lon_deg, lat_deg, NEAR_M)
    near = bulk.list_places_in(connection, agency_id, box, limit=_MAX_NEIGHBOURS, ignoring=marker_id)
    neighbours = Neighbours(*places_of(near), tuple(row.vertical_datum for row in near))
    declaration = ImportDeclaration(realization=values["realization"], vertical_datum=values["vertical_datum"])
    is_known = partial(_is_known, connection, agency_id, marker_id)
    faults = [
        *check_accuracy(values["horizontal_rmse_m"], values["vertical_rmse_m"]),
        *check_consistency(survey),
        *check_location(survey, declaration, neighbours, is_known),
    ]
    found = [fault for fault in faults if fault.code not in _OF_SURVEYS]
    if found and mode == "refuse":
        raise _refusal(found)
    return [
        {"field": _field(fault), "code": fault.code, "message": fault.message, "proposal": fault.proposal}
        for fault in found
    ]


def _survey_of(values: Mapping[str, Any]) -> GeoreferencedSurvey:
    """A survey of one row, with its coordinates as they were sent; those of a lane's markers in WGS 84."""
    original, none = values["original"], None
    names = next((pair for pair in _PAIRS if all(original.get(name) is not None for name in pair)), none)
    crs = values["crs"] if names is not None else WGS84
    first, second = (original[name] for name in names) if names is not None else (values["lon_deg"], values["lat_deg"])
    projected = bool(reference_system(crs).is_projected)
    height_m = original.get("height_m", values["height_m"])
    heights = np.array([np.nan if height_m is None else height_m])
    one = np.array([first], dtype=np.float64), np.array([second], dtype=np.float64)
    table = SurveyTable(
        "json", *one, None if height_m is None else heights, projected, crs, "m" if projected else "deg", "m"
    )
    placed = PlacedPositions(
        np.array([values["lon_deg"]]), np.array([values["lat_deg"]]), heights, np.array([True]), crs,
        values["realization"], values["epoch"], values["transform_accuracy_m"], None,
    )  # fmt: skip
    return GeoreferencedSurvey(table, placed, np.zeros(1), np.zeros(1), heights)


_PAIRS = (("easting_m", "northing_m"), ("lon_deg", "lat_deg"))


def _is_known(connection: sa.Connection, agency_id: str, marker_id: str, lon_deg: float, lat_deg: float) -> bool:
    return bulk.is_any_near(connection, agency_id, lon_deg, lat_deg, KNOWN_M, ignoring=marker_id)


_FIELDS = {"position": "position", "height": "position.height_m"}


def _field(fault: Fault) -> str:
    return _FIELDS.get(fault.field, f"position.{fault.field}")


def _refusal(faults: Sequence[Fault]) -> InvalidParameter:
    errors = [
        InvalidParameter(fault.message, field=_field(fault), limit="no warnings", cure=fault.proposal)
        for fault in faults
    ]
    errors[0].parts = tuple(errors[1:])
    return errors[0]
