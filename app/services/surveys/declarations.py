"""What was declared of a survey, as the API takes it and as a queued import stores it, becomes typed values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from app.errors import naming
from app.families import FAMILIES
from app.formats.spooled_file import SpooledFile
from app.formats.surveys.declaration import ControlPoint, ImportDeclaration, LocalGrid
from app.services.surveys.import_report import ImportInput

_SURVEYS = {family.name: family.survey for family in FAMILIES if family.survey is not None}
_NOT_OF_THE_SURVEY = {"dry_run", "mode", "reason", "warnings", "list_rows"}.union(
    *(s.members.model_fields for s in _SURVEYS.values())
)


def import_input(declared: Mapping[str, Any], file: SpooledFile) -> ImportInput:
    """A file with its declaration.

    Parameters
    ----------
    declared : mapping
        JSON, with the members of `app.api.surveys.schemas.DeclarationIn`, all of them.
    file : SpooledFile
        The survey.

    Raises
    ------
    InvalidParameter
        A value is out of its limits, or values contradict each other; the field is below ``declaration``.
    """
    values = {name: value for name, value in declared.items() if name not in _NOT_OF_THE_SURVEY}
    for name in ("area_deg", "height_range_m"):
        values[name] = tuple(values[name]) if values[name] is not None else None
    values["leave_out"] = tuple(values.get("leave_out", ()))
    with naming("declaration"):
        if (grid := values["local_grid"]) is not None:
            points = tuple(ControlPoint(**point) for point in grid["control_points"])
            values["local_grid"] = LocalGrid(**{**grid, "control_points": points})
        defaults = _defaults(declared)
        declaration = ImportDeclaration(**values)
    strict = declared["warnings"] == "refuse"
    rows = declared.get("list_rows", 0)
    return ImportInput(
        file, declaration, defaults, declared["dry_run"], declared["mode"], declared["reason"], strict, rows
    )


def _defaults(declared: Mapping[str, Any]) -> Any:
    """Of the declared family; members of the other families are checked too."""
    return {name: survey.defaults(declared) for name, survey in _SURVEYS.items()}.get(declared["family"])
