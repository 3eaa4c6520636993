"""Vehicles of a fleet: their sensor profiles, the keys that speak for them, and what they uploaded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta
from itertools import pairwise
from typing import Annotated, Any

import sqlalchemy as sa
from pydantic import AfterValidator, ConfigDict, Field, JsonValue

from app.decoding.declarations import DecodeContext, Profile, UploadContext
from app.errors import Conflict, InvalidParameter, NotAllowed, NotFound, naming
from app.formats.format import SpooledFile
from app.formats.kinds import UploadKind, guess_kind
from app.geodesy.frames import distance_m
from app.inputs import Declaration, Identifier, Text, parse_input
from app.registry import vehicles as store
from app.registry.database import Database
from app.registry.resources import first_version
from app.registry.vehicles import CALIBRATIONS, VEHICLES, VehicleKeyRow, VehicleRow
from app.sensors.camera import INTRINSICS, CameraDeclaration
from app.services.access.access import Caller
from app.services.access.audit import log_change
from app.services.documents import document_of
from app.services.fleet.documents import (
    VehicleDocument,
    VehicleKey,
    VehiclePage,
    VehicleStatus,
    VehicleVersionDocument,
    VehicleVersionPage,
)
from app.services.idempotency import IdempotencyKey, find_earlier, write_once
from app.services.ports import Clock
from app.values import JsonObject

# === Sensor profiles: the part of a decode's context that stays the same from upload to upload.
#
# What an upload states itself goes before its vehicle's profile, member by member.


FRAME, TRACE, PACKETS = (str(kind) for kind in UploadKind)
NEEDED = {FRAME: "camera", TRACE: "trace", PACKETS: "packets"}
"""Section that an upload of a kind cannot do without."""
SECTIONS = {
    FRAME: ("camera", "thermal", "thermal_range", "frames"),
    TRACE: ("trace",),
    PACKETS: ("packets", "camera"),
}
_SIZE = ("width_px", "height_px")
_CALIBRATED = (*_SIZE, *INTRINSICS, "distortion")
"""What a calibration puts into a camera, and another calibration or field of view invalidates."""
_WHOLE = ("trace.can.speed", "trace.can.heading")
"""Objects that are replaced as a whole: a signal by its name and one by its bits declare the same thing."""
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


class VehicleCamera(CameraDeclaration):
    """A vehicle's camera: that of a context; intrinsics may come later, from a calibration."""

    calibration_id: Identifier | None = Field(None, description="Calibration that the intrinsics are of.")


class VehicleProfile(Profile):
    """What stays the same from upload to upload, in the members of a decode's context."""

    model_config = ConfigDict(json_schema_extra={"examples": [PROFILE_EXAMPLE]})

    camera: VehicleCamera | None = None

    def check(self) -> None:
        """Refuse a profile that no upload could use; a camera may be its mount alone.

        Raises
        ------
        InvalidParameter
            The field is below ``profile``.
        """
        usable = self
        if self.camera is not None and not self.camera.has_projection:
            camera = self.camera.model_copy(update={"horizontal_fov_deg": 60.0})
            usable = self.model_copy(update={"camera": camera})
        with naming("profile"):
            Profile.check(usable)

    def document(self) -> JsonObject:
        """The profile as it is stored: the members that have a value."""
        return self.model_dump(mode="json", exclude_unset=True, exclude_none=True)


