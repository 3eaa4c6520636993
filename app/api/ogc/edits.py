"""OGC API Features part 4, as QGIS edits: a point and flat properties become what /v1/markers takes.

If-Match is not required here, because these clients send none; one that is sent is compared. Deleting a marker retires
it: nothing is lost.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import orjson
from fastapi import Depends, Header, Request
from pydantic import TypeAdapter
from starlette.responses import Response

from app.api.http.bodies import media_type_of
from app.api.http.dependencies import Caller, Markers, SentVersion
from app.api.http.permissions import PLANNERS, READERS, SURVEYORS
from app.api.http.problems import problem_responses, reference
from app.api.http.routes import Router
from app.api.http.strict_json import in_thread_if_large, validated
from app.api.markers.markers import WARNINGS_TEXT, MarkerPatch, NewMarkerIn, patch_marker, post_marker
from app.api.ogc.responses import (
    GEOJSON,
    JSON,
    BaseUrl,
    CollectionOf,
    EditableCollection,
    FeatureId,
    FeaturesService,
    NewFeature,
    refuse_parameters,
)
from app.errors import InvalidParameter, StaleVersion, UnsupportedUpload
from app.families import FAMILIES, FAMILY_NAMES, get_family
from app.families.family import AnyFamily
from app.formats.json_text import parse_json
from app.geodesy.systems import is_ellipsoidal
from app.services.access.access import Caller as CallerValue
from app.services.markers.features import STORAGE_CRS, Collection, FeatureCrs
from app.services.markers.features import Features as FeaturesUseCases
from app.services.markers.markers import Markers as MarkersUseCases
from app.services.markers.plausibility import WarningMode
from app.values import JsonObject

_PLAIN = ("status", "heading_deg", "heading_rmse_deg", "road", "measure_m", "offset_m", "side")
_CLEARED = ("heading_deg", "heading_rmse_deg", "road", "measure_m", "offset_m")  # by a PUT without them
_SURVEYED = (
    *("realization", "epoch", "height_m", "vertical_datum", "horizontal_rmse_m", "vertical_rmse_m", "survey_method"),
    *("check_points", "surveyor", "instrument"),
)
_FIXED = ("family", "scheme", "code")
READ_ONLY = ("transform_accuracy_m", "localization_grade", "version", "updated_at")
_NEW_MARKER, _MARKER_PATCH = TypeAdapter(NewMarkerIn), TypeAdapter(MarkerPatch)
_BODY_TYPES = (GEOJSON, JSON, "application/merge-patch+json")
_WITH_BODY = {
    "requestBody": {"content": {kind: {"schema": reference(NewFeature)} for kind in _BODY_TYPES}, "required": True}
}
router = Router("/ogc/collections/{collection}/items", "ogc")


@dataclass(frozen=True, slots=True)
class _Edit:
    """A request that edits: the caller, the use cases on features and markers, and the CRS of the body."""

    collection: Collection
    caller: CallerValue
    features: FeaturesUseCases
    markers: MarkersUseCases
    crs: FeatureCrs
    warnings: WarningMode


async def get_edit(
    collection: EditableCollection,
    caller: Caller,
    features: FeaturesService,
    markers: Markers,
    _parameters: Annotated[None, Depends(refuse_parameters)],
    content_crs: Annotated[
        str, Header(alias="Content-Crs", description="CRS of the body's geometry.")
    ] = f"<{STORAGE_CRS}>",
    warnings: Annotated[WarningMode, Header(alias="Waymark-Warnings", description=WARNINGS_TEXT)] = "store",
) -> _Edit:
    """What a request that edits has besides its feature."""
    sent = content_crs.strip().strip("<>")
    if sent not in list(FeatureCrs):
        raise InvalidParameter("this CRS is not offered", field="Content-Crs", limit=", ".join(FeatureCrs))
    return _Edit(collection, caller, features, markers, FeatureCrs(sent), warnings)


async def get_body(request: Request) -> JsonObject:
    """The feature in the body.

    Raises
    ------
    UnsupportedUpload
        The body is not GeoJSON.
    MalformedRequest, InvalidParameter
        It is not a feature.
    """
    kind = media_type_of(request)
    if kind not in _BODY_TYPES:
        raise UnsupportedUpload("the body is not GeoJSON", field="Content-Type", limit=", ".join(_BODY_TYPES))
    raw = await request.body()
    body = await in_thread_if_large(len(raw), partial(parse_json, raw))
    if not isinstance(body, dict) or body.get("type", "Feature") != "Feature":
        raise InvalidParameter(
            "the body is not a feature", field="type", limit="Feature", cure="send a GeoJSON Feature"
        )
    return body


Edit = Annotated[_Edit, Depends(get_edit)]
Body = Annotated[JsonObject, Depends(get_body)]


@router.options("", READERS, responses=problem_responses(404))
async def list_collection_methods(request: Request, collection: CollectionOf, caller: Caller) -> Response:
    """List the methods that the caller may use on a collection.

    They are in the header Allow.
    """
    return _allowed(request, collection, caller, "POST")


@router.options("/{feature}", READERS, responses=problem_responses(404))
async def list_feature_methods(request: Request, collection: CollectionOf, caller: Caller, feature: str) -> Response:
    """List the methods that the caller may use on a feature.

    They are in the header Allow.
    """
    return _allowed(request, collection, caller, "PUT", "PATCH", "DELETE")


def _allowed(request: Request, collection: Collection, caller: CallerValue, *edits: str) -> Response:
    allowed = ["GET", "HEAD", "OPTIONS"]
    if collection.editable:
        path, permissions = request.scope["route"].path, request.app.state.permissions
        allowed += [method for method in edits if caller.scope in permissions[f"{method} {path}"]]
    return Response(headers={"Allow": ", ".join(allowed)})


@router.post("", PLANNERS, status_code=201, responses=problem_responses(404, 409), openapi_extra=_WITH_BODY)
def post_feature(feature: Body, edit: Edit, base: BaseUrl) -> Response:
    """Register a marker as a feature.

    Of a family whose markers are points.
    """
    given = {name: value for name, value in _properties(feature).items() if value is not None}
    body = {name: given[name] for name in _PLAIN if name in given}
    surveyed = {name: given[name] for name in _SURVEYED if name in given}
    body["position"] = _position(_place(feature.get("geometry"), edit.crs), surveyed)
    family = _family(given.get("family", FAMILY_NAMES[0]))
    body |= {"family": family.name, **family.feature_members(given)}
    made = post_marker(validated(_NEW_MARKER, body, "body"), edit.caller, edit.markers, None, edit.warnings)
    marker_id = made.headers["Location"].rsplit("/", 1)[1]
    where = f"{base}/collections/{edit.collection.id}/items/{marker_id}"
    return Response(status_code=201, headers={"Location": where, **_warned(made)})


@router.put(
    "/{feature}", SURVEYORS, status_code=204, responses=problem_responses(404, 409, 412), openapi_extra=_WITH_BODY
)
def put_feature(feature: Body, edit: Edit, feature_id: FeatureId, version: SentVersion) -> Response:
    """Replace a marker by a feature.

    What is left out is cleared, but for what a marker always has.
    """
    stored = edit.features.get(edit.caller, edit.collection, feature_id)
    given = {**dict.fromkeys((*_CLEARED, *_SURVEYED)), **_properties(feature)}
    place = _place(feature.get("geometry"), edit.crs)
    before, properties = stored["geometry"]["coordinates"], stored["properties"]
    if "height_m" in place:
        given["height_m"] = _position(place, given)["height_m"]
    if tuple(place.values()) == tuple(before) and all(given[name] == properties[name] for name in _SURVEYED):
        for name in _SURVEYED:  # the position is as it was, and stays as it was sent
            del given[name]
        return _change({"properties": given}, edit, feature_id, version)
    return _change({"properties": given, "geometry": feature["geometry"]}, edit, feature_id, version)


@router.patch(
    "/{feature}", SURVEYORS, status_code=204, responses=problem_responses(404, 409, 412), openapi_extra=_WITH_BODY
)
def patch_feature(feature: Body, edit: Edit, feature_id: FeatureId, version: SentVersion) -> Response:
    """Change properties or the position of a marker."""
    return _change(feature, edit, feature_id, version)


@router.delete("/{feature}", PLANNERS, status_code=204, responses=problem_responses(404, 409, 412))
def delete_feature(edit: Edit, feature_id: FeatureId, version: SentVersion) -> Response:
    """Retire a marker."""
    edit.features.get(edit.caller, edit.collection, feature_id)
    patch = MarkerPatch(status="retired", reason="deleted through OGC API Features")
    patch_marker(feature_id, patch, edit.caller, edit.markers, version)
    return Response(status_code=204)


def _change(feature: JsonObject, edit: _Edit, feature_id: str, version: int | None) -> Response:
    stored = edit.features.get(edit.caller, edit.collection, feature_id)
    if version not in (None, stored["properties"]["version"]):  # also where there is nothing to change
        raise StaleVersion(f"marker {feature_id} is no longer at version {version}", field="If-Match")
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
    for name in _members_of_others(stored["properties"]["family"]):
        if body.get(name) is None:  # a client sends every property that it was sent
            body.pop(name, None)
    surveyed = {name: given[name] for name in _SURVEYED if name in given}
    if feature.get("geometry") is not None:
        body["position"] = _position(_place(feature["geometry"], edit.crs), surveyed)
    elif surveyed:
        marker = edit.markers.get(edit.caller, feature_id)
        body["position"] = {**marker["position"]["original"], **surveyed}
    if not body:
        return Response(status_code=204)
    patch = validated(_MARKER_PATCH, body, "body")
    changed = patch_marker(feature_id, patch, edit.caller, edit.markers, version, edit.warnings)
    return Response(status_code=204, headers=_warned(changed))


def _warned(answer: Response) -> dict[str, str]:
    """Codes of the warnings about a position that was stored, as a header: these responses have no body."""
    found = orjson.loads(answer.body).get("position_warnings", ())
    return {"Waymark-Warnings": " ".join(warning["code"] for warning in found)} if found else {}


def _family(name: object) -> AnyFamily:
    if name not in FAMILY_NAMES:
        raise InvalidParameter(
            f"there is no family {str(name)[:40]!r}", field="properties.family", limit=", ".join(FAMILY_NAMES)
        )
    return get_family(name)


def _members_of_others(family: str) -> set[str]:
    """Members of a change that only other families have."""
    return {name for other in FAMILIES if other.name != family and other.change for name in other.change.model_fields}


def _properties(feature: JsonObject) -> JsonObject:
    given = feature.get("properties", {})
    if given is None:
        return {}
    if not isinstance(given, dict):
        raise InvalidParameter("properties is not an object", field="properties", limit="an object")
    for name in given:
        if name not in (*_PLAIN, *_SURVEYED, *_FIXED, *READ_ONLY, "id"):
            raise InvalidParameter(
                f"there is no property {name[:80]!r}",
                field="properties",
                limit=", ".join((*_PLAIN, *_SURVEYED, *_FIXED)),
                cure="leave it out",
            )
    return given


def _position(place: JsonObject, surveyed: JsonObject) -> JsonObject:
    """A point with its properties. The height of a geometry is ellipsoidal; another is in the properties."""
    if "height_m" not in place:
        return place | surveyed
    if is_ellipsoidal(surveyed.get("vertical_datum")):
        return surveyed | place
    raise InvalidParameter(
        "the geometry has a height, which is ellipsoidal, and vertical_datum is another",
        field="geometry",
        limit="two numbers with a vertical_datum other than ellipsoid",
        cure="send the height as the property height_m",
    )


def _place(geometry: Any, crs: FeatureCrs) -> JsonObject:
    spot = geometry.get("coordinates") if isinstance(geometry, dict) and geometry.get("type") == "Point" else None
    if (
        not isinstance(spot, list)
        or len(spot) not in (2, 3)
        or not all(isinstance(v, int | float) and not isinstance(v, bool) and abs(v) < 1e9 for v in spot)
    ):
        raise InvalidParameter("the geometry is not a point", field="geometry", limit="Point with two or three numbers")
    lon_deg, lat_deg = crs.to_lon_lat(float(spot[0]), float(spot[1]))
    place: JsonObject = {"lon_deg": lon_deg, "lat_deg": lat_deg}
    return place if len(spot) == 2 else {**place, "height_m": float(spot[2])}
