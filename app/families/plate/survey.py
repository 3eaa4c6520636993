"""Surveys of plates."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, Field

from app.errors import InvalidParameter, WaymarkError, naming
from app.families.plate.inputs import RECOMMENDED_SCHEME_NAME, SCHEME_DESCRIPTION, GeometryIn, SchemeName
from app.families.surveys import RETIRED, Flags, MarkerRules, RowCodes, Rows, SurveyImport, listed_codes
from app.formats.surveys.roles import CodeForm
from app.formats.surveys.table import Fault
from app.markers.plate import (
    RECOMMENDED_SCHEME,
    PlateCode,
    PlateGeometry,
    PlateScheme,
    code_cells,
    id_digits,
    position_digits,
    recommended_geometry,
    registry_number_bits,
)
from app.registry.bulk_load import Columns
from app.registry.marker_rows import CodeRow
from app.registry.spatial import distance_m
from app.surveys.georeference import GeoreferencedSurvey

_LETTERS = np.frombuffer(b"ABCDEF", dtype=np.uint8)
_MIN_LETTERS = 3
_REDRAWS = 20


class PlateSurveyIn(BaseModel):
    """Members of a survey's declaration that plates have."""

    scheme: SchemeName = Field(RECOMMENDED_SCHEME_NAME, description=f"Of plates. {SCHEME_DESCRIPTION}")
    check_digits: Annotated[int, Field(strict=True, ge=1, le=2)] | None = None
    geometry: GeometryIn = Field(default_factory=GeometryIn, description="Of plates.")


@dataclass(frozen=True, slots=True)
class PlateDefaults:
    """What a survey's plates have in common."""

    scheme: PlateScheme = RECOMMENDED_SCHEME
    check_digits: int | None = None
    geometry: PlateGeometry = field(default_factory=PlateGeometry)

    @property
    def checks(self) -> int:
        """Check digits of position plates."""
        return (self.check_digits or 1) if self.scheme is PlateScheme.POSITION_CHECK else 0


class PlateSurvey(SurveyImport[PlateDefaults]):
    """Points that become plates: their digits follow from the position, or are registry numbers."""

    members = PlateSurveyIn

    def defaults(self, declared: Mapping[str, Any]) -> PlateDefaults:
        """Scheme, check digits and dimensions."""
        checks, scheme = declared.get("check_digits"), PlateScheme(declared.get("scheme", RECOMMENDED_SCHEME))
        if checks is not None and scheme is not PlateScheme.POSITION_CHECK:
            raise InvalidParameter(
                "check_digits means nothing in this scheme", field="check_digits", limit="position-check"
            )
        with naming("geometry"):
            geometry = recommended_geometry(scheme, **declared.get("geometry", {}))
        return PlateDefaults(scheme, checks, geometry)

    def code_form(self, defaults: PlateDefaults, *, compare: bool) -> CodeForm:
        """Digits of the declared size and scheme, or registry numbers; digits of any plate in comparisons."""
        cells = len(code_cells(defaults.geometry.n))
        if compare:
            return CodeForm("[0-9A-F]{5,}", True, "digits of plates")
        if defaults.scheme is PlateScheme.ID:
            pattern = f"[0-9A-F]{{{cells}}}|[0-9]{{1,{cells - 1}}}"
            return CodeForm(pattern, True, f"{cells} digits of an id plate, or its registry number")
        digits = "[0-9A-F]" if defaults.scheme.corrects else "[0-9]"
        return CodeForm(f"{digits}{{{cells}}}", True, f"{cells} digits of a plate")

    def read_codes(
        self, survey: GeoreferencedSurvey, rows: Rows, defaults: PlateDefaults
    ) -> tuple[RowCodes, list[Fault]]:
        """Digits by the scheme."""
        if defaults.scheme is PlateScheme.ID:
            return _read_id_codes(survey, rows, defaults.geometry)
        return _read_position_codes(survey, rows, defaults)

    def is_unique(self, codes: RowCodes) -> bool:
        """A registry number names one plate."""
        return codes.scheme == PlateScheme.ID

    def collides(
        self,
        codes: RowCodes,
        defaults: PlateDefaults,
        place: tuple[float, float],
        known: CodeRow,
        agency_id: str,
        rules: MarkerRules,
    ) -> bool:
        """With any plate of the same registry number, or with one nearby of the same digits."""
        if codes.scheme == PlateScheme.ID:
            return known.scheme == "id" and known.n == defaults.geometry.n
        if known.status == RETIRED:
            return False
        radius_m = rules.position_code_radius_m if known.digits_match_position else rules.explicit_code_radius_m
        return distance_m(*place, known.lon_deg, known.lat_deg) <= radius_m

    def columns(self, survey: GeoreferencedSurvey, codes: RowCodes, defaults: PlateDefaults) -> Columns:
        """Scheme and dimensions."""
        geometry = defaults.geometry
        same = {
            "scheme": codes.scheme,
            "check_digits": defaults.checks or None,
            "digits_match_position": None if defaults.scheme is PlateScheme.ID else True,
            "n": geometry.n,
            "unit_mm": geometry.unit_mm,
            "gap_mm": geometry.gap_mm,
            "thickness_mm": geometry.thickness_mm,
        }
        return Columns(len(codes.rows), same, {})


