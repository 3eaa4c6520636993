"""What the fleet keeps: migrations over rows, and counts that two at once cannot spoil, on both databases."""

from __future__ import annotations

import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
import sqlalchemy as sa

from app.registry import agencies, vehicles
from app.registry.database import Database
from app.registry.decodes import DecodeRow, add_decode
from app.registry.engines import across_agencies
from app.registry.tables import metadata
from tests.conftest import LiveServer

pytestmark = pytest.mark.both_databases

NOW = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)
TABLES = ("vehicles", "vehicle_versions", "vehicle_keys", "vehicle_uploads", "calibrations")
VEHICLE = "019cb624-0000-7000-8000-00000000bbbb"


def _fill(connection: sa.Connection) -> str:
    agency_id = agencies.add_agency(connection, "one", NOW)
    values = {
        "id": VEHICLE, "name": "BUS-7", "status": "active", "profile": {"trace": {"axes": "FRD"}}, "version": 1,
        "created_at": NOW, "updated_at": NOW,
    }  # fmt: skip
    vehicles.VEHICLES.add(connection, agency_id, values, who="w")
    vehicles.link_key(connection, agency_id, "holder", VEHICLE)
    for number in range(2):
        decode = DecodeRow(f"019cb624-0000-7000-8000-00000000000{number}", "trace", {}, NOW)
        add_decode(connection, agency_id, "holder", decode)
        at = NOW + timedelta(hours=1 - number)
        vehicles.add_upload(connection, agency_id, VEHICLE, decode.id, version=1, now=at)
    calibration = vehicles.CalibrationRow(id=VEHICLE, who="w", result={"rms_px": 0.1}, created_at=NOW)
    vehicles.CALIBRATIONS.add(connection, agency_id, calibration._asdict())
    return agency_id


@pytest.mark.slow
def test_migrations_go_down_and_up_over_a_fleet(tmp_path: Path, new_database_url: Callable[[Path], str]) -> None:
    database = Database(new_database_url(tmp_path))
    database.open()
    with across_agencies():
        try:
            database.migrate()
            with database.write() as connection:
                _fill(connection)
            database.migrate("0007")
            with database.read() as connection:
                assert not set(TABLES) & set(sa.inspect(connection).get_table_names())
                assert connection.execute(sa.select(metadata.tables["decodes"].c.id)).all()
            database.migrate()
            with database.read() as connection:
                for name in TABLES:
                    assert connection.execute(sa.select(metadata.tables[name])).all() == []
        finally:
            database.close()


def test_what_was_driven_counts_once(tmp_path: Path, new_database_url: Callable[[Path], str]) -> None:
    database = Database(new_database_url(tmp_path))
    database.open()
    with across_agencies():
        try:
            database.migrate()
            with database.write() as connection:
                agency_id = _fill(connection)
                for _again in range(2):
                    vehicles.add_driven(connection, agency_id, "019cb624-0000-7000-8000-000000000000", 1234.5)
                vehicles.add_driven(connection, agency_id, "of no vehicle", 99.0)
                vehicles.add_driven(connection, "another agency", "019cb624-0000-7000-8000-000000000001", 99.0)
                row = vehicles.VEHICLES.get(connection, agency_id, VEHICLE)
            assert (row.uploads, row.driven_m) == (2, 1234.5)
            assert row.last_seen_at == NOW + timedelta(hours=1), "the later of the two, whichever came first"
        finally:
            database.close()


@pytest.mark.slow
def test_uploads_at_once_are_all_counted_and_repeated_ones_once(server: LiveServer) -> None:
    picture = bytes(cv2.imencode(".png", np.full((64, 96), 90, np.uint8))[1])
    camera = {"horizontal_fov_deg": 70.0}

    def post(client: httpx.Client, key: str) -> int:
        parts: dict[str, Any] = {
            "file": ("a.png", picture, "image/png"), "context": (None, json.dumps({"vehicle": "BUS-7"}))
        }  # fmt: skip
        return client.post("/v1/decodes", files=parts, headers={"Idempotency-Key": key}).status_code

    with server.agency("at once") as client, ThreadPoolExecutor(6) as threads:
        client.timeout = httpx.Timeout(280)
        made = client.post("/v1/vehicles", json={"name": "BUS-7", "profile": {"camera": camera}}).json()
        assert post(client, "warm") == 201
        assert set(threads.map(lambda k: post(client, f"key {k % 6}"), range(18))) == {201}
        assert client.get(f"/v1/vehicles/{made['id']}").json()["uploads"] == 7
