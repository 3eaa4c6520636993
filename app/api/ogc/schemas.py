"""JSON Schemas of a collection's features: as OGC API Common part 3 (OGC 23-058r2, formerly Features part 5) describes
properties, as GeoJSON, and of what filters can ask.
"""

from __future__ import annotations

import re
from typing import Any

from app.api.ogc.edits import READ_ONLY
from app.registry.features import Field
from app.services.markers.features import Collection

SCHEMA_REL = "http://www.opengis.net/def/rel/ogc/1.0/schema"
QUERYABLES_REL = "http://www.opengis.net/def/rel/ogc/1.0/queryables"
_DRAFT = "https://json-schema.org/draft/2020-12/schema"
_COMMON = "http://www.opengis.net/spec/ogcapi-common-3/1.0/conf"
_DRAFT_5 = "http://www.opengis.net/spec/ogcapi-features-5/1.0/conf"
SCHEMA_CONFORMANCE = (
    f"{_COMMON}/schemas",
    f"{_COMMON}/advanced-property-roles",
    f"{_COMMON}/returnables-and-receivables",
    f"{_COMMON}/queryables",
    f"{_DRAFT_5}/schemas",
    f"{_DRAFT_5}/core-roles-features",
    f"{_DRAFT_5}/returnables-and-receivables",
)
"""The classes of the standard, and those of its last draft, which QGIS up to 4.0 looks for."""
_UNITS = {"deg": "deg", "m": "m", "km/h": "km/h", "1/m": "/m", "decimal year": "a"}
"""UCUM codes of units as the texts of properties name them."""
_ROLES = {"family": "type", "updated_at": "primary-instant"}
_UNIT = re.compile(r" \[([^\]]+)\]$")


def property_schema(collection: Collection, url: str) -> dict[str, Any]:
    """The properties of a collection's features, independent of their format; the geometry is one of them."""
    properties: dict[str, Any] = {
        "id": {"title": "Id of the feature", "type": "string", "readOnly": True, "x-ogc-role": "id"},
        "geometry": {
            "title": "Position" if collection.geometry == "Point" else "Course",
            "format": f"geometry-{collection.geometry.lower()}",
            "x-ogc-role": "primary-geometry",
            **({} if collection.editable else {"readOnly": True}),
        },
    }
    for field in collection.fields:
        properties[field.name] = _returnable(field, collection.editable and field.name not in READ_ONLY)
    for place, described in enumerate(properties.values(), start=1):
        described["x-ogc-propertySeq"] = place
    return {
        "$schema": _DRAFT,
        "$id": url,
        "title": collection.title,
        "description": collection.text,
        "type": "object",
        "properties": properties,
        "additionalProperties": False,
    }


def geojson_schema(collection: Collection, url: str) -> dict[str, Any]:
    """A feature as GeoJSON: GDAL takes the types of fields from it; without it, it guesses from the first page."""
    return {
        "$schema": _DRAFT,
        "$id": url,
        "title": collection.title,
        "type": "object",
        "required": ["type", "geometry", "properties"],
        "properties": {
            "type": {"type": "string", "enum": ["Feature"]},
            "id": {"type": "string"},
            "geometry": {"$ref": f"https://geojson.org/schema/{collection.geometry}.json"},
            "properties": {"type": "object", "properties": _plain(collection)},
        },
    }


def queryables(collection: Collection, url: str) -> dict[str, Any]:
    """What filters can ask of a collection's features."""
    return {
        "$schema": _DRAFT,
        "$id": url,
        "title": collection.title,
        "type": "object",
        "properties": _plain(collection),
        "additionalProperties": False,
    }


def schema_type(kind: str) -> dict[str, str]:
    """JSON Schema of a kind of property."""
    return {"type": "string", "format": "date-time"} if kind == "date-time" else {"type": kind}


def _plain(collection: Collection) -> dict[str, dict[str, str]]:
    return {field.name: schema_type(field.kind) | {"title": field.text} for field in collection.fields}


def _returnable(field: Field, is_receivable: bool) -> dict[str, Any]:
    described: dict[str, Any] = {**schema_type(field.kind), "title": field.text}
    unit = _UNIT.search(field.text)
    if unit is not None and unit[1] in _UNITS:
        described |= {"x-ogc-unit": _UNITS[unit[1]]}
    if field.name in _ROLES:
        described["x-ogc-role"] = _ROLES[field.name]
    return described if is_receivable else described | {"readOnly": True}
