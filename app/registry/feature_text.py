"""A marker's GeoJSON feature, as the row keeps it beside its columns: pages are read a thousand times a second, and
putting a hundred features together for each takes longer than all the rest (decision 0013).

Whatever writes a marker writes this with it. A property that is added here needs a migration that writes all texts
anew.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from operator import itemgetter
from typing import Any

import orjson

PROPERTIES = {
    "family": "family",
    "status": "status",
    "scheme": "scheme",
    "code": "digits",
    "heading_deg": "heading_deg",
    "heading_rmse_deg": "heading_rmse_deg",
    "side": "spec",
    "road": "road",
    "measure_m": "measure_m",
    "offset_m": "offset_m",
    "realization": "realization",
    "epoch": "epoch",
    "vertical_datum": "vertical_datum",
    "horizontal_rmse_m": "horizontal_rmse_m",
    "vertical_rmse_m": "vertical_rmse_m",
    "survey_method": "survey_method",
    "localization_grade": "localization_grade",
    "version": "version",
    "updated_at": "updated_at",
}
"""Properties in their order, and the columns that they come from; of `spec` a CERPM's side."""
_pick = itemgetter(*PROPERTIES.values())


def feature_text(marker: Mapping[str, Any]) -> str:
    """The feature of a marker with all its columns: WGS 84 longitude and latitude, height if there is one; one line."""
    lon_deg, lat_deg, height_m = marker["lon_deg"], marker["lat_deg"], marker["height_m"]
    properties = dict(zip(PROPERTIES, _pick(marker), strict=True))
    properties["side"] = _side(marker["spec"]) if marker["family"] == "cerpm" else None
    feature = {
        "type": "Feature",
        "id": marker["id"],
        "geometry": {
            "type": "Point",
            "coordinates": (lon_deg, lat_deg) if height_m is None else (lon_deg, lat_deg, height_m),
        },
        "properties": properties,
    }
    return orjson.dumps(feature, option=orjson.OPT_UTC_Z).decode()


def _side(spec: Any) -> str | None:
    if isinstance(spec, orjson.Fragment):
        return _side_in(spec.contents)
    return None if spec is None else spec.get("side")


@lru_cache(maxsize=64)  # the rows of an import have the same
def _side_in(spec: bytes | str) -> str | None:
    side: str | None = orjson.loads(spec)["side"]
    return side
