"""Routes on roads."""

from __future__ import annotations

from typing import Annotated

from fastapi import Path, Query, Request, Response
from pydantic import ConfigDict, Field

from app.api.http.dependencies import AfterLink, AfterVersion, Caller, Idempotency, LastId, PageSize, Version, use_case
from app.api.http.permissions import PLANNERS, READERS
from app.api.http.problems import problem_responses
from app.api.http.responses import (
    NOT_MODIFIED,
    IfNoneMatch,
    created_response,
    cursor_of,
    document_response,
    json_response,
    no_cursor,
    page_response,
    versioned_response,
)
from app.api.http.routes import Router
from app.errors import InvalidParameter
from app.families.documents import Metres
from app.inputs import Identifier, Number, StrictModel, Text
from app.services.markers.markers import MarkerPage
from app.services.roads.documents import (
    ChangedRoad,
    OnRoad,
    RoadDocument,
    RoadIn,
    RoadLocated,
    RoadLocatedMany,
    RoadPage,
    RoadPatch,
    RoadPlaced,
    RoadPlacedMany,
    RoadVersionPage,
)
from app.services.roads.roads import Roads as RoadsService

# === Schemas of roads and of linear references.


MAX_POSITIONS = 1_000
MAX_REACH_M = 1_000.0
MAX_OFFSET_M = 1_000.0

RoadId = Annotated[Identifier, Path(description="Id of the road.")]
Offset = Annotated[float, Field(allow_inf_nan=False, ge=-MAX_OFFSET_M, le=MAX_OFFSET_M)]


class PositionsIn(StrictModel):
    """Positions to find on a road."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"positions": [[8.4012, 49.0003]], "max_offset_m": 20}]})

    positions: Annotated[
        list[Annotated[list[Number], Field(min_length=2, max_length=2)]],
        Field(min_length=1, max_length=MAX_POSITIONS, description="Longitude and latitude of each. [deg]"),
    ]
    max_offset_m: Annotated[float, Field(allow_inf_nan=False, gt=0, le=MAX_REACH_M)] = 100.0


class ReferenceIn(StrictModel):
    """A place along a road."""

    measure_m: Metres
    offset_m: Offset = 0.0


class ReferencesIn(StrictModel):
    """Places along a road."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"references": [{"measure_m": 612100, "offset_m": -3.5}]}]}
    )

    references: Annotated[list[ReferenceIn], Field(min_length=1, max_length=MAX_POSITIONS)]


# === /v1/roads: axes with measures; positions to measures and offsets, and back.


router = Router("/v1/roads", "roads")

_MetresQuery = Annotated[float | None, Query(ge=-1e8, le=1e8, allow_inf_nan=False)]
_OfVersion = Annotated[
    int | None, Query(alias="version", ge=1, lt=2**31, description="On an earlier version of the road.")
]
Roads = Annotated[RoadsService, use_case(lambda cases: cases.roads)]


@router.post(
    "",
    PLANNERS,
    expensive=True,
    status_code=201,
    responses={
        200: {"model": ChangedRoad, "description": "Checked; nothing was stored"},
        201: {"model": ChangedRoad, "description": "Registered"},
        **problem_responses(409),
    },
)
def post_road(road: RoadIn, caller: Caller, roads: Roads, idempotency: Idempotency) -> Response:
    """Register a road.

    The markers that name it get the measure and offset of their position.
    """
    document, replayed = roads.register(caller, road, idempotency)
    return json_response(document) if road.dry_run else created_response(document, replayed, path="/v1/roads")


@router.get("", READERS, responses=document_response(RoadPage))
def list_roads(
    request: Request,
    caller: Caller,
    roads: Roads,
    name: Annotated[Text | None, Query(min_length=1, max_length=200)] = None,
    limit: PageSize = 100,
    after: LastId = None,
) -> Response:
    """List the roads of an agency.

    In the order they were registered, without their geometry.
    """
    page, last = roads.page(caller, name=name, after=after, limit=limit)
    return page_response(request, page, after=last)


@router.get("/{road_id}", READERS, responses={**NOT_MODIFIED, **document_response(RoadDocument, 404)})
def get_road(road_id: RoadId, caller: Caller, roads: Roads, if_none_match: IfNoneMatch = None) -> Response:
    """Get a road.

    With its version as ETag.
    """
    return versioned_response(roads.get(caller, road_id), if_none_match)


@router.patch("/{road_id}", PLANNERS, expensive=True, responses=document_response(ChangedRoad, 404, 412, 428))
def patch_road(road_id: RoadId, patch: RoadPatch, caller: Caller, roads: Roads, version: Version) -> Response:
    """Change a road's axis or calibration.

    Its markers stay where they are; their measures follow.
    """
    if patch.geometry is None and patch.calibration is None:
        raise InvalidParameter(
            "the patch changes nothing",
            field="body",
            limit="geometry or calibration",
            cure="name what to change",
        )
    document = roads.change(caller, road_id, patch, version)
    return json_response(document) if patch.dry_run else versioned_response(document)


