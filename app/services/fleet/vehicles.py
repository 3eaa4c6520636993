"""Vehicles of a fleet: their sensor profiles, the keys that speak for them, and what they uploaded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from datetime import datetime, timedelta
from itertools import pairwise
from typing import Any

import sqlalchemy as sa

from app.errors import Conflict, InvalidParameter, NotAllowed, NotFound, naming
from app.formats.format import SpooledFile
from app.formats.kinds import UploadKind, guess_kind
from app.registry import vehicles as store
from app.registry.database import Database
from app.registry.resources import first_version
from app.registry.spatial import distance_m
from app.registry.vehicles import CALIBRATIONS, VEHICLES, VehicleKeyRow, VehicleRow
from app.services.access.access import Caller
from app.services.access.audit import log_change
from app.services.decodes.context import CameraSetup, ContextInput, DecodeContext, context_from_document
from app.services.decodes.declarations import packet_terms, trace_terms
from app.services.documents import document_of
from app.services.fleet.documents import (
    VehicleDocument,
    VehicleKey,
    VehiclePage,
    VehicleVersionDocument,
    VehicleVersionPage,
)
from app.services.idempotency import IdempotencyKey, find_earlier, write_once
from app.services.ports import Clock

# === Sensor profiles: the part of a decode's context that stays the same from upload to upload.
#
# A profile has the members of the context (`camera`, `thermal`, `thermal_range`, `trace`, `packets`) and their names.
# What an upload states itself goes before its vehicle's profile, member by member.


FRAME, TRACE, PACKETS = (str(kind) for kind in UploadKind)
NEEDED = {FRAME: "camera", TRACE: "trace", PACKETS: "packets"}
"""Section that an upload of a kind cannot do without."""
SECTIONS = {
    FRAME: ("camera", "thermal", "thermal_range", "frames"),
    TRACE: ("trace",),
    PACKETS: ("packets", "camera"),
}
INTRINSICS = ("fx_px", "fy_px", "cx_px", "cy_px")
_SIZE = ("width_px", "height_px")
_OF_THE_SIZE = (*INTRINSICS, "distortion")
_PROFILE_ONLY = ("calibration_id",)
"""What a vehicle's camera has and a context's has not."""
_WHOLE = ("trace.can.speed", "trace.can.heading")
"""Objects that are replaced as a whole: a signal by its name and one by its bits declare the same thing."""

Object = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Inherited:
    """A context after its vehicle's profile was put behind it."""

    context: Object  # as `DecodeContext.document` writes it, without what is nobody's
    sources: dict[str, str]  # path of each member to ``upload``, ``vehicle`` or ``default``


def check_profile(profile: Mapping[str, Any]) -> None:
    """Refuse a profile that no upload could use.

    Raises
    ------
    InvalidParameter
        The field is below ``profile``.
    """
    with naming("profile"):
        camera = context_camera(profile.get("camera"))
        if camera is not None:
            # the mount alone is allowed: intrinsics can come from a calibration later
            known = camera if has_intrinsics(camera) else {**camera, "horizontal_fov_deg": 60.0}
            CameraSetup(**{**known, "distortion": tuple(known.get("distortion", ()))})
        counts = profile.get("thermal_range")
        DecodeContext(thermal=profile.get("thermal", False), thermal_range=(counts[0], counts[1]) if counts else None)
        if profile.get("trace") is not None:
            trace_terms(profile["trace"])
        if profile.get("packets") is not None:
            packet_terms(profile["packets"])


def has_intrinsics(camera: Mapping[str, object]) -> bool:
    """Whether a camera states its projection, completely or in part."""
    return any(camera.get(name) is not None for name in (*INTRINSICS, "horizontal_fov_deg"))


def context_camera(camera: Mapping[str, object] | None) -> Object | None:
    """A vehicle's camera as a context has it."""
    if camera is None:
        return None
    return {name: value for name, value in camera.items() if name not in _PROFILE_ONLY}


