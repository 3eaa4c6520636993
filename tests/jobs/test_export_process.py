"""Files of exports are written in processes that end with the file, with its client, or at their limit of memory."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from pyarrow import parquet

from app.errors import ClientLeft, InvalidParameter, ProcessStopped
from app.formats.exports import FIELDS, Record
from app.jobs.export_process import ExportProcesses
from app.services.request_work import current_work, working

MARKER: Record = dict.fromkeys(FIELDS) | {"id": "a", "code": "1", "lon_deg": 8.4, "lat_deg": 49.0}


def _written_for(pages: Iterator[Sequence[Record]], folder: Path, memory_bytes: int = 2**40) -> Path:
    with working(600.0) as work:
        path = ExportProcesses(memory_bytes).write("landxml", pages, folder, all_heights=False).path
    assert work.used_s > 0
    return path


def test_the_process_ends_with_its_file(tmp_path: Path) -> None:
    before = multiprocessing.active_children()
    path = _written_for(iter([[MARKER]] * 3), tmp_path)
    assert path.read_text().count("<CgPoint ") == 3
    assert set(multiprocessing.active_children()) <= set(before)  # those of servers of other tests


def test_the_process_ends_when_the_client_leaves(tmp_path: Path) -> None:
    before = multiprocessing.active_children()

    def pages() -> Iterator[Sequence[Record]]:
        yield [MARKER]
        work = current_work()
        assert work is not None
        work.stops.stop()
        yield [MARKER]

    with pytest.raises(ClientLeft):
        _written_for(pages(), tmp_path)
    assert set(multiprocessing.active_children()) <= set(before)  # those of servers of other tests


def test_the_process_has_a_limit_of_memory(tmp_path: Path) -> None:
    with pytest.raises(ProcessStopped, match=r"takes too much memory|was stopped") as refused:
        _written_for(iter([[MARKER] * 5_000] * 200), tmp_path, memory_bytes=2**20)
    assert refused.value.field == "bbox"


def test_geoparquet_is_written_within_the_memory_of_a_process(tmp_path: Path) -> None:
    pages = iter([[MARKER] * 5_000] * 24)
    written = ExportProcesses(1_280_000_000).write("geoparquet", pages, tmp_path, all_heights=False)
    assert parquet.read_metadata(written.path).num_rows == 120_000


def test_an_error_in_the_process_is_raised_here(tmp_path: Path) -> None:
    def pages() -> Iterator[Sequence[Record]]:
        yield [MARKER]
        raise InvalidParameter("enough")

    with pytest.raises(InvalidParameter, match="enough"):
        _written_for(pages(), tmp_path)
    with pytest.raises(KeyError, match="lon_deg"):
        _written_for(iter([[{"id": "a"}]]), tmp_path)
