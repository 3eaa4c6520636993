"""Routes on vehicles, calibrations of cameras, and snapshots for vehicles."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from fastapi import Depends, Path, Query, Request, Response
from pydantic import ConfigDict, Field, JsonValue, field_validator

from app.api.decodes.schemas import CameraIn, FramesIn, PacketsIn, TraceIn
from app.api.http.bodies import DeclaredForm, SpooledPart, form_body, idempotency_of, read_declaration
from app.api.http.dependencies import (
    AfterVersion,
    Caller,
    Idempotency,
    Identifier,
    LastId,
    Number,
    PageSize,
    Text,
    Version,
    Whole,
    use_case,
)
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
from app.errors import InvalidParameter, UnreadableUpload
from app.families.documents import Flag, StrictModel
from app.formats.format import SpooledFile
from app.markers.snapshot import MEDIA_TYPE
from app.sensors.camera import CalibrationBoard
from app.services.fleet.calibrations import Calibrations
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
from app.services.fleet.vehicles import VehicleChange, Vehicles
from app.services.idempotency import IdempotencyKey
from app.services.markers.searches import parse_box

# === Schemas of calibration boards and calibrations.


DECLARATION_EXAMPLE: dict[str, JsonValue] = {
    "board": {"columns": 7, "rows": 10, "square_mm": 25.0, "marker_mm": 18.0},
}


class BoardIn(StrictModel):
    """A board: squares across and down, the upper left one black, and their sides as measured on the print."""

    columns: Whole = Field(7, description="Squares across, 4 to 24.")
    rows: Whole = Field(10, description="Squares down, 4 to 24; at most 200 squares.")
    square_mm: Number = Field(25.0, description="Side of a square, 8 to 250. [mm]")
    marker_mm: Number = Field(18.0, description="Side of a marker, 0.5 to 0.85 of a square. [mm]")

    def calibration_board(self) -> CalibrationBoard:
        """The board as the core knows it."""
        return CalibrationBoard(self.columns, self.rows, self.square_mm, self.marker_mm)


class CalibrationIn(StrictModel):
    """What is declared of the photos."""

    model_config = ConfigDict(json_schema_extra={"examples": [DECLARATION_EXAMPLE]})

    board: BoardIn = Field(default_factory=BoardIn)
    coefficients: Annotated[Literal[4, 5, 8] | None, Field(description="Of the distortion; chosen if left out.")] = None


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
    CalibrationIn,
    {"photos": ["1.jpg", "2.jpg"], "declaration": DECLARATION_EXAMPLE},
)


@dataclass(frozen=True, slots=True)
class _Asked:
    photos: tuple[tuple[str, SpooledFile], ...]
    declared: CalibrationIn
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
        yield _Asked(tuple(photos), await read_declaration(CalibrationIn, text, "declaration"), key)


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
    document, replayed = calibrations.run(
        caller, asked.photos, asked.declared.board.calibration_board(), asked.declared.coefficients, asked.idempotency
    )
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


# === Schemas of vehicles and their sensor profiles: a profile has the members of a decode's context.


Name = Annotated[Text, Field(min_length=1, max_length=80)]
Note = Annotated[Text, Field(max_length=500)]

PROFILE_EXAMPLE: dict[str, JsonValue] = {
    "camera": {
        "width_px": 1920, "height_px": 1080, "fx_px": 1371.0, "fy_px": 1371.0, "cx_px": 959.5, "cy_px": 539.5,
        "height_m": 1.57, "depression_deg": 23.0, "forward_m": 1.2,
    },
    "trace": {"axes": "FRD", "unit": "uT", "bar": {"forward_m": 0.4}, "rate_hz": 350.0},
    "packets": {
        "receiver": {"sensitivity_dbm": -129.0, "antenna_height_m": 1.6},
        "poses": {"forward_m": 0.9, "left_m": 0.0, "accuracy_m": 0.5},
    },
}  # fmt: skip


class VehicleCameraIn(CameraIn):
    """A vehicle's camera: that of a context; intrinsics may come later, from a calibration."""

    calibration_id: Identifier | None = Field(None, description="Calibration that the intrinsics are of.")