def inherit(profile: Mapping[str, Any], stated: Mapping[str, Any], kind: str) -> Inherited:
    """Complete what an upload states from the vehicle's profile.

    Parameters
    ----------
    stated : mapping
        Only what the upload states; a member that is None is unknown and is not inherited.
    kind : str
        ``frame``, ``trace`` or ``packets``: sections of other kinds are ignored.

    Raises
    ------
    InvalidParameter
        The profile's intrinsics belong to another frame size than the upload states.
    """
    ours = {name: profile[name] for name in SECTIONS[kind] if name in profile}
    stated_members = {name: value for name, value in stated.items() if value is not None or name not in NEEDED}
    if "camera" in ours:
        ours["camera"] = _fitting_camera(context_camera(ours["camera"]) or {}, stated_members.get("camera", {}))
        if kind != FRAME and not has_intrinsics({**ours["camera"], **(stated_members.get("camera") or {})}):
            del ours["camera"]  # a mount without a projection cannot draw over a frame
    if stated_members.get("thermal") is False:
        ours.pop("thermal_range", None)
    sources: dict[str, str] = {}
    context = _merge(ours, stated_members, sources)
    if isinstance(context.get("camera"), dict):
        for entry in fields(CameraSetup):
            if entry.default is not None and entry.name not in context["camera"] and entry.name != "distortion":
                sources[f"camera.{entry.name}"] = "default"
    return Inherited(context, dict(sorted(sources.items())))


def _fitting_camera(camera: Object, stated: object) -> Object:
    """A profile's camera without the members that the upload's camera invalidates."""
    if not isinstance(stated, Mapping):
        return camera
    given = {name for name, value in stated.items() if value is not None}
    if "horizontal_fov_deg" in given:
        return {name: value for name, value in camera.items() if name not in (*_OF_THE_SIZE, *_SIZE)}
    if given & set(INTRINSICS):
        camera = {name: value for name, value in camera.items() if name != "horizontal_fov_deg"}
    if set(INTRINSICS) <= given:
        return {name: value for name, value in camera.items() if name not in (*_OF_THE_SIZE, *_SIZE)}
    for name in _SIZE:
        if name in given and camera.get(INTRINSICS[0]) is not None and stated[name] != camera.get(name):
            raise InvalidParameter(
                f"the vehicle's camera was calibrated at {camera.get('width_px')} x {camera.get('height_px')} px, "
                f"the upload states {name} {stated[name]}",
                field=f"camera.{name}",
                limit="intrinsics belong to one size of frame",
                cure="send all four intrinsics of this size, or frames of the calibrated size",
            )
    return camera


def _merge(
    ours: Mapping[str, object], stated_members: Mapping[str, object], sources: dict[str, str], path: str = ""
) -> Object:
    merged: Object = {}
    for name in [*ours, *(name for name in stated_members if name not in ours)]:
        at = f"{path}{name}"
        theirs, own = stated_members.get(name), ours.get(name)
        if name in stated_members and theirs is None:
            continue  # stated to be unknown
        if isinstance(theirs if name in stated_members else own, Mapping) and at not in _WHOLE:
            merged[name] = _merge(
                own if isinstance(own, Mapping) else {},
                theirs if isinstance(theirs, Mapping) else {},
                sources,
                f"{at}.",
            )
            continue
        value = theirs if name in stated_members else own
        merged[name] = {k: v for k, v in value.items() if v is not None} if isinstance(value, Mapping) else value
        sources[at] = "upload" if name in stated_members else "vehicle"
    return merged


# === Vehicles of a fleet.


ACTIVE, RETIRED = "active", "retired"
MAX_KEYS = 20
_CALIBRATED = ("width_px", "height_px", *INTRINSICS, "distortion")
"""What a calibration puts into a camera."""


@dataclass(frozen=True, slots=True)
class VehicleChange:
    """What to change of a vehicle."""

    values: dict[str, Any] = field(default_factory=dict)  # of name, status and note; what is not in it stays
    # sections to replace, each as a whole; a section that is None is taken out
    profile: dict[str, object] = field(default_factory=dict)
    reason: str | None = None


