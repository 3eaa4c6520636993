"""Query strings of /ogc. What a client cannot mean is 400 here, as OGC API Features asks."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone
from typing import NamedTuple, NoReturn
from urllib.parse import parse_qsl

import numpy as np
import shapely
from starlette.requests import Request

from app.api.ogc.cql2 import LANGUAGES, Place, Placed, Reader, Sides
from app.errors import InvalidParameter, MalformedRequest
from app.geodesy.systems import listed_systems
from app.registry.conditions import Compared, Condition, Joined, Located
from app.registry.features import FeatureFilter
from app.registry.spatial import Box
from app.services.markers.features import (
    COLLECTIONS,
    EPSG_URI,
    STORAGE_CRS,
    AnyCrs,
    Collection,
    FeatureCrs,
    OtherCrs,
    in_lon_lat,
)
from app.services.markers.searches import MAX_OVER_ANTIMERIDIAN_DEG, area_of_shape

# === The parameters of requests under /ogc in one list: /ogc/api, /openapi.json and the query's reader use it.


DEFAULT_LIMIT = 1000
MAX_LIMIT = 10_000
DEFAULT_HTML_LIMIT = 100
MAX_HTML_LIMIT = 1000
"""In HTML: browsers draw all rows of a table before they show one."""
_CRS = {"type": "string", "format": "uri", "default": STORAGE_CRS, "examples": list(FeatureCrs)}
_NUMBERS = {
    "type": "array",
    "minItems": 4,
    "maxItems": 6,
    "oneOf": [{"minItems": 4, "maxItems": 4}, {"minItems": 6, "maxItems": 6}],
    "items": {"type": "number"},
}


def schema_type(kind: str) -> dict[str, str]:
    """JSON Schema of a kind of property."""
    return {"type": "string", "format": "date-time"} if kind == "date-time" else {"type": kind}


class Parameter(NamedTuple):
    """A query parameter: its JSON schema, and its description."""

    schema: Mapping[str, object]
    text: str


_COMMON = {
    "f": Parameter({"type": "string", "enum": ["json", "html"]}, "Format; without it the Accept header decides"),
    "crs": Parameter(
        _CRS,
        f"CRS of the response, its axes in the authority's order: one that the collection lists, as {EPSG_URI}25832",
    ),
    "bbox": Parameter(_NUMBERS, "west,south,east,north; west is greater across the antimeridian"),
    "bbox-crs": Parameter(_CRS, "CRS of bbox"),
    "datetime": Parameter({"type": "string"}, "Last change: a moment, a/b, ../b or a/.."),
    "limit": Parameter(
        {"type": "integer", "minimum": 1, "maximum": MAX_LIMIT, "default": DEFAULT_LIMIT},
        "Features on a page; a number above the maximum is set to the maximum",
    ),
    "after": Parameter({"type": "string"}, "Last id of the page before; next links have it"),
    "earlier": Parameter({"type": "string"}, "Starts of the pages before, in HTML; links of pages have it"),
    "resultType": Parameter(
        {"type": "string", "enum": ["results", "hits"], "default": "results"}, "hits: only numberMatched"
    ),
    "count": Parameter({"type": "boolean", "default": False}, "numberMatched with every page"),
    "filter": Parameter({"type": "string"}, "An expression on properties and geometry, in the language filter-lang"),
    "filter-lang": Parameter({"type": "string", "enum": LANGUAGES, "default": LANGUAGES[0]}, "Language of filter"),
    "filter-crs": Parameter(_CRS, "CRS of geometries in filter"),
}
_OF_TILES = {
    "groups": Parameter(
        {"type": "boolean", "default": False},
        "Where a tile has too many features: the layer of groups, with their numbers, in place of single features",
    )
}
_FIELDS = {
    field.name: field
    for collection in reversed(COLLECTIONS.values())  # of equal names the first collection's description is kept
    for field in collection.fields
}
PARAMETERS = (
    _COMMON
    | _OF_TILES
    | {
        name: Parameter(schema_type(field.kind), f"{field.text}: equal to this")
        for name, field in sorted(_FIELDS.items())
    }
)
ONLY_FORMAT = ("f",)
OF_TILE = ("f", *_OF_TILES)
OF_ITEM = ("f", "crs")
OF_ITEMS = tuple(_COMMON)


def list_parameters(collection: Collection) -> tuple[str, ...]:
    """Names of the parameters that a request for items of a collection may have."""
    return (*OF_ITEMS, *(field.name for field in collection.fields))


def described(name: str, formats: tuple[str, ...] = ("json", "html")) -> dict[str, object]:
    """A query parameter as OpenAPI describes it, of a route that offers some formats."""
    parameter = PARAMETERS[name]
    schema = {"type": "string", "enum": list(formats)} if name == "f" else parameter.schema
    return {
        "name": name,
        "in": "query",
        "required": False,
        "style": "form",
        "explode": False,
        "description": parameter.text,
        "schema": schema,
    }


# === Query strings of /ogc. What a client cannot mean is 400 here, as OGC API Features asks.


_MAX_QUERY_BYTES = 8192
_BOX_PARTS = 64
"""Parts of the longer edges of a box in another system. Those of 100 km along a parallel at 50 degrees north are
straight to 0.06 m."""
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]{1,3})?", re.ASCII)
_TIME = re.compile(
    r"(?P<year>[0-9]{4})-(?P<month>[0-9]{2})-(?P<day>[0-9]{2})"
    r"(?P<clock>[Tt ](?P<hour>[0-9]{2}):(?P<minute>[0-9]{2})(:(?P<second>[0-9]{2})(?P<part>\.[0-9]+)?)?"
    r"(?P<zone>[Zz]|[+-][0-9]{2}:[0-9]{2})?)?",
    re.ASCII,
)
_ID = re.compile(r"[\x21-\x7e]{1,300}", re.ASCII)


@dataclass(frozen=True, slots=True)
class ItemsQuery:
    """What a request for items asks for."""

    pairs: list[tuple[str, str]]
    filtered: FeatureFilter
    limit: int
    after: str | None
    crs: AnyCrs
    hits: bool
    counted: bool
    is_page: bool = False
    earlier: tuple[str, ...] = ()


def refuse(name: str, message: str, limit: str) -> NoReturn:
    """Refuse a parameter."""
    raise MalformedRequest(message, field=name, limit=limit, cure="/ogc/api describes the parameters")


def query_pairs(request: Request) -> list[tuple[str, str]]:
    """The parameters as they were sent.

    Raises
    ------
    MalformedRequest
        They are not UTF-8, too long, hold a NUL, or one is sent twice.
    """
    raw: bytes = request.scope["query_string"]
    if not raw:
        return []
    if len(raw) > _MAX_QUERY_BYTES:
        refuse("query", "the query string is too long", f"{_MAX_QUERY_BYTES} bytes")
    try:
        pairs = parse_qsl(raw.decode("ascii"), keep_blank_values=True, errors="strict", max_num_fields=100)
    except ValueError:
        refuse("query", "the query string cannot be read", "at most 100 parameters in UTF-8, percent-encoded")
    if any("\x00" in text for pair in pairs for text in pair):
        refuse("query", "the query string holds NUL", "no U+0000")
    return pairs


def known_parameters(request: Request, known: Sequence[str]) -> dict[str, str]:
    """Parameters by name, each of them known and sent once.

    Raises
    ------
    MalformedRequest
        They are not.
    """
    return _named(query_pairs(request), known)


def _named(pairs: list[tuple[str, str]], known: Sequence[str]) -> dict[str, str]:
    found = dict(pairs)
    if len(found) != len(pairs):
        refuse("query", "a parameter is sent twice", "each parameter once")
    for name in found:
        if name not in known:
            refuse(name[:80], "there is no such parameter here", ", ".join(known))
    return found


def items_query(pairs: list[tuple[str, str]], collection: Collection, *, is_page: bool = False) -> ItemsQuery:
    """The parsed parameters of a request for items of a collection, as JSON or as a page in HTML.

    Raises
    ------
    MalformedRequest
        One is unknown or cannot be.
    """
    found = _named(pairs, list_parameters(collection))
    box, heights_m, area = _bbox(found)
    since, until = _datetime(found["datetime"]) if "datetime" in found else (None, None)
    kind = found.get("resultType", "results")
    if kind not in ("results", "hits"):
        refuse("resultType", "resultType is results or hits", "results, hits")
    after = found.get("after")
    if after is not None and not _ID.fullmatch(after):
        refuse("after", "after is the id of a feature", "take it from a next link")
    kinds = {field.name: field.kind for field in collection.fields}
    asked = {name: text for name, text in found.items() if name in kinds}
    moments = [
        Compared(name, "=", _moment(text, last=False, name=name))
        for name, text in asked.items()
        if kinds[name] == "date-time"
    ]
    wheres = [part for part in (area, _where(found, kinds), *moments) if part is not None]
    filtered = FeatureFilter(
        table=collection.table,
        box=box,
        heights_m=heights_m,
        since=since,
        until=until,
        equal=tuple(
            (name, _value(name, text, kinds[name])) for name, text in asked.items() if kinds[name] != "date-time"
        ),
        where=wheres[0] if len(wheres) == 1 else Joined(True, tuple(wheres)) if wheres else None,
    )
    return ItemsQuery(
        pairs=pairs,
        filtered=filtered,
        limit=min(_limit(found, DEFAULT_HTML_LIMIT), MAX_HTML_LIMIT) if is_page else _limit(found, DEFAULT_LIMIT),
        after=after,
        crs=crs_parameter(found, "crs"),
        hits=kind == "hits",
        counted=flag_parameter(found, "count"),
        is_page=is_page,
        earlier=_earlier(found),
    )


def crs_parameter(found: dict[str, str], name: str) -> AnyCrs:
    """The CRS that a parameter names.

    Raises
    ------
    MalformedRequest
        It is neither listed nor a horizontal system of the EPSG registry.
    """
    sent = found.get(name)
    if sent is None:
        return STORAGE_CRS
    if sent in list(FeatureCrs):
        return FeatureCrs(sent)
    if re.fullmatch(re.escape(EPSG_URI) + "[0-9]{4,6}", sent, re.ASCII):
        if int(sent.removeprefix(EPSG_URI)) in listed_systems():
            return OtherCrs(sent)
        refuse(
            name, "this system is not served", f"geographic and projected systems of the EPSG registry, {EPSG_URI}CODE"
        )
    refuse(name, "this is not the URI of a CRS that is served", f"{', '.join(FeatureCrs)}, or {EPSG_URI}CODE")


def number(name: str, text: str) -> float:
    """A finite number.

    Raises
    ------
    MalformedRequest
        It is none.
    """
    text = text.strip()
    if len(text) > 64 or not _NUMBER.fullmatch(text) or not math.isfinite(float(text)):
        refuse(name, f"{name} holds something that is not a finite number", "finite decimal numbers")
    return float(text)


def _earlier(found: dict[str, str]) -> tuple[str, ...]:
    if "earlier" not in found:
        return ()
    starts = tuple(found["earlier"].split(","))
    if not all(_ID.fullmatch(start) for start in starts):
        refuse("earlier", "earlier is a list of ids of features", "take it from the links of a page")
    return starts


def _limit(found: dict[str, str], default: int) -> int:
    text = found.get("limit")
    if text is None:
        return default
    if not re.fullmatch(r"[0-9]{1,200}", text, re.ASCII) or not int(text):
        refuse("limit", "limit is not a whole number above 0", f"1 to {MAX_LIMIT}; more is set to {MAX_LIMIT}")
    return min(int(text), MAX_LIMIT)


def flag_parameter(found: dict[str, str], name: str) -> bool:
    """The value of a parameter that is true or false; false if it is missing.

    Raises
    ------
    MalformedRequest
        It is neither.
    """
    text = found.get(name, "false")
    if text not in ("true", "false"):
        refuse(name, f"{name} is true or false", "true, false")
    return text == "true"


def _value(name: str, text: str, kind: str) -> str | float:
    if kind == "string":
        return text
    value = number(name, text)
    if kind != "integer":
        return value
    if value != int(value) or not -(2**31) <= value < 2**31:
        refuse(name, f"{name} is a whole number", "32 bits")
    return int(value)


def _where(found: dict[str, str], kinds: dict[str, str]) -> Condition | None:
    language = found.get("filter-lang", LANGUAGES[0])
    if language not in LANGUAGES:
        refuse("filter-lang", "filters are not read in this language", ", ".join(LANGUAGES))
    crs = crs_parameter(found, "filter-crs")
    if "filter" not in found:
        return None
    reader = Reader(
        kinds,
        lambda text: _moment(text, last=False, name="filter"),
        lambda text: number("filter", text),
        places_in(crs),
    )
    return reader.read(found["filter"], language)


def places_in(crs: AnyCrs) -> Place:
    """What turns the geometries and boxes of a filter in a CRS into areas; they are refused as the filter's."""

    def place(shape: shapely.Geometry | Sides, within_m: float) -> Placed:
        heights_m = None
        if isinstance(shape, tuple):
            shapes, heights_m = _sides_in_lon_lat("filter", shape, crs)
        else:
            shapes = _simple_parts(in_lon_lat(shape, crs))
        try:
            return Placed(tuple(area_of_shape(one, "filter", within_m) for one in shapes), heights_m)
        except InvalidParameter as error:
            refuse("filter", error.message, error.limit or "points, lines and polygons")

    return place


