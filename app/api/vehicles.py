"""/v1/vehicles: the fleet, its sensor profiles and the keys that speak for it."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Path, Query, Request, Response

from app.api.dependencies import Caller, Idempotency, Identifier, Text, Version, json_response, next_link
from app.api.problems import problem_responses
from app.api.schemas_vehicles import (
    CalibrationChoice,
    VehicleIn,
    VehicleOut,
    VehiclePage,
    VehiclePatch,
    VehicleStatus,
    VehicleVersionPage,
)
from app.api.strict_json import StrictRoute
from app.services.vehicles import Vehicles

router = APIRouter(prefix="/v1/vehicles", tags=["fleet"], route_class=StrictRoute)

MAX_PAGE = 1000
VehicleId = Annotated[Identifier, Path(description="Id of the vehicle.")]
KeyId = Annotated[Text, Path(min_length=1, max_length=200, description="Id of the key, as GET /v1/keys lists it.")]


async def get_vehicles(request: Request) -> Vehicles:
    """Use cases on vehicles."""
    service: Vehicles = request.app.state.vehicles
    return service


Service = Annotated[Vehicles, Depends(get_vehicles)]


@router.post(
    "",
    status_code=201,
    response_class=Response,
    responses={201: {"model": VehicleOut, "description": "Added"}, **problem_responses(404, 409)},
)
def post_vehicle(vehicle: VehicleIn, caller: Caller, vehicles: Service, idempotency: Idempotency) -> Response:
    """Add a vehicle with its sensor profile; uploads that name it inherit the profile."""
    document, replayed = vehicles.add(caller, vehicle.name, vehicle.profile.given(), vehicle.note, idempotency)
    headers = {"Location": f"/v1/vehicles/{document['id']}", "ETag": _etag(document)}
    return json_response(document, 201, headers | ({"Idempotency-Replayed": "true"} if replayed else {}))


@router.get("", response_class=Response, responses={200: {"model": VehiclePage}, **problem_responses()})
def list_vehicles(
    request: Request,
    caller: Caller,
    vehicles: Service,
    status: VehicleStatus | None = None,
    limit: Annotated[int, Query(ge=1, le=MAX_PAGE)] = 100,
    after: Annotated[Identifier | None, Query(description="Last id of the page before.")] = None,
) -> Response:
    """Vehicles in the order they were added."""
    page, last = vehicles.page(caller, status=status, after=after, limit=limit)
    return json_response({"items": page}, headers=next_link(request, after=last) if last else None)


@router.get("/{vehicle_id}", response_class=Response, responses={200: {"model": VehicleOut}, **problem_responses(404)})
def get_vehicle(vehicle_id: VehicleId, caller: Caller, vehicles: Service) -> Response:
    """One vehicle, with its version as ETag; what it did since (uploads, kilometres) makes no version."""
    return _answer(vehicles.get(caller, vehicle_id))


@router.patch(
    "/{vehicle_id}",
    response_class=Response,
    responses={200: {"model": VehicleOut}, **problem_responses(404, 409, 412, 428)},
)
def patch_vehicle(
    vehicle_id: VehicleId, patch: VehiclePatch, caller: Caller, vehicles: Service, version: Version
) -> Response:
    """Change a vehicle that is still at the version named by If-Match."""
    return _answer(vehicles.change(caller, vehicle_id, patch.change(), version))


@router.delete("/{vehicle_id}", status_code=204, response_class=Response, responses=problem_responses(404, 412, 428))
def delete_vehicle(vehicle_id: VehicleId, caller: Caller, vehicles: Service, version: Version) -> Response:
    """Retire a vehicle. Its uploads and its history stay; new uploads are refused."""
    vehicles.retire(caller, vehicle_id, version)
    return Response(status_code=204)


@router.get(
    "/{vehicle_id}/versions",
    response_class=Response,
    responses={200: {"model": VehicleVersionPage}, **problem_responses(404)},
)
def list_vehicle_versions(
    vehicle_id: VehicleId,
    request: Request,
    caller: Caller,
    vehicles: Service,
    limit: Annotated[int, Query(ge=1, le=MAX_PAGE)] = 100,
    after: Annotated[int, Query(ge=0, lt=2**31, description="Last version of the page before.")] = 0,
) -> Response:
    """The vehicle's history, oldest first: which profile an upload used can be read back."""
    page, last = vehicles.history(caller, vehicle_id, after=after, limit=limit)
    return json_response({"items": page}, headers=next_link(request, after=last) if last else None)


@router.put(
    "/{vehicle_id}/calibration",
    response_class=Response,
    responses={200: {"model": VehicleOut}, **problem_responses(404, 412, 428)},
)
def put_calibration(
    vehicle_id: VehicleId, choice: CalibrationChoice, caller: Caller, vehicles: Service, version: Version
) -> Response:
    """Put the intrinsics and the distortion of a calibration into the vehicle's camera; its mount stays."""
    return _answer(vehicles.put_calibration(caller, vehicle_id, choice.calibration_id, version))


@router.put(
    "/{vehicle_id}/keys/{key_id}",
    response_class=Response,
    responses={200: {"model": VehicleOut}, **problem_responses(404, 409)},
)
def put_vehicle_key(vehicle_id: VehicleId, key_id: KeyId, caller: Caller, vehicles: Service) -> Response:
    """Let a key speak for the vehicle: what is uploaded with it need not name the vehicle, and may name no other."""
    return _answer(vehicles.link_key(caller, vehicle_id, key_id))


@router.delete(
    "/{vehicle_id}/keys/{key_id}", status_code=204, response_class=Response, responses=problem_responses(404)
)
def delete_vehicle_key(vehicle_id: VehicleId, key_id: KeyId, caller: Caller, vehicles: Service) -> Response:
    """Let a key speak for the vehicle no longer. The key itself stays valid."""
    vehicles.unlink_key(caller, vehicle_id, key_id)
    return Response(status_code=204)


def _answer(document: dict[str, Any]) -> Response:
    return json_response(document, headers={"ETag": _etag(document)})


def _etag(document: dict[str, Any]) -> str:
    return f'"{document["version"]}"'
