"""What the kernel keeps a decoder process from: memory, files, processor time, the network, other folders' files."""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import resource
import shutil
import struct
import tempfile
from dataclasses import dataclass
from pathlib import Path

FOLDER_PREFIX = "waymark-decoder-"
_ROOM_BYTES = 2 * 1024**3
"""Address space beside the private memory: libraries, and the stacks of threads that never run. [byte] Source: a warm
process has 1.0 GB of addresses and 0.3 GB of private memory (`/proc/PID/status`)."""
_OPEN_FILES = 128
"""Source: a warm process has 11 open; by hand."""
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
    """What a decoder process may use.

    Attributes
    ----------
    memory_bytes : int
        Its private memory. Libraries add 0.1 to 0.2 GB that processes share, so it has at most 1.5 GB resident. [byte]
    timeout_s : float
        Longest time on one frame. [s]
    trace_timeout_s : float
        Longest time on one recording. [s]
    file_bytes : int
        Largest file that it may write. [byte]
    """

    memory_bytes: int = 1_280_000_000
    timeout_s: float = 20.0
    trace_timeout_s: float = 300.0
    file_bytes: int = 256 * 1024**2


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
