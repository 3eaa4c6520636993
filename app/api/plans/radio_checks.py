"""/v1/radio-checks: whether markers along a road can be read in time, and lawfully."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from fastapi import Response
from pydantic import ConfigDict, Field, JsonValue, with_config

from app.api.http.dependencies import Caller
from app.api.http.permissions import READERS
from app.api.http.responses import document_response, json_response
from app.api.http.routes import Router
from app.inputs import Flag
from app.planning.radio_checks import RadioCheck, RadioPlan, check_radio

router = Router("/v1/radio-checks", "cerpms")

_EXAMPLES: list[JsonValue] = [
    {"radio": {"spreading_factor": 7, "bandwidth_hz": 500_000, "interval_s": 2.0}, "design_speed_m_s": 13.4},
    {
        "region": "EU868",
        "radio": {"frequency_hz": 868_300_000, "bandwidth_hz": 125_000, "interval_s": 10.0, "power_dbm": 11.0},
        "road": {"spacing_m": 24.384, "sides": 1},
        "recommend": True,
    },
]


@with_config(ConfigDict(extra="forbid", json_schema_extra={"examples": _EXAMPLES}))
@dataclass(frozen=True, slots=True)
class RadioCheckIn(RadioPlan):
    """A plan to check."""

    recommend: Annotated[
        Flag, Field(description="Also search for lawful settings that reach it; takes a second or two.")
    ] = False


@router.post("", READERS, expensive=True, responses=document_response(RadioCheck))
def post_radio_check(wanted: RadioCheckIn, caller: Caller) -> Response:
    """Check the radios of CERPMs on a road.

    Law, link, collisions, reading in time, battery. Nothing is stored.
    """
    return json_response(check_radio(wanted, recommend=wanted.recommend))
