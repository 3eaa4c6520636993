"""/v1/vehicles: the fleet, its sensor profiles and the keys that speak for it."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Request, Response

from app.api.fleet.schemas_vehicles import CalibrationChoice, VehicleIn, VehiclePatch
from app.api.http.dependencies import (
    AfterVersion,
    Caller,
    Idempotency,
    Identifier,
    LastId,
    PageSize,
    Text,
    Version,
    use_cases,
)
from app.api.http.problems import problem_responses
from app.api.http.responses import created_response, document_response, page_response, versioned_response
from app.api.http.strict_json import StrictRoute
from app.services.fleet.documents import VehicleDocument, VehiclePage, VehicleStatus, VehicleVersionPage
from app.services.fleet.vehicles import Vehicles

router = APIRouter(prefix="/v1/vehicles", tags=["fleet"], route_class=StrictRoute)

VehicleId = Annotated[Identifier, Path(description="Id of the vehicle.")]
KeyId = Annotated[Text, Path(min_length=1, max_length=200, description="Id of the key, as GET /v1/keys lists it.")]
Service = Annotated[Vehicles, use_cases("vehicles")]


@router.post(
    "", status_code=201, responses=document_response(VehicleDocument, 404, 409, status=201, description="Added")
)
def post_vehicle(vehicle: VehicleIn, caller: Caller, vehicles: Service, idempotency: Idempotency) -> Response:
    """Add a vehicle with its sensor profile; uploads that name it inherit the profile."""
    document, replayed = vehicles.add(caller, vehicle.name, vehicle.profile.given(), vehicle.note, idempotency)
    return created_response(document, replayed, path="/v1/vehicles")


@router.get("", responses=document_response(VehiclePage))
def list_vehicles(
    request: Request,
    caller: Caller,
    vehicles: Service,
    status: VehicleStatus | None = None,
    limit: PageSize = 100,
    after: LastId = None,
) -> Response:
    """Vehicles in the order they were added."""
    page, last = vehicles.page(caller, status=status, after=after, limit=limit)
    return page_response(request, page, after=last)


@router.get("/{vehicle_id}", responses=document_response(VehicleDocument, 404))
def get_vehicle(vehicle_id: VehicleId, caller: Caller, vehicles: Service) -> Response:
    """One vehicle, with its version as ETag; what it did since (uploads, kilometres) makes no version."""
    return versioned_response(vehicles.get(caller, vehicle_id))


@router.patch("/{vehicle_id}", responses=document_response(VehicleDocument, 404, 409, 412, 428))
def patch_vehicle(
    vehicle_id: VehicleId, patch: VehiclePatch, caller: Caller, vehicles: Service, version: Version
) -> Response:
    """Change a vehicle that is still at the version named by If-Match."""
    return versioned_response(vehicles.change(caller, vehicle_id, patch.change(), version))


@router.delete("/{vehicle_id}", status_code=204, responses=problem_responses(404, 412, 428))
def delete_vehicle(vehicle_id: VehicleId, caller: Caller, vehicles: Service, version: Version) -> Response:
    """Retire a vehicle. Its uploads and its history stay; new uploads are refused."""
    vehicles.retire(caller, vehicle_id, version)
    return Response(status_code=204)


@router.get("/{vehicle_id}/versions", responses=document_response(VehicleVersionPage, 404))
def list_vehicle_versions(
    vehicle_id: VehicleId,
    request: Request,
    caller: Caller,
    vehicles: Service,
    limit: PageSize = 100,
    after: AfterVersion = 0,
) -> Response:
    """The vehicle's history, oldest first: which profile an upload used can be read back."""
    page, last = vehicles.history(caller, vehicle_id, after=after, limit=limit)
    return page_response(request, page, after=last)


@router.put("/{vehicle_id}/calibration", responses=document_response(VehicleDocument, 404, 412, 428))
def put_calibration(
    vehicle_id: VehicleId, choice: CalibrationChoice, caller: Caller, vehicles: Service, version: Version
) -> Response:
    """Put the intrinsics and the distortion of a calibration into the vehicle's camera; its mount stays."""
    return versioned_response(vehicles.put_calibration(caller, vehicle_id, choice.calibration_id, version))


@router.put("/{vehicle_id}/keys/{key_id}", responses=document_response(VehicleDocument, 404, 409))
def put_vehicle_key(vehicle_id: VehicleId, key_id: KeyId, caller: Caller, vehicles: Service) -> Response:
    """Let a key speak for the vehicle: what is uploaded with it need not name the vehicle, and may name no other."""
    return versioned_response(vehicles.link_key(caller, vehicle_id, key_id))


@router.delete("/{vehicle_id}/keys/{key_id}", status_code=204, responses=problem_responses(404))
def delete_vehicle_key(vehicle_id: VehicleId, key_id: KeyId, caller: Caller, vehicles: Service) -> Response:
    """Let a key speak for the vehicle no longer. The key itself stays valid."""
    vehicles.unlink_key(caller, vehicle_id, key_id)
    return Response(status_code=204)
