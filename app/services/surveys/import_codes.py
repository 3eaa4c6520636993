"""Codes of a survey's markers: assigned where they are missing, and compared with each other and the registry."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import numpy as np
import sqlalchemy as sa

from app.families.family import Family, Registration
from app.families.rules import MarkerRules
from app.families.surveys import RowCodes, SurveyImport
from app.formats.surveys.table import Fault
from app.registry import bulk
from app.registry.marker_rows import CodeRow
from app.registry.spatial import distance_m
from app.surveys.georeference import GeoreferencedSurvey

_SAME_CODE = 20
_PART = 20_000


def assign_codes(
    connection: sa.Connection,
    registration: Registration,
    family: Family[Any, Any],
    codes: RowCodes,
    survey: GeoreferencedSurvey,
    defaults: Any,
) -> Iterator[Fault]:
    """Give codes to the rows without one, and name the rows whose code another marker has."""
    assert family.survey is not None
    family.survey.assign_missing(connection, registration.agency_id, codes)
    yield from _check_within(family.survey, codes, survey, registration.rules)
    yield from _check_stored(connection, registration, family, codes, survey, defaults)


def _check_within(
    family: SurveyImport[Any], codes: RowCodes, survey: GeoreferencedSurvey, rules: MarkerRules
) -> Iterator[Fault]:
    """Codes that two rows of the file carry."""
    is_unique = family.is_unique(codes)
    order = np.argsort(codes.digits, kind="stable")
    same = codes.digits[order[1:]] == codes.digits[order[:-1]]
    if not same.any():
        return
    groups = np.split(order, np.flatnonzero(~same) + 1)
    found = []
    for group in (g for g in groups if len(g) > 1):
        for place, k in enumerate(group[1:].tolist(), 1):
            for other in group[: min(place, _SAME_CODE)].tolist():
                if is_unique or _apart_m(survey, codes, k, other) <= rules.position_code_radius_m:
                    found.append((k, other))
                    break
    for k, other in sorted(found):
        message = f"row {codes.rows[other] + 1} has the same code {codes.digits[k].decode()}"
        yield Fault(int(codes.rows[k]) + 1, "code", "duplicate_code", message, "leave one of the two out")


def _apart_m(survey: GeoreferencedSurvey, codes: RowCodes, one: int, other: int) -> float:
    placed, (a, b) = survey.placed, (codes.rows[one], codes.rows[other])
    return distance_m(placed.lon_deg[a], placed.lat_deg[a], placed.lon_deg[b], placed.lat_deg[b])


def _check_stored(
    connection: sa.Connection,
    registration: Registration,
    family: Family[Any, Any],
    codes: RowCodes,
    survey: GeoreferencedSurvey,
    defaults: Any,
) -> Iterator[Fault]:
    assert family.survey is not None
    agency_id, rules = registration.agency_id, registration.rules
    for start in range(0, len(codes.rows), _PART):
        part = codes.of(slice(start, start + _PART))
        stored: dict[str, list[CodeRow]] = defaultdict(list)
        texts = [digits.decode() for digits in part.digits.tolist()]
        for known in bulk.list_by_digits(connection, family.name, texts):
            stored[known.digits].append(known)
        for row, text in zip(part.rows.tolist(), texts, strict=True) if stored else ():
            place = float(survey.placed.lon_deg[row]), float(survey.placed.lat_deg[row])
            for known in stored.get(text, ()):
                if family.survey.collides(codes, defaults, place, known, agency_id, rules):
                    own = known.agency_id == agency_id
                    whose = f"marker {known.id}" if own else "a marker of another agency"
                    proposal = "declare compare if the survey measures it, or give another code"
                    yield Fault(row + 1, "code", "code_taken", f"the code {text} is taken by {whose}", proposal)
                    break