class Vehicles:
    """Use cases on vehicles, one transaction each."""

    def __init__(self, database: Database, clock: Clock, idempotency_ttl: timedelta = timedelta(hours=24)) -> None:
        self._database = database
        self._clock = clock
        self._ttl = idempotency_ttl

    def add(
        self,
        caller: Caller,
        name: str,
        profile: dict[str, object],
        note: str | None = None,
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
        check_profile(profile)
        with write_once(self._database, caller.agency_id, key, now, self._ttl) as (connection, answer):
            if answer.replayed:
                return answer.response, True
            VEHICLES.check_name(connection, caller.agency_id, name)
            _check_calibrated(connection, caller, profile)
            values = {**first_version(now), "name": name, "status": ACTIVE, "note": note, "profile": profile}
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
            changes = dict(change.values)
            if "name" in changes and changes["name"] != row.name:
                VEHICLES.check_name(connection, caller.agency_id, changes["name"])
            if change.profile:
                merged = {**row.profile, **change.profile}
                changes["profile"] = {name: section for name, section in merged.items() if section is not None}
                check_profile(changes["profile"])
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
            check_profile(profile)
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


def _check_calibrated(connection: sa.Connection, caller: Caller, profile: dict[str, Any]) -> None:
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


def resolve_context(connection: sa.Connection, caller: Caller, given: ContextInput, file: SpooledFile) -> DecodeContext:
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
    vehicle = find_vehicle(connection, caller, given.vehicle)
    if vehicle is None:
        return _named(context_from_document(inherit({}, given.stated, FRAME).context), given.file_name)
    kind = _kind(vehicle, given, file)
    _check_sections(vehicle, given, kind)
    stated = given.stated
    if kind != FRAME and stated.get(kind) is None:
        stated = {**stated, kind: {}}  # its content shows what it is
    inherited = inherit(vehicle.profile, stated, kind)
    used = {
        "id": vehicle.id,
        "name": vehicle.name,
        "version": vehicle.version,
        "sources": inherited.sources,
    }
    return _named(context_from_document(inherited.context | {"vehicle": used}), given.file_name)


def count_upload(
    connection: sa.Connection, agency_id: str, decode_id: str, context: DecodeContext, now: datetime
) -> None:
    """Count an upload for its vehicle, in the transaction that stores its decode."""
    if context.vehicle is not None:
        store.add_upload(
            connection, agency_id, context.vehicle["id"], decode_id, version=context.vehicle["version"], now=now
        )


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


def _kind(vehicle: VehicleRow, given: ContextInput, file: SpooledFile) -> str:
    """What a vehicle's upload is: as it states, else by its content, else the only kind that the profile has."""
    for kind in (TRACE, PACKETS):
        if given.stated.get(kind) is not None:
            return kind
    guessed = guess_kind(given.file_name or "upload", file)
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


def _check_sections(vehicle: VehicleRow, given: ContextInput, kind: str) -> None:
    needed = NEEDED[kind]
    if given.stated.get(needed) is not None or (kind == FRAME and needed in given.stated):
        return  # stated in the upload, or stated to be unknown
    section = vehicle.profile.get(needed)
    if section is None:
        raise InvalidParameter(
            f"the file is {_NAMED.get(kind, 'a picture')}; the profile of vehicle {vehicle.name} has no {needed}",
            field="vehicle",
            limit=f"a profile with {needed}, or {needed} in the context",
            cure=f"PATCH /v1/vehicles/{vehicle.id} with profile.{needed}",
        )
    if kind == FRAME and not has_intrinsics(section):
        raise InvalidParameter(
            f"the camera of vehicle {vehicle.name} has a mount and no intrinsics",
            field="vehicle",
            limit="fx_px, fy_px, cx_px, cy_px; or horizontal_fov_deg",
            cure="calibrate it with POST /v1/calibrations, or send them in the context",
        )


def _named(context: DecodeContext, name: str) -> DecodeContext:
    """A context with the name of its file; the suffix of a trace or packet log distinguishes kinds of text files."""
    if not name:
        return context
    if context.trace is not None:
        return replace(context, trace={**context.trace, "file_name": name[:120]})
    if context.packets is not None:
        return replace(context, packets={**context.packets, "file_name": name[:120]})
    shown = "".join(sign for sign in name if sign.isprintable())[:120]
    return replace(context, file_name=shown or None)