def inherit(profile: JsonObject, stated: JsonObject, kind: str) -> tuple[JsonObject, dict[str, str]]:
    """Complete what an upload states from the vehicle's profile.

    Parameters
    ----------
    profile : mapping
        As it is stored.
    stated : mapping
        Only what the upload states; a member that is None is unknown and is not inherited.
    kind : str
        ``frame``, ``trace`` or ``packets``: sections of other kinds are ignored.

    Returns
    -------
    context : dict
        The members of a `DecodeContext`.
    sources : dict
        Path of each member to ``upload``, ``vehicle`` or ``default``.

    Raises
    ------
    InvalidParameter
        The profile's intrinsics belong to another frame size than the upload states.
    """
    ours = {name: profile[name] for name in SECTIONS[kind] if name in profile}
    stated = {name: value for name, value in stated.items() if value is not None or name not in NEEDED}
    if "camera" in ours:
        ours["camera"] = _fitting_camera(ours["camera"], stated.get("camera") or {})
        if kind != FRAME and not _has_projection({**ours["camera"], **(stated.get("camera") or {})}):
            del ours["camera"]  # a mount without a projection cannot draw over a frame
    if stated.get("thermal") is False:
        ours.pop("thermal_range", None)
    sources: dict[str, str] = {}
    context = _merge(ours, stated, sources)
    if (camera := context.get("camera")) is not None:
        for name, member in CameraDeclaration.model_fields.items():
            if name not in camera and member.default not in (None, ()):
                camera[name], sources[f"camera.{name}"] = member.default, "default"
    return context, dict(sorted(sources.items()))


def _has_projection(camera: Mapping[str, object]) -> bool:
    return any(camera.get(name) is not None for name in (*INTRINSICS, "horizontal_fov_deg"))


def _fitting_camera(camera: JsonObject, stated: Mapping[str, object]) -> JsonObject:
    """A profile's camera without its calibration's id and the members that the upload's camera invalidates."""
    known = {name for name, value in stated.items() if value is not None}
    dropped = {"calibration_id"}
    if "horizontal_fov_deg" in known or set(INTRINSICS) <= known:
        dropped |= set(_CALIBRATED)
    if known & set(INTRINSICS):
        dropped.add("horizontal_fov_deg")
    camera = {name: value for name, value in camera.items() if name not in dropped}
    for name in _SIZE:
        if name in known and camera.get(INTRINSICS[0]) is not None and stated[name] != camera.get(name):
            raise InvalidParameter(
                f"the vehicle's camera was calibrated at {camera.get('width_px')} x {camera.get('height_px')} px, "
                f"the upload states {name} {stated[name]}",
                field=f"camera.{name}",
                limit="intrinsics belong to one size of frame",
                cure="send all four intrinsics of this size, or frames of the calibrated size",
            )
    return camera


def _merge(ours: JsonObject, stated: JsonObject, sources: dict[str, str], path: str = "") -> JsonObject:
    merged: JsonObject = {}
    for name in {**ours, **stated}:
        at, is_stated = f"{path}{name}", name in stated
        own, value = ours.get(name), stated[name] if is_stated else ours[name]
        if value is None:
            continue  # stated to be unknown
        if isinstance(value, dict) and at not in _WHOLE:
            part = own if isinstance(own, dict) else {}
            merged[name] = _merge(part, value if is_stated else {}, sources, f"{at}.")
            continue
        merged[name] = {k: v for k, v in value.items() if v is not None} if isinstance(value, dict) else value
        sources[at] = "upload" if is_stated else "vehicle"
    return merged


# === Vehicles of a fleet.


ACTIVE: VehicleStatus = "active"
RETIRED: VehicleStatus = "retired"
MAX_KEYS = 20


def _check_name(name: str) -> str:
    if name != name.strip() or not name.isprintable() or (len(name) == 36 and name.count("-") == 4):
        raise InvalidParameter(
            "a vehicle's name is printable, does not begin or end with a space, and is no id",
            limit="1 to 80 printable characters",
            cure="send a fleet number or a plate, e.g. BUS-7",
        )
    return name


VehicleName = Annotated[Text, Field(min_length=1, max_length=80), AfterValidator(_check_name)]
Note = Annotated[Text, Field(max_length=500)]


class NewVehicle(Declaration):
    """A vehicle of the fleet."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"name": "BUS-7", "profile": PROFILE_EXAMPLE}]})

    name: VehicleName = Field(description="What uploads call it; each name once in an agency.")
    note: Note | None = Field(None, description="Make, number plate, whatever distinguishes it.")
    profile: VehicleProfile = VehicleProfile()


class VehicleChange(Declaration):
    """Members to change. A section of the profile is replaced as a whole; one that is null is taken out."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"profile": {"trace": {"axes": "FRD", "unit": "uT"}}, "reason": "new bar"}]},
    )

    name: VehicleName = Field("", description="New name.")
    status: VehicleStatus = Field(ACTIVE, description="A retired vehicle's uploads are refused.")
    note: Note | None = Field(None, description="New note; null clears it.")
    profile: VehicleProfile = VehicleProfile()
    reason: Note | None = Field(None, description="Why; appears in the history.")


