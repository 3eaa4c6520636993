"""Rules of a plan: one YAML 1.2 or JSON document, checked here; its JSON Schema is generated from these classes.

Speeds are in km/h and lengths in metres, as road agencies write them. Three examples: docs/plans/rules-*.yaml.
"""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import date
from enum import StrEnum
from functools import cache, lru_cache
from importlib import resources
from itertools import islice
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import ErrorDetails
from ruamel.yaml import YAML
from ruamel.yaml.constructor import SafeConstructor
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.tokens import (
    AliasToken,
    BlockEndToken,
    BlockMappingStartToken,
    BlockSequenceStartToken,
    FlowMappingEndToken,
    FlowMappingStartToken,
    FlowSequenceEndToken,
    FlowSequenceStartToken,
    TagToken,
    Token,
)

from app.errors import InvalidParameter, MalformedRequest, UnreadableUpload, naming
from app.formats.alignments.geometry import EventKind
from app.formats.json_text import check_values, parse_json
from app.markers.magnet import Installation
from app.markers.magnet_design import TagDesign
from app.markers.plate import RECOMMENDED_SCHEME, PlateGeometry, PlateScheme, recommended_geometry
from app.planning.magnet_checks import WHEEL_CIRCUMFERENCE_M, check_circumference, vehicle_clearances
from app.radio.settings import RadioSettings, Region
from app.values import JsonObject

# === Marking cycles per country and edition, as data with citations: app/planning/data/marking_rules.json.


@dataclass(frozen=True, slots=True)
class MarkingRules:
    """The cycle N of the markings of a country in an edition of its manual."""

    key: str
    title: str
    country: str
    edition: str
    cycle_m: float  # [m] distance from the start of a line segment to the next one, or between studs
    # `straight_cycles`, `curve_cycles`: spacing of raised markers that guide, in cycles
    straight_cycles: float
    curve_cycles: float


@lru_cache(maxsize=1)
def list_marking_rules() -> dict[str, MarkingRules]:
    """All rules by key."""
    document = json.loads((resources.files("app.planning") / "data" / "marking_rules.json").read_text("utf-8"))
    found = {}
    for key, rule in document["rules"].items():
        cycles = rule["positioning_guide_cycles"]
        found[key] = MarkingRules(
            key, rule["title"], rule["country"], rule["edition"], rule["cycle_m"], cycles["straight"], cycles["curve"]
        )
    return found


def marking_rules(key: str) -> MarkingRules:
    """Rules by their key.

    Raises
    ------
    InvalidParameter
        There are none with this key.
    """
    found = list_marking_rules().get(key)
    if found is None:
        known = ", ".join(list_marking_rules())
        raise InvalidParameter(
            f"there are no marking rules {key[:40]!r}",
            field="cerpm.marking_rules",
            limit=known,
            cure="choose one of these, and give n_m if the agency has another cycle",
        )
    return found


# === Rules of a plan.


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
    deceleration_m_s2: float = Field(default=3.4, ge=0.5, le=10.0)
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


class TagSize(StrEnum):
    """Size of information tags: METRO's, or longer ones for higher speeds (METRO section 10)."""

    STREET = "street"
    FREEWAY = "freeway"

    @property
    def lengths_m(self) -> tuple[float, float]:
        """Length and segment. [m] Source: METRO section 7.1; docs/plans.md has the codes by speed."""
        return (4.0, 0.5) if self is TagSize.STREET else (12.0, 1.0)


