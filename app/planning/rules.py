"""Rules of a plan: one YAML 1.2 or JSON document, checked here; its JSON Schema is generated from these classes.

Speeds are in km/h and lengths in metres, as road agencies write them. Three examples: docs/plans/rules-*.yaml.
"""

from __future__ import annotations

from datetime import date
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from app.formats.alignments.geometry import EventKind
from app.markers.plate import PlateScheme
from app.markers.recommended_plate import RECOMMENDED_SCHEME, recommended_geometry
from app.radio.lorawan import Region

SpeedKmh = Annotated[float, Field(ge=2.0, le=250.0)]
SCHEMA_ID = "https://waymark.example/schemas/rules-1.json"


class _Part(BaseModel):
    """A part of the rules: unknown keys, NaN and infinities are refused."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True, strict=False)


class AppliesTo(_Part):
    """Roads that the rules are made for; a road outside of it is refused."""

    road_class: Literal["rural", "urban", "motorway", "work_zone", "any"] = "any"
    speed_kmh: tuple[SpeedKmh, SpeedKmh] = (2.0, 250.0)

    @model_validator(mode="after")
    def _ordered(self) -> AppliesTo:
        if self.speed_kmh[0] > self.speed_kmh[1]:
            raise ValueError("speed_kmh is [lowest, highest]")
        return self


class RoadRules(_Part):
    """What the file with the road may leave open."""

    lanes: list[str] | None = Field(default=None, description="Names of the lanes that get markers; without, all.")
    design_speed_kmh: SpeedKmh | None = Field(
        default=None, description="For lanes without a speed in the file; with `override_speed`, for all."
    )
    override_speed: bool = False
    lane_width_m: float = Field(default=3.5, ge=1.5, le=12.0, description="For lanes without a width in the file.")
    curve_radius_m: float = Field(
        default=400.0, ge=5.0, le=5000.0, description="Bends with a smaller radius are announced as curves."
    )
    curve_turn_deg: float = Field(default=10.0, ge=1.0, le=180.0, description="Bends that turn less are no curves.")


class Ahead(_Part):
    """Distance ahead of an event: by reaction and deceleration at the design speed, or fixed."""

    before: Literal["stopping_distance", "reaction_distance"] | float = "stopping_distance"
    reaction_s: float = Field(default=2.5, ge=0.0, le=10.0)
    deceleration_mps2: float = Field(default=3.4, ge=0.5, le=10.0)
    min_before_m: float = Field(default=20.0, ge=0.0, le=1000.0)


class DecisionPoints(Ahead):
    """Events ahead of which a plate is placed."""

    at: list[EventKind] = [EventKind.STOP_LINE, EventKind.JUNCTION, EventKind.CURVE]


class PlateRules(_Part):
    """Plates in the middle of the lane."""

    scheme: PlateScheme = Field(default=RECOMMENDED_SCHEME, description="`id` unless plates carry their position.")
    n: Literal[8, 10, 12] = Field(default=8, description="Units along a side; 10 by default for `position-robust`.")
    unit_mm: float = Field(default=35.0, ge=20.0, le=50.0, description="27 by default for `position-robust`.")
    gap_mm: float = Field(default=5.0, ge=2.0, le=10.0)
    thickness_mm: float = Field(default=20.0, ge=5.0, le=50.0)
    spacing_m: float = Field(default=100.0, ge=5.0, le=5000.0)
    offset_from_centre_m: float = Field(default=0.0, ge=-2.0, le=2.0, description="Left positive.")
    min_frames: int = Field(default=2, ge=1, le=100, description="Frames per pass in which the plate is readable.")
    max_grade: float = Field(default=0.08, ge=0.0, le=0.3, description="Rise per distance on which plates are placed.")

    @model_validator(mode="before")
    @classmethod
    def _size_of_scheme(cls, rules: object) -> object:
        if not isinstance(rules, dict) or rules.get("scheme") != PlateScheme.POSITION_ROBUST:
            return rules
        usual = recommended_geometry(PlateScheme.POSITION_ROBUST)
        rules = {"n": usual.n, **rules}
        return {"unit_mm": usual.unit_mm, **rules} if rules["n"] == usual.n else rules

    @model_validator(mode="after")
    def _size_exists(self) -> PlateRules:
        if self.n not in self.scheme.sizes:
            raise ValueError(f"{self.scheme} has {' or '.join(map(str, self.scheme.sizes))} units along a side: set n")
        return self


class LineRules(_Part):
    """Line magnets along the painted lines of a lane."""

    solid: Literal["N", "S"] | None = "N"
    dashed: Literal["N", "S"] | None = "S"
    max_spacing_m: float = Field(default=6.0, ge=0.5, le=6.0)
    along: Literal["painted_line"] = "painted_line"
    sides: Literal["left", "right", "both"] = "both"
    offset_m: float = Field(default=0.0, ge=-0.5, le=0.5, description="From the painted line, left positive.")


class TagRules(Ahead):
    """Information tags ahead of events, with the meaning that the event has there."""

    at: list[EventKind] = [EventKind.STOP_LINE, EventKind.ARROW, EventKind.CURVE, EventKind.SPEED_LIMIT]
    before: Literal["stopping_distance", "reaction_distance"] | float = "reaction_distance"
    length_m: float = Field(default=4.0, ge=1.0, le=20.0)
    segment_m: float = Field(default=0.5, ge=0.05, le=2.0)
    magnets: int = Field(default=3, ge=2, le=7)
    clearance_class: str = Field(default="utility", description="Kind of vehicle that must be served.")
    codebook: str | None = Field(default=None, description="Name of the agency's codebook; without, a new one.")


class CerpmRules(_Part):
    """CERPMs on the boundaries of a lane, by the cycle N of the markings."""

    marking_rules: str = Field(default="us-mutcd-11", description="Key in app/planning/data/marking_rules.json.")
    sides: Literal["both", "left", "right"] = "both"
    n_m: float | None = Field(default=None, ge=1.0, le=50.0, description="Cycle N; without, that of the marking rules.")
    straight: float = Field(default=2.0, ge=0.1, le=4.0, description="Spacing on straights, in cycles.")
    curve: float = Field(default=1.0, ge=0.1, le=4.0, description="Spacing in curves, in cycles.")
    max_path_error_m: float | None = Field(default=0.05, ge=0.005, le=1.0)
    preview_m: float | None = Field(default=None, ge=1.0, le=2000.0)
    collisions_max: float = Field(default=0.1, ge=0.0, le=1.0)
    region: Region | None = Field(
        default=None,
        description="Whose rules the radio is checked by. Without, US915; the check names the law of the place.",
    )
    spreading_factor: int | None = Field(default=None, ge=7, le=12, description="Without, recommended settings.")
    bandwidth_hz: Literal[125_000, 250_000, 500_000] = 500_000
    interval_s: float | None = Field(default=None, ge=0.05, le=3600.0, description="Without, recommended settings.")

    @model_validator(mode="after")
    def _radio_complete(self) -> CerpmRules:
        if (self.spreading_factor is None) != (self.interval_s is None):
            raise ValueError("give both spreading_factor and interval_s, or neither for recommended settings")
        return self


class AvoidRules(_Part):
    """Areas in which nothing is installed."""

    layers: list[str] = Field(default=["joints", "manholes", "crossings", "bridges"])
    clearance_m: float = Field(default=0.5, ge=0.0, le=50.0)
    max_shift_m: float = Field(default=5.0, ge=0.0, le=100.0, description="How far a marker may move to stay clear.")


class Temporary(_Part):
    """Dates between which the markers are on the road."""

    from_: date = Field(alias="from")
    to: date

    @model_validator(mode="after")
    def _ordered(self) -> Temporary:
        if self.from_ > self.to:
            raise ValueError("`from` is after `to`")
        return self


class CameraRules(_Part):
    """A camera for which plates must be readable."""

    name: str = Field(default="camera", min_length=1, max_length=80)
    width_px: int = Field(default=1920, ge=160, le=8192)
    height_px: int = Field(default=1080, ge=120, le=8192)
    horizontal_fov_deg: float = Field(default=70.0, ge=10.0, le=150.0)
    height_m: float = Field(default=1.57, ge=0.2, le=5.0)
    depression_deg: float = Field(default=23.0, ge=0.0, le=90.0)
    frames_per_s: float = Field(default=30.0, ge=1.0, le=1000.0)
    exposure_s: float = Field(default=0.001, ge=1e-6, le=0.1)
    rolling_shutter_s: float = Field(default=0.0, ge=0.0, le=0.1, description="Time from the first to the last row.")


_CONDITION = "(day|night|rain|shade|wear|dirt)"


class PredictionRules(_Part):
    """Circumstances for which the checks predict read rates and path errors."""

    conditions: list[Annotated[str, Field(pattern=rf"^{_CONDITION}(\+{_CONDITION})*$", max_length=60)]] = Field(
        default=["day"], min_length=1, max_length=20, description="As in a proof; several are joined: night+rain."
    )
    speed_share: float = Field(default=1.0, ge=0.1, le=1.5, description="Of the design speed.")
    lost_share: float = Field(default=0.0, ge=0.0, le=0.9, description="Share of the markers that are missing.")
    clearance_m: float = Field(default=0.16, ge=0.05, le=0.6, description="Of the magnetometers above the road.")
    survey_rmse_m: float = Field(default=0.03, ge=0.0, le=2.0, description="Of the registered positions, horizontal.")
    min_read_rate: float = Field(default=0.9, ge=0.0, le=1.0, description="Lower predicted read rates are reported.")


class Quality(_Part):
    """Required of the finished road; the optimiser finds the cheapest plan that has it."""

    fix_every_m: float = Field(default=100.0, ge=1.0, le=5000.0)
    fix_probability: float = Field(default=0.99, ge=0.5, le=0.9999)
    fix_error_m: float = Field(default=0.10, ge=0.005, le=5.0)
    path_error_m: float | None = Field(default=None, ge=0.005, le=1.0)
    budget: float | None = Field(default=None, gt=0.0, description="In the currency of the costs.")


class CostItem(_Part):
    """One entry of the agency's price list."""

    item: str = Field(min_length=1, max_length=80)
    per: Literal["plate", "magnet", "tag", "cerpm", "hole", "marker", "metre_of_lane", "day", "plan"] = Field(
        description="What the price is multiplied by; days come from `per_day`."
    )
    price: float = Field(ge=0.0, le=1e9)
    pay_item: str | None = Field(default=None, max_length=40)
    source: str = Field(default="", max_length=200)


