"""Bodies of requests on drives."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field

from app.api.http.dependencies import Identifier, Number, Text
from app.errors import InvalidParameter
from app.families.inputs import Flag, StrictModel
from app.services.drives.collect import DEFAULT_CLOCK_SIGMA_S, DecodeClock
from app.services.drives.drives import MAX_DECODES, NewDrive
from app.tracks.types import MAX_CLOCK_SIGMA_S, TrackRules

_RULES = TrackRules()


class DriveDecodeIn(StrictModel):
    """A decode of a drive, and its sensor's clock."""

    id: Identifier
    clock: Annotated[Text, Field(min_length=1, max_length=80)] | None = Field(
        None, description="Name of the clock; decodes with the same name share one. Without it, each has its own."
    )
    offset_s: Annotated[Number, Field(ge=-1e7, le=1e7)] = Field(
        0.0, description="To be added to the times of the decode, where the clock was set wrong."
    )
    clock_sigma_s: Annotated[Number, Field(ge=0, le=MAX_CLOCK_SIGMA_S)] = Field(
        DEFAULT_CLOCK_SIGMA_S, description="How far the clock may be off; 0: it is exact, no offset is estimated."
    )


class DriveOptionsIn(StrictModel):
    """How the track is estimated."""

    rate_hz: Annotated[Number, Field(ge=0.1, le=10)] = Field(_RULES.rate_hz, description="Of the positions.")
    max_sigma_m: Annotated[Number, Field(ge=0.05, le=100)] = Field(
        _RULES.max_sigma_m, description="Where a standard deviation is larger, the track has a gap."
    )
    outlier_probability: Annotated[Number, Field(ge=1e-9, le=0.1)] = Field(
        _RULES.outlier_probability, description="Share of good markers that the gate may leave out."
    )
    speed_scale_sigma: Annotated[Number, Field(ge=1e-4, le=0.2)] = Field(
        _RULES.speed_scale_sigma, description="Scale error of the vehicle's speed to be expected."
    )
    heading_bias_sigma_deg: Annotated[Number, Field(ge=0.01, le=30)] = Field(
        _RULES.heading_bias_sigma_deg, description="Bias of the vehicle's heading to be expected."
    )
    use_unfit: Flag = Field(False, description="Use positions that are not for localization, too.")


class DriveIn(StrictModel):
    """A drive to make of decodes that are done."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "name": "L 560, Monday morning",
                    "decodes": [
                        {"id": "019cb624-0000-7000-8000-0000000000aa", "clock": "bar", "clock_sigma_s": 0.1},
                        {"id": "019cb624-0000-7000-8000-0000000000ab", "clock": "camera", "offset_s": -0.2},
                    ],
                    "options": {"rate_hz": 5, "max_sigma_m": 1.0},
                }
            ]
        }
    )

    name: Annotated[Text, Field(min_length=1, max_length=80)] | None = None
    vehicle: Annotated[Text, Field(max_length=80)] | None = Field(None, description="Name or id of the vehicle.")
    decodes: Annotated[list[DriveDecodeIn], Field(min_length=1, max_length=MAX_DECODES)]
    options: DriveOptionsIn = Field(default_factory=DriveOptionsIn)

    def drive(self) -> NewDrive:
        """The drive to make.

        Raises
        ------
        InvalidParameter
            A decode is named twice.
        """
        ids = [entry.id for entry in self.decodes]
        twice = next((k for k, name in enumerate(ids) if name in ids[:k]), None)
        if twice is not None:
            raise InvalidParameter(
                f"decode {ids[twice]} is named twice", field=f"decodes.{twice}.id", limit="each decode once"
            )
        options = self.options.model_dump()
        use_unfit = options.pop("use_unfit")
        clocks = tuple(
            DecodeClock(entry.id, entry.clock or entry.id, entry.offset_s, entry.clock_sigma_s)
            for entry in self.decodes
        )
        return NewDrive(clocks, self.name, self.vehicle, TrackRules(**options), use_unfit)