class TagRules(Ahead):
    """Information tags ahead of events, with the meaning that the event has there."""

    at: list[EventKind] = [EventKind.STOP_LINE, EventKind.ARROW, EventKind.CURVE, EventKind.SPEED_LIMIT]
    before: Literal["stopping_distance", "reaction_distance"] | float = "reaction_distance"
    size: TagSize = Field(default=TagSize.STREET, description="Sets `length_m` and `segment_m`: `freeway` is longer.")
    length_m: float = Field(default=4.0, ge=1.0, le=30.0, description="12 by default for `freeway`.")
    segment_m: float = Field(default=0.5, ge=0.05, le=5.0, description="1 by default for `freeway`.")
    magnets: int = Field(default=3, ge=2, le=7)
    clearance_class: str = Field(default="utility", description="Kind of vehicle that must be served.")
    codebook: str | None = Field(default=None, description="Name of the agency's codebook; without, a new one.")

    @model_validator(mode="before")
    @classmethod
    def _lengths_of_size(cls, rules: object) -> object:
        if not isinstance(rules, dict) or rules.get("size") not in list(TagSize):
            return rules
        length_m, segment_m = TagSize(rules["size"]).lengths_m
        return {"length_m": length_m, "segment_m": segment_m, **rules}


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


class VehicleRules(_Part):
    """The vehicles that read the markers."""

    wheel_circumference_m: tuple[float, float] = Field(
        default=WHEEL_CIRCUMFERENCE_M,
        description="Smallest and largest rolling circumference of the wheels: no line of magnets repeats with them.",
    )
    read_alone: bool = Field(
        default=True, description="Some vehicles read plates without the registry: plain positions get a warning."
    )


class PredictionRules(_Part):
    """Circumstances for which the checks predict read rates and path errors."""

    conditions: list[Annotated[str, Field(pattern=rf"^{_CONDITION}(\+{_CONDITION})*$", max_length=60)]] = Field(
        default=["day"], min_length=1, max_length=20, description="As in a proof; several are joined: night+rain."
    )
    speed_share: float = Field(default=1.0, ge=0.1, le=1.5, description="Of the design speed.")
    lost_share: float = Field(default=0.0, ge=0.0, le=0.9, description="Share of the markers that are missing.")
    clearance_m: float = Field(
        default=0.16,
        ge=0.05,
        le=0.6,
        description="Of the magnetometers above the road; the depth of the magnets is added.",
    )
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
    per: Literal["plate", "magnet", "tag", "cerpm", "hole", "shell", "marker", "metre_of_lane", "day", "plan"] = Field(
        description="What the price is multiplied by; `shell`: magnets on the surface. Days come from `per_day`."
    )
    price: float = Field(ge=0.0, le=1e9)
    pay_item: str | None = Field(default=None, max_length=40)
    source: str = Field(default="", max_length=200)


class Costs(_Part):
    """The agency's unit costs. There are no published unit prices, so there are no defaults."""

    currency: str = Field(default="USD", pattern="^[A-Z]{3}$")
    items: list[CostItem] = []
    markers_per_day: float | None = Field(default=None, gt=0.0, description="Markers that a crew installs in a day.")


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
    vehicles: VehicleRules = VehicleRules()
    predictions: PredictionRules = PredictionRules()
    quality: Quality | None = None
    costs: Costs = Costs()
    installation: Installation = Installation()
    tolerances: Tolerances = Tolerances()

    @property
    def magnet_distance_m(self) -> float:
        """Distance from the sensors of the predictions down to the magnets. [m]"""
        return self.installation.distance_m(self.predictions.clearance_m)

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


# === Rules of a plan from YAML 1.2 or JSON, and their JSON Schema. Each error names the place, the limit and the cure.


MAX_RULES_BYTES = 200_000
"""Longest document. [bytes] A hundred times the examples."""
_MAX_DEPTH = 20  # levels of a document; rules have four
_MAX_TOKENS = 10_000  # of YAML: 30 times the examples, half a CPU second
_OPENING = (BlockMappingStartToken, BlockSequenceStartToken, FlowMappingStartToken, FlowSequenceStartToken)
_CLOSING = (BlockEndToken, FlowMappingEndToken, FlowSequenceEndToken)
_DIALECT = "https://json-schema.org/draft/2020-12/schema"
_LONG_LIST = 12  # names that an error lists
_MAX_FAULTS = 100  # that are listed; more than a person mends at once


class _DatesAsTexts(SafeConstructor):
    """Leaves dates to the rules that have them, as in JSON."""


