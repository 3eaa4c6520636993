"""What runs inside a decoder process. Nothing here may write a file, open a socket or touch the database."""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import signal
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.pool import ExceptionWithTraceback  # type: ignore[attr-defined]
from typing import Any

import cv2
import numpy as np

from app.jobs.frame_tasks import DecodePlates, use_decoder
from app.markers.plate import PlateCode
from app.services.decoder_processes import Task

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
READY = "ready"
"""What a process sends when it can take tasks."""
# glibc's mallopt: keep freed memory for the next frame, or the kernel clears every page of every frame anew
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_PR_SET_PDEATHSIG = 1  # Linux's prctl(2)
_KEPT_BYTES = 256 * 1024**2
_KEPT_BLOCK_BYTES = 32 * 1024**2  # glibc accepts no more


@dataclass(frozen=True, slots=True)
class ProcessLimits:
    """What a decoder process may use.

    Attributes
    ----------
    memory_bytes : int
        Its whole address space, libraries included. [byte]
    timeout_s : float
        Longest time on one frame. [s]
    trace_timeout_s : float
        Longest time on one recording. [s]
    """

    memory_bytes: int = 3 * 1024**3
    timeout_s: float = 20.0
    trace_timeout_s: float = 300.0


def serve_tasks(connection: Connection, decode: DecodePlates, limits: ProcessLimits) -> None:
    """Load everything, send `READY`, and answer tasks until the server closes the connection.

    A task comes in steps: (function, argument, whether it is the last). Each is called with its argument and the result
    of the step before it. The answer is (whether all succeeded, result or exception).
    """
    end_with_parent()
    warm_process(decode, limits)
    connection.send(READY)
    answer: tuple[bool, Any] = (True, None)
    while True:
        try:
            function, argument, is_last = connection.recv()
        except EOFError:
            return
        if answer[0]:
            try:
                answer = (True, function(argument, answer[1]))
            except Exception as error:  # noqa: BLE001 - raised again in the server
                answer = (False, ExceptionWithTraceback(error, error.__traceback__))
        if is_last:
            connection.send(answer)
            answer = (True, None)
        del function, argument  # a frame's memory is free before the next frame comes


def warm_process(decode: DecodePlates, limits: ProcessLimits) -> None:
    """Prepare a fresh process: one thread, compiled kernels loaded, then the address space closed."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # a decoder in native code must end at once, too
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the server, which then stops its children
    cv2.setNumThreads(1)
    cv2.ocl.setUseOpenCL(False)
    keep_memory()
    use_decoder(decode)
    decode(_warm_frame(), camera=None, codebook=(), thermal=False)
    gc.collect()
    gc.freeze()  # the libraries' objects are never freed: a collection need not visit them
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (limits.memory_bytes, limits.memory_bytes))


def end_with_parent() -> None:
    """Have the kernel kill this process when the one that it is a fork of ends, also in the middle of native code.

    That one ends when the server does: it waits for the server's requests. Only Linux can do so.
    """
    prctl = getattr(ctypes.CDLL(None), "prctl", None)
    if prctl is not None:
        prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def keep_memory() -> None:
    """Have this process reuse the memory of earlier frames; without glibc nothing changes."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _KEPT_BLOCK_BYTES)
        mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)


class ProcessIdTask(Task[int]):
    """Nothing to decode: the answer shows that a process is ready."""

    is_long = False


def process_id(_task: ProcessIdTask, _before: None) -> int:
    """Id of the process."""
    return os.getpid()


def _warm_frame() -> np.ndarray[Any, np.dtype[np.uint8]]:
    """A plate seen from straight above, so that every stage of the decoder runs once."""
    pitch, gap, unit = 10, 1, 9
    code = PlateCode.from_position(114.179583, 22.305278)
    side = code.n * pitch + gap
    plate = np.full((side, side, 3), 235, np.uint8)
    for row, column in np.argwhere(code.units):
        y, x = gap + row * pitch, gap + column * pitch
        plate[y : y + unit, x : x + unit] = 25
    near, far, cell = gap, side - gap - 2 * pitch + gap, 2 * pitch - gap
    for y, x in ((near, far), (far, far), (far, near)):
        plate[y : y + cell, x : x + cell] = (60, 160, 30)
    triangle = np.array([[near, near], [near + cell, near], [near, near + cell]], dtype=np.int32)
    cv2.fillPoly(plate, [triangle], (40, 40, 200))
    frame = np.full((480, 640, 3), 110, np.uint8)
    frame[200 : 200 + side, 280 : 280 + side] = plate
    return frame
