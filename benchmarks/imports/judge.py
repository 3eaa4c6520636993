"""What became of a survey: stored clean, warned or refused; and how far the fault moves its markers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from pydantic import ValidationError
from pyproj import CRS

from app.errors import WaymarkError
from app.families.surveys import MarkerRules
from app.formats.format import SpooledFile
from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.read import read_survey
from app.registry.database import Database
from app.services.access.access import Access, Caller, Scope
from app.services.decoder_tasks import SameProcess
from app.services.surveys.import_report import DeclarationIn, ImportInput, ImportReport, import_input
from app.services.surveys.imports import Imports
from app.surveys.georeference import east_north_m, georeference_survey
from benchmarks.imports.faults import Planted
from benchmarks.imports.surveys import Survey

STANDING = ("place_unchecked", "place_by_area_only")
"""Warnings that a sound survey gets too where there is nothing to check it against."""
VERDICTS = ("refused", "warned", "standing caution only", "missed")


@dataclass(frozen=True)
class Judgement:
    """What became of a file."""

    verdict: str
    codes: tuple[str, ...]
    moved_m: float


class Judge:
    """Imports into one registry, an agency a survey."""

    def __init__(self, database: Database) -> None:
        self._access = Access(database, now)
        self._imports = Imports(database, now, SameProcess(), MarkerRules())
        self._count = 0

    def caller(self, survey: Survey) -> Caller:
        """An agency that has what the survey says is registered."""
        self._count += 1
        caller = self._access.authenticate(self._access.create_key(f"agency {self._count}", Scope.PLANNER, "bench"))
        if survey.registered:
            lines = ["number,lon,lat,height", *(",".join(map(repr, map(_plain, row))) for row in survey.registered)]
            # the survey's coordinates are made by PROJ's null shifts: what is registered is in the datum of the survey
            geodetic = CRS(survey.crs).geodetic_crs
            assert geodetic is not None
            crs = ":".join(geodetic.to_2d().to_authority() or ())
            declaration = DeclarationIn(
                crs=crs, family="cerpm", vertical_datum="ellipsoid", columns={"code": "number"}, status="active",
                mode="good",
            )  # fmt: skip
            given = import_input(declaration, SpooledFile.of("\n".join(lines).encode()))
            report, _ = self._imports.run(caller, given)
            assert report["stored"] == len(survey.registered), report["faults"][:3]
        return caller

    def codes(self, caller: Caller, data: bytes, declaration: dict[str, Any]) -> tuple[bool, Counter[str]]:
        """Whether something is refused, and the faults by code."""
        try:
            given = import_input(DeclarationIn(**declaration, dry_run=True), SpooledFile.of(data))
            report, _ = self._imports.run(caller, given)
        except ValidationError as error:
            return True, Counter(str(part) for part in error.errors()[0]["loc"][:1])
        except WaymarkError as error:
            return True, Counter([error.field or "file"])
        refused = any(fault["severity"] == "refused" for fault in report["faults"])
        return refused, Counter(report["counts"])

    def store(self, caller: Caller, given: ImportInput) -> tuple[ImportReport, bool]:
        """Import a file."""
        return self._imports.run(caller, given)

    def judge(self, planted: Planted) -> Judgement:
        """What a fault leads to beyond what the clean survey leads to."""
        caller = self.caller(planted.survey)
        _, clean = self.codes(caller, planted.survey.csv(), planted.survey.declaration)
        refused, found = self.codes(caller, planted.data, planted.declaration)
        new = found - clean
        moved = moved_m(planted)
        if refused:
            return Judgement("refused", tuple(new), moved)
        if any(code not in STANDING for code in new):
            return Judgement("warned", tuple(new), moved)
        standing = any(code in STANDING for code in found)
        return Judgement("standing caution only" if standing else "missed", tuple(new), moved)


def moved_m(planted: Planted) -> float:
    """How far the fault moves a marker at most, across or up; NaN where rows are no longer the same. [m]"""
    try:
        declaration = ImportDeclaration(**planted.declaration)
        placed = georeference_survey(read_survey(planted.data, declaration), declaration, 0.1)
    except (WaymarkError, ValidationError):
        return float("nan")
    survey = planted.survey
    place_of = {code: k for k, code in enumerate(survey.codes)}
    codes = placed.table.texts["code"]
    true = np.array([place_of.get(code or "", -1) for code in codes])
    origin = (float(survey.lon_deg[0]), float(survey.lat_deg[0]))
    here = east_north_m(placed.placed.lon_deg, placed.placed.lat_deg, origin)
    there = east_north_m(survey.lon_deg[true], survey.lat_deg[true], origin)
    across = np.hypot(here[0] - there[0], here[1] - there[1])
    up = np.abs(placed.height_m - survey.height_m[true])
    moved = np.fmax(across, up)[(true >= 0) & np.isfinite(across)]
    return float(moved.max()) if len(moved) else float("nan")


@contextmanager
def open_judge() -> Iterator[Judge]:
    """A judge over an empty registry."""
    with TemporaryDirectory() as folder:
        database = Database(f"sqlite:///{Path(folder) / 'bench.sqlite3'}")
        database.open()
        try:
            database.migrate()
            yield Judge(database)
        finally:
            database.close()


def _plain(value: Any) -> Any:
    return int(value) if isinstance(value, str) else value


def now() -> datetime:
    return datetime.now(UTC)
