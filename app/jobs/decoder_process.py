"""What runs inside a decoder process. It has limits, and may open no socket and write into its folder only."""

from __future__ import annotations

import ctypes
import errno
import gc
import os
import platform
import resource
import shutil
import signal
import struct
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from multiprocessing.connection import Connection
from multiprocessing.pool import ExceptionWithTraceback  # type: ignore[attr-defined]
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from app.decoding.frames import DecodePlates
from app.errors import ProcessStopped, WaymarkError
from app.markers.plate import PlateCode
from app.services.decoder_tasks import out_of_memory, ran_short
from app.services.decodes.frame_tasks import use_decoder

# === What the kernel keeps a decoder process from: memory, files, processor time, the network, other folders' files.


FOLDER_PREFIX = "waymark-decoder-"
_ROOM_BYTES = 2 * 1024**3
"""Address space beside the private memory: libraries, and the stacks of threads that never run. [byte] Source: a warm
process has 1.0 GB of addresses and 0.3 GB of private memory (`/proc/PID/status`)."""
_OPEN_FILES = 128
"""Source: a warm process has 11 open."""
_MORE_S = 5.0

# Linux: prctl(2), seccomp(2), linux/audit.h, linux/filter.h
_PR_SET_NO_NEW_PRIVS, _PR_SET_SECCOMP, _MODE_FILTER = 38, 22, 2
_ALLOW, _REFUSE = 0x7FFF0000, 0x00050000 | errno.EACCES
_LOAD, _IF_EQUAL, _IF_AT_LEAST, _RETURN = 0x20, 0x15, 0x35, 0x06
_NUMBER_AT, _MACHINE_AT = 0, 4
_X32_BIT = 0x40000000
_CALLS = {"x86_64": (0xC000003E, (41, 42, 425)), "aarch64": (0xC00000B7, (198, 203, 425))}
"""Machine and numbers of the system calls socket, connect and io_uring_setup."""


@dataclass(frozen=True, slots=True)
class ProcessLimits:
    """What a decoder process may use."""

    # [byte] its private memory. Libraries add 0.1 to 0.2 GB that processes share, so it has at most 1.5 GB resident.
    memory_bytes: int = 1_280_000_000
    timeout_s: float = 20.0  # [s] longest time on one frame
    trace_timeout_s: float = 300.0  # [s] longest time on one recording
    file_bytes: int = 256 * 1024**2  # [byte] largest file that it may write


def limit_resources(limits: ProcessLimits) -> None:
    """Limit the memory of this process, its files and its dumps."""
    for name, value in (
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_DATA, limits.memory_bytes),
        (resource.RLIMIT_AS, limits.memory_bytes + _ROOM_BYTES),
        (resource.RLIMIT_FSIZE, limits.file_bytes),
        (resource.RLIMIT_NOFILE, _OPEN_FILES),
    ):
        hard = resource.getrlimit(name)[1]
        allowed = value if hard == resource.RLIM_INFINITY else min(value, hard)
        resource.setrlimit(name, (allowed, allowed))


def allow_processor_time(limits: ProcessLimits) -> None:
    """Have the kernel end this process when its next task takes too much processor time.

    The supervisor ends it earlier, by the clock; this holds also where the supervisor is busy or gone.
    """
    used = resource.getrusage(resource.RUSAGE_SELF)
    longest_s = max(limits.timeout_s, limits.trace_timeout_s)
    soft = int(used.ru_utime + used.ru_stime + longest_s + _MORE_S)
    resource.setrlimit(resource.RLIMIT_CPU, (soft, resource.getrlimit(resource.RLIMIT_CPU)[1]))


def close_network() -> bool:
    """Refuse sockets and connections to this process and its children for good. False where the kernel cannot.

    A filter of system calls needs no rights and works in containers, which mostly forbid new network namespaces.
    """
    machine, calls = _CALLS.get(platform.machine(), (0, ()))
    prctl = getattr(ctypes.CDLL(None, use_errno=True), "prctl", None)
    if not calls or prctl is None:
        return False
    checks = [(_IF_EQUAL, number) for number in calls]
    if platform.machine() == "x86_64":
        checks.append((_IF_AT_LEAST, _X32_BIT))
    program = [
        (_LOAD, 0, 0, _MACHINE_AT),
        (_IF_EQUAL, 1, 0, machine),
        (_RETURN, 0, 0, _REFUSE),
        (_LOAD, 0, 0, _NUMBER_AT),
    ]
    program += [(code, len(checks) - k, 0, value) for k, (code, value) in enumerate(checks)]
    program += [(_RETURN, 0, 0, _ALLOW), (_RETURN, 0, 0, _REFUSE)]
    text = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *step) for step in program))
    head = ctypes.create_string_buffer(struct.pack("HxxxxxxP", len(program), ctypes.addressof(text)))
    if prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) != 0:
        return False
    return bool(prctl(_PR_SET_SECCOMP, _MODE_FILTER, ctypes.byref(head), 0, 0) == 0)


# --- the working folder -----------------------------------------------------------------------------------------------


def new_folder() -> Path:
    """An empty folder for a decoder process of this one, which has to delete it."""
    return Path(tempfile.mkdtemp(prefix=f"{FOLDER_PREFIX}{os.getpid()}-"))


def delete_folders_of_the_dead() -> None:
    """Delete the folders that processes have left which were killed."""
    for folder in Path(tempfile.gettempdir()).glob(f"{FOLDER_PREFIX}*"):
        owner = folder.name.removeprefix(FOLDER_PREFIX).partition("-")[0]
        if owner.isdigit() and not Path(f"/proc/{owner}").exists():
            shutil.rmtree(folder, ignore_errors=True)


