"""A decoder whose behaviour the frame's first pixel chooses: processes are tested with it, not codes."""

from __future__ import annotations

import errno
import multiprocessing
import os
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from app.errors import InvalidParameter
from app.markers.plate import PlateCode
from app.markers.reading import PlateOutcome, PlateReading

OBEY, SLEEP, DIE, HOG, RAISE, BUG = 10, 60, 110, 160, 210, 250
NO_THREAD, NO_MEMORY = 110, 160  # for `run_short_once`


def frame_that(what: int) -> np.ndarray[Any, Any]:
    """RGB frame that makes the decoder do something."""
    frame = np.full((64, 96, 3), 128, np.uint8)
    frame[:16, :16] = what
    return frame


def decode(pixels: Any, *, codebook: Sequence[PlateCode] = (), **_options: Any) -> list[PlateReading]:
    """Do what the corner pixel says."""
    what = min((OBEY, SLEEP, DIE, HOG, RAISE, BUG), key=lambda known: abs(known - int(pixels[4, 4].min())))
    if multiprocessing.parent_process() is None:  # the server's own process asks for a proof
        return []
    if pixels.shape[0] == 480:  # the frame that warms the process
        return []
    if what == SLEEP:
        time.sleep(600)
    elif what == DIE:
        os.kill(os.getpid(), signal.SIGKILL)
    elif what == HOG:
        np.ones(4 * 1024**3, np.uint8)
    elif what == RAISE:
        raise InvalidParameter("no", field="a.b", limit="c", cure="d")
    elif what == BUG:
        raise ZeroDivisionError("a defect")
    threads = {"cv2": __import__("cv2").getNumThreads()}
    return [
        PlateReading(PlateOutcome.READ, code=code, reason=f"{os.getpid()} {threads['cv2']}") for code in codebook
    ] or [PlateReading(PlateOutcome.UNSURE, reason=str(os.getpid()))]


def run_short_once(folder: Path, pixels: Any, **options: Any) -> list[PlateReading]:
    """As a process without a thread or without memory left; the first time, or while the folder has a file `always`."""
    what = min((OBEY, NO_THREAD, NO_MEMORY), key=lambda known: abs(known - int(pixels[4, 4].min())))
    if pixels.shape[0] != 480 and what != OBEY and not (folder / "short").exists():
        if not (folder / "always").exists():
            (folder / "short").touch()
        raise BlockingIOError(errno.EAGAIN, "no thread") if what == NO_THREAD else MemoryError
    frame = pixels.copy()
    frame[:16, :16] = OBEY
    return decode(frame, **options)


def hold(folder: Path, pixels: Any, **options: Any) -> list[PlateReading]:
    """Write the process's id into a file of the folder, and decode once the folder has a file `go`."""
    if pixels.shape[0] != 480:
        (folder / f"{os.getpid()}.pid").touch()
        while not (folder / "go").exists():
            time.sleep(0.01)
    return decode(pixels, **options)