@router.get("/{road_id}/versions", READERS, responses=document_response(RoadVersionPage, 404))
def list_road_versions(
    road_id: RoadId,
    request: Request,
    caller: Caller,
    roads: Roads,
    limit: Annotated[int, Query(ge=1, le=100)] = 10,
    after: AfterVersion = 0,
) -> Response:
    """List the versions of a road.

    Oldest first.
    """
    page, last = roads.history(caller, road_id, after=after, limit=limit)
    return page_response(request, page, after=last)


@router.get("/{road_id}/locate", READERS, responses=document_response(RoadLocated, 404))
def locate_on_road(
    road_id: RoadId,
    caller: Caller,
    roads: Roads,
    lon: Annotated[float, Query(allow_inf_nan=False, description="Longitude. [deg]")],
    lat: Annotated[float, Query(allow_inf_nan=False, description="Latitude. [deg]")],
    max_offset_m: Annotated[float, Query(gt=0, le=MAX_REACH_M, allow_inf_nan=False)] = 100.0,
    version: _OfVersion = None,
) -> Response:
    """Convert a position to a measure on a road.

    Measure and offset, left positive; several feet where the road passes more than once.
    """
    many = roads.locate(caller, road_id, [(lon, lat)], max_offset_m, version)
    return json_response(RoadLocated(**_of(many), **many["items"][0]))


@router.post("/{road_id}/locate", READERS, expensive=True, responses=document_response(RoadLocatedMany, 404))
def locate_many_on_road(
    road_id: RoadId, body: PositionsIn, caller: Caller, roads: Roads, version: _OfVersion = None
) -> Response:
    """Convert up to 1000 positions to measures on a road.

    Measures and offsets.
    """
    positions = [(position[0], position[1]) for position in body.positions]
    return json_response(roads.locate(caller, road_id, positions, body.max_offset_m, version))


@router.get("/{road_id}/position", READERS, responses=document_response(RoadPlaced, 404))
def get_position_on_road(
    road_id: RoadId,
    caller: Caller,
    roads: Roads,
    measure_m: Annotated[float, Query(ge=-1e8, le=1e8, allow_inf_nan=False)],
    offset_m: Annotated[float, Query(ge=-MAX_OFFSET_M, le=MAX_OFFSET_M, allow_inf_nan=False)] = 0.0,
    version: _OfVersion = None,
) -> Response:
    """Convert a measure on a road to a position.

    With an offset. Refused where the measure is on no road, several where it repeats.
    """
    many = roads.place(caller, road_id, [(measure_m, offset_m)], version)
    document = RoadPlaced(**_of(many), **many["items"][0])
    if not document["places"]:
        ranges = ", ".join(f"{s['from_m']:.3f} to {s['to_m']:.3f} m" for s in document["sections"][:20])
        raise InvalidParameter(
            f"the measure {measure_m:.3f} m is on no part of road {document['road']}",
            field="measure_m",
            limit=ranges,
            cure="choose a measure of the road; equations of stationing leave gaps",
        )
    return json_response(document)


@router.post("/{road_id}/position", READERS, expensive=True, responses=document_response(RoadPlacedMany, 404))
def get_positions_on_road(
    road_id: RoadId, body: ReferencesIn, caller: Caller, roads: Roads, version: _OfVersion = None
) -> Response:
    """Convert up to 1000 measures on a road to positions.

    With offsets; no place where a measure is on no road.
    """
    references = [(reference.measure_m, reference.offset_m) for reference in body.references]
    return json_response(roads.place(caller, road_id, references, version))


@router.get("/{road_id}/markers", READERS, responses=document_response(MarkerPage, 404))
def list_markers_on_road(
    road_id: RoadId,
    request: Request,
    caller: Caller,
    roads: Roads,
    from_m: _MetresQuery = None,
    to_m: _MetresQuery = None,
    min_offset_m: _MetresQuery = None,
    max_offset_m: _MetresQuery = None,
    section: Annotated[
        int | None, Query(ge=0, lt=2**31, description="One of the road's sections, from 0: measures may repeat.")
    ] = None,
    limit: PageSize = 100,
    after: AfterLink = None,
) -> Response:
    """List the markers on a road.

    Along the road: section by section, in the order of their measures.
    """
    first, separator, place = (after or "").partition(";")
    if after is not None and not (separator and first.isdecimal() and len(first) < 10):
        raise no_cursor()
    page, last = roads.markers(
        caller,
        road_id,
        measures_m=(from_m, to_m),
        offsets_m=(min_offset_m, max_offset_m),
        section=section,
        after=(int(first), cursor_of(place)) if after is not None else (0, None),
        limit=limit,
    )
    return page_response(request, {"items": page}, after=last)


def _of(many: OnRoad) -> OnRoad:
    return {
        "road_id": many["road_id"],
        "road": many["road"],
        "version": many["version"],
        "sections": many["sections"],
    }
