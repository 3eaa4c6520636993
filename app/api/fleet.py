"""Routes on vehicles, calibrations of cameras, and snapshots for vehicles."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Path, Query, Request, Response
from pydantic import ConfigDict

from app.api.http.bodies import DeclaredForm, SpooledPart, form_body, idempotency_of, read_declaration
from app.api.http.dependencies import AfterVersion, Caller, Idempotency, LastId, PageSize, Version, use_case
from app.api.http.permissions import ADMINS, EVERYBODY, PLANNERS, READERS, SURVEYORS
from app.api.http.problems import problem_responses
from app.api.http.responses import (
    BINARY,
    IdempotencyKeyHeader,
    created_response,
    document_response,
    file_response,
    json_response,
    page_response,
    versioned_response,
)
from app.api.http.routes import Router
from app.encoders.calibration_board import encode_board
from app.encoders.plate import ArtworkFormat, write_artwork
from app.errors import UnreadableUpload
from app.formats.format import SpooledFile
from app.inputs import Identifier, StrictModel, Text
from app.markers.snapshot import MEDIA_TYPE
from app.sensors.camera import CalibrationBoard
from app.services.fleet.calibrations import DECLARATION_EXAMPLE, CalibrationDeclaration, Calibrations
from app.services.fleet.documents import (
    CalibrationDocument,
    CalibrationPage,
    TrustDocument,
    VehicleDocument,
    VehiclePage,
    VehicleStatus,
    VehicleVersionPage,
    trust_document,
)
from app.services.fleet.snapshots import MAX_HOURS
from app.services.fleet.snapshots import Snapshots as SnapshotsService
from app.services.fleet.tasks import MAX_PHOTOS
from app.services.fleet.vehicles import NewVehicle, VehicleChange, Vehicles
from app.services.idempotency import IdempotencyKey
from app.services.markers.searches import parse_box

# === /v1/calibration-boards: boards to print; /v1/calibrations: photos of them -> the camera's intrinsics.


calibration_router = Router("/v1", "fleet")

MAX_DECLARATION_BYTES = 16 * 1024
_CURE = "send multipart/form-data with several parts photos, or one ZIP of them, and a part declaration"
_FORM = DeclaredForm("a calibration", "photos", MAX_DECLARATION_BYTES, _CURE, max_files=MAX_PHOTOS)
_BODY = form_body(
    {
        "photos": {
            "type": "array",
            "items": BINARY,
            "description": f"JPEG or PNG, or a ZIP of them; {MAX_PHOTOS} at most, 12 to 20 are good.",
        }
    },
    "declaration",
    CalibrationDeclaration,
    {"photos": ["1.jpg", "2.jpg"], "declaration": DECLARATION_EXAMPLE},
)


@dataclass(frozen=True, slots=True)
class _Asked:
    photos: tuple[tuple[str, SpooledFile], ...]
    declared: CalibrationDeclaration
    idempotency: IdempotencyKey | None


async def get_asked(request: Request, idempotency_key: IdempotencyKeyHeader = None) -> AsyncIterator[_Asked]:
    """Read the photos and their declaration from the form; the files are deleted when the request ends.

    Raises
    ------
    UnsupportedUpload
        The request is no form.
    UnreadableUpload
        There is no photo in it, or one came as text.
    MalformedRequest
        The form or the declaration's JSON cannot be read.
    """
    async with _FORM.received(request) as (form, text):
        files = form.getlist("photos")
        if not files or not all(isinstance(file, SpooledPart) for file in files):
            raise UnreadableUpload("there is no photo in the form", field="photos", limit="files", cure=_CURE)
        photos = [
            ((file.filename or f"photo {k}")[:120], file.spooled)
            for k, file in enumerate(files)
            if isinstance(file, SpooledPart)
        ]
        key = idempotency_of(request, idempotency_key, text, *(file for _name, file in photos))
        yield _Asked(tuple(photos), await read_declaration(CalibrationDeclaration, text, "declaration"), key)


CalibrationService = Annotated[Calibrations, use_case(lambda cases: cases.calibrations)]
Asked = Annotated[_Asked, Depends(get_asked)]


@calibration_router.get(
    "/calibration-boards/board.{form}",
    READERS,
    responses={**file_response(form.media_type for form in ArtworkFormat), **problem_responses()},
)
def get_board(
    form: ArtworkFormat,
    caller: Caller,
    columns: Annotated[int, Query(description="Squares across.", ge=1, le=1000)] = 7,
    rows: Annotated[int, Query(description="Squares down.", ge=1, le=1000)] = 10,
    square_mm: Annotated[float, Query(allow_inf_nan=False, description="Side of a square. [mm]")] = 25.0,
    marker_mm: Annotated[float, Query(allow_inf_nan=False, description="Side of a marker. [mm]")] = 18.0,
    resolution_dpi: Annotated[float, Query(ge=36, le=300, allow_inf_nan=False, description="Of a PNG.")] = 150.0,
) -> Response:
    """Download a calibration board at true size.

    With a bar to measure the print by. Print it at 100 %, flat and matt.
    """
    board = CalibrationBoard(columns, rows, square_mm, marker_mm)
    artwork = write_artwork(encode_board(board), form, dpi=resolution_dpi)
    headers = {"Content-Disposition": f'inline; filename="waymark-board-{columns}x{rows}-{square_mm:g}mm.{form}"'}
    return Response(artwork.content, headers=headers, media_type=artwork.media_type)


@calibration_router.post(
    "/calibrations",
    SURVEYORS,
    expensive=True,
    status_code=201,
    openapi_extra=_BODY,
    responses=document_response(CalibrationDocument, 409, 415, status=201, description="Calibrated"),
)
def post_calibration(caller: Caller, asked: Asked, calibrations: CalibrationService) -> Response:
    """Calibrate a camera from photos of a board.

    Photos that cannot be used are left out, each with its reason.

    What is not good enough is refused with a named reason. `PUT /v1/vehicles/{id}/calibration` puts the result into a
    vehicle's camera. The photos are not kept.
    """
    document, replayed = calibrations.run(caller, asked.photos, asked.declared, asked.idempotency)
    return created_response(document, replayed, path="/v1/calibrations")


@calibration_router.get("/calibrations", READERS, responses=document_response(CalibrationPage))
def list_calibrations(
    request: Request,
    caller: Caller,
    calibrations: CalibrationService,
    limit: Annotated[int, Query(ge=1, le=100)] = 100,
    after: LastId = None,
) -> Response:
    """List the calibrations of an agency.

    Newest first.
    """
    page, last = calibrations.page(caller, before=after, limit=limit)
    return page_response(request, page, after=last)


@calibration_router.get(
    "/calibrations/{calibration_id}", READERS, responses=document_response(CalibrationDocument, 404)
)
def get_calibration(
    calibration_id: Annotated[Identifier, Path(description="Id of the calibration.")],
    caller: Caller,
    calibrations: CalibrationService,
) -> Response:
    """Get a calibration.

    With what became of each photo.
    """
    return json_response(calibrations.get(caller, calibration_id))


# === /v1/vehicles: the fleet, its sensor profiles and the keys that speak for it.


class CalibrationChoice(StrictModel):
    """Which calibration a vehicle's camera shall have."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"calibration_id": "019cb624-0000-7000-8000-00000000aaaa"}]},
    )

    calibration_id: Identifier


