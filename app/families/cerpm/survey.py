"""Surveys of CERPMs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
import sqlalchemy as sa
from pydantic import BaseModel, Field

from app.errors import InvalidParameter
from app.families.cerpm.inputs import SpeedLimitIn
from app.families.cerpm.message import speed_limit_document
from app.families.rules import MarkerRules
from app.families.surveys import Flags, RowCodes, Rows, SurveyImport, listed_codes, texts_of, unknown_texts
from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.roles import CodeForm
from app.formats.surveys.table import Fault
from app.markers.cerpm import HEIGHT_M, MAX_NUMBER, LaneSide, SpeedLimit, SpeedUnit
from app.radio.settings import RadioSettings
from app.registry import cerpms
from app.registry.columns import Columns
from app.registry.marker_rows import CodeRow
from app.surveys.georeference import GeoreferencedSurvey


class CerpmSurveyIn(BaseModel):
    """Members of a survey's declaration that CERPMs have."""

    side: Literal["unknown", "left", "right"] = Field("unknown", description="Of CERPMs without one of their own.")
    speed_limit: SpeedLimitIn | None = Field(None, description="Of CERPMs.")


@dataclass(frozen=True, slots=True)
class CerpmDefaults:
    """What a survey's CERPMs have in common."""

    side: LaneSide = LaneSide.UNKNOWN
    speed_limit: SpeedLimit | None = None


class CerpmSurvey(SurveyImport[CerpmDefaults]):
    """Points that become CERPMs: rows without a number get the next ones of the agency."""

    members = CerpmSurveyIn

    def defaults(self, declared: Mapping[str, Any]) -> CerpmDefaults:
        """Side and speed limit."""
        limit = declared.get("speed_limit")
        return CerpmDefaults(
            LaneSide[str(declared.get("side", "unknown")).upper()],
            SpeedLimit(limit["value"], SpeedUnit(limit["unit"])) if limit is not None else None,
        )

    def check_values(
        self, survey: GeoreferencedSurvey, wanted: Flags, declaration: ImportDeclaration
    ) -> Iterator[Fault]:
        """Unknown sides, and heights that do not fit a message."""
        sides = {side.name for side in LaneSide}
        known = sides | {name.lower() for name in sides}
        yield from unknown_texts(survey.table.texts.get("side"), wanted, "side", known, "left, right, unknown")
        if declaration.vertical_datum not in (None, "ellipsoid"):
            return
        height = survey.placed.height_m
        cure = "leave the height out where it does not fit"
        for row in np.flatnonzero(wanted & ((height < HEIGHT_M[0]) | (height > HEIGHT_M[1]))):
            message = f"height_m is {height[row]:g}, a message holds {HEIGHT_M[0]:g} to {HEIGHT_M[1]:g} m"
            yield Fault(int(row) + 1, "position.height_m", "not_a_marker", message, cure)

    def code_form(self, defaults: CerpmDefaults, *, compare: bool) -> CodeForm:
        """Numbers."""
        return CodeForm("[1-9][0-9]{0,9}", True, "numbers of CERPMs")

    def read_codes(
        self, survey: GeoreferencedSurvey, rows: Rows, defaults: CerpmDefaults
    ) -> tuple[RowCodes, list[Fault]]:
        """Numbers."""
        return _read_numbers(survey, rows)

    def assign_missing(self, connection: sa.Connection, agency_id: str, codes: RowCodes) -> None:
        """The next numbers of the agency."""
        highest = int(codes.digits[codes.from_file].astype(np.int64).max()) if codes.from_file.any() else 0
        last = max(cerpms.last_number(connection, agency_id), highest)
        missing = codes.digits == b""
        count = int(missing.sum())
        if last + count > MAX_NUMBER:
            raise InvalidParameter(
                "there are not enough numbers left",
                field="code",
                limit=f"1 to {MAX_NUMBER}",
                cure="add the numbers to the file",
            )
        codes.digits[missing] = np.arange(last + 1, last + 1 + count).astype("S10")

    def is_unique(self, codes: RowCodes) -> bool:
        """A number names one CERPM of its agency."""
        return True

    def collides(
        self,
        codes: RowCodes,
        defaults: CerpmDefaults,
        place: tuple[float, float],
        known: CodeRow,
        agency_id: str,
        rules: MarkerRules,
    ) -> bool:
        """Only with CERPMs of the same agency."""
        return known.agency_id == agency_id

    def columns(self, survey: GeoreferencedSurvey, codes: RowCodes, defaults: CerpmDefaults) -> Columns:
        """The spec, by the side of the row."""
        specs = _specs(defaults)
        same: dict[str, Any] = {"scheme": codes.scheme}
        own: dict[str, Sequence[Any]] = {}
        if "side" in survey.table.texts:
            own["spec"] = [specs[side.upper()] for side in texts_of(survey, codes.rows, "side")]
        else:
            same["spec"] = specs[""]
        return Columns(len(codes.rows), same, own)


def _read_numbers(survey: GeoreferencedSurvey, rows: Rows) -> tuple[RowCodes, list[Fault]]:
    """Numbers of CERPMs, and the rows whose number is none."""
    numbers = np.zeros(len(rows), dtype=np.int64)
    faults: list[Fault] = []
    for k, text in listed_codes(survey, rows):
        if text.isdigit() and text.isascii() and len(text) <= 10 and 1 <= (number := int(text)) <= MAX_NUMBER:
            numbers[k] = number
        else:
            numbers[k] = -1
            message = f"{text[:40]!r} is no number of a CERPM"
            faults.append(Fault(int(rows[k]) + 1, "code", "not_a_marker", message, "a whole number"))
    good = numbers >= 0
    digits = np.where(numbers > 0, numbers, 0).astype("S10")
    digits[numbers == 0] = b""
    return RowCodes(rows, digits, numbers > 0, "cerpm").of(good), faults


def _specs(defaults: CerpmDefaults) -> dict[str, dict[str, Any]]:
    """What CERPMs of each side keep; rows share these, and none changes them."""
    limit, radio = speed_limit_document(defaults.speed_limit), _default_radio()
    of_side = {
        side.name: {"side": side.name.lower(), "speed_limit": limit, "dev_eui": None, "radio": radio}
        for side in LaneSide
    }
    return {**of_side, "": of_side[defaults.side.name]}


@lru_cache
def _default_radio() -> dict[str, Any]:
    return asdict(RadioSettings())