class Vehicles:
    """Use cases on vehicles, one transaction each."""

    def __init__(self, database: Database, clock: Clock, idempotency_ttl: timedelta = timedelta(hours=24)) -> None:
        self._database = database
        self._clock = clock
        self._ttl = idempotency_ttl

    def add(
        self,
        caller: Caller,
        vehicle: NewVehicle,
        key: IdempotencyKey | None = None,
    ) -> tuple[VehicleDocument, bool]:
        """Store a new vehicle.

        Returns
        -------
        vehicle : dict
        replayed : bool
            The request had been made before under the same Idempotency-Key; nothing was stored now.

        Raises
        ------
        InvalidParameter
            The profile contradicts itself.
        Conflict
            The agency has a vehicle of this name.
        """
        now = self._clock()
        if earlier := find_earlier(self._database, caller.agency_id, key, now):
            return earlier, True
        vehicle.profile.check()
        name, profile = vehicle.name, vehicle.profile.document()
        with write_once(self._database, caller.agency_id, key, now, self._ttl) as (connection, answer):
            if answer.replayed:
                return answer.response, True
            VEHICLES.check_name(connection, caller.agency_id, name)
            _check_calibrated(connection, caller, profile)
            values = {**first_version(now), "name": name, "status": ACTIVE, "note": vehicle.note, "profile": profile}
            row = VEHICLES.add(connection, caller.agency_id, values, who=caller.label)
            document = answer.store(vehicle_document(row))
            log_change(connection, caller, "vehicle.added", now=now, subject=row.id, document=profile)
        return document, False

    def get(self, caller: Caller, vehicle_id: str) -> VehicleDocument:
        """One vehicle."""
        with self._database.read() as connection:
            return _document(connection, caller, VEHICLES.get(connection, caller.agency_id, vehicle_id))

    def page(
        self, caller: Caller, *, status: str | None = None, after: str | None = None, limit: int = 100
    ) -> tuple[VehiclePage, str | None]:
        """A page of vehicles, and the id to continue after if there may be more."""
        with self._database.read() as connection:
            rows, last = VEHICLES.page(connection, caller.agency_id, beyond=after, limit=limit, status=status)
            keys = store.list_keys(connection, caller.agency_id, [row.id for row in rows])
        return VehiclePage(items=[vehicle_document(row, keys.get(row.id, [])) for row in rows]), last

    def history(
        self, caller: Caller, vehicle_id: str, *, after: int = 0, limit: int = 100
    ) -> tuple[VehicleVersionPage, int | None]:
        """A page of a vehicle's history, oldest first, and the version to continue after if there may be more."""
        with self._database.read() as connection:
            rows, last = VEHICLES.history(connection, caller.agency_id, vehicle_id, after=after, limit=limit)
        return {"items": [document_of(VehicleVersionDocument, row, vehicle=row.stored) for row in rows]}, last

    def change(self, caller: Caller, vehicle_id: str, change: VehicleChange, version: int | None) -> VehicleDocument:
        """Change a vehicle that is still at a version (None: whatever it is at).

        Raises
        ------
        NotFound
            There is none with this id, or it belongs to another agency.
        StaleVersion
            It is at another version.
        InvalidParameter
            The profile would contradict itself.
        Conflict
            Another vehicle of the agency has the name.
        """
        now = self._clock()
        with self._database.write() as connection:
            row = VEHICLES.get_at(connection, caller.agency_id, vehicle_id, version)
            changes = change.model_dump(include=change.model_fields_set & {"name", "status", "note"})
            sections = change.profile.model_fields_set if "profile" in change.model_fields_set else set()
            if not changes and not sections:
                raise InvalidParameter(
                    "the patch changes nothing", field="body", limit="at least one member", cure="name what to change"
                )
            if "name" in changes and changes["name"] != row.name:
                VEHICLES.check_name(connection, caller.agency_id, changes["name"])
            if sections:
                kept = {name: section for name, section in row.profile.items() if name not in sections}
                changes["profile"] = {**kept, **change.profile.document()}
                parse_input(VehicleProfile, changes["profile"], "profile").check()
                _check_calibrated(connection, caller, changes["profile"])
            return _changed(connection, caller, row, changes, now, change.reason)

    def retire(self, caller: Caller, vehicle_id: str, version: int | None) -> None:
        """Take a vehicle out of use: its uploads and its history stay, new uploads are refused."""
        now = self._clock()
        with self._database.write() as connection:
            row = VEHICLES.get_at(connection, caller.agency_id, vehicle_id, version)
            if row.status != RETIRED:
                _changed(connection, caller, row, {"status": RETIRED}, now, "retired")

    def put_calibration(
        self, caller: Caller, vehicle_id: str, calibration_id: str, version: int | None
    ) -> VehicleDocument:
        """Put a calibration's intrinsics into a vehicle's camera; its mount stays. Raises as `change`.

        Raises
        ------
        NotFound
            There is no such vehicle or calibration.
        """
        now = self._clock()
        with self._database.write() as connection:
            row = VEHICLES.get_at(connection, caller.agency_id, vehicle_id, version)
            found = CALIBRATIONS.get(connection, caller.agency_id, calibration_id).result["camera"]
            camera = {**row.profile.get("camera", {}), **found, "calibration_id": calibration_id}
            camera.pop("horizontal_fov_deg", None)
            profile = {**row.profile, "camera": camera}
            parse_input(VehicleProfile, profile, "profile").check()
            why = f"calibration {calibration_id}"
            return _changed(connection, caller, row, {"profile": profile}, now, why)

    # --- keys -----------------------------------------------------------------------------------------------------

    def link_key(self, caller: Caller, vehicle_id: str, key_id: str) -> VehicleDocument:
        """Let a key speak for a vehicle: its uploads are the vehicle's without naming it.

        Raises
        ------
        NotFound
            There is no such vehicle or key.
        Conflict
            The key speaks for another vehicle, or too many speak for this one.
        """
        with self._database.write() as connection:
            row = VEHICLES.get(connection, caller.agency_id, vehicle_id)
            holder_id = _holder(connection, caller, key_id)
            other = store.find_of_key(connection, caller.agency_id, holder_id)
            if other is not None and other.id != vehicle_id:
                raise Conflict(
                    f"the key speaks for vehicle {other.name}",
                    field="key_id",
                    limit="one vehicle a key",
                    cure="make a key for each vehicle, or take it from the other one first",
                )
            if other is None:
                linked = store.list_keys(connection, caller.agency_id, [vehicle_id]).get(vehicle_id, [])
                if len(linked) >= MAX_KEYS:
                    raise Conflict(
                        f"{len(linked)} keys speak for the vehicle", field="key_id", limit=f"at most {MAX_KEYS} keys"
                    )
                store.link_key(connection, caller.agency_id, holder_id, vehicle_id)
                log_change(
                    connection, caller, "vehicle.key-linked", now=self._clock(), subject=vehicle_id, key=holder_id
                )
            return _document(connection, caller, row)

    def unlink_key(self, caller: Caller, vehicle_id: str, key_id: str) -> None:
        """Let a key speak for a vehicle no longer.

        Raises
        ------
        NotFound
            There is no such vehicle or key, or it does not speak for it.
        """
        with self._database.write() as connection:
            VEHICLES.get(connection, caller.agency_id, vehicle_id)
            holder_id = _holder(connection, caller, key_id)
            if not store.unlink_key(connection, caller.agency_id, holder_id, vehicle_id):
                raise NotFound(f"the key {key_id} does not speak for this vehicle", field="key_id")
            log_change(connection, caller, "vehicle.key-unlinked", now=self._clock(), subject=vehicle_id, key=holder_id)


