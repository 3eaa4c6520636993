"""What decodes traces is compiled when a server starts, not while somebody waits."""

from __future__ import annotations

import subprocess
import sys

import pytest

_COUNTED = """
import gc
from pathlib import Path
from numba.core.registry import CPUDispatcher
from app.formats.format import SpooledFile
from app.services.decodes.trace_tasks import compile_traces, decode_recording

def compiled():
    kernels = [found for found in gc.get_objects() if isinstance(found, CPUDispatcher)]
    return sum(len(kernel.signatures) for kernel in kernels if kernel.py_func.__module__.startswith("app.decoders"))

compile_traces()
before = compiled()
decode_recording("drive.zip", SpooledFile.of(Path("docs/images/drive.zip").read_bytes()))
print(before, compiled())
"""


@pytest.mark.slow
def test_a_recording_compiles_nothing_after_the_warm_up() -> None:
    """In a process of its own: in this one other tests have compiled the kernels."""
    ended = subprocess.run([sys.executable, "-c", _COUNTED], capture_output=True, text=True, check=True)
    before, after = map(int, ended.stdout.split())
    assert before == after > 5
