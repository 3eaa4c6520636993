"""Vehicles of a fleet: their sensor profiles, the keys that speak for them, and what they uploaded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any

import sqlalchemy as sa

from app.errors import Conflict, InvalidParameter, NotFound
from app.registry import vehicles as store
from app.registry.database import Database
from app.registry.resources import first_version
from app.registry.vehicles import CALIBRATIONS, VEHICLES, VehicleKeyRow, VehicleRow
from app.services.access.access import Caller
from app.services.access.audit import log_change
from app.services.documents import document_of
from app.services.fleet.documents import (
    VehicleDocument,
    VehicleKey,
    VehiclePage,
    VehicleVersionDocument,
    VehicleVersionPage,
)
from app.services.fleet.profiles import INTRINSICS, check_profile
from app.services.idempotency import IdempotencyKey, find_earlier, write_once
from app.services.ports import Clock

ACTIVE, RETIRED = "active", "retired"
MAX_KEYS = 20
_CALIBRATED = ("width_px", "height_px", *INTRINSICS, "distortion")
"""What a calibration puts into a camera."""


@dataclass(frozen=True, slots=True)
class VehicleChange:
    """What to change of a vehicle.

    Attributes
    ----------
    values : dict
        Of name, status and note; what is not in it stays.
    profile : dict
        Sections to replace, each as a whole; a section that is None is taken out.
    reason : str or None
    """

    values: dict[str, Any] = field(default_factory=dict)
    profile: dict[str, Any] = field(default_factory=dict)
    reason: str | None = None


class Vehicles:
    """Use cases on vehicles, one transaction each.

    Parameters
    ----------
    database : Database
    clock : Clock
    idempotency_ttl : timedelta
    """

    def __init__(self, database: Database, clock: Clock, idempotency_ttl: timedelta = timedelta(hours=24)) -> None:
        self._database = database
        self._clock = clock
        self._ttl = idempotency_ttl

    def add(
        self,
        caller: Caller,
        name: str,
        profile: dict[str, Any],
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
    connection: sa.Connection, caller: Caller, row: VehicleRow, changes: dict[str, Any], now: datetime, why: str | None
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
