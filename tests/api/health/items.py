"""Items of the work list for tests: opened by verdicts, as the tests of markers open them."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import sqlalchemy as sa

from app.health import Fault, StretchDrive, Verdict, stretch_drive
from app.registry.column_types import new_id
from app.registry.decodes import NewObservation, decodes
from app.registry.health import ItemFilter, list_items
from app.services.health.maintenance import ItemUpload, Suspicion, open_items
from app.services.health.record import RADIO, STRETCH, ObservedDrive, record_drive

AT = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)


def add_test_decode(connection: sa.Connection, agency_id: str) -> str:
    """A decode of a frame, done."""
    decode_id = new_id(AT)
    row = {"id": decode_id, "agency_id": agency_id, "kind": "frame", "context": {}, "created_at": AT}
    connection.execute(sa.insert(decodes).values(row))
    return decode_id


def add_test_item(connection: sa.Connection, agency_id: str, marker_id: str, fault: Fault = Fault.MOVED) -> str:
    """An open item of a marker."""
    verdict = Verdict(fault, 17.5, 13.1, 4, 5, AT.timestamp() - 3600, (1.2, -0.9))
    upload = ItemUpload(add_test_decode(connection, agency_id), True, "v", AT)
    open_items(connection, agency_id, upload, [Suspicion(marker_id, verdict, 120.0)], None, AT)
    found = list_items(connection, agency_id, ItemFilter(marker_id=marker_id, what=str(fault), status="open"))
    return found[0].id


def drive_shifted_stretch(connection: sa.Connection, agency_id: str, vehicle: str, north_m: float) -> None:
    """A drive with RTK to the east, past CERPMs that are all registered too far north."""
    along = np.arange(0.0, 500.0, 5.0)
    lane = np.column_stack([along, np.zeros(len(along))])
    north = np.tile([0.0, 1.0], (len(along), 1))
    drive = StretchDrive(8.0, 50.0, 90.0, *stretch_drive(lane, lane + north_m * north, north, along, 0.02))
    stretch = {"subject": "stretch:S7:3", "road": "S7", "measure_m": 1500.0, "drive": drive.document()}
    decode_id = add_test_decode(connection, agency_id)
    row = NewObservation("marker", 0, AT, "seen", {STRETCH: stretch})
    record_drive(connection, agency_id, ObservedDrive(decode_id, RADIO, vehicle, [row]), AT)