def _simple_parts(shape: shapely.Geometry) -> list[shapely.Geometry]:
    if not isinstance(shape, shapely.GeometryCollection):
        return [shape]
    return [simple for part in shapely.get_parts(shape) for simple in _simple_parts(part) if not simple.is_empty]


def _sides_in_lon_lat(
    name: str, sides: Sides, crs: AnyCrs
) -> tuple[list[shapely.Geometry], tuple[float, float] | None]:
    """A box of four or six numbers as shapes in longitude and latitude, none over the antimeridian; and its heights."""
    low, high, heights_m = _corners(name, sides)
    if isinstance(crs, OtherCrs):
        return _other_box(name, low, high, crs), heights_m
    return [_shape_of(part) for part in _lon_lat_box(name, low, high, crs).parts], heights_m


def _shape_of(box: Box) -> shapely.Geometry:
    """A box; of no width or height the line or the point that it is. No edge is longer than half a turn."""
    west, south, east, north = box.west_deg, box.south_deg, box.east_deg, box.north_deg
    if west == east and south == north:
        return shapely.Point(west, south)
    if west == east or south == north:
        return shapely.segmentize(shapely.LineString([(west, south), (east, north)]), 90.0)
    return shapely.segmentize(shapely.box(west, south, east, north), 90.0)