def vehicle_document(row: VehicleRow, keys: Sequence[VehicleKeyRow] = ()) -> VehicleDocument:
    """A vehicle as clients see it."""
    held = [document_of(VehicleKey, key) for key in keys]
    return document_of(VehicleDocument, row, driven_km=round(row.driven_m / 1000, 3), keys=held)


def _document(connection: sa.Connection, caller: Caller, row: VehicleRow) -> VehicleDocument:
    keys = store.list_keys(connection, caller.agency_id, [row.id])
    return vehicle_document(row, keys.get(row.id, []))


def _changed(
    connection: sa.Connection,
    caller: Caller,
    row: VehicleRow,
    changes: dict[str, object],
    now: datetime,
    why: str | None,
) -> VehicleDocument:
    changed = VEHICLES.update(
        connection, caller.agency_id, row.id, changes, version=row.version, now=now, who=caller.label, why=why
    )
    said = {"version": changed.version, "status": changed.status}
    log_change(connection, caller, "vehicle.changed", now=now, subject=row.id, document=changed.profile, **said)
    return _document(connection, caller, changed)


def _holder(connection: sa.Connection, caller: Caller, key_id: str) -> str:
    holder_id = store.find_holder(connection, caller.agency_id, key_id)
    if holder_id is None:
        raise NotFound(f"there is no key {key_id}", field="key_id", cure="GET /v1/keys lists yours")
    return holder_id


