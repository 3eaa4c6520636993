"""Uploads of a vehicle: its profile completes their contexts, and they are counted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from datetime import datetime
from itertools import pairwise
from typing import Any

import sqlalchemy as sa

from app.errors import Conflict, InvalidParameter, NotAllowed, NotFound
from app.formats.kinds import guess_kind
from app.formats.spooled_file import SpooledFile
from app.registry import vehicles as store
from app.registry.spatial import distance_m
from app.registry.vehicles import VEHICLES, VehicleRow
from app.services.access.access import Caller
from app.services.decodes.context import ContextInput, DecodeContext, context_from_document
from app.services.fleet.profiles import FRAME, NEEDED, PACKETS, TRACE, has_intrinsics, inherit
from app.services.fleet.vehicles import RETIRED

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
    connection: sa.Connection, agency_id: str, decode_id: str, context: DecodeContext, result: Mapping[str, Any]
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