def _other_box(name: str, low: Sides, high: Sides, crs: OtherCrs) -> list[shapely.Geometry]:
    """A box of another system: its edges are straight there, and bent in longitude and latitude."""
    if low[0] > high[0] or low[1] > high[1]:
        refuse(name, "a box has its upper bound below its lower one", "lower corner first")
    width, height = high[0] - low[0], high[1] - low[1]
    if not (width and height):
        refuse(name, "a box has no width or no height", "lower corner, upper corner")
    inside = crs.within_area((low[0], low[1]), (high[0], high[1]))
    if inside is None:
        refuse(name, f"a box lies outside the area of {crs.name}", "a box in the area of its CRS")
    (west, south), (east, north) = inside
    box = shapely.box(west, south, east, north)
    turned = in_lon_lat(shapely.segmentize(box, max(east - west, north - south) / _BOX_PARTS), crs)
    if not np.isfinite(shapely.get_coordinates(turned)).all():
        refuse(name, f"a box lies outside the area of {crs.name}", "a box in the area of its CRS")
    lon_deg = shapely.get_coordinates(turned)[:, 0]
    is_over_antimeridian = np.abs(np.diff(lon_deg)).max() > 180.0
    if is_over_antimeridian:
        turned = shapely.transform(turned, lambda at: np.where([True, False] & (at < 0.0), at + 360.0, at))
    if not turned.is_valid:  # about a pole, or over much of the earth: a box round it
        return [_shape_of(part) for part in _on_earth(*crs.bounds_deg(*inside)).parts]
    if not is_over_antimeridian:
        return [turned]
    halves = [shapely.clip_by_rect(turned, 0, -90, 180, 90), shapely.clip_by_rect(turned, 180, -90, 360, 90)]
    back = shapely.transform(halves[1], lambda at: at - [360.0, 0.0])
    return [half for half in (halves[0], back) if not half.is_empty]