vehicle_router = Router("/v1/vehicles", "fleet")

VehicleId = Annotated[Identifier, Path(description="Id of the vehicle.")]
KeyId = Annotated[Text, Path(min_length=1, max_length=200, description="Id of the key, as GET /v1/keys lists it.")]
VehicleService = Annotated[Vehicles, use_case(lambda cases: cases.vehicles)]


@vehicle_router.post(
    "",
    PLANNERS,
    status_code=201,
    responses=document_response(VehicleDocument, 404, 409, status=201, description="Added"),
)
def post_vehicle(vehicle: NewVehicle, caller: Caller, vehicles: VehicleService, idempotency: Idempotency) -> Response:
    """Add a vehicle with its sensor profile.

    Uploads that name it inherit the profile.
    """
    document, replayed = vehicles.add(caller, vehicle, idempotency)
    return created_response(document, replayed, path="/v1/vehicles")


@vehicle_router.get("", READERS, responses=document_response(VehiclePage))
def list_vehicles(
    request: Request,
    caller: Caller,
    vehicles: VehicleService,
    status: VehicleStatus | None = None,
    limit: PageSize = 100,
    after: LastId = None,
) -> Response:
    """List the vehicles of an agency.

    In the order they were added.
    """
    page, last = vehicles.page(caller, status=status, after=after, limit=limit)
    return page_response(request, page, after=last)


@vehicle_router.get("/{vehicle_id}", READERS, responses=document_response(VehicleDocument, 404))
def get_vehicle(vehicle_id: VehicleId, caller: Caller, vehicles: VehicleService) -> Response:
    """Get a vehicle.

    With its version as ETag; what it did since (uploads, kilometres) makes no version.
    """
    return versioned_response(vehicles.get(caller, vehicle_id))


