"""Kernels are compiled for a level of processors that others share, and a process that compiles says so once."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest
from llvmlite import binding

from app.compiled import portable_target

NEWER = {"avx": True, "avx2": True, "bmi": True, "bmi2": True, "f16c": True, "fma": True, "lzcnt": True, "movbe": True}
_TWO_KERNELS = """
from app.tracks.kernel import lengths, wrap
wrap(7.0), lengths(0.8)
import numba
print(numba.config.CPU_NAME)
"""
_ANOTHER_PROCESSOR = """
from llvmlite import binding
binding.get_host_cpu_name = lambda: "cascadelake"
features = binding.get_host_cpu_features()
features["avx512f"] = True
binding.get_host_cpu_features = lambda: features
"""


@pytest.mark.parametrize(
    ("machine", "extensions", "name"),
    [
        ("x86_64", NEWER, "x86-64-v3"),
        ("AMD64", NEWER | {"avx512f": True}, "x86-64-v3"),
        ("x86_64", NEWER | {"avx2": False}, None),
        ("x86_64", {}, None),
        ("aarch64", {"neon": True}, "generic"),
        ("arm64", {}, "generic"),
        ("riscv64", {}, None),
    ],
)
def test_the_level_of_a_processor(machine: str, extensions: dict[str, bool], name: str | None) -> None:
    assert portable_target(machine, extensions).get("NUMBA_CPU_NAME") == name


def compiled_by(program: str, cache: Path, **more: str) -> tuple[str, int]:
    """Name of the target of a process that uses two kernels, and the number of its notices."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    environment = kept | {"NUMBA_CACHE_DIR": str(cache)} | more
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    return done.stdout.strip(), done.stderr.count("run `waymark compile`")


@pytest.mark.slow
@pytest.mark.timeout(3600)  # a loaded machine compiles for minutes
def test_a_cache_serves_another_processor_and_compiling_is_logged_once(tmp_path: Path) -> None:
    if not portable_target(platform.machine(), dict(binding.get_host_cpu_features())):
        pytest.skip("this processor has no level that others share")
    target, notices = compiled_by(_TWO_KERNELS, tmp_path)
    assert notices == 1
    assert compiled_by(_TWO_KERNELS, tmp_path) == (target, 0)
    assert compiled_by(_ANOTHER_PROCESSOR + _TWO_KERNELS, tmp_path) == (target, 0)
    assert compiled_by(_TWO_KERNELS, tmp_path, NUMBA_CPU_NAME="generic") == ("generic", 1)  # the operator's choice