def _corners(name: str, sides: Sides) -> tuple[Sides, Sides, tuple[float, float] | None]:
    """Lower and upper corner of a box of four or six numbers, and its heights."""
    half = len(sides) // 2
    low, high = sides[:half], sides[half:]
    heights_m = (low[2], high[2]) if half == 3 else None
    if heights_m is not None and heights_m[0] > heights_m[1]:
        refuse(name, "a box has its upper height below its lower one", "lower corner first")
    return low[:2], high[:2], heights_m


def _bbox(found: dict[str, str]) -> tuple[Box | None, tuple[float, float] | None, Condition | None]:
    """The box of the parameter bbox, its heights, and of other systems than WGS 84 its exact area."""
    crs = crs_parameter(found, "bbox-crs")
    text = found.get("bbox")
    if text is None:
        if "bbox-crs" in found:
            refuse("bbox-crs", "bbox-crs means nothing without bbox", "bbox with bbox-crs")
        return None, None, None
    numbers = tuple(number("bbox", part) for part in text.split(",", 7))
    if len(numbers) not in (4, 6):
        refuse("bbox", "bbox has four numbers, or six with heights", "west,south,east,north")
    low, high, heights_m = _corners("bbox", numbers)
    if not isinstance(crs, OtherCrs):
        return _lon_lat_box("bbox", low, high, crs), heights_m, None
    areas = [Located(area_of_shape(shape, "bbox")) for shape in _other_box("bbox", low, high, crs)]
    return None, heights_m, Joined(False, tuple(areas))


