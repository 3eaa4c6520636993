"""OGC API Features part 4, as QGIS edits: a point and flat properties become what /v1/markers takes.

No If-Match is asked for here, because these clients send none. Deleting a marker retires it: nothing is lost.
"""

from __future__ import annotations

from typing import Any

from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response

from app.api.markers import NewMarkerIn, patch_marker, post_marker
from app.api.ogc.items import feature_id
from app.api.ogc.query import known_parameters
from app.api.ogc.responses import GEOJSON, JSON, base_url, caller_of
from app.api.permissions import PERMISSIONS
from app.api.schemas_patch import MarkerPatch
from app.api.strict_json import parse_json
from app.errors import InvalidParameter, UnsupportedUpload
from app.services.feature_crs import STORAGE_CRS, FeatureCrs
from app.services.features import Features, get_collection

_PLAIN = ("status", "heading_deg", "heading_rmse_deg", "road", "measure_m", "offset_m", "side")
_CLEARED = ("heading_deg", "heading_rmse_deg", "road", "measure_m", "offset_m")  # by a PUT without them
_SURVEYED = (
    *("realization", "epoch", "vertical_datum", "horizontal_rmse_m", "vertical_rmse_m", "survey_method"),
    *("check_points", "surveyor", "instrument"),
)
_FIXED = ("family", "scheme", "code")
_READ_ONLY = ("transform_accuracy_m", "localization_grade", "version", "updated_at")
_BODY_TYPES = (GEOJSON, JSON, "application/merge-patch+json")


async def item_options(request: Request) -> Response:
    """What may be done with this."""
    collection = get_collection(request.path_params["collection"])
    allowed = ["GET", "HEAD", "OPTIONS"]
    if collection.editable:
        scope, path = caller_of(request).scope, request.scope["route"].path
        edits = ("PUT", "PATCH", "DELETE") if "feature" in request.path_params else ("POST",)
        allowed += [method for method in edits if scope in PERMISSIONS[f"{method} {path}"]]
    return Response(headers={"Allow": ", ".join(allowed)})


async def post_item(request: Request) -> Response:
    """Register a plate or a CERPM."""
    body = await _body(request)
    return await run_in_threadpool(_create, request, body)


async def patch_item(request: Request) -> Response:
    """Change properties or the place of a marker."""
    body = await _body(request)
    return await run_in_threadpool(_change, request, body)


async def put_item(request: Request) -> Response:
    """Replace a marker: what is left out is cleared, but for what a marker always has."""
    body = await _body(request)
    return await run_in_threadpool(_replace, request, body)


def delete_item(request: Request) -> Response:
    """Retire a marker."""
    marker_id, _ = _stored(request)
    known_parameters(request, ())
    patch = MarkerPatch(status="retired", reason="deleted through OGC API Features")
    patch_marker(marker_id, patch, caller_of(request), request.app.state.markers, None)
    return Response(status_code=204)


def _create(request: Request, feature: dict[str, Any]) -> Response:
    collection = _editable(request)
    known_parameters(request, ())
    given = {name: value for name, value in _properties(feature).items() if value is not None}
    body = {name: given[name] for name in _PLAIN if name in given}
    body["position"] = _place(feature.get("geometry"), request) | {n: given[n] for n in _SURVEYED if n in given}
    body["family"] = given.get("family", "plate")
    if body["family"] == "magnet":
        raise InvalidParameter(
            "magnets need a lane, which a point has not",
            field="properties.family",
            limit="plate, cerpm",
            cure="register magnets at /v1/markers",
        )
    if body["family"] == "cerpm" and "code" in given:
        digits = str(given["code"])
        body["number"] = int(digits) if digits.isascii() and digits.isdigit() and len(digits) < 20 else digits
    elif body["family"] == "plate":
        code = {"scheme": given.get("scheme"), "digits": given.get("code")}
        body["code"] = {name: value for name, value in code.items() if value is not None}
    made = post_marker(_validated(NewMarkerIn, body), caller_of(request), request.app.state.markers, None)
    marker_id = made.headers["Location"].rsplit("/", 1)[1]
    return Response(
        status_code=201, headers={"Location": f"{base_url(request)}/collections/{collection}/items/{marker_id}"}
    )