class Costs(_Part):
    """The agency's unit costs. There are no published unit prices, so there are no defaults."""

    currency: str = Field(default="USD", pattern="^[A-Z]{3}$")
    items: list[CostItem] = []
    markers_per_day: float | None = Field(default=None, gt=0.0, description="Markers that a crew installs in a day.")


class Installation(_Part):
    """Holes for magnets, for drawings and sheets; data of the agency and of the magnets' supplier."""

    hole_diameter_mm: float | None = Field(
        default=None, ge=22.0, le=200.0, description="A bare METRO magnet of 15 x 15 x 9.5 mm needs at least 22 mm."
    )
    hole_depth_mm: float | None = Field(
        default=None, ge=10.0, le=300.0, description="From the road's surface to the bottom of the hole."
    )


class Tolerances(_Part):
    """As-built against plan; data of the agency."""

    along_m: float = Field(default=0.05, gt=0.0, le=10.0)
    across_m: float = Field(default=0.05, gt=0.0, le=10.0)
    heading_deg: float = Field(default=2.0, gt=0.0, le=180.0)


class PlanRules(_Part):
    """Rules of a plan."""

    version: Literal[1]
    name: str = Field(default="rules", min_length=1, max_length=80)
    applies: AppliesTo = AppliesTo()
    road: RoadRules = RoadRules()
    plates: PlateRules | None = None
    decision_points: DecisionPoints | None = None
    lines: LineRules | None = None
    tags: TagRules | None = None
    cerpm: CerpmRules | None = None
    avoid: AvoidRules = AvoidRules()
    temporary: Temporary | None = None
    cameras: list[CameraRules] = Field(default=[CameraRules()], min_length=1, max_length=10)
    predictions: PredictionRules = PredictionRules()
    quality: Quality | None = None
    costs: Costs = Costs()
    installation: Installation = Installation()
    tolerances: Tolerances = Tolerances()

    @model_validator(mode="after")
    def _cameras_differ(self) -> PlanRules:
        names = [camera.name for camera in self.cameras]
        if len(set(names)) < len(names):
            raise ValueError("two cameras have the same name: findings and proofs name the camera")
        return self

    @model_validator(mode="after")
    def _has_markers(self) -> PlanRules:
        if self.plates is None and self.lines is None and self.tags is None and self.cerpm is None:
            raise ValueError("the rules place nothing: give at least one of plates, lines, tags, cerpm")
        if self.decision_points is not None and self.plates is None:
            raise ValueError("decision_points are places of plates: give plates too")
        return self