_DatesAsTexts.add_constructor("tag:yaml.org,2002:timestamp", SafeConstructor.construct_yaml_str)


@cache
def rules_schema() -> JsonObject:
    """JSON Schema (draft 2020-12) of a document of rules; not to be changed."""
    return {"$schema": _DIALECT, "$id": SCHEMA_ID, **PlanRules.model_json_schema()}


def read_rules(data: bytes) -> PlanRules:
    """Read and check a document of rules.

    Parameters
    ----------
    data : bytes
        YAML 1.2 or JSON in UTF-8, at most 200,000 bytes.

    Raises
    ------
    UnreadableUpload
        It is neither YAML nor JSON, has a key twice, or is too long.
    InvalidParameter
        A value is missing, unknown, outside its limits, or contradicts another one; `field` is its path, and `parts`
        has all of them.
    """
    return check_rules(_parse(data))


def check_rules(document: object) -> PlanRules:
    """Rules from a parsed document; raises InvalidParameter as `read_rules`."""
    if not isinstance(document, Mapping):
        raise InvalidParameter(
            "the rules are not a mapping of names to values",
            field="rules",
            limit="a mapping with version: 1",
            cure="see docs/plans/rules-rural-plates.yaml",
        )
    try:
        with naming("installation"):  # the one part that checks itself
            rules = PlanRules.model_validate(document)
    except ValidationError as error:
        raise _invalid(error, document) from None
    _check_contradictions(rules)
    return rules


# --- text -----------------------------------------------------------------------------------------------------------


def _parse(data: bytes) -> object:
    if len(data) > MAX_RULES_BYTES:
        raise UnreadableUpload(
            f"the rules have {len(data)} bytes", field="rules", limit=f"{MAX_RULES_BYTES} bytes", cure="shorten them"
        )
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise _unreadable(f"the rules are not UTF-8: byte {error.start}", "save them as UTF-8") from error
    try:
        if text.lstrip()[:1] == "{" and '"' in text:
            return parse_json(text.encode(), "rules")
        document = _parse_yaml(text)
        check_values(document, "rules")
    except MalformedRequest as error:
        field, at_value, rest = (error.field or "rules").partition("rules.")
        kind = InvalidParameter if at_value else UnreadableUpload
        raise kind(
            f"the rules cannot be read: {error.message}",
            field=rest or field,
            limit=error.limit,
            cure="correct them there",
        ) from error
    return document


