"""What crews take along: programs of CERPMs, and the drilling sheets of magnets."""

from __future__ import annotations

import base64
import hashlib
from dataclasses import dataclass

import sqlalchemy as sa
from typing_extensions import TypedDict

from app.decoding.recordings import radio_of
from app.encoders.cerpm import MarkerProgram, encode_message, explain_payload, write_programs_csv
from app.encoders.magnet import SheetFormat
from app.errors import InvalidParameter, NotFound
from app.families import get_family
from app.families.cerpm import CERPM, message_of
from app.families.family import AnyFamily
from app.families.surveys import RETIRED
from app.geodesy import UNFIT_TEXT
from app.markers.cerpm import MAX_SEQUENCE, derive_marker_key
from app.markers.reading import MarkerRow
from app.radio.settings import F_PORT
from app.registry import markers
from app.registry import markers as store
from app.registry.database import Database
from app.services.access.access import Caller, Scope
from app.services.access.agency_secrets import AgencySecrets
from app.services.access.audit import log_change
from app.services.markers.searches import Selection, select_markers
from app.services.ports import Clock

# === CERPMs -> what they are programmed with. Who has it can speak for a marker, so it takes a planner's key.


MAX_PROGRAMS = 5_000
_SPEAKERS = (Scope.PLANNER, Scope.ADMIN)


@dataclass(frozen=True, slots=True)
class CerpmPayload:
    """The bytes of one transmission."""

    number: int
    sequence: int
    # `payload`, `key`: the message, and the marker's own key, which never goes out with it
    payload: bytes
    key: bytes
    note: str | None  # what is wrong with the marker's position


class ExplainedDocument(TypedDict):
    """Some bytes of a message and their meaning."""

    offset: int
    length: int
    hex: str
    field: str
    value: str


class PayloadDocument(TypedDict):
    """The message of a marker, byte by byte."""

    number: int
    sequence: int
    hex: str
    base64: str
    lorawan_f_port: int
    bytes: list[ExplainedDocument]
    note: str | None


class CerpmPrograms:
    """Use cases on what CERPMs are programmed with."""

    def __init__(self, database: Database, clock: Clock, secrets: AgencySecrets) -> None:
        self._database = database
        self._clock = clock
        self._secrets = secrets

    def payload(self, caller: Caller, marker_id: str, sequence: int | None = None) -> CerpmPayload:
        """What a marker sends, by default the next transmission after the last that was received.

        Raises
        ------
        NotFound
            There is no such CERPM.
        NotAllowed
            The caller may not speak for markers.
        InvalidParameter
            The sequence does not fit, or is at its end.
        """
        caller.require(_SPEAKERS)
        with self._database.read() as connection:
            row = store.get_marker(connection, caller.agency_id, marker_id)
            if row.family != CERPM.name:
                raise NotFound(f"marker {marker_id} is no CERPM", field="marker_id", limit="CERPMs have a payload")
            agency_key = self._secrets.find_key(connection, caller.agency_id)
            following = _next_sequences(connection, caller.agency_id, [row])
        if agency_key is None:
            agency_key = self._make_key(caller)
        number = int(row.digits)
        chosen = following[number] if sequence is None else sequence
        key = derive_marker_key(agency_key, number)
        payload = encode_message(message_of(row, chosen), key)
        return CerpmPayload(number, chosen, payload, key, _note(row))

    def programs_csv(self, caller: Caller, selection: Selection, *, with_keys: bool = False) -> str:
        """A table for programming a selection of markers, one row each.

        Raises
        ------
        InvalidParameter, NotFound
            No CERPM is selected, or too many, or one is missing.
        NotAllowed
            Keys are asked for by a caller who is no admin.
        """
        caller.require((Scope.ADMIN,) if with_keys else _SPEAKERS)
        agency_id = caller.agency_id
        with self._database.read() as connection:
            rows = select_markers(connection, agency_id, selection, CERPM.name, most=MAX_PROGRAMS)
            agency_key = self._secrets.find_key(connection, agency_id)
            following = _next_sequences(connection, agency_id, rows)
        if agency_key is None:
            agency_key = self._make_key(caller)
        programs = [
            MarkerProgram(
                message_of(row, following[int(row.digits)]),
                derive_marker_key(agency_key, int(row.digits)),
                radio_of(row),
            )
            for row in rows
        ]
        if with_keys:
            numbers = sorted(int(row.digits) for row in rows)
            with self._database.write() as connection:
                log_change(
                    connection,
                    caller,
                    "marker-keys.handed-out",
                    now=self._clock(),
                    markers=len(rows),
                    first=numbers[0],
                    last=numbers[-1],
                )
        return write_programs_csv(programs, with_keys=with_keys)

    def _make_key(self, caller: Caller) -> bytes:
        now = self._clock()
        with self._database.write() as connection:
            if self._secrets.find_key(connection, caller.agency_id) is None:
                log_change(connection, caller, "agency-key.made", now=now)
            return self._secrets.ensure_key(connection, caller.agency_id, now)