def _lon_lat_box(name: str, low: Sides, high: Sides, crs: FeatureCrs) -> Box:
    west, south = crs.to_lon_lat(low[0], low[1])
    east, north = crs.to_lon_lat(high[0], high[1])
    if south > north:
        refuse(name, "a box has its upper bound below its lower one", "lower corner first; west of east may be greater")
    if 0.0 < west - east < 360.0 - MAX_OVER_ANTIMERIDIAN_DEG:
        refuse(
            name,
            f"a box has its west above its east, and spans {360.0 + east - west:.6g} degrees over the antimeridian",
            f"west,south,east,north; {MAX_OVER_ANTIMERIDIAN_DEG:g} degrees over the antimeridian",
        )
    return _on_earth(west, south, east, north)


def _on_earth(west: float, south: float, east: float, north: float) -> Box:
    """The box within -180 to 180 and -90 to 90; maps that show more than the world ask for more."""
    south, north = max(south, -90.0), min(north, 90.0)
    if east - west >= 360.0:
        return Box(-180.0, south, 180.0, north)
    return Box(_wrapped(west), south, _wrapped(east), north)


def _wrapped(lon_deg: float) -> float:
    return lon_deg if -180.0 <= lon_deg <= 180.0 else (lon_deg + 180.0) % 360.0 - 180.0


def _datetime(text: str) -> tuple[datetime | None, datetime | None]:
    """First and last moment of an instant or an interval; None is open."""
    parts = text.split("/")
    if len(parts) == 1:
        return _moment(parts[0], last=False), _moment(parts[0], last=True)
    if len(parts) != 2 or all(part in ("", "..") for part in parts):
        refuse("datetime", "datetime is a moment or an interval", "2026-03-04T05:06:07Z, a/b, ../b or a/..")
    since = None if parts[0] in ("", "..") else _moment(parts[0], last=False)
    until = None if parts[1] in ("", "..") else _moment(parts[1], last=True)
    if since is not None and until is not None and since > until:
        refuse("datetime", "the interval ends before it begins", "begin/end")
    return since, until


_FIRST = datetime.min.replace(tzinfo=UTC)
_LAST = datetime.max.replace(tzinfo=UTC)


def _moment(text: str, *, last: bool, name: str = "datetime") -> datetime:
    """A moment; of a date or a whole second, its first or last one. Years without a datetime become the nearest."""
    match = _TIME.fullmatch(text)
    if match is None:
        refuse(name, f"{name} holds a time that is not in RFC 3339", "2026-03-04T05:06:07Z or 2026-03-04")
    year = int(match["year"])
    leap_second = match["second"] == "60"
    try:
        moment = datetime(
            max(year, 1) if year else 4,  # year 0 was a leap year; only its month and day are checked
            int(match["month"]),
            int(match["day"]),
            int(match["hour"] or 0),
            int(match["minute"] or 0),
            59 if leap_second else int(match["second"] or 0),
            int((match["part"] or ".0")[1:7].ljust(6, "0")),
            tzinfo=_zone(match["zone"]),
        )
    except ValueError:
        refuse(name, "there is no such moment", "RFC 3339")
    if year == 0:
        return _FIRST
    try:
        moment = moment.astimezone(UTC)
        if last and match["part"] is None:
            moment += timedelta(seconds=1) if match["clock"] else timedelta(days=1)
            moment -= timedelta(microseconds=1)
    except OverflowError:
        return _FIRST if year == 1 else _LAST
    return moment


def _zone(text: str | None) -> timezone:
    if text is None or text in "Zz":
        return UTC
    sign = -1 if text[0] == "-" else 1
    hours, minutes = int(text[1:3]), int(text[4:6])
    if hours > 23 or minutes > 59:
        raise ValueError("no such zone")
    return timezone(sign * timedelta(hours=hours, minutes=minutes))
