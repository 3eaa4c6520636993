"""Surveys come in: read in a decoder process, checked, compared with the registry, stored in one transaction.

`Imports.run` is the whole path. Checks add what they find to the faults of the survey's table; what is stored, and
whether anything is, follows from the faults of each row.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import sqlalchemy as sa

from app.errors import InvalidParameter
from app.families import get_family
from app.families.family import Registration
from app.families.surveys import PLANNED, MarkerRules, RowCodes, Rows, SurveyImport
from app.formats.surveys.roles import CodeForm
from app.formats.surveys.table import Fault, Faults, Severity, warn
from app.markers.reading import MarkerRow
from app.planning.alignment import format_station
from app.registry import markers as store
from app.registry.audit import AuditEntry, EntryRow, find_head, recording
from app.registry.bulk_load import LARGE, Columns
from app.registry.column_types import new_ids
from app.registry.database import Database
from app.services.access.access import Caller
from app.services.access.audit import author_of
from app.services.documents import kind_of_change, kind_of_new
from app.services.idempotency import IdempotencyKey, find_earlier, write_once
from app.services.ports import Clock, DecoderProcesses
from app.services.roads.documents import linear_references
from app.services.surveys.import_report import (
    ALL,
    SURVEY_IMPORTS,
    DeclarationIn,
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

READ, SETTLED = 0.3, 0.5
"""How far an import is when its file was read, and when it goes to store what is good."""
_BUSY_WAIT_S = 10.0
_PART = 2000  # rows that are stored at a time
_MEASURES_AGREE_M = 5.0  # [m] between a measure that a survey states and that of the position; posts stand so exactly
_ALWAYS_WARNED = {"place_by_area_only"}  # every survey of a new road gets this warning, however well it is declared


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
        now = self._clock()
        if earlier := find_earlier(self._database, caller.agency_id, key, now):
            return earlier, True
        table = self._processes.run(
            read_survey_file, given.file, given.declaration, _code_form(given), wait_s=_BUSY_WAIT_S
        )
        if table.vertical_datum != given.declaration.vertical_datum:  # that of the file's CRS
            known = given.declaration.model_copy(update={"vertical_datum": table.vertical_datum})
            given = replace(given, declaration=known)
        table, grid = apply_local_grid(table, given.declaration)
        table = without_rows(table, given.declaration.leave_out)
        survey = georeference_survey(table, given.declaration, self._rules.crs_accuracy_m)
        step(READ)
        registration = Registration(caller.agency_id, now, self._rules, self._database)
        running = _Import(caller, given, survey, grid, registration)
        running.check_rows()
        with self._database.read() as connection:
            checked = running.check_against_registry(connection)
        step(SETTLED)
        if given.declaration.dry_run:
            with self._database.read() as connection:
                prepared = running.prepare(connection, checked)
            return running.report("checked", prepared), False
        if running.is_hopeless:
            return running.report("refused"), False
        ttl, is_long = self._rules.idempotency_ttl, table.rows >= LARGE
        with write_once(self._database, caller.agency_id, key, now, ttl, long=is_long) as (connection, answer):
            if answer.replayed:
                return answer.response, True
            prepared = running.prepare(connection, checked)
            if running.is_hopeless or not len(running.good_rows()):
                return running.report("refused", prepared), False
            count = running.store(connection, prepared, stored)
            return answer.store(running.report("stored", prepared, count)), False


def _code_form(request: ImportInput) -> CodeForm:
    declaration = request.declaration
    return SURVEY_IMPORTS[declaration.family].code_form(request.defaults, compare=declaration.compare)


@dataclass(frozen=True, slots=True)
class _Checked:
    """What the registry had when a survey was compared with it."""

    head: EntryRow | None  # last entry of the audit log
    duplicates: frozenset[Fault]  # of rows that were registered already


@dataclass(frozen=True, slots=True)
class _Resurvey:
    """Rows that measure registered markers: each gets a new version with its surveyed place."""

    known: list[MarkerRow]
    comparison: Comparison  # matches rows with `known`


_Prepared = RowCodes | _Resurvey
"""What is stored of the good rows: new markers with these codes, or new places of registered markers."""


@dataclass(frozen=True, slots=True)
class _Import:
    """A survey that is imported, and the steps of its import in their order."""

    caller: Caller
    request: ImportInput
    survey: GeoreferencedSurvey
    grid: LocalGridDocument | None
    registration: Registration

    @property
    def declaration(self) -> DeclarationIn:
        return self.request.declaration

    @property
    def faults(self) -> Faults:
        """What was found so far; each check adds to it."""
        return self.survey.table.faults

    @property
    def points(self) -> SurveyImport[Any]:
        """How points become markers of the declared family."""
        return SURVEY_IMPORTS[self.declaration.family]

    # --- which rows are good, by the faults that were found so far --------------------------------------------------

    def good_rows(self) -> Rows:
        """Indices of the rows that are stored, or would be."""
        if self._refuses_file:
            return np.empty(0, dtype=np.intp)
        rows = self.survey.table.rows
        bad = self.faults.flags(rows, Severity.REFUSED)
        if self.declaration.warnings == "refuse":
            bad |= self.faults.flags(rows, Severity.WARNING)
        return np.flatnonzero(~bad & self.survey.placed.placed)

    @property
    def is_hopeless(self) -> bool:
        """Whether nothing can be stored, whatever the codes are."""
        rows = self.survey.table.rows
        kept_rows = rows - sum(1 <= row <= rows for row in set(self.declaration.leave_out))
        return self._refuses_file or (self.declaration.mode == ALL and len(self.good_rows()) < kept_rows)

    @property
    def _refuses_file(self) -> bool:
        has_warning = bool(self.faults.file_warnings - _ALWAYS_WARNED)
        return self.faults.refuses_file or (self.declaration.warnings == "refuse" and has_warning)

    # --- checks -----------------------------------------------------------------------------------------------------

    def check_rows(self) -> None:
        """Check the rows against each other."""
        stated = self.declaration.survey
        self.faults.add(check_consistency(self.survey))
        self.faults.add(check_accuracy(stated.horizontal_rmse_m, stated.vertical_rmse_m))

    def check_against_registry(self, connection: sa.Connection) -> _Checked:
        """Check the survey against the places of registered markers."""
        agency_id = self.caller.agency_id

        def is_known(lon_deg: float, lat_deg: float) -> bool:
            return store.is_any_near(connection, agency_id, lon_deg, lat_deg, KNOWN_M)

        neighbours, registered = list_neighbours(connection, agency_id, self.survey)
        self.faults.add(check_location(self.survey, self.declaration, neighbours, is_known))
        self.faults.add(self._check_measures(connection))
        duplicates = self._duplicates(registered)
        self.faults.add(duplicates)
        return _Checked(find_head(connection, agency_id), frozenset(duplicates))

    def _check_measures(self, connection: sa.Connection) -> Iterator[Fault]:
        """Rows whose measure is not that of their position on the registered road that they name."""
        placed, measures = self.survey.placed, self.survey.table.numbers.get("measure_m")
        if measures is None:
            return
        named = self.survey.table.texts.get("road")
        known = np.flatnonzero(np.isfinite(measures) & placed.placed)
        for start in range(0, len(known), _PART):
            rows = known[start : start + _PART].tolist()
            places = [
                {
                    "road": (named[row] if named is not None else "") or self.declaration.road,
                    "lon_deg": float(placed.lon_deg[row]),
                    "lat_deg": float(placed.lat_deg[row]),
                }
                for row in rows
            ]
            found = linear_references(connection, self.caller.agency_id, places, measures[rows].tolist())
            for row, reference in zip(rows, found, strict=True):
                at_m = reference.get("measure_m")
                if at_m is not None and abs(at_m - measures[row]) > _MEASURES_AGREE_M:
                    message = f"the measure is {format_station(measures[row])}, the position lies at"
                    message += f" {format_station(at_m)} on the registered road"
                    cure = "check the measure and the road's calibration; rows without a measure get that of the road"
                    yield warn(row + 1, "measure_m", "measure_disagrees", message, cure)

    def _duplicates(self, registered: RegisteredPoints) -> list[Fault]:
        sha256 = self.request.file.sha256
        return list(find_duplicates(self.survey, self.declaration, sha256, registered))

    # --- what is stored ---------------------------------------------------------------------------------------------

    def prepare(self, connection: sa.Connection, checked: _Checked) -> _Prepared:
        """Match the good rows with registered markers, or give them codes.

        The survey is compared again with what was registered since the check.
        """
        if find_head(connection, self.caller.agency_id) != checked.head:
            _, registered = list_neighbours(connection, self.caller.agency_id, self.survey)
            self.faults.add(fault for fault in self._duplicates(registered) if fault not in checked.duplicates)
        return self._match_rows(connection) if self.declaration.compare else self._give_codes(connection)

    def _give_codes(self, connection: sa.Connection) -> RowCodes:
        survey, defaults = self.survey, self.request.defaults
        wanted = np.zeros(survey.table.rows, dtype=bool)
        wanted[self.good_rows()] = True
        self.faults.add(check_values(survey, wanted))
        self.faults.add(self.points.check_values(survey, wanted, self.declaration))
        codes, wrong = self.points.read_codes(survey, self.good_rows(), defaults)
        self.faults.add(wrong)
        family = get_family(self.declaration.family)
        self.faults.add(assign_codes(connection, self.registration, family, codes, survey, defaults))
        return codes.of(np.isin(codes.rows, self.good_rows()))

    def _match_rows(self, connection: sa.Connection) -> _Resurvey:
        """The marker that each row measured: the one that it names, or the nearest."""
        declaration, agency_id = self.declaration, self.caller.agency_id
        known: list[MarkerRow] = []
        matched: npt.NDArray[np.intp] | None = None
        if declaration.match == "code":
            known, matched = self._match_by_code(connection)
        elif (box := survey_box(self.survey)) is not None:
            known = store.list_markers_in(connection, agency_id, declaration.family, box, limit=MAX_NEIGHBOURS)
        epoch = np.array([marker.epoch for marker in known], dtype=np.float64)
        comparison = compare_survey(self.survey, *places_of(known), matched, epoch)
        self.faults.add(check_residuals(comparison, declaration.tolerance_m, declaration.family))
        return _Resurvey(known, comparison)

    def _match_by_code(self, connection: sa.Connection) -> tuple[list[MarkerRow], npt.NDArray[np.intp]]:
        """Markers with the codes of the good rows, and the index of each row's: of several the nearest; -1 without."""
        codes = self.survey.table.texts.get("code")
        if codes is None:
            raise InvalidParameter(
                "the survey has no codes to find its markers by",
                field="declaration.match",
                limit="a column with the role code",
                cure='declare the column, or match "nearest"',
            )
        known = self._find_by_digits(connection, codes)
        by_digits: dict[str, list[int]] = {}
        for index, marker in enumerate(known):
            by_digits.setdefault(marker.digits, []).append(index)
        placed = self.survey.placed
        matched = np.full(self.survey.table.rows, -1, dtype=np.intp)
        used: set[int] = set()
        for row in self.good_rows().tolist():
            candidates = by_digits.get(codes[row], [])
            if candidates:
                lon_deg, lat_deg = placed.lon_deg[row], placed.lat_deg[row]
                nearest = min(candidates, key=lambda k: _square_deg(known[k], lon_deg, lat_deg))
                if nearest in used:
                    self.faults.add([Fault(row + 1, "code", "duplicate_code", "another row has the same code")])
                used.add(nearest)
                matched[row] = nearest
        return known, matched

    def _find_by_digits(self, connection: sa.Connection, codes: Sequence[str]) -> list[MarkerRow]:
        agency_id = self.caller.agency_id
        named = {codes[row] for row in self.good_rows().tolist()} - {""}
        found = store.list_by_digits(connection, self.declaration.family, list(named))
        ids = [row.id for row in found if row.agency_id == agency_id and row.status != "retired"]
        return store.get_markers(connection, agency_id, ids)

    def store(self, connection: sa.Connection, prepared: _Prepared, stored: Callable[[int, int], None]) -> int:
        """Store what was prepared under one entry of the audit log; returns the number of markers."""
        with recording(
            connection,
            self.caller.agency_id,
            author_of(self.caller),
            "import.stored",
            now=self.registration.now,
            subject=self.request.file.sha256,
            detail={"format": self.survey.table.format, "compare": self.declaration.compare},
        ) as entry:
            if isinstance(prepared, _Resurvey):
                return self._store_resurvey(connection, entry, prepared)
            return self._store_new(connection, entry, prepared, stored)

    def _store_new(
        self, connection: sa.Connection, entry: AuditEntry, codes: RowCodes, stored: Callable[[int, int], None]
    ) -> int:
        sha256, now, total = self.request.file.sha256, self.registration.now, len(codes.rows)
        why = self.declaration.reason or f"import of {sha256[:12]}"
        count = 0
        with store.many_markers(connection, total):
            for number, start in enumerate(range(0, total, _PART)):
                part = codes.of(slice(start, start + _PART))
                ids = new_ids(now, len(part.rows), number)
                columns = marker_columns(
                    self.survey,
                    part,
                    self.declaration,
                    self.points,
                    self.request.defaults,
                    ids=ids,
                    now=now,
                    file_sha256=sha256,
                )
                columns = self._with_measures(connection, columns)
                store.add_markers(connection, entry, columns, kind=kind_of_new, why=why)
                count += columns.count
                stored(count, total)
        return count

    def _with_measures(self, connection: sa.Connection, columns: Columns) -> Columns:
        """With the measures and offsets of rows that name a registered road and give no measure."""
        if columns.same.get("road", "") is None:
            return columns
        names = ("road", "lon_deg", "lat_deg")
        rows = [dict(zip(names, row, strict=True)) for row in zip(*map(columns.values, names), strict=True)]
        measures, offsets = columns.values("measure_m"), columns.values("offset_m")
        found = linear_references(connection, self.caller.agency_id, rows, measures)
        for k, reference in enumerate(found):
            if measures[k] is None and reference:
                measures[k], offsets[k] = reference["measure_m"], reference["offset_m"]
        return columns.but(measure_m=measures, offset_m=offsets)

    def _store_resurvey(self, connection: sa.Connection, entry: AuditEntry, resurvey: _Resurvey) -> int:
        """A new version of every marker that a good row measured."""
        sha256, rows = self.request.file.sha256, self.good_rows()
        family = get_family(self.declaration.family)
        surveyed = common_columns(self.survey, rows, self.declaration, file_sha256=sha256).rows()
        markers = [resurvey.known[k] for k in resurvey.comparison.matched[rows].tolist()]
        moved = [{**columns, "road": marker.road} for marker, columns in zip(markers, surveyed, strict=True)]
        references = linear_references(
            connection, self.caller.agency_id, moved, [marker.measure_m for marker in markers]
        )
        count = 0
        for marker, columns, reference in sorted(
            zip(markers, surveyed, references, strict=True), key=lambda item: item[0].id
        ):
            values = {name: value for name, value in columns.items() if name not in _KEPT_BY_RESURVEY} | reference
            values["status"] = self.declaration.status or "surveyed"
            # a marker that is on the road keeps its digits, whatever was planned
            built = marker._replace(status="built" if marker.status == PLANNED else marker.status)
            values |= family.revise(connection, self.registration, built, values)
            store.update_marker(
                connection,
                entry,
                marker.id,
                values,
                version=marker.version,
                kind=kind_of_change(marker.status, values["status"], moved=True),
                why=self.declaration.reason or f"as built, import of {sha256[:12]}",
            )
            count += 1
        return count

    def report(self, outcome: Outcome, prepared: _Prepared | None = None, stored: int = 0) -> ImportReport:
        """What was found, and what was stored of it."""
        comparison = None
        if isinstance(prepared, _Resurvey):
            tolerance_m = self.declaration.tolerance_m
            comparison = comparison_document(prepared.comparison, self.survey, prepared.known, tolerance_m)
        return import_report(
            outcome,
            self.request,
            self.survey,
            good_rows=self.good_rows(),
            stored=stored,
            local_grid=self.grid,
            comparison=comparison,
        )


_KEPT_BY_RESURVEY = ("family", "heading_deg", "heading_rmse_deg", "road", "measure_m", "offset_m")


def _square_deg(marker: MarkerRow, lon_deg: float, lat_deg: float) -> float:
    return (marker.lon_deg - lon_deg) ** 2 + (marker.lat_deg - lat_deg) ** 2
