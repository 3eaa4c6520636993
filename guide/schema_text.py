"""Schemas of an OpenAPI document in words: types, limits, members."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from guide.markdown import code, json_block, table

Schema = dict[str, Any]
LinkTo = Callable[[str], str]
"""A link to the description of a component schema."""
PREFIX = "#/components/schemas/"
_LIMITS = {
    "minimum": "at least {}",
    "exclusiveMinimum": "greater than {}",
    "maximum": "at most {}",
    "exclusiveMaximum": "less than {}",
    "minLength": "at least {} characters",
    "maxLength": "at most {} characters",
    "minItems": "at least {} items",
    "maxItems": "at most {} items",
}


def references(value: Any) -> Iterator[str]:
    """Names of the component schemas that a part of the document refers to, directly."""
    if isinstance(value, dict):
        for name, member in value.items():
            if name == "$ref" and isinstance(member, str) and member.startswith(PREFIX):
                yield member.removeprefix(PREFIX)
            elif name not in ("examples", "example"):
                yield from references(member)
    elif isinstance(value, list):
        for member in value:
            yield from references(member)


def type_text(schema: Schema, link: LinkTo) -> str:
    """The type, such as "array of `PlateIn` or null"."""
    if "$ref" in schema:
        return link(schema["$ref"].removeprefix(PREFIX))
    for union in ("anyOf", "oneOf", "allOf"):
        if union in schema:
            return " or ".join(dict.fromkeys(type_text(part, link) for part in schema[union]))
    if "const" in schema:
        return code(schema["const"])
    if "enum" in schema:
        return ", ".join(code(value) for value in schema["enum"])
    kind = schema.get("type", "any value")
    if isinstance(kind, list):
        return " or ".join(kind)
    if kind == "array":
        return f"array of {type_text(schema['items'], link)}" if schema.get("items") else "array"
    if kind == "object":
        return _object_text(schema, link)
    return f"{kind} ({schema['format']})" if "format" in schema else str(kind)


def _object_text(schema: Schema, link: LinkTo) -> str:
    if "properties" in schema:
        return "object: " + ", ".join(
            f"{code(name)} {type_text(member, link)}" for name, member in schema["properties"].items()
        )
    more = schema.get("additionalProperties")
    return f"object of {type_text(more, link)}" if isinstance(more, dict) and more else "object"


def limits_text(schema: Schema) -> str:
    """Limits and default of a value; those of a union are those of its members."""
    parts = [schema, *(part for union in ("anyOf", "oneOf") for part in schema.get(union, ()))]
    found = [_limit_text(name, part[name]) for part in parts for name in _LIMITS if name in part]
    found += [f"pattern {code(part['pattern'])}" for part in parts if "pattern" in part]
    if schema.get("default") is not None:
        found.append(f"default {code(schema['default'])}")
    return "; ".join(dict.fromkeys(found))


def _limit_text(name: str, value: float) -> str:
    text = _LIMITS[name].format(f"{value:g}" if isinstance(value, float) else value)
    return text.removesuffix("s") if value == 1 else text


def meaning_text(schema: Schema, description: str | None = None) -> str:
    """Description and limits of a member or a parameter."""
    text = (description or schema.get("description") or "").strip()
    limits = limits_text(schema)
    sentence = f"{limits[:1].upper()}{limits[1:]}." if limits else ""
    return f"{text}{'' if not text or text.endswith('.') else '.'} {sentence}".strip() if sentence else text


def members_table(schema: Schema, link: LinkTo) -> str:
    """The members of an object."""
    required = set(schema.get("required", ()))
    return table(
        ("member", "type", "required", "meaning"),
        (
            (code(name), type_text(member, link), "yes" if name in required else "", meaning_text(member))
            for name, member in schema.get("properties", {}).items()
        ),
    )


def schema_section(name: str, schema: Schema, link: LinkTo) -> str:
    """A component schema under a heading of its own."""
    text = f"### {code(name)}\n\n"
    if description := schema.get("description"):
        text += f"{description.strip()}\n\n"
    if "properties" in schema:
        text += members_table(schema, link)
    else:
        text += f"Type: {type_text(schema, link)}\n\n"
        if limits := limits_text(schema):
            text += f"Limits: {limits}\n\n"
    examples = schema.get("examples") or ([schema["example"]] if "example" in schema else [])
    return text + "".join(json_block(example) for example in examples[:1])