def _next_sequences(connection: sa.Connection, agency_id: str, rows: list[MarkerRow]) -> dict[int, int]:
    """The sequence after the last that was received of each marker, by number."""
    numbers = [int(row.digits) for row in rows]
    spans = markers.list_spans(connection, agency_id, numbers)
    following = {n: max((span.last_sequence for span in spans.get(n, ())), default=-1) + 1 for n in numbers}
    worn_out = next((n for n, sequence in following.items() if sequence > MAX_SEQUENCE), None)
    if worn_out is not None:
        raise InvalidParameter(
            f"marker {worn_out} is at the end of its sequence",
            field="sequence",
            limit=f"at most {MAX_SEQUENCE}",
            cure="retire it and register one with a new number",
        )
    return following


def _note(row: MarkerRow) -> str | None:
    if row.status == RETIRED:
        return "the marker is retired: packets from it are not used"
    if row.localization_grade != "unfit":
        return None
    return f"{UNFIT_TEXT}: {row.transform_note}"


def payload_document(payload: CerpmPayload) -> PayloadDocument:
    """A message as hexadecimal and base64 text, with the meaning of its bytes."""
    return {
        "number": payload.number,
        "sequence": payload.sequence,
        "hex": payload.payload.hex(),
        "base64": base64.b64encode(payload.payload).decode(),
        "lorawan_f_port": F_PORT,
        "bytes": [
            {"offset": p.offset, "length": len(p.hex.split()), "hex": p.hex, "field": p.field, "value": p.value}
            for p in explain_payload(payload.payload, payload.key)
        ],
        "note": payload.note,
    }


# === Sheets of markers for the crew: the drilling sheets of magnets.


@dataclass(frozen=True, slots=True)
class LayoutFile:
    """A sheet as a file."""

    content: bytes
    media_type: str
    file_name: str


class Layouts:
    """Use cases on layouts."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def tag(self, caller: Caller, marker_id: str, form: SheetFormat) -> str:
        """A short hash of everything that the sheet depends on.

        Raises
        ------
        NotFound
            There is no such marker, or its family has no layout.
        """
        row, family = self._get(caller, marker_id)
        parts = (family.sheet_version, row.id, row.version, str(form))
        return hashlib.sha256(repr(parts).encode()).hexdigest()[:32]

    def sheet(self, caller: Caller, marker_id: str, form: SheetFormat) -> LayoutFile:
        """Sheet of a marker; raises as `tag`."""
        row, family = self._get(caller, marker_id)
        return LayoutFile(family.write_sheet(row, form), form.media_type, f"{row.id}-r{row.version}.{form}")

    def _get(self, caller: Caller, marker_id: str) -> tuple[MarkerRow, AnyFamily]:
        with self._database.read() as connection:
            row = store.get_marker(connection, caller.agency_id, marker_id)
        family = get_family(row.family)
        if family.sheet_version is None:
            raise NotFound(f"marker {marker_id} has no magnets", field="marker_id", limit="magnets have a layout")
        return row, family