class ProfileIn(StrictModel):
    """What stays the same from upload to upload, in the members of a decode's context."""

    model_config = ConfigDict(json_schema_extra={"examples": [PROFILE_EXAMPLE]})

    camera: VehicleCameraIn | None = None
    thermal: Flag | None = Field(None, description="The camera is thermal.")
    thermal_range: Annotated[list[Number], Field(min_length=2, max_length=2)] | None = Field(
        None, description="Counts of 16-bit thermal frames that become 0 and 255."
    )
    frames: FramesIn | None = Field(None, description="Rate and clock of the frames of drives.")
    trace: TraceIn | None = Field(None, description="Magnetometer bar, axes, unit and rate; {} for METRO's own.")
    packets: PacketsIn | None = Field(None, description="Receiver, poses and clock of packet logs; {} for the usual.")

    def values(self) -> dict[str, Any]:
        """The values that the request sets."""
        return self.model_dump(exclude_unset=True, exclude_none=True)

    def sections(self) -> dict[str, Any]:
        """Sections that the request names; None for those that are removed."""
        values = self.values()
        return {name: values.get(name) for name in self.model_fields_set}


def _checked_name(name: str) -> str:
    if name != name.strip() or not name.isprintable() or (len(name) == 36 and name.count("-") == 4):
        raise InvalidParameter(
            "a vehicle's name is printable, does not begin or end with a space, and is no id",
            field="name",
            limit="1 to 80 printable characters",
            cure="send a fleet number or a plate, e.g. BUS-7",
        )
    return name


class VehicleIn(StrictModel):
    """A vehicle of the fleet."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"name": "BUS-7", "profile": PROFILE_EXAMPLE}]})

    name: Name = Field(description="What uploads call it; each name once in an agency.")
    note: Note | None = Field(None, description="Make, number plate, whatever distinguishes it.")
    profile: ProfileIn = Field(default_factory=ProfileIn)

    @field_validator("name")
    @classmethod
    def _name(cls, name: str) -> str:
        return _checked_name(name)


class VehiclePatch(StrictModel):
    """Members to change. A section of the profile is replaced as a whole; one that is null is taken out."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"profile": {"trace": {"axes": "FRD", "unit": "uT"}}, "reason": "new bar"}]},
    )

    name: Name = Field("", description="New name.")
    status: VehicleStatus = Field("active", description="A retired vehicle's uploads are refused.")
    note: Note | None = Field(None, description="New note; null clears it.")
    profile: ProfileIn = Field(default_factory=ProfileIn)
    reason: Note | None = Field(None, description="Why; appears in the history.")

    @field_validator("name")
    @classmethod
    def _name(cls, name: str) -> str:
        return _checked_name(name)

    def change(self) -> VehicleChange:
        """The change as the use cases know it."""
        named = self.model_fields_set
        values = self.model_dump(include=named & {"name", "status", "note"})
        profile = self.profile.sections() if "profile" in named else {}
        if not values and not profile:
            raise InvalidParameter(
                "the patch changes nothing", field="body", limit="at least one member", cure="name what to change"
            )
        return VehicleChange(values, profile, self.reason)


class CalibrationChoice(StrictModel):
    """Which calibration a vehicle's camera shall have."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"calibration_id": "019cb624-0000-7000-8000-00000000aaaa"}]},
    )

    calibration_id: Identifier


# === /v1/vehicles: the fleet, its sensor profiles and the keys that speak for it.


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
def post_vehicle(vehicle: VehicleIn, caller: Caller, vehicles: VehicleService, idempotency: Idempotency) -> Response:
    """Add a vehicle with its sensor profile.

    Uploads that name it inherit the profile.
    """
    document, replayed = vehicles.add(caller, vehicle.name, vehicle.profile.values(), vehicle.note, idempotency)
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
    vehicle_id: VehicleId, patch: VehiclePatch, caller: Caller, vehicles: VehicleService, version: Version
) -> Response:
    """Change a vehicle.

    One that is still at the version named by If-Match.
    """
    return versioned_response(vehicles.change(caller, vehicle_id, patch.change(), version))


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