@vehicle_router.patch("/{vehicle_id}", PLANNERS, responses=document_response(VehicleDocument, 404, 409, 412, 428))
def patch_vehicle(
    vehicle_id: VehicleId, patch: VehicleChange, caller: Caller, vehicles: VehicleService, version: Version
) -> Response:
    """Change a vehicle.

    One that is still at the version named by If-Match.
    """
    return versioned_response(vehicles.change(caller, vehicle_id, patch, version))


@vehicle_router.delete("/{vehicle_id}", PLANNERS, status_code=204, responses=problem_responses(404, 412, 428))
def delete_vehicle(vehicle_id: VehicleId, caller: Caller, vehicles: VehicleService, version: Version) -> Response:
    """Retire a vehicle.

    Its uploads and its history stay; new uploads are refused.
    """
    vehicles.retire(caller, vehicle_id, version)
    return Response(status_code=204)


@vehicle_router.get("/{vehicle_id}/versions", READERS, responses=document_response(VehicleVersionPage, 404))
def list_vehicle_versions(
    vehicle_id: VehicleId,
    request: Request,
    caller: Caller,
    vehicles: VehicleService,
    limit: PageSize = 100,
    after: AfterVersion = 0,
) -> Response:
    """List the versions of a vehicle.

    Oldest first: which profile an upload used can be read back.
    """
    page, last = vehicles.history(caller, vehicle_id, after=after, limit=limit)
    return page_response(request, page, after=last)


@vehicle_router.put("/{vehicle_id}/calibration", PLANNERS, responses=document_response(VehicleDocument, 404, 412, 428))
def put_calibration(
    vehicle_id: VehicleId, choice: CalibrationChoice, caller: Caller, vehicles: VehicleService, version: Version
) -> Response:
    """Put a calibration into a vehicle's camera.

    Its intrinsics and distortion; the mount of the camera stays.
    """
    return versioned_response(vehicles.put_calibration(caller, vehicle_id, choice.calibration_id, version))


@vehicle_router.put("/{vehicle_id}/keys/{key_id}", ADMINS, responses=document_response(VehicleDocument, 404, 409))
def put_vehicle_key(vehicle_id: VehicleId, key_id: KeyId, caller: Caller, vehicles: VehicleService) -> Response:
    """Let a key speak for a vehicle.

    What is uploaded with it need not name the vehicle, and may name no other.
    """
    return versioned_response(vehicles.link_key(caller, vehicle_id, key_id))


@vehicle_router.delete("/{vehicle_id}/keys/{key_id}", ADMINS, status_code=204, responses=problem_responses(404))
def delete_vehicle_key(vehicle_id: VehicleId, key_id: KeyId, caller: Caller, vehicles: VehicleService) -> Response:
    """Let a key speak for a vehicle no longer.

    The key itself stays valid.
    """
    vehicles.unlink_key(caller, vehicle_id, key_id)
    return Response(status_code=204)


# === /v1/snapshots: what vehicles take along.


snapshot_router = Router("/v1/snapshots", "snapshots")
Snapshots = Annotated[SnapshotsService, use_case(lambda cases: cases.snapshots)]


@snapshot_router.get(
    "",
    EVERYBODY,  # vehicles without a connection decode with it
    expensive=True,
    responses={**file_response([MEDIA_TYPE], "See docs/snapshots.md"), **problem_responses()},
)
def get_snapshot(
    caller: Caller,
    snapshots: Snapshots,
    bbox: Annotated[Text, Query(max_length=200, examples=["8.3,48.9,8.6,49.1"])],
    hours: Annotated[
        float, Query(gt=0, le=MAX_HOURS, allow_inf_nan=False, description="How long it holds. [h]")
    ] = 24.0,
) -> Response:
    """Download a signed snapshot of an area.

    The markers for vehicles that decode without a connection; all but the retired ones.

    With the agency's codebooks. Keys of CERPMs are not in it.
    """
    headers = {"Content-Disposition": 'attachment; filename="markers.waymark"', "Cache-Control": "private, no-store"}
    return Response(snapshots.make(caller, parse_box(bbox), hours), headers=headers, media_type=MEDIA_TYPE)


@snapshot_router.get("/trust", EVERYBODY, responses=document_response(TrustDocument))
def get_trust(caller: Caller, snapshots: Snapshots) -> Response:
    """Get the keys that snapshots are verified with.

    The operator installs them in a vehicle over a trusted channel.
    """
    return json_response(trust_document(snapshots.trust(caller)))
