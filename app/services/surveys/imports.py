"""Surveys come in: read in a decoder process, checked, held against the registry, stored in one transaction."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import partial
from typing import Any

import numpy as np
import sqlalchemy as sa

from app.errors import InvalidParameter
from app.families import FAMILIES, FAMILY_NAMES, get_family
from app.families.family import Family, Registration
from app.families.surveys import PLANNED, MarkerRules, RowCodes, Rows
from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.roles import CodeForm
from app.formats.surveys.table import Fault, Severity
from app.registry import markers as bulk
from app.registry import markers as store
from app.registry.audit import AuditEntry, EntryRow, find_head, recording
from app.registry.bulk_load import LARGE, Columns
from app.registry.column_types import new_ids
from app.registry.database import Database
from app.registry.marker_rows import MarkerRow
from app.services.access.access import Caller
from app.services.access.audit import author_of
from app.services.documents import kind_of_change, kind_of_new
from app.services.idempotency import IdempotencyKey, find_earlier, write_once
from app.services.ports import Clock, DecoderProcesses
from app.services.roads.documents import linear_references
from app.services.surveys.import_report import (
    ALL,
    Found,
    ImportInput,
    ImportReport,
    Outcome,
    comparison_document,
    import_report,
)
from app.services.surveys.import_rows import (
    MAX_NEIGHBOURS,
    assign_codes,
    check_values,
    common_columns,
    list_neighbours,
    marker_columns,
    places_of,
    survey_box,
)
from app.services.surveys.tasks import read_survey_file
from app.surveys.comparison import Comparison, RegisteredPoints, check_residuals, compare_survey, find_duplicates
from app.surveys.consistency_checks import check_accuracy, check_consistency
from app.surveys.georeference import (
    GeoreferencedSurvey,
    LocalGridDocument,
    apply_local_grid,
    georeference_survey,
    without_rows,
)
from app.surveys.location_checks import KNOWN_M, check_location

SURVEYED = tuple(name for name, family in zip(FAMILY_NAMES, FAMILIES, strict=True) if family.survey is not None)
"""Families whose markers can be imported from points."""
READ, SETTLED = 0.3, 0.5
"""How far an import is when its file was read, and when it goes to store what is good."""
_BUSY_WAIT_S = 10.0
_PART = 2000
_ACCURACY = ("horizontal_rmse_m", "vertical_rmse_m", "check_points")
_STANDING = "place_by_area_only"
"""The caution that every survey of a new road gets, however well it is declared."""


class Imports:
    """Use cases on imports, one transaction each."""

    def __init__(self, database: Database, clock: Clock, processes: DecoderProcesses, rules: MarkerRules) -> None:
        self._database = database
        self._clock = clock
        self._processes = processes
        self._rules = rules

    def run(
        self,
        caller: Caller,
        given: ImportInput,
        key: IdempotencyKey | None = None,
        step: Callable[[float], None] = lambda progress: None,
        stored: Callable[[int, int], None] = lambda rows, total: None,
    ) -> tuple[ImportReport, bool]:
        """Import a survey, or say what an import would do.

        Parameters
        ----------
        caller, given, key
        step : callable, optional
            Called with `READ` when the file was read, and with `SETTLED` before anything is stored, outside of any
            transaction; what it raises stops the import.
        stored : callable, optional
            Called with the rows that are stored and all that will be, inside the transaction.

        Returns
        -------
        report : dict
            `outcome` is ``checked`` (dry run), ``stored`` or ``refused``; nothing is stored of what is refused.
        replayed : bool

        Raises
        ------
        UnreadableUpload, UnsupportedUpload, InvalidParameter, ReferenceSystemError
            The file, the declaration, or both together cannot be used.
        Unavailable
            The decoder processes are busy.
        """
        _check_family(given.declaration)
        now = self._clock()
        if earlier := find_earlier(self._database, caller.agency_id, key, now):
            return earlier, True
        table = self._processes.run(
            read_survey_file, given.file, given.declaration, _code_form(given), wait_s=_BUSY_WAIT_S
        )
        table, grid = apply_local_grid(table, given.declaration)
        table = without_rows(table, given.declaration.leave_out)
        survey = georeference_survey(table, given.declaration, self._rules.crs_accuracy_m)
        step(READ)
        registration = Registration(caller.agency_id, now, self._rules, self._database)
        running = _Running(caller, given, survey, grid, registration, given.file.sha256)
        with self._database.read() as connection:
            running.check(connection)
        step(SETTLED)
        if given.dry_run:
            with self._database.read() as connection:
                running.prepare(connection)
            return running.report("checked"), False
        if running.is_hopeless:
            return running.report("refused"), False
        ttl, is_long = self._rules.idempotency_ttl, survey.table.rows >= LARGE
        with write_once(self._database, caller.agency_id, key, now, ttl, long=is_long) as (connection, answer):
            if answer.replayed:
                return answer.response, True
            running.prepare(connection)
            if running.is_refused:
                return running.report("refused"), False
            running.store(connection, get_family(given.declaration.family), stored)
            return answer.store(running.report("stored")), False


class _Running:
    """An import between its steps."""

    def __init__(
        self,
        caller: Caller,
        given: ImportInput,
        survey: GeoreferencedSurvey,
        grid: LocalGridDocument | None,
        registration: Registration,
        sha256: str,
    ) -> None:
        self._caller, self._given, self._survey, self._now = caller, given, survey, registration.now
        self._grid = grid
        self._sha256, self._registration, self._rules = sha256, registration, registration.rules
        self._faults = survey.table.faults
        self._faults.add(check_consistency(survey))
        self._faults.add(check_accuracy(*(given.declaration.survey.get(name) for name in _ACCURACY[:2])))
        self._codes: RowCodes | None = None
        self._defaults = _defaults(given)
        self._known: list[MarkerRow] = []
        self._comparison: Comparison | None = None
        self._stored = 0
        self._duplicates: set[Fault] = set()
        self._checked_head: EntryRow | None = None

    def check(self, connection: sa.Connection) -> None:
        """Hold the survey against the registry's places."""
        neighbours, registered = list_neighbours(connection, self._caller.agency_id, self._survey)
        is_known = partial(self._is_known, connection)
        self._faults.add(check_location(self._survey, self._given.declaration, neighbours, is_known))
        self._add_duplicates(connection, registered)

    def _add_duplicates(self, connection: sa.Connection, registered: RegisteredPoints) -> None:
        """Add the faults of what is registered, once each."""
        self._checked_head = find_head(connection, self._caller.agency_id)
        found = find_duplicates(self._survey, self._given.declaration, self._sha256, registered)
        new = [fault for fault in found if fault not in self._duplicates]
        self._duplicates.update(new)
        self._faults.add(new)

    def prepare(self, connection: sa.Connection) -> None:
        """What would be stored; compared again with what was registered since `check`."""
        if find_head(connection, self._caller.agency_id) != self._checked_head:
            self._add_duplicates(connection, list_neighbours(connection, self._caller.agency_id, self._survey)[1])
        good = self._good_rows()
        if self._given.declaration.compare:
            self._compare(connection, good)
            return
        family, survey = get_family(self._given.declaration.family), self._survey
        assert family.survey is not None  # `run` refuses the others
        wanted = np.zeros(survey.table.rows, dtype=bool)
        wanted[good] = True
        self._faults.add(check_values(survey, wanted))
        self._faults.add(family.survey.check_values(survey, wanted, self._given.declaration))
        codes, wrong = family.survey.read_codes(survey, self._good_rows(), self._defaults)
        self._faults.add(wrong)
        self._faults.add(assign_codes(connection, self._registration, family, codes, survey, self._defaults))
        self._codes = codes.of(np.isin(codes.rows, self._good_rows()))

    @property
    def is_hopeless(self) -> bool:
        """Whether nothing can be stored, whatever the codes are."""
        return self._refuses_file or (self._given.mode == ALL and len(self._good_rows()) < self._kept_rows)

    @property
    def _kept_rows(self) -> int:
        rows = self._survey.table.rows
        return rows - sum(1 <= row <= rows for row in set(self._given.declaration.leave_out))

    @property
    def is_refused(self) -> bool:
        """Whether nothing is to be stored."""
        return self.is_hopeless or not len(self._good_rows())

    def store(
        self, connection: sa.Connection, family: Family[Any, Any], stored: Callable[[int, int], None]
    ) -> None:  # fmt: skip
        """Store what was prepared."""
        if self._given.declaration.compare:
            self._resurvey(connection, family)
            return
        assert self._codes is not None
        why = self._given.reason or f"import of {self._sha256[:12]}"
        total = len(self._codes.rows)
        survey_import = family.survey
        assert survey_import is not None
        with self._recording(connection) as entry, bulk.many_markers(connection, total):
            for number, start in enumerate(range(0, total, _PART)):
                part = self._codes.of(slice(start, start + _PART))
                ids = new_ids(self._now, len(part.rows), number)
                columns = marker_columns(
                    self._survey, part, self._given.declaration, survey_import, self._defaults,
                    ids=ids, now=self._now, file_sha256=self._sha256,
                )  # fmt: skip
                columns = self._measured(connection, columns)
                bulk.add_markers(connection, entry, columns, kind=kind_of_new, why=why)
                self._stored += columns.count
                stored(self._stored, total)

    def report(self, outcome: Outcome) -> ImportReport:
        """What was found, and what was stored of it."""
        found = Found(
            self._given, self._survey, self._faults, self._good_rows(), self._stored, self._grid,
            comparison_document(
                self._comparison, self._survey, self._known, self._given.declaration.tolerance_m
            ),
        )  # fmt: skip
        return import_report(outcome, found)

    # --- steps ------------------------------------------------------------------------------------------------------

    @property
    def _refuses_file(self) -> bool:
        strict = self._given.refuse_warnings and self._faults.file_warnings - {_STANDING}
        return self._faults.refuses_file or bool(strict)

    def _good_rows(self) -> Rows:
        if self._refuses_file:
            return np.empty(0, dtype=np.intp)
        rows = self._survey.table.rows
        bad = self._faults.flags(rows, Severity.REFUSED)
        if self._given.refuse_warnings:
            bad |= self._faults.flags(rows, Severity.WARNING)
        return np.flatnonzero(~bad & self._survey.placed.placed)

    def _is_known(self, connection: sa.Connection, lon_deg: float, lat_deg: float) -> bool:
        return bulk.is_any_near(connection, self._caller.agency_id, lon_deg, lat_deg, KNOWN_M)

    def _compare(self, connection: sa.Connection, good: Rows) -> None:
        declaration = self._given.declaration
        codes = self._survey.table.texts.get("code")
        if declaration.match == "code" and codes is None:
            raise InvalidParameter(
                "the survey has no codes to find its markers by",
                field="declaration.match",
                limit="a column with the role code",
                cure='declare the column, or match "nearest"',
            )
        matched: Any = None
        if declaration.match == "code":
            assert codes is not None
            matched = self._by_code(connection, codes, good)
        elif (box := survey_box(self._survey)) is not None:
            self._known = bulk.list_markers_in(
                connection, self._caller.agency_id, declaration.family, box, limit=MAX_NEIGHBOURS
            )
        lon, lat, height = places_of(self._known)
        epoch = np.array([marker.epoch for marker in self._known], dtype=np.float64)
        self._comparison = compare_survey(self._survey, lon, lat, height, matched, epoch)
        self._faults.add(check_residuals(self._comparison, declaration.tolerance_m, declaration.family))

    def _by_code(self, connection: sa.Connection, codes: Sequence[str], good: Rows) -> Any:
        """Index of the marker that each row names: of several with the same digits the nearest."""
        named = {codes[row] for row in good.tolist()}
        family, agency_id = self._given.declaration.family, self._caller.agency_id
        found = bulk.list_by_digits(connection, family, [code for code in named if code])
        ids = [row.id for row in found if row.agency_id == agency_id and row.status != "retired"]
        self._known = store.get_markers(connection, agency_id, ids)
        by_digits: dict[str, list[int]] = {}
        for index, marker in enumerate(self._known):
            by_digits.setdefault(marker.digits, []).append(index)
        placed = self._survey.placed
        matched = np.full(self._survey.table.rows, -1, dtype=np.intp)
        used: set[int] = set()
        for row in good.tolist():
            candidates = by_digits.get(codes[row], [])
            if candidates:
                lon, lat = placed.lon_deg[row], placed.lat_deg[row]
                best = min(candidates, key=lambda k: _square_deg(self._known[k], lon, lat))
                if best in used:
                    self._faults.add([Fault(row + 1, "code", "duplicate_code", "another row has the same code")])
                used.add(best)
                matched[row] = best
        return matched

    def _measured(self, connection: sa.Connection, columns: Columns) -> Columns:
        """With the measures and offsets of rows that name a registered road and give no measure."""
        if columns.same.get("road", "") is None:
            return columns
        names = ("road", "lon_deg", "lat_deg")
        rows = [dict(zip(names, row, strict=True)) for row in zip(*map(columns.values, names), strict=True)]
        measures, offsets = columns.values("measure_m"), columns.values("offset_m")
        found = linear_references(connection, self._caller.agency_id, rows, [None] * columns.count)
        for k, reference in enumerate(found):
            if measures[k] is None and reference:
                measures[k], offsets[k] = reference["measure_m"], reference["offset_m"]
        return columns.but(measure_m=measures, offset_m=offsets)

    def _resurvey(self, connection: sa.Connection, family: Family[Any, Any]) -> None:
        """A new version of every marker that a good row measured."""
        assert self._comparison is not None
        rows = self._good_rows()
        surveyed = common_columns(self._survey, rows, self._given.declaration, file_sha256=self._sha256).rows()
        markers = [self._known[k] for k in self._comparison.matched[rows].tolist()]
        kept_measures = [marker.measure_m for marker in markers]
        moved = [{**columns, "road": marker.road} for marker, columns in zip(markers, surveyed, strict=True)]
        measured = linear_references(connection, self._caller.agency_id, moved, kept_measures)
        found = sorted(zip(markers, surveyed, measured, strict=True), key=lambda item: item[0].id)
        with self._recording(connection) as entry:
            for marker, columns, reference in found:
                kept = ("family", "heading_deg", "heading_rmse_deg", "road", "measure_m", "offset_m")
                values = {name: v for name, v in columns.items() if name not in kept} | reference
                values["status"] = self._given.declaration.status or "surveyed"
                # what stands on the road keeps its digits, whatever was planned
                built = marker._replace(status="built" if marker.status == PLANNED else marker.status)
                values |= family.revise(connection, self._registration, built, values)
                store.update_marker(
                    connection,
                    entry,
                    marker.id,
                    values,
                    version=marker.version,
                    kind=kind_of_change(marker.status, values["status"], moved=True),
                    why=self._given.reason or f"as built, import of {self._sha256[:12]}",
                )
                self._stored += 1

    def _recording(self, connection: sa.Connection) -> AbstractContextManager[AuditEntry]:
        """The entry of the audit log that stands for the whole import."""
        return recording(
            connection,
            self._caller.agency_id,
            author_of(self._caller),
            "import.stored",
            now=self._now,
            subject=self._sha256,
            detail={"format": self._survey.table.format, "compare": self._given.declaration.compare},
        )


def _square_deg(marker: MarkerRow, lon_deg: float, lat_deg: float) -> float:
    return (marker.lon_deg - lon_deg) ** 2 + (marker.lat_deg - lat_deg) ** 2


def _defaults(given: ImportInput) -> Any:
    """What the survey's markers have in common; the family's own defaults where nothing is declared."""
    survey = get_family(given.declaration.family).survey
    return survey.defaults({}) if given.defaults is None and survey is not None else given.defaults


def _code_form(given: ImportInput) -> CodeForm:
    survey = get_family(given.declaration.family).survey
    assert survey is not None  # `_check_family` refuses the others
    return survey.code_form(_defaults(given), compare=given.declaration.compare)


def _check_family(declaration: ImportDeclaration) -> None:
    if declaration.family not in SURVEYED:
        raise InvalidParameter(
            f"{declaration.family[:40]!r} cannot be imported from points",
            field="declaration.family",
            limit=", ".join(SURVEYED),
            cure="register markers of the other families one by one or in bulk: POST /v1/markers",
        )