def _replace(request: Request, feature: dict[str, Any]) -> Response:
    _, stored = _stored(request)
    known_parameters(request, ())
    given = {**dict.fromkeys((*_CLEARED, *_SURVEYED)), **_properties(feature)}
    place = _place(feature.get("geometry"), request)
    before, properties = stored["geometry"]["coordinates"], stored["properties"]
    if tuple(place.values()) == tuple(before) and all(given[name] == properties[name] for name in _SURVEYED):
        for name in _SURVEYED:  # the position is as it was, and stays as it was given
            del given[name]
        return _change(request, {"properties": given})
    return _change(request, {"properties": given, "geometry": feature["geometry"]})


def _change(request: Request, feature: dict[str, Any]) -> Response:
    marker_id, stored = _stored(request)
    known_parameters(request, ())
    given = _properties(feature)
    for name in _FIXED:
        if name in given and given[name] != stored["properties"][name]:
            raise InvalidParameter(
                f"{name} of a marker stays as it is",
                field=f"properties.{name}",
                limit=str(stored["properties"][name]),
                cure="delete the marker and register another",
            )
    body = {name: given[name] for name in _PLAIN if name in given}
    if stored["properties"]["family"] != "cerpm" and body.get("side") is None:
        body.pop("side", None)
    surveyed = {name: given[name] for name in _SURVEYED if name in given}
    if feature.get("geometry") is not None:
        body["position"] = _place(feature["geometry"], request) | surveyed
    elif surveyed:
        marker = request.app.state.markers.get(caller_of(request), marker_id)
        body["position"] = {**marker["position"]["original"], **surveyed}
    if body:
        patch_marker(marker_id, _validated(MarkerPatch, body), caller_of(request), request.app.state.markers, None)
    return Response(status_code=204)


def _editable(request: Request) -> str:
    collection = get_collection(request.path_params["collection"])
    if not collection.editable:
        raise InvalidParameter("this collection is read only", field="collectionId", limit="markers can be edited")
    return collection.id


def _stored(request: Request) -> tuple[str, dict[str, Any]]:
    _editable(request)
    collection = get_collection(request.path_params["collection"])
    features: Features = request.app.state.features
    marker_id = feature_id(request, collection)
    return marker_id, features.get(caller_of(request), collection, marker_id)


async def _body(request: Request) -> dict[str, Any]:
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind not in _BODY_TYPES:
        raise UnsupportedUpload("the body is not GeoJSON", field="Content-Type", limit=", ".join(_BODY_TYPES))
    body = parse_json(await request.body())
    if not isinstance(body, dict) or body.get("type", "Feature") != "Feature":
        raise InvalidParameter(
            "the body is not a feature", field="type", limit="Feature", cure="send a GeoJSON Feature"
        )
    return body


def _properties(feature: dict[str, Any]) -> dict[str, Any]:
    given = feature.get("properties", {})
    if given is None:
        return {}
    if not isinstance(given, dict):
        raise InvalidParameter("properties is not an object", field="properties", limit="an object")
    for name in given:
        if name not in (*_PLAIN, *_SURVEYED, *_FIXED, *_READ_ONLY, "id"):
            raise InvalidParameter(
                f"there is no property {name[:80]!r}",
                field="properties",
                limit=", ".join((*_PLAIN, *_SURVEYED, *_FIXED)),
                cure="leave it out",
            )
    return given


def _place(geometry: Any, request: Request) -> dict[str, Any]:
    spot = geometry.get("coordinates") if isinstance(geometry, dict) and geometry.get("type") == "Point" else None
    if (
        not isinstance(spot, list)
        or len(spot) not in (2, 3)
        or not all(isinstance(v, int | float) and not isinstance(v, bool) and abs(v) < 1e9 for v in spot)
    ):
        raise InvalidParameter("the geometry is not a point", field="geometry", limit="Point with two or three numbers")
    sent = request.headers.get("content-crs", f"<{STORAGE_CRS}>").strip().strip("<>")
    if sent not in list(FeatureCrs):
        raise InvalidParameter("this CRS is not offered", field="Content-Crs", limit=", ".join(FeatureCrs))
    lon_deg, lat_deg = FeatureCrs(sent).to_lon_lat(float(spot[0]), float(spot[1]))
    place: dict[str, Any] = {"lon_deg": lon_deg, "lat_deg": lat_deg}
    return place if len(spot) == 2 else {**place, "height_m": float(spot[2])}


def _validated(schema: type[BaseModel], body: dict[str, Any]) -> Any:
    try:
        return schema.model_validate(body)
    except ValidationError as error:
        raise RequestValidationError([{**item, "loc": ("body", *item["loc"])} for item in error.errors()]) from error
