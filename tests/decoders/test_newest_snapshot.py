"""A reader remembers the newest snapshot: in a file that survives it, and that other processes share."""

from __future__ import annotations

import multiprocessing
import uuid
from datetime import UTC, datetime, timedelta
from pathlib import Path

import orjson
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from app.decoders.snapshot import UnreadableMemory, open_newest_snapshot
from app.encoders.snapshot import write_snapshot
from app.markers.snapshot import ForgedSnapshot, RolledBackSnapshot, Trust

NOW = datetime(2026, 5, 4, 8, 0, 0, tzinfo=UTC)
KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))


def _trust(agency: int = 7) -> Trust:
    return Trust(str(uuid.UUID(int=agency)), (KEY.public_key().public_bytes_raw(),))


def _made(after_s: float, agency: int = 7) -> bytes:
    made_at = NOW + timedelta(seconds=after_s)
    return write_snapshot(
        [], agency_id=str(uuid.UUID(int=agency)), area_deg=(8.0, 48.0, 9.0, 50.0), made_at=made_at,
        expires_at=made_at + timedelta(hours=1), key=KEY,
    )  # fmt: skip


def test_an_older_one_is_refused_by_the_next_process_too(tmp_path: Path) -> None:
    memory = tmp_path / "newest.json"
    for after_s in (0.0, 10.0, 10.0):
        open_newest_snapshot(_made(after_s), _trust(), NOW, memory)
    kept = memory.read_bytes()
    with pytest.raises(RolledBackSnapshot):
        open_newest_snapshot(_made(9.999), _trust(), NOW, memory)
    with pytest.raises(ForgedSnapshot):
        open_newest_snapshot(_made(20.0)[:-1] + b"x", _trust(), NOW, memory)
    assert memory.read_bytes() == kept
    open_newest_snapshot(_made(1.0, 8), _trust(8), NOW, memory)  # another agency has its own newest
    with pytest.raises(RolledBackSnapshot):
        open_newest_snapshot(_made(9.999), _trust(), NOW, memory)
    assert list(tmp_path.iterdir()) == [memory]


def test_an_unfinished_write_is_as_if_it_had_not_begun(tmp_path: Path) -> None:
    """What a loss of power leaves: the old memory, and a part of the new one beside it."""
    memory = tmp_path / "newest.json"
    open_newest_snapshot(_made(10.0), _trust(), NOW, memory)
    (tmp_path / "newest.json.new").write_bytes(b'{"0000')
    with pytest.raises(RolledBackSnapshot):
        open_newest_snapshot(_made(0.0), _trust(), NOW, memory)
    open_newest_snapshot(_made(20.0), _trust(), NOW, memory)
    assert list(orjson.loads(memory.read_bytes()).values()) == [int((NOW.timestamp() + 20) * 1000)]


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"a": "1"}', b'{"a": true}', b"\xff"])
def test_a_damaged_memory_is_not_forgotten(tmp_path: Path, content: bytes) -> None:
    memory = tmp_path / "newest.json"
    memory.write_bytes(content)
    with pytest.raises(UnreadableMemory):
        open_newest_snapshot(_made(0.0), _trust(), NOW, memory)
    assert memory.read_bytes() == content


def _open_all(memory: Path, order: list[int]) -> None:
    for after_s in order:
        try:
            open_newest_snapshot(_made(after_s), _trust(), NOW, memory)
        except RolledBackSnapshot:
            continue


def test_processes_share_a_memory(tmp_path: Path) -> None:
    memory, context = tmp_path / "newest.json", multiprocessing.get_context("fork")
    orders = [list(range(part, 60, 4)) for part in range(4)]
    processes = [context.Process(target=_open_all, args=(memory, order)) for order in orders]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0] * 4
    assert list(orjson.loads(memory.read_bytes()).values()) == [int((NOW.timestamp() + 59) * 1000)]