def _check_calibrated(connection: sa.Connection, caller: Caller, profile: JsonObject) -> None:
    """A camera that names its calibration has the calibration's figures."""
    camera = profile.get("camera") or {}
    calibration_id = camera.get("calibration_id")
    if calibration_id is None:
        return
    field_name = "profile.camera.calibration_id"
    found = CALIBRATIONS.get(connection, caller.agency_id, calibration_id, field_name).result["camera"]
    other = next((name for name in _CALIBRATED if camera.get(name) != found.get(name)), None)
    if other is not None:
        raise InvalidParameter(
            f"{other} is not that of calibration {calibration_id}",
            field=f"profile.camera.{other}",
            limit=str(found.get(other)),
            cure="leave calibration_id out, or send the calibration's own figures",
        )


# === Uploads of a vehicle: its profile completes their contexts, and they are counted.


_MAX_BETWEEN_FRAMES_M = 200.0
_MIN_BETWEEN_FRAMES_M = 1.0
_NAMED = {TRACE: "a magnetometer trace", PACKETS: "a packet log"}


def resolve_context(
    connection: sa.Connection, caller: Caller, stated: UploadContext, file: SpooledFile, name: str
) -> DecodeContext:
    """The context of an upload: its own members, completed by the profile of its vehicle if it has one.

    Raises
    ------
    NotFound
        The agency has no such vehicle.
    NotAllowed
        The key speaks for another vehicle.
    Conflict
        The vehicle is retired.
    InvalidParameter
        The context contradicts itself or a limit, or the vehicle's profile lacks what this kind of upload needs.
    """
    vehicle, members = find_vehicle(connection, caller, stated.vehicle), stated.stated
    if vehicle is None:
        context, _ = inherit({}, members, FRAME)
    else:
        kind = _kind(vehicle, members, file, name)
        _check_sections(vehicle, members, kind)
        if kind != FRAME and members.get(kind) is None:
            members[kind] = {}  # its content shows what it is
        context, sources = inherit(vehicle.profile, members, kind)
        context["vehicle"] = {"id": vehicle.id, "name": vehicle.name, "version": vehicle.version, "sources": sources}
    if shown := "".join(sign for sign in name if sign.isprintable())[:120]:
        context["file_name"] = shown
    return parse_input(DecodeContext, context)


def count_upload(
    connection: sa.Connection, agency_id: str, decode_id: str, context: DecodeContext, now: datetime
) -> None:
    """Count an upload for its vehicle, in the transaction that stores its decode."""
    if context.vehicle is not None:
        store.add_upload(connection, agency_id, context.vehicle.id, decode_id, version=context.vehicle.version, now=now)


