"""Terms of a proof: how many drives, of which vehicles, in which conditions; and the units that it is divided into."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, field_validator

from app.errors import InvalidParameter
from app.planning.plan import Plan
from app.planning.rules import CameraRules

Whole = Annotated[int, Field(strict=True)]
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]


class Condition(StrEnum):
    """A condition of a drive; several are joined with ``+``, as in ``night+rain``."""

    DAY = "day"
    NIGHT = "night"
    RAIN = "rain"
    SHADE = "shade"
    WEAR = "wear"
    DIRT = "dirt"


class UnitKind(StrEnum):
    """What the vehicle reads in a unit of the proof."""

    PLATES = "plates"
    TAGS = "tags"
    LINE = "line"
    LANE = "lane"


class ProofTerms(BaseModel):
    """What is driven, and how. The same plan, terms and seed give the same result.

    `lost_share` of the markers are missing, drawn anew for each drive. Drives take the conditions in turn, and the
    cameras in turn after each round of conditions. The uncertainty of a survey is radial, as in the registry.
    """

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)

    drives: Whole = Field(default=6, ge=1, le=10_000)
    seed: Whole = Field(default=1, ge=0, le=2**31 - 1)
    conditions: tuple[str, ...] = Field(
        default=("day",), min_length=1, max_length=20, description="Of the drives in turn; `night+rain` is both."
    )
    cameras: tuple[str, ...] | None = Field(
        default=None, min_length=1, max_length=10, description="Names in the rules; without, all of them."
    )
    speed_share: Number = Field(default=1.0, ge=0.1, le=1.5, description="Of the design speed.")
    lost_share: Number = Field(default=0.0, ge=0.0, le=0.9, description="Of the markers, missing in a drive.")
    clearance_m: Number = Field(default=0.16, ge=0.05, le=0.6, description="Of the magnetometers above the road.")
    survey_rmse_m: Number = Field(default=0.03, ge=0.0, le=2.0, description="Of the registered positions, horizontal.")
    max_markers_per_drive: Whole = Field(
        default=40, ge=1, le=1_000_000, description="Plates and tags each; more are sampled by strata."
    )
    max_sections_per_drive: Whole = Field(
        default=6, ge=1, le=100_000, description="Stretches of line magnets and of lanes with CERPMs each."
    )
    weak_below: Number = Field(default=0.9, gt=0.0, le=1.0, description="Read rate below which a marker is weak.")

    @field_validator("conditions")
    @classmethod
    def _known(cls, conditions: tuple[str, ...]) -> tuple[str, ...]:
        for text in conditions:
            parse_conditions(text)
        return conditions


def parse_conditions(text: str) -> frozenset[Condition]:
    """The conditions of a drive, e.g. of ``night+rain``; ``day`` is what the others are added to.

    Raises
    ------
    InvalidParameter
        A name is unknown.
    """
    names = [part.strip() for part in text.split("+")]
    unknown = [name for name in names if name not in list(Condition)]
    if unknown:
        raise InvalidParameter(
            f"{unknown[0][:40]!r} is no condition",
            field="conditions",
            limit=", ".join(Condition),
            cure="name one of these, or join several with +",
        )
    return frozenset(Condition(name) for name in names)


@dataclass(frozen=True, slots=True)
class ProofUnit:
    """A part of the proof that is computed apart from the others, in any order and in any process.

    Attributes
    ----------
    kind : UnitKind
    drive : int
        From 0.
    lane : str
    markers : tuple of int
        Numbers of the plates or tags that are driven over; empty for the others.
    from_m, to_m : float
        Stretch of the lane that is driven for line magnets and CERPMs. [m]
    weight : tuple of float
        Of each marker: how many of its stratum it stands for; one value for a stretch.
    """

    kind: UnitKind
    drive: int
    lane: str
    markers: tuple[int, ...] = ()
    from_m: float = 0.0
    to_m: float = 0.0
    weight: tuple[float, ...] = (1.0,)

    @property
    def key(self) -> str:
        """Identifies the unit among those of the same plan and terms."""
        start = str(self.markers[0]) if self.markers else f"{self.from_m:.2f}"
        return f"{self.drive}/{self.kind}/{self.lane}/{start}"


@dataclass(frozen=True, slots=True)
class DriveTerms:
    """What is the same along one drive.

    Attributes
    ----------
    drive : int
    condition : str
        As in the terms.
    camera : CameraRules
    """

    drive: int
    condition: str
    camera: CameraRules


def drive_terms(plan: Plan, terms: ProofTerms, drive: int) -> DriveTerms:
    """Condition and camera of a drive: they take turns.

    Raises
    ------
    InvalidParameter
        The rules have no camera of this name.
    """
    condition = terms.conditions[drive % len(terms.conditions)]
    known = {camera.name: camera for camera in plan.rules.cameras}
    names = terms.cameras if terms.cameras is not None else tuple(known)
    name = names[drive // len(terms.conditions) % len(names)]
    if name not in known:
        raise InvalidParameter(
            f"the rules have no camera {name[:60]!r}",
            field="cameras",
            limit=", ".join(known)[:300],
            cure="name a camera of the rules",
        )
    return DriveTerms(drive, condition, known[name])