def work_in(folder: Path) -> None:
    """Make a folder the one in which this process works and writes temporary files."""
    os.chdir(folder)
    os.environ["TMPDIR"] = tempfile.tempdir = str(folder)


def empty_folder(folder: Path) -> None:
    """Delete what a task has left in the folder."""
    for entry in os.scandir(folder):
        if entry.is_dir(follow_symlinks=False):
            shutil.rmtree(entry.path, ignore_errors=True)
        else:
            os.unlink(entry.path)


# === What runs inside a decoder process. It has limits, and may open no socket and write into its folder only.


ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")


class Outcome(Enum):
    """How a task ended in a decoder process."""

    DONE = "done"
    FAILED = "failed"
    RAN_SHORT = "ran short"
    """The process had no memory or no thread left for it, which may be because of the tasks before."""


READY, READY_WITH_NETWORK = "ready", "ready, with network"
"""What a process sends when it can take tasks."""
# glibc's mallopt: keep freed memory for the next frame, or the kernel clears every page of every frame again
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_PR_SET_PDEATHSIG = 1  # Linux's prctl(2)
_KEPT_BYTES = 256 * 1024**2
_KEPT_BLOCK_BYTES = 32 * 1024**2  # glibc accepts no more


class Placeholder(Enum):
    """Stands for an argument that follows the others when the caller has set it."""

    LATE = "late"


class _LateArgument:
    """A late argument as the task sees it (`app.services.ports.Later`)."""

    def __init__(self, connection: Connection) -> None:
        self._connection: Connection | None = connection
        self._value: object = None

    def result(self) -> object:
        """Wait until the caller sends it."""
        if self._connection is not None:
            self._value, self._connection = self._connection.recv(), None
        return self._value


def serve_tasks(connection: Connection, decode: DecodePlates, limits: ProcessLimits, folder: Path) -> None:
    """Load everything, work in a folder, send `READY`, and answer tasks until the server closes the connection.

    A task comes as (function, arguments), followed by its late arguments in their order. The answer is (an `Outcome`,
    result or exception, when the task began and ended [ns]).
    """
    end_with_parent()
    warm_process(decode)
    work_in(folder)
    limit_resources(limits)
    connection.send(READY if close_network() else READY_WITH_NETWORK)
    with suppress(EOFError):
        while True:
            connection.send(_carry_out(connection, limits, folder))


def _carry_out(connection: Connection, limits: ProcessLimits, folder: Path) -> tuple[Outcome, object, tuple[int, int]]:
    """Receive a task and carry it out. A frame's memory is free when this returns, before the next frame comes."""
    function, sent = connection.recv()
    began_ns = time.time_ns()
    arguments = [_LateArgument(connection) if argument is Placeholder.LATE else argument for argument in sent]
    allow_processor_time(limits)
    try:
        outcome, answer = Outcome.DONE, function(*arguments)
    except Exception as error:  # noqa: BLE001 - raised again in the server
        outcome = Outcome.RAN_SHORT if ran_short(error) else Outcome.FAILED
        answer = ExceptionWithTraceback(_met_limit(error, outcome) or error, error.__traceback__)
    for argument in arguments:
        if isinstance(argument, _LateArgument):
            argument.result()  # the caller sends it also where the function did not get as far
    empty_folder(folder)
    return outcome, answer, (began_ns, time.time_ns())


def _met_limit(error: Exception, outcome: Outcome) -> ProcessStopped | None:
    """What a call means that the limits of this process refused; None if another thing failed, or is known already."""
    if outcome is Outcome.RAN_SHORT and not isinstance(error, WaymarkError):
        return out_of_memory("the file", "send it in smaller parts")
    if not isinstance(error, OSError) or error.errno not in (errno.EFBIG, errno.EMFILE):
        return None
    return ProcessStopped(
        "decoding the file took larger or more files than a decoder process may write",
        field="file",
        cure="send it in smaller parts",
    )


def warm_process(decode: DecodePlates) -> None:
    """Prepare a fresh process: one thread, and compiled kernels loaded."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # a decoder in native code must end at once, too
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the server, which then stops its children
    cv2.setNumThreads(1)
    cv2.ocl.setUseOpenCL(False)
    keep_memory()
    use_decoder(decode)
    decode(warm_frame(), camera=None, codebook=(), thermal=False)
    gc.collect()
    gc.freeze()  # the libraries' objects are never freed: a collection need not visit them


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


def process_id() -> int:
    """Id of the process: the answer shows that it is ready."""
    return os.getpid()


def warm_frame() -> npt.NDArray[np.uint8]:
    """A plate seen from straight above, so that every stage of the decoder runs once."""
    pitch, gap, unit = 10, 1, 9
    code = PlateCode.from_position(114.179583, 22.305278)
    side = code.n * pitch + gap
    plate = np.full((side, side, 3), 235, np.uint8)
    for row, column in np.argwhere(code.units):
        y, x = gap + row * pitch, gap + column * pitch
        plate[y : y + unit, x : x + unit] = 25
    row, column = np.argwhere(code.units == 0)[-10]  # a stain, so that the pixels are judged, too
    plate[gap + row * pitch + 2 : gap + (row + 1) * pitch, gap + column * pitch : gap + (column + 1) * pitch] = 170
    near, far, cell = gap, side - gap - 2 * pitch + gap, 2 * pitch - gap
    for y, x in ((near, far), (far, far), (far, near)):
        plate[y : y + cell, x : x + cell] = (60, 160, 30)
    triangle = np.array([[near, near], [near + cell, near], [near, near + cell]], dtype=np.int32)
    cv2.fillPoly(plate, [triangle], (40, 40, 200))
    frame = np.full((480, 640, 3), 110, np.uint8)
    frame[200 : 200 + side, 280 : 280 + side] = plate
    return frame
