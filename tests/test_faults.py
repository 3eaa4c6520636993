"""The judge of the benchmark of faults notices what is lost."""

from __future__ import annotations

import hashlib
from datetime import UTC, datetime
from pathlib import Path

import sqlalchemy as sa

from app.registry import agencies
from app.registry import decodes as store
from app.registry.decodes import DecodeRow
from app.registry.ids import new_id
from app.registry.tables import markers
from app.storage.blobs import new_blob_key
from benchmarks.faults.stored import Stored
from benchmarks.faults.writers import IMPORT_ROAD, IMPORT_ROWS, Acknowledged
from tests.conftest import verified_server

NOW = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)


def test_lost_and_changed_writes_are_noticed(tmp_path: Path) -> None:
    stored = Stored(tmp_path)
    stored.database.migrate()
    key, unused, row = new_blob_key("uploads"), new_blob_key("uploads"), new_id(NOW)
    for blob in (key, unused):
        stored.blobs.put(blob, b"frame")
    with stored.database.write() as connection:
        agency_id = agencies.add_agency(connection, "one", NOW)
        store.add_decode(connection, agency_id, "x", DecodeRow(row, "frame", {}, NOW, upload_key=key))
    kept = Acknowledged(uploads={row: hashlib.sha256(b"frame").hexdigest()})
    assert stored.list_lost(kept) == []
    lost = Acknowledged({"a marker"}, {row: hashlib.sha256(b"another").hexdigest(), new_id(NOW): "0" * 64})
    assert len(stored.list_lost(lost)) == 3
    assert stored.delete_unused() == (1, 2, 0)
    assert stored.list_lost(kept) == []
    stored.database.close()


def test_surveys_in_part_and_rows_without_a_blob_are_noticed(tmp_path: Path) -> None:
    with verified_server(tmp_path, "") as server, server.client() as client:
        places = [{"lon_deg": 8.5 + k * 5e-4, "lat_deg": 49.0} for k in range(IMPORT_ROWS)]
        items = [{"create": {"position": place, "family": "cerpm", "road": f"{IMPORT_ROAD}1"}} for place in places]
        assert client.post("/v1/markers/bulk", json={"items": items}).status_code == 200
    stored, key = Stored(tmp_path), new_blob_key("uploads")
    try:
        assert stored.list_partial() == stored.list_without_blob() == []
        with stored.database.write() as connection:
            agency_id, last = connection.execute(sa.select(markers.c.agency_id, markers.c.id).limit(1)).one()
            connection.execute(sa.update(markers).where(markers.c.id == last).values(road=f"{IMPORT_ROAD}2"))
            store.add_decode(connection, agency_id, "x", DecodeRow(new_id(NOW), "frame", {}, NOW, upload_key=key))
        assert sorted(stored.list_partial()) == ["import 1: 19 of 20", "import 2: 1 of 20"]
        assert stored.list_without_blob() == [key]
        assert stored.list_lost(Acknowledged(imports={"x": "import 3"}, plans={"y": 4})) == ["import x", "plan y"]
    finally:
        stored.database.close()
