"""What the CERPMs of a plan are programmed with, without keys: those are derived on the server when markers exist."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import orjson

from app.encoders.cerpm.program import MAX_PROGRAMS, MarkerProgram, write_programs_csv
from app.errors import InvalidParameter
from app.markers.cerpm import HEIGHT_M, KEY_BYTES, CerpmMessage
from app.planning.plan import Plan, PlannedCerpm, PlannedMarker
from app.planning.plan_checks.cerpms import radio_settings
from app.radio.settings import RadioSettings

_NO_KEY = bytes(KEY_BYTES)  # stands for the marker's own, which is never written here
PROGRAMS_FORMAT = "waymark-cerpm-programs/1"


def plan_programs(plan: Plan) -> tuple[MarkerProgram, ...]:
    """Programs of all CERPMs of a plan, with the first message of each; empty without CERPMs.

    Raises
    ------
    InvalidParameter
        There are more than 100,000.
    """
    cerpms = [marker for marker in plan.markers if isinstance(marker.detail, PlannedCerpm)]
    if not cerpms or plan.rules.cerpm is None:
        return ()
    if len(cerpms) > MAX_PROGRAMS:
        raise InvalidParameter(
            f"the plan has {len(cerpms)} CERPMs",
            field="plan",
            limit=f"{MAX_PROGRAMS} in one list",
            cure="plan the road in sections",
        )
    radio = plan.radio or radio_settings(plan) or RadioSettings()
    datum = plan.alignment.vertical_datum
    return tuple(MarkerProgram(_message(marker, datum), _NO_KEY, radio) for marker in cerpms)


def _message(marker: PlannedMarker, vertical_datum: str | None) -> CerpmMessage:
    """A message holds heights above the ellipsoid only."""
    detail = marker.detail
    assert isinstance(detail, PlannedCerpm)
    height = marker.height_m if vertical_datum == "ellipsoid" else None
    if height is not None and not HEIGHT_M[0] <= height <= HEIGHT_M[1]:
        height = None
    return CerpmMessage(
        detail.number, marker.lon_deg, marker.lat_deg, height, detail.side, detail.speed_limit, sequence=0
    )


def write_plan_programs_csv(programs: Sequence[MarkerProgram]) -> bytes:
    """The programming list as CSV in UTF-8, without keys."""
    return write_programs_csv(programs).encode()


def write_plan_programs_json(plan: Plan, programs: Sequence[MarkerProgram]) -> bytes:
    """The programming list as JSON, without keys: the radio's settings once, and number and message of each marker."""
    document: dict[str, Any] = {
        "format": PROGRAMS_FORMAT,
        "plan": plan.name,
        "keys": "not included: the server derives each marker's key when the plan is committed",
        "radio": programs[0].radio if programs else None,
        "markers": [
            {
                "number": program.message.number,
                "side": program.message.side.name.lower(),
                "lon_deg": program.message.lon_deg,
                "lat_deg": program.message.lat_deg,
                "height_m": program.message.height_m,
                "body_hex": program.body.hex(),
                "sequence_start": program.message.sequence,
            }
            for program in programs
        ],
    }
    return orjson.dumps(document, option=orjson.OPT_INDENT_2)
