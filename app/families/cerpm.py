"""The family of chip-enabled raised pavement markers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Annotated, Any, Literal, get_args

import numpy as np
import sqlalchemy as sa
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, JsonValue
from typing_extensions import TypedDict

from app.decoding.recordings import side_of, speed_limit_of
from app.errors import CodeTaken, InvalidParameter
from app.families.documents import (
    FamilyChange,
    Headed,
    MarkerDocument,
    MarkerIn,
    PositionIn,
    marker_head,
    marker_place,
    place_input,
    position_columns,
)
from app.families.family import Family, Registration, map_point
from app.families.surveys import (
    ColumnValues,
    Commitment,
    MarkerRules,
    PlannedRow,
    RowCodes,
    Rows,
    SurveyImport,
    listed_codes,
    texts_of,
    unknown_texts,
)
from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.roles import CodeForm
from app.formats.surveys.table import Fault
from app.geodesy import PlacedPosition
from app.geodesy.frames import ecef_from_wgs84
from app.markers.cerpm import HEIGHT_M, MAX_NUMBER, CerpmMessage, LaneSide, SpeedLimit
from app.markers.reading import MarkerRow
from app.planning.outputs.hd_map import MapMarker
from app.planning.plan import PlannedCerpm, PlannedMarker
from app.radio.settings import RadioSettings, assign_places
from app.registry import markers as cerpms
from app.registry.bulk_load import Columns
from app.registry.column_types import row_of
from app.registry.lines import CerpmRuns
from app.registry.marker_rows import CodeRow, markers
from app.surveys.georeference import GeoreferencedSurvey
from app.values import Bools

# === The row of a CERPM as values of the core: what it sends, its side, its speed limit and its radio.


def message_of(row: MarkerRow, sequence: int = 0) -> CerpmMessage:
    """The message that a CERPM sends; with its height only if that is above the ellipsoid.

    Raises
    ------
    InvalidParameter
        It does not fit a message.
    """
    ellipsoidal = row.vertical_datum in (None, "ellipsoid")
    return CerpmMessage(
        number=int(row.digits),
        lon_deg=row.lon_deg,
        lat_deg=row.lat_deg,
        height_m=row.height_m if ellipsoidal else None,
        side=side_of(row),
        speed_limit=speed_limit_of(row),
        sequence=sequence,
    )


# === Schemas of requests that register or change CERPMs.


Side = Literal["left", "right", "unknown"]
Line = Annotated[str, Field(min_length=1, max_length=300)]
LINE_TEXT = "Line of its road on which it stands: CERPMs with the same road and line are on one line."
DevEui = Annotated[str, Field(pattern=r"^[0-9a-fA-F]{16}$"), AfterValidator(str.lower)]


CERPM_EXAMPLES: list[JsonValue] = [
    {
        "family": "cerpm",
        "position": {
            "lon_deg": -85.6436,
            "lat_deg": 42.2531,
            "height_m": 236.4,
            "realization": "ITRF2014",
            "horizontal_rmse_m": 0.02,
            "vertical_rmse_m": 0.02,
            "survey_method": "GNSS RTK",
        },
        "number": 17,
        "side": "right",
        "speed_limit": {"value": 25, "unit": "mph"},
        "radio": {"interval_s": 2.0, "spreading_factor": 7, "bandwidth_hz": 500_000},
        "status": "surveyed",
        "road": "Parkview Campus Drive",
    }
]


class CerpmIn(Headed, MarkerIn):
    """A chip-enabled raised pavement marker to register."""

    model_config = ConfigDict(json_schema_extra={"examples": CERPM_EXAMPLES})

    family: Literal["cerpm"]
    position: PositionIn
    number: Annotated[int, Field(strict=True, ge=1, le=MAX_NUMBER)] | None = Field(
        None, description="Within the agency; the next free one if left out."
    )
    side: Side = Field("unknown", description="Boundary of the lane that it is on, in the direction of travel.")
    line: Line | None = Field(None, description=f"{LINE_TEXT} The commit of a plan names it.")
    speed_limit: SpeedLimit | None = Field(None, description="As it is posted; nothing where none is.")
    dev_eui: DevEui | None = Field(None, description="LoRaWAN DevEUI, where the marker joins a network.")
    radio: RadioSettings = Field(default_factory=RadioSettings)


class CerpmChange(FamilyChange):
    """Members of a change that CERPMs have."""

    side: Side = Field("unknown", description="Of a CERPM.")
    line: Line | None = Field(None, description="Of a CERPM.")
    speed_limit: SpeedLimit | None = Field(None, description="Of a CERPM.")
    dev_eui: DevEui | None = Field(None, description="Of a CERPM.")
    radio: RadioSettings = Field(
        default_factory=RadioSettings, description="Of a CERPM; replaces the whole of the old."
    )


# === CERPMs as clients see them.


class CerpmCodeDocument(TypedDict):
    """What identifies a CERPM within its agency."""

    scheme: Literal["cerpm"]
    text: str
    number: int


class CerpmDocument(MarkerDocument):
    """A CERPM."""

    family: Literal["cerpm"]
    code: CerpmCodeDocument
    side: Side
    line: str | None
    speed_limit: SpeedLimit | None
    dev_eui: str | None
    radio: RadioSettings


def cerpm_document(row: MarkerRow) -> CerpmDocument:
    """A CERPM's row as clients see it."""
    spec = row.spec
    return {
        **marker_head(row),
        "family": "cerpm",
        "code": {"scheme": "cerpm", "text": row.digits, "number": int(row.digits)},
        "side": spec["side"],
        "line": spec.get("line"),
        "speed_limit": spec["speed_limit"],
        "dev_eui": spec["dev_eui"],
        "radio": spec["radio"],
        **marker_place(row),
    }


