"""The judge of the benchmark of faults notices what is lost."""

from __future__ import annotations

import hashlib
from datetime import UTC, datetime
from pathlib import Path

from app.registry import agencies
from app.registry import decodes as store
from app.registry.decodes import DecodeRow
from app.registry.ids import new_id
from app.storage.blobs import new_blob_key
from benchmarks.faults.stored import Stored
from benchmarks.faults.writers import Acknowledged

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
