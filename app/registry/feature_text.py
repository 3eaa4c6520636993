"""A marker's GeoJSON feature, as the row keeps it beside its columns: pages are read a thousand times a second, and
putting a hundred features together for each takes longer than all the rest (decision 0006).

Whatever writes a marker writes this with it. A property that is added to `FIELDS` needs a migration that writes all
texts anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from functools import lru_cache
from operator import attrgetter
from typing import Any

import orjson

from app.geodesy.vertical import is_ellipsoidal
from app.registry.columns import Columns, JsonTexts, json_objects, json_texts
from app.registry.features import FIELDS
from app.registry.marker_rows import MarkerRow

PROPERTIES = {field.name: field.column.key or "spec" for field in FIELDS}
"""Properties in their order, and the columns that they come from; of `spec` a CERPM's side."""
_pick = attrgetter(*PROPERTIES.values())


def feature_text(marker: MarkerRow) -> str:
    """The feature of a marker: WGS 84 longitude and latitude, and its height if that is ellipsoidal; one line.

    A height in a geometry is above the ellipsoid: RFC 7946 section 4. Others are in the properties, with their datum.
    """
    lon_deg, lat_deg = marker.lon_deg, marker.lat_deg
    height_m = marker.height_m if is_ellipsoidal(marker.vertical_datum) else None
    properties = dict(zip(PROPERTIES, _pick(marker), strict=True))
    properties["side"] = _side(marker.spec) if marker.family == "cerpm" else None
    feature = {
        "type": "Feature",
        "id": marker.id,
        "geometry": {
            "type": "Point",
            "coordinates": (lon_deg, lat_deg) if height_m is None else (lon_deg, lat_deg, height_m),
        },
        "properties": properties,
    }
    return orjson.dumps(feature, option=orjson.OPT_UTC_Z).decode()


def feature_texts(columns: Columns) -> list[str]:
    """As `feature_text`, of markers given by column."""
    same, own = (
        {name: of[column] for name, column in PROPERTIES.items() if column in of} for of in (columns.same, columns.own)
    )
    kinds = zip(columns.values("family"), columns.values("spec"), strict=True)
    properties = Columns(columns.count, same, own).but(
        side=[_side(spec) if family == "cerpm" else None for family, spec in kinds],
        updated_at=list(map(_time, columns.values("updated_at"))),
    )
    places = zip(*(json_texts(columns.values(name)) for name in ("lon_deg", "lat_deg", "height_m")), strict=True)
    flat = [not is_ellipsoidal(datum) for datum in columns.values("vertical_datum")]
    coordinates = (
        f"{lon},{lat}" if is_flat or height == "null" else f"{lon},{lat},{height}"
        for (lon, lat, height), is_flat in zip(places, flat, strict=True)
    )
    members: dict[str, Sequence[Any]] = {
        "id": columns.values("id"),
        "geometry": JsonTexts([f'{{"type":"Point","coordinates":[{place}]}}' for place in coordinates]),
        "properties": json_objects(properties, names=tuple(PROPERTIES)),
    }
    return json_objects(Columns(columns.count, {"type": "Feature"}, members), names=("type", *members))


@lru_cache(maxsize=64)  # the rows of an import have the same
def _time(at: datetime) -> orjson.Fragment:
    return orjson.Fragment(orjson.dumps(at, option=orjson.OPT_UTC_Z))


def _side(spec: Any) -> str | None:
    if isinstance(spec, orjson.Fragment):
        return _side_in(spec.contents)
    return None if spec is None else spec.get("side")


@lru_cache(maxsize=64)  # the rows of an import have the same
def _side_in(spec: bytes | str) -> str | None:
    side: str | None = orjson.loads(spec)["side"]
    return side