# === Surveys of CERPMs.


class CerpmSurveyIn(BaseModel):
    """Members of a survey's declaration that CERPMs have."""

    side: Side = Field("unknown", description="Of CERPMs without one of their own.")
    line: Line | None = Field(None, description=f"Of all CERPMs of the file. {LINE_TEXT}")
    speed_limit: SpeedLimit | None = Field(None, description="Of CERPMs.")


class CerpmSurvey(SurveyImport[CerpmSurveyIn]):
    """Points that become CERPMs: rows without a number get the next ones of the agency."""

    members = CerpmSurveyIn

    def defaults(self, declared: Mapping[str, object]) -> CerpmSurveyIn:
        """Side and speed limit."""
        return CerpmSurveyIn.model_validate(declared)

    def check_values(
        self, survey: GeoreferencedSurvey, wanted: Bools, declaration: ImportDeclaration
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

    def code_form(self, defaults: CerpmSurveyIn, *, compare: bool) -> CodeForm:
        """Numbers."""
        return CodeForm("[1-9][0-9]{0,9}", True, "numbers of CERPMs")

    def read_codes(
        self, survey: GeoreferencedSurvey, rows: Rows, defaults: CerpmSurveyIn
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
        defaults: CerpmSurveyIn,
        place: tuple[float, float],
        known: CodeRow,
        agency_id: str,
        rules: MarkerRules,
    ) -> bool:
        """Only with CERPMs of the same agency."""
        return known.agency_id == agency_id

    def columns(self, survey: GeoreferencedSurvey, codes: RowCodes, defaults: CerpmSurveyIn) -> Columns:
        """The spec, by the side of the row."""
        specs = _specs(defaults)
        same: dict[str, object] = {"scheme": codes.scheme}
        own: dict[str, Sequence[object]] = {}
        if "side" in survey.table.texts:
            own["spec"] = [specs[side.lower() or defaults.side] for side in texts_of(survey, codes.rows, "side")]
        else:
            same["spec"] = specs[defaults.side]
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


def _specs(defaults: CerpmSurveyIn) -> dict[str, dict[str, object]]:
    """What CERPMs of each side keep; rows share these, and none changes them."""
    return {side: _spec(side, defaults.speed_limit, RadioSettings(), line=defaults.line) for side in get_args(Side)}


def _spec(
    side: str,
    speed_limit: SpeedLimit | None,
    radio: RadioSettings,
    *,
    line: str | None = None,
    dev_eui: str | None = None,
) -> dict[str, object]:
    """What the row of a CERPM has in its column `spec`; later surveys keep it."""
    limit = None if speed_limit is None else {"value": speed_limit.value, "unit": speed_limit.unit.value}
    return {"side": side, "line": line, "speed_limit": limit, "dev_eui": dev_eui, "radio": asdict(radio)}


def line_in_plan(plan_id: str, marker: PlannedMarker) -> str:
    """Name of the line that a planned CERPM marks: a boundary of the first lane of its plan that has this boundary."""
    return f"{plan_id} {marker.lane} {'left' if marker.offset_m > 0 else 'right'}".strip()


def _placed_radios(commitment: Commitment, markers: Sequence[PlannedMarker]) -> list[RadioSettings]:
    """The radio of each marker of a plan: in slots with a place that no marker near it has."""
    radio = commitment.radio
    if radio.slots is None:
        return [radio] * len(markers)
    lanes = {lane.name: lane for lane in commitment.alignment.lanes}
    at_m = [float(lanes[one.lane].value_at(lanes[one.lane].station_m, one.chainage_m)) for one in markers]
    along = sorted(range(len(markers)), key=lambda k: at_m[k])
    lon_deg, lat_deg = (np.array([getattr(markers[k], name) for k in along]) for name in ("lon_deg", "lat_deg"))
    places = assign_places(ecef_from_wgs84(lon_deg, lat_deg), radio.slots.capacity)
    place_of = dict(zip(along, places.tolist(), strict=True))
    return [replace(radio, place=place_of[k]) for k in range(len(markers))]


# === The family of CERPMs: their numbers, the properties that they broadcast, and their radio.


_SPAN = ("first_sequence", "last_sequence", "first_heard_s", "last_heard_s")


class Cerpms(Family[CerpmIn, PlacedPosition]):
    """The family of chip-enabled raised pavement markers."""

    name = "cerpm"
    label = "CERPM"
    title = "CERPMs"
    schema = CerpmIn
    examples = CERPM_EXAMPLES
    change = CerpmChange
    in_snapshots_when_retired = True  # whoever has the keys of a retired one can still send
    survey = CerpmSurvey()
    lines = CerpmRuns()
    document_type = CerpmDocument
    detail_type = CerpmDocument

    def prepare(self, registration: Registration, new: CerpmIn) -> PlacedPosition:
        """The marker's place in WGS 84."""
        return place_input(new.position, registration.rules.crs_accuracy_m)

    def columns(
        self, connection: sa.Connection, registration: Registration, new: CerpmIn, prepared: PlacedPosition
    ) -> ColumnValues:
        """Number, place and spec.

        Raises
        ------
        InvalidParameter
            It does not fit a message.
        CodeTaken
            Another marker carries the number, or once did.
        """
        number = new.number
        if number is None:
            number = cerpms.last_number(connection, registration.agency_id) + 1
        elif (other := cerpms.find_number(connection, registration.agency_id, number)) is not None:
            raise CodeTaken(
                f"the number {number} is marker {other.id}'s",
                field="number",
                limit="a number names one marker of its agency for ever",
                cure="leave the number out and the next free one is assigned",
            )
        columns = {
            "family": self.name,
            "scheme": self.name,
            "digits": str(number),
            "heading_deg": new.heading_deg,
            **position_columns(new.position, prepared),
            "spec": _spec(new.side, new.speed_limit, new.radio, line=new.line, dev_eui=new.dev_eui),
        }
        message_of(row_of(MarkerRow, columns))
        return columns

    def revise(
        self, connection: sa.Connection, registration: Registration, row: MarkerRow, values: ColumnValues
    ) -> ColumnValues:
        """The spec after a change.

        Raises
        ------
        InvalidParameter
            It does not fit a message.
        """
        spec = {**row.spec, **values.get("spec", {})}
        message_of(row._replace(**{**values, "spec": spec}))
        return {"spec": spec}

    def feature_members(self, properties: Mapping[str, object]) -> dict[str, object]:
        """The number."""
        if "code" not in properties:
            return {}
        digits = str(properties["code"])
        return {"number": int(digits) if digits.isascii() and digits.isdigit() and len(digits) < 20 else digits}

    def document(self, row: MarkerRow) -> CerpmDocument:
        """A CERPM."""
        return cerpm_document(row)

    def map_markers(self, row: MarkerRow) -> Sequence[MapMarker]:
        """A point, with the side of the lane that it is on."""
        side = row.spec["side"]
        return (map_point(row, kind="" if side == "unknown" else side),)

    def taken_numbers(self, agency_id: str, known: Iterable[CodeRow]) -> set[int]:
        """A number names one CERPM of its agency."""
        return {int(row.digits) for row in known if row.agency_id == agency_id}

    def planned_rows(self, commitment: Commitment, markers: Sequence[PlannedMarker]) -> Iterator[PlannedRow]:
        """One row for each CERPM; in slots each with its place."""
        radios = _placed_radios(commitment, markers)
        for marker, radio in zip(markers, radios, strict=True):
            detail = marker.detail
            assert isinstance(detail, PlannedCerpm)
            line = line_in_plan(commitment.plan_id, marker)
            spec = _spec(detail.side.name.lower(), detail.speed_limit, radio, line=line)
            columns = {"scheme": "cerpm", "digits": str(detail.number), "spec": spec}
            yield PlannedRow(marker.number, commitment.position(marker) | columns)

    def snapshot_columns(self) -> tuple[sa.ColumnElement[Any], ...]:
        """Side, speed limit and interval."""
        spec = markers.c.spec
        radio = spec["radio"]
        return (
            spec["side"].as_string().label("side"),
            spec["speed_limit"].label("speed_limit"),
            radio["interval_s"].as_float().label("interval_s"),
            radio["jitter_share"].as_float().label("jitter_share"),
        )

    def snapshot_kind(self, row: MarkerRow) -> dict[str, object]:
        """Side, speed limit and the shortest interval between two transmissions."""
        spec = row.spec
        min_interval_s = spec["interval_s"] * (1 - spec["jitter_share"])
        return {"side": spec["side"], "speed_limit": spec["speed_limit"], "min_interval_s": min_interval_s}

    def snapshot_members(
        self, connection: sa.Connection, agency_id: str, codes: Sequence[str]
    ) -> Mapping[str, Sequence[object]]:
        """First and last transmission that was received from each."""
        received = cerpms.list_span_ends(connection, agency_id, map(int, codes))
        ends = [received.get(int(code)) for code in codes]
        return {name: [None if end is None else getattr(end, name) for end in ends] for name in _SPAN}


CERPM = Cerpms()