def _read_position_codes(
    survey: GeoreferencedSurvey, rows: Rows, defaults: PlateDefaults
) -> tuple[RowCodes, list[Fault]]:
    """Digits of position plates; a row whose digits are not those of its place is refused."""
    placed = survey.placed
    digits = position_digits(
        placed.lon_deg[rows],
        placed.lat_deg[rows],
        n=defaults.geometry.n,
        scheme=defaults.scheme,
        check_digits=defaults.checks,
    )
    good = np.ones(len(rows), dtype=bool)
    faults: list[Fault] = []
    for k, text in listed_codes(survey, rows):
        if text.encode() != digits[k]:
            good[k] = False
            message = f"the digits {text[:40]} are not those of the position, {digits[k].decode()}"
            cure = (
                "leave the digits out, correct the position, or declare compare if this measures a plate that is built"
            )
            faults.append(Fault(int(rows[k]) + 1, "code", "not_a_marker", message, cure))
    return RowCodes(rows, digits, np.zeros(len(rows), dtype=bool), str(defaults.scheme)).of(good), faults


def _read_id_codes(survey: GeoreferencedSurvey, rows: Rows, geometry: PlateGeometry) -> tuple[RowCodes, list[Fault]]:
    """Digits of id plates, as digits or as registry numbers; drawn where the file has none."""
    n, cells = geometry.n, PlateCode.from_registry_number(0, n=geometry.n).digits
    digits = np.zeros(len(rows), dtype=f"S{len(cells)}")
    good, from_file = np.ones(len(rows), dtype=bool), np.zeros(len(rows), dtype=bool)
    faults: list[Fault] = []
    for k, text in listed_codes(survey, rows):
        is_number = text.isascii() and text.isdigit() and len(text) < len(cells)
        try:
            code = PlateCode.from_registry_number(int(text), n=n) if is_number else PlateCode(text, PlateScheme.ID, n)
        except WaymarkError as error:
            good[k] = False
            faults.append(Fault(int(rows[k]) + 1, error.field or "code", "not_a_marker", error.message, error.cure))
        else:
            digits[k], from_file[k] = code.digits.encode(), True
    codes = RowCodes(rows, digits, from_file, str(PlateScheme.ID)).of(good)
    _draw(codes, ~codes.from_file, n)
    return codes, faults


def _draw(codes: RowCodes, wanted: Flags, n: int) -> None:
    """Give rows random numbers, again where they are too like a decimal number or somebody else's in the file."""
    for _ in range(_REDRAWS):
        count = int(wanted.sum())
        if not count:
            return
        drawn = np.frombuffer(secrets.token_bytes(8 * count), dtype=np.uint64)
        codes.digits[wanted] = id_digits(drawn >> np.uint64(64 - registry_number_bits(n)), n=n)
        letters = np.isin(codes.digits.view(np.uint8).reshape(len(codes.digits), -1), _LETTERS).sum(axis=1)
        _values, first, count_of = np.unique(codes.digits, return_index=True, return_counts=True)
        twice = np.ones(len(codes.digits), dtype=bool)
        twice[first[count_of == 1]] = False
        wanted = ~codes.from_file & ((letters < _MIN_LETTERS) | twice)
    raise InvalidParameter("no registry numbers are left to draw", field="geometry.n", cure="take larger plates")