def count_driven(
    connection: sa.Connection, agency_id: str, decode_id: str, context: DecodeContext, result: Mapping[str, object]
) -> None:
    """Count what a decode that is done found to have been driven, for its vehicle."""
    if context.vehicle is not None:
        store.add_driven(connection, agency_id, decode_id, driven_m(result))


def driven_m(result: Mapping[str, Any]) -> float:
    """How far a vehicle drove by a decode's result. [m]

    A trace: its speed over time. A packet log: along its track, see `PoseTrack.driven_m`. Frames: straight from the
    position of each frame to that of the next one that has one, where they lie 1 to 200 m apart.
    """
    if "report" in result:
        return float(result["report"].get("driven_m") or 0.0)
    fixes = [frame["fix"] for frame in result.get("frames", ()) if frame["fix"] is not None]
    legs = [distance_m(a["lon_deg"], a["lat_deg"], b["lon_deg"], b["lat_deg"]) for a, b in pairwise(fixes)]
    return sum(leg for leg in legs if _MIN_BETWEEN_FRAMES_M <= leg <= _MAX_BETWEEN_FRAMES_M)


def find_vehicle(connection: sa.Connection, caller: Caller, named: str | None) -> VehicleRow | None:
    """The vehicle with a name or an id, or that of the caller's key; None without both.

    Raises
    ------
    NotFound, NotAllowed, Conflict
        As `resolve_context`.
    """
    own = store.find_of_key(connection, caller.agency_id, caller.key_id)
    vehicle = own
    if named is not None:
        # a name is never like an id
        vehicle = VEHICLES.find(connection, caller.agency_id, name=named) or (
            VEHICLES.get(connection, caller.agency_id, named, "vehicle") if len(named) == 36 else None
        )
        if vehicle is None:
            raise NotFound(f"there is no vehicle {named}", field="vehicle", cure="GET /v1/vehicles lists yours")
        if own is not None and own.id != vehicle.id:
            raise NotAllowed(
                f"this key speaks for vehicle {own.name}, not for {vehicle.name}",
                field="vehicle",
                limit=own.name,
                cure="leave vehicle out, or use the other vehicle's key",
            )
    if vehicle is not None and vehicle.status == RETIRED:
        raise Conflict(
            f"vehicle {vehicle.name} is retired",
            field="vehicle",
            limit="vehicles in use",
            cure='set its status to "active", or name another vehicle',
        )
    return vehicle


def _kind(vehicle: VehicleRow, stated: Mapping[str, object], file: SpooledFile, name: str) -> str:
    """What a vehicle's upload is: as it states, else by its content, else the only kind that the profile has."""
    for kind in (TRACE, PACKETS):
        if stated.get(kind) is not None:
            return kind
    guessed = guess_kind(name or "upload", file)
    if guessed is not None:
        return str(guessed)
    possible = [kind for kind in _NAMED if kind in vehicle.profile]
    if len(possible) == 1:
        return possible[0]
    raise InvalidParameter(
        "the file does not show what it is, and neither does the vehicle's profile",
        field="trace",
        limit="one of trace, packets",
        cure='add "trace": {} or "packets": {} to the context',
    )


def _check_sections(vehicle: VehicleRow, stated: Mapping[str, object], kind: str) -> None:
    needed = NEEDED[kind]
    if stated.get(needed) is not None or (kind == FRAME and needed in stated):
        return  # stated in the upload, or stated to be unknown
    section = vehicle.profile.get(needed)
    if section is None:
        raise InvalidParameter(
            f"the file is {_NAMED.get(kind, 'a picture')}; the profile of vehicle {vehicle.name} has no {needed}",
            field="vehicle",
            limit=f"a profile with {needed}, or {needed} in the context",
            cure=f"PATCH /v1/vehicles/{vehicle.id} with profile.{needed}",
        )
    if kind == FRAME and not _has_projection(section):
        raise InvalidParameter(
            f"the camera of vehicle {vehicle.name} has a mount and no intrinsics",
            field="vehicle",
            limit="fx_px, fy_px, cx_px, cy_px; or horizontal_fov_deg",
            cure="calibrate it with POST /v1/calibrations, or send them in the context",
        )
