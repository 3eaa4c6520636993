"""Surveys of fiducial signs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from pydantic import BaseModel, Field

from app.errors import InvalidParameter, WaymarkError, naming
from app.families.fiducial.inputs import FiducialGeometryIn
from app.families.inputs import StrictModel, Text
from app.families.rules import RETIRED, MarkerRules
from app.families.surveys import RowCodes, Rows, SurveyImport, listed_codes
from app.formats.surveys.roles import CodeForm
from app.formats.surveys.table import Fault
from app.markers.fiducial import FiducialCode, KnownFiducial
from app.registry.columns import Columns
from app.registry.marker_rows import CodeRow
from app.registry.spatial import distance_m
from app.surveys.georeference import GeoreferencedSurvey


class SignIn(StrictModel):
    """What the signs of a survey have in common."""

    dictionary: Text = Field(max_length=40, description="Such as `apriltag-36h11`.")
    geometry: FiducialGeometryIn


class FiducialSurveyIn(BaseModel):
    """Members of a survey's declaration that fiducial signs have."""

    sign: SignIn | None = Field(None, description="Of fiducial signs; the column `code` has their numbers.")


class FiducialSurvey(SurveyImport[KnownFiducial | None]):
    """Points that become fiducial signs of one dictionary and size; each row names its number."""

    members = FiducialSurveyIn

    def defaults(self, declared: Mapping[str, Any]) -> KnownFiducial | None:
        """Any sign of the declared dictionary and dimensions."""
        if declared.get("sign") is None:
            return None
        sign = SignIn.model_validate(declared["sign"])
        with naming("sign"):
            code = FiducialCode(sign.dictionary, 0)
            return KnownFiducial(code, sign.geometry.geometry(code))

    def code_form(self, defaults: KnownFiducial | None, *, compare: bool) -> CodeForm:
        """Numbers, with or without the series of the dictionary."""
        return CodeForm("(?:[^ ]+-)?[0-9]{1,5}", False, "numbers of signs")

    def read_codes(
        self, survey: GeoreferencedSurvey, rows: Rows, defaults: KnownFiducial | None
    ) -> tuple[RowCodes, list[Fault]]:
        """Numbers of the dictionary.

        Raises
        ------
        InvalidParameter
            No dictionary is declared.
        """
        dictionary = _declared(defaults).code.dictionary
        digits, faults = np.zeros(len(rows), dtype="S64"), list[Fault]()
        for k, text in listed_codes(survey, rows):
            try:
                digits[k] = FiducialCode.from_text(text, dictionary).text.encode()
            except WaymarkError as error:
                faults.append(Fault(int(rows[k]) + 1, "code", "not_a_marker", error.message, error.cure))
        named = {fault.row for fault in faults}
        for k in np.flatnonzero(digits == b"").tolist():
            if int(rows[k]) + 1 not in named:
                message, cure = "a sign needs its number", "add a column with the role code"
                faults.append(Fault(int(rows[k]) + 1, "code", "not_a_marker", message, cure))
        good = digits != b""
        return RowCodes(rows, digits, good.copy(), dictionary).of(good), faults

    def is_unique(self, codes: RowCodes) -> bool:
        """Signs with the same code may stand far apart."""
        return False

    def collides(
        self,
        codes: RowCodes,
        defaults: KnownFiducial | None,
        place: tuple[float, float],
        known: CodeRow,
        agency_id: str,
        rules: MarkerRules,
    ) -> bool:
        """With a sign near by that has the same code."""
        if known.status == RETIRED:
            return False
        return distance_m(*place, known.lon_deg, known.lat_deg) <= rules.position_code_radius_m

    def columns(self, survey: GeoreferencedSurvey, codes: RowCodes, defaults: KnownFiducial | None) -> Columns:
        """Dictionary and dimensions."""
        spec = asdict(_declared(defaults).geometry)
        same = {"scheme": codes.scheme, "spec": {**spec, "mounting": str(spec["mounting"])}}
        return Columns(len(codes.rows), same, {})


def _declared(defaults: KnownFiducial | None) -> KnownFiducial:
    if defaults is None:
        raise InvalidParameter(
            "the dictionary and the size of the signs are not declared",
            field="declaration.sign",
            limit="dictionary and geometry",
            cure="declare sign with both",
        )
    return defaults
