"""What the kernel keeps a decoder process from: each limit is reached by a real one."""

from __future__ import annotations

import errno
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.decoding.frames import PlateSearch
from app.formats.format import SpooledFile
from app.jobs import decoder_process
from app.jobs.decoder_process import ProcessLimits
from app.jobs.pool import DecodePool
from app.markers.reading import PlateOutcome, PlateReading
from app.services.decodes.frame_tasks import FramePicture, FrameSearch, decode_frame
from tests.formats.pictures import png
from tests.jobs import standin

BLOCK_BYTES = 32 * 1024**2


def outcome(attempt: Callable[[], object]) -> str:
    """Name of the error number that an attempt ended with, or of its error."""
    try:
        attempt()
    except OSError as error:
        return errno.errorcode[error.errno or 0]
    except MemoryError:
        return "MemoryError"
    return "done"


def take_memory() -> list[np.ndarray[Any, Any]]:
    held = []
    while True:
        held.append(np.ones(BLOCK_BYTES, np.uint8))


def write_much() -> None:
    with open("large", "wb") as file:
        while True:
            file.write(bytes(BLOCK_BYTES))


def open_many() -> None:
    held = []
    while True:
        held.append(open(os.devnull))  # noqa: SIM115 - closed with the list


def attempt_all(pixels: Any, **_options: Any) -> list[PlateReading]:
    """A decoder that breaks every limit and reports what happened."""
    if pixels.shape[0] == 480:  # the frame that warms the process
        return []
    before = os.listdir()
    report = {
        "before": before,
        "folder": os.getcwd(),
        "temporary": tempfile.gettempdir(),
        "network": outcome(lambda: socket.create_connection(("127.0.0.1", 5432), 1)),
        "local socket": outcome(lambda: socket.socket(socket.AF_UNIX)),
        "memory": outcome(take_memory),
        "file": outcome(write_much),
        "files": outcome(open_many),
        "resident_kb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        "processor_s": resource.getrlimit(resource.RLIMIT_CPU)[0],
        "dump": resource.getrlimit(resource.RLIMIT_CORE)[1],
    }
    return [PlateReading(PlateOutcome.UNSURE, reason=json.dumps(report))]


def attempt(pool: DecodePool) -> dict[str, Any]:
    search: Future[FrameSearch] = Future()
    search.set_result({"plate": PlateSearch()})
    picture = FramePicture(SpooledFile.of(png(standin.frame_that(standin.OBEY))))
    return dict(json.loads(pool.run(decode_frame, picture, search).readings[0].reason))


@pytest.fixture(scope="module")
def pool() -> Iterator[DecodePool]:
    made = DecodePool(attempt_all, workers=1)
    yield made
    made.close()


@pytest.mark.slow
def test_every_limit_holds_and_the_next_task_finds_an_empty_folder(pool: DecodePool) -> None:
    first, second = attempt(pool), attempt(pool)
    for report in (first, second):
        assert (report["network"], report["local socket"]) == ("EACCES", "EACCES")
        assert (report["memory"], report["file"], report["files"]) == ("MemoryError", "EFBIG", "EMFILE")
        assert report["resident_kb"] * 1024 < 1_500_000_000
        assert ProcessLimits().trace_timeout_s < report["processor_s"] < 2 * ProcessLimits().trace_timeout_s
        assert report["dump"] == 0
        assert report["before"] == []
        assert report["temporary"] == report["folder"] != os.getcwd()
    assert Path(first["folder"]).name.startswith(decoder_process.FOLDER_PREFIX)
    pool.close()
    assert not Path(first["folder"]).exists()


def test_processor_time_ends_a_process_that_nobody_watches() -> None:
    program = (
        "from app.jobs import decoder_process as limits\n"
        "limits._MORE_S = 0.0\n"
        "limits.allow_processor_time(limits.ProcessLimits(timeout_s=1.0, trace_timeout_s=1.0))\n"
        "while True: pass"
    )
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == -signal.SIGXCPU


def test_folders_of_dead_processes_are_deleted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    left = tmp_path / f"{decoder_process.FOLDER_PREFIX}{ended.pid}-x"
    left.mkdir()
    (left / "file").touch()
    own = decoder_process.new_folder()
    decoder_process.delete_folders_of_the_dead()
    assert (left.exists(), own.exists()) == (False, True)
