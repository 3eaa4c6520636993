"""Rules of a plan from YAML 1.2 or JSON, and their JSON Schema. Each error names the place, the limit and the cure."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping
from functools import cache
from itertools import islice
from typing import Any

from pydantic import ValidationError
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
from app.formats.json_text import check_values, parse_json
from app.markers.magnet_design import TagDesign
from app.markers.plate import PlateGeometry
from app.planning.magnet_checks import vehicle_clearances
from app.planning.marking_rules import marking_rules
from app.planning.rules import SCHEMA_ID, CerpmRules, PlanRules, TagRules
from app.radio.settings import RadioSettings

MAX_RULES_BYTES = 200_000
"""Longest document. [bytes] Source: chosen by hand, a hundred times the examples."""
_MAX_DEPTH = 20  # levels of a document; source: by hand, rules have four
_MAX_TOKENS = 10_000  # of YAML: source: by hand, 30 times the examples, half a CPU second
_OPENING = (BlockMappingStartToken, BlockSequenceStartToken, FlowMappingStartToken, FlowSequenceStartToken)
_CLOSING = (BlockEndToken, FlowMappingEndToken, FlowSequenceEndToken)
_DIALECT = "https://json-schema.org/draft/2020-12/schema"
_LONG_LIST = 12  # names that an error lists; source: chosen by hand
_MAX_FAULTS = 100  # that are listed; source: chosen by hand, more than a person mends at once


class _DatesAsTexts(SafeConstructor):
    """Leaves dates to the rules that have them, as in JSON."""


_DatesAsTexts.add_constructor("tag:yaml.org,2002:timestamp", SafeConstructor.construct_yaml_str)


@cache
def rules_schema() -> dict[str, Any]:
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


def _invalid(error: ValidationError, document: Mapping[Any, Any]) -> InvalidParameter:
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


def _schema_at(path: list[str | int]) -> dict[str, Any]:
    """The part of the JSON Schema that describes the value at a path; empty where there is none."""
    schema = rules_schema()
    definitions = schema["$defs"]
    here: dict[str, Any] = schema
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


def _allowed(schema: Mapping[str, Any]) -> str | None:
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
