"""The family of CERPMs: their numbers, the properties that they broadcast, and their radio."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import sqlalchemy as sa

from app.errors import CodeTaken
from app.families.cerpm.documents import CerpmDocument, cerpm_document
from app.families.cerpm.inputs import CERPM_EXAMPLES, CerpmChange, CerpmIn
from app.families.cerpm.message import message_of, speed_limit_document
from app.families.cerpm.planned import PlannedCerpms
from app.families.cerpm.registration import NewCerpm
from app.families.cerpm.snapshot import CerpmSnapshot
from app.families.cerpm.survey import CerpmSurvey
from app.families.family import Family, Registration, map_point
from app.families.positions import place_input, position_columns
from app.geodesy import PlacedPosition
from app.planning.outputs.hd_map import MapMarker
from app.registry import cerpms
from app.registry.cerpm_runs import CerpmRuns
from app.registry.marker_rows import MarkerRow
from app.registry.rows import row_of


class Cerpms(Family[NewCerpm, PlacedPosition]):
    """The family of chip-enabled raised pavement markers."""

    name = "cerpm"
    label = "CERPM"
    title = "CERPMs"
    schema = CerpmIn
    examples = CERPM_EXAMPLES
    change = CerpmChange
    snapshot = CerpmSnapshot()
    survey = CerpmSurvey()
    planned = PlannedCerpms()
    lines = CerpmRuns()
    document_type = CerpmDocument
    detail_type = CerpmDocument

    def prepare(self, registration: Registration, new: NewCerpm) -> PlacedPosition:
        """The marker's place in WGS 84."""
        return place_input(new.position, registration.rules.crs_accuracy_m)

    def columns(
        self, connection: sa.Connection, registration: Registration, new: NewCerpm, prepared: PlacedPosition
    ) -> dict[str, Any]:
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
            "spec": {
                "side": new.side.name.lower(),
                "speed_limit": speed_limit_document(new.speed_limit),
                "dev_eui": new.dev_eui,
                "radio": asdict(new.radio),
            },
        }
        message_of(row_of(MarkerRow, columns))
        return columns

    def revise(
        self, connection: sa.Connection, registration: Registration, row: MarkerRow, values: dict[str, Any]
    ) -> dict[str, Any]:
        """The spec after a change.

        Raises
        ------
        InvalidParameter
            It does not fit a message.
        """
        spec = {**row.spec, **values.get("spec", {})}
        message_of(row._replace(**{**values, "spec": spec}))
        return {"spec": spec}

    def feature_members(self, properties: Mapping[str, Any]) -> dict[str, Any]:
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


CERPM = Cerpms()