def _parse_yaml(text: str) -> object:
    try:
        _check_tokens(YAML(typ="safe", pure=True).scan(text))
        reader = YAML(typ="safe", pure=True)
        reader.Constructor = _DatesAsTexts
        return reader.load(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f" at line {mark.line + 1}, column {mark.column + 1}" if mark is not None else ""
        problem = str(error.problem or error.context or "it cannot be parsed").split("\n")[0][:200]
        raise _unreadable(f"the rules are not YAML 1.2: {problem}{place}", "correct them there") from error
    except (YAMLError, ValueError, TypeError, ArithmeticError, RecursionError) as error:
        reason = str(error).split("\n")[0][:200] or "nested too deeply"  # a list as a key is a TypeError
        raise _unreadable(f"the rules are not YAML 1.2: {reason}", "see docs/plans for examples") from error


def _check_tokens(tokens: Iterable[Token]) -> None:
    """Refuse aliases, tags, deep nesting and long documents at the first such token, before values are read."""
    depth = 0
    for number, token in enumerate(tokens):
        if number == _MAX_TOKENS:
            raise _unreadable(f"the rules have more than {_MAX_TOKENS} tokens", "leave out what is not needed")
        if isinstance(token, AliasToken):
            raise _unreadable("the rules have an alias (*name)", "write the values out")
        if isinstance(token, TagToken):
            raise _unreadable("the rules have a tag (!name)", "write the values without tags")
        depth += isinstance(token, _OPENING) - isinstance(token, _CLOSING)
        if depth > _MAX_DEPTH:
            place = f"line {token.start_mark.line + 1}, column {token.start_mark.column + 1}"
            raise _unreadable(
                f"the rules are not YAML 1.2 of at most {_MAX_DEPTH} levels: {place}", "see docs/plans for examples"
            )


def _unreadable(message: str, cure: str) -> UnreadableUpload:
    return UnreadableUpload(message, field="rules", limit="YAML 1.2 or JSON, each key once", cure=cure)


# --- values ---------------------------------------------------------------------------------------------------------


def _invalid(error: ValidationError, document: Mapping[object, object]) -> InvalidParameter:
    """One error a place; the first is raised and has all of them as parts."""
    found: dict[str, InvalidParameter] = {}
    for detail in islice(error.errors(include_url=False, include_context=False), _MAX_FAULTS):
        path = _path(detail, document)
        found.setdefault(_dotted(path), _invalid_value(detail, path))
    first, *rest = found.values()
    if rest:
        first = InvalidParameter(first.message, field=first.field, limit=first.limit, cure=first.cure)
        first.parts = tuple(found.values())
    return first


def _path(detail: ErrorDetails, document: object) -> list[str | int]:
    """Keys and indices of the value at fault; pydantic adds the names of the types that it tried."""
    path: list[str | int] = []
    value = document
    for part in detail["loc"]:
        if isinstance(value, Mapping):
            path.append(part)
            value = value.get(part)
        elif isinstance(value, list) and isinstance(part, int):
            path.append(part)
            value = value[part] if part < len(value) else None
        else:
            break
    return path


def _invalid_value(detail: ErrorDetails, path: list[str | int]) -> InvalidParameter:
    field = _dotted(path)
    message = detail["msg"].removeprefix("Value error, ")
    match detail["type"]:
        case "extra_forbidden":
            known = sorted(_schema_at(path[:-1]).get("properties", {}))
            near = difflib.get_close_matches(str(path[-1]), known, 1)
            cure = f"write {near[0]!r}" if near else "leave it out"
            return InvalidParameter(f"there is no rule {field!r}", field=field, limit=_names(known), cure=cure)
        case "missing":
            return InvalidParameter(f"the rule {field!r} is missing", field=field, limit=_limit(path), cure="add it")
        case "value_error":
            return InvalidParameter(
                f"{field or 'rules'}: {message}", field=field or "rules", limit="rules that agree", cure="correct them"
            )
    shown = repr(detail["input"])
    shown = shown if len(shown) <= 60 else f"{shown[:57]}..."
    return InvalidParameter(
        f"{field} is {shown}: {message[:1].lower()}{message[1:]}",
        field=field,
        limit=_limit(path) or message,
        cure="correct the value",
    )


def _dotted(path: list[str | int]) -> str:
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{str(part)[:60]}" for part in path)
    return text.removeprefix(".")


def _names(names: list[str]) -> str:
    return ", ".join(names[:_LONG_LIST]) + (", ..." if len(names) > _LONG_LIST else "")


def _schema_at(path: list[str | int]) -> JsonObject:
    """The part of the JSON Schema that describes the value at a path; empty where there is none."""
    schema = rules_schema()
    definitions = schema["$defs"]
    here: JsonObject = schema
    for part in [*path, None]:
        for option in (here, *here.get("anyOf", ())):
            if "$ref" in option:
                here = {**here, **definitions[option["$ref"].rpartition("/")[2]]}
        if part is None:
            return here
        if isinstance(part, int):
            prefix = here.get("prefixItems", [])
            here = prefix[part] if part < len(prefix) else here.get("items", {})
        else:
            here = here.get("properties", {}).get(part, {})
    return {}


def _limit(path: list[str | int]) -> str | None:
    schema = _schema_at(path)
    limits = [text for option in schema.get("anyOf", (schema,)) if (text := _allowed(option)) is not None]
    return ", or ".join(dict.fromkeys(limits)) or None


def _allowed(schema: JsonObject) -> str | None:
    """Allowed values of a schema, for people."""
    if "const" in schema:
        return str(schema["const"])
    if "enum" in schema:
        return _names([str(value) for value in schema["enum"]])
    low = schema.get("minimum", schema.get("exclusiveMinimum"))
    high = schema.get("maximum", schema.get("exclusiveMaximum"))
    if low is not None and high is not None:
        return f"{low:g} to {high:g}"
    if low is not None:
        return f"{'above' if 'exclusiveMinimum' in schema else 'at least'} {low:g}"
    if "pattern" in schema:
        return str(schema["pattern"])
    return {"number": "a number", "integer": "a whole number", "boolean": "true or false", "object": "a mapping",
            "array": "a list", "null": None, "string": "a text"}.get(schema.get("type", "null"))  # fmt: skip


# --- contradictions -------------------------------------------------------------------------------------------------


def _check_contradictions(rules: PlanRules) -> None:
    """Rules that are allowed one by one and do not fit together."""
    if plates := rules.plates:
        with naming("plates"):
            PlateGeometry(plates.n, plates.unit_mm, plates.gap_mm, plates.thickness_mm)
    check_circumference(rules.vehicles.wheel_circumference_m, "vehicles.wheel_circumference_m")
    if rules.tags:
        _check_tags(rules.tags)
    if lines := rules.lines:
        _check(
            lines.solid is not None or lines.dashed is not None,
            "lines.solid and lines.dashed are both null, so no line gets magnets",
            "lines.solid",
            "a polarity for at least one kind of line",
            "give a polarity, or leave lines out",
        )
    if rules.cerpm:
        _check_cerpms(rules.cerpm)
    for name, group in (("decision_points", rules.decision_points), ("tags", rules.tags)):
        if group is not None and not isinstance(group.before, str):
            _check(
                math.isfinite(group.before) and 0 <= group.before <= 2000,
                f"{name}.before is {group.before}",
                f"{name}.before",
                "stopping_distance, reaction_distance, or 0 to 2000 m",
                "choose another distance",
            )
    _check_prices(rules)


def _check_tags(tags: TagRules) -> None:
    with naming("tags"):
        TagDesign(tags.magnets, tags.length_m, tags.segment_m)
    _check(
        tags.clearance_class in vehicle_clearances(),
        f"there is no kind of vehicle {tags.clearance_class[:40]!r}",
        "tags.clearance_class",
        ", ".join(vehicle_clearances()),
        "choose one of these",
    )


def _check_cerpms(cerpm: CerpmRules) -> None:
    marking_rules(cerpm.marking_rules)
    _check(
        cerpm.curve <= cerpm.straight,
        f"CERPMs in curves are {cerpm.curve:g} cycles apart, on straights only {cerpm.straight:g}",
        "cerpm.curve",
        f"at most cerpm.straight, {cerpm.straight:g}",
        "swap the two, or make them equal",
    )
    if cerpm.spreading_factor is not None and cerpm.interval_s is not None:
        with naming("cerpm"):
            RadioSettings(
                spreading_factor=cerpm.spreading_factor, interval_s=cerpm.interval_s, bandwidth_hz=cerpm.bandwidth_hz
            )


def _check_prices(rules: PlanRules) -> None:
    daily = next((k for k, item in enumerate(rules.costs.items) if item.per == "day"), None)
    _check(
        daily is None or rules.costs.markers_per_day is not None,
        f"costs.items[{daily}] is per day, and the number of days is unknown",
        "costs.markers_per_day",
        "needed for prices per day",
        "give the markers that a crew installs in a day",
    )
    if rules.quality is not None and rules.quality.budget is not None:
        _check(
            bool(rules.costs.items),
            "quality.budget is given and costs.items has no prices",
            "costs.items",
            "prices for a budget",
            "give the agency's unit costs",
        )


def _check(holds: bool, message: str, field: str, limit: str, cure: str) -> None:
    if not holds:
        raise InvalidParameter(message, field=field, limit=limit, cure=cure)
