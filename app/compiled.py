"""How numerical kernels are compiled, and for which processors. Only this module imports Numba.

Three kinds of compiled function, so that as little as possible is compiled on first use:

- a kernel is called from Python: compiled once per combination of argument types, and cached on disk;
- a routine is called from several places in kernels: compiled once, with each kernel's cache holding its own copy;
- a step is a part of one kernel that deserves a name: its code is copied into the kernel, at no cost.

Arguments that belong together are passed as one `NamedTuple` of arrays. All kernels release the interpreter's lock.
Numba's cache is keyed by the file of the kernel: after editing a routine or a step in another file, delete the cache.

The cache is keyed by the processor, too. Kernels are compiled for a level that nearly all processors have, so that a
cache which one machine wrote (an image, a shared folder) serves the others. benchmarks/processors.py measures the cost.
"""

from __future__ import annotations

import logging
import os
import platform
from collections.abc import Callable
from typing import Any, TypeVar

from llvmlite import binding, ir

_LOG = logging.getLogger(__name__)
_TARGET_SETTINGS = ("NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES", "NUMBA_ENABLE_AVX")
_X86_64_V3 = ("avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe")
"""Extensions of the level x86-64-v3, which Intel has since 2013 and AMD since 2015 (System V ABI, section 3.1.1)."""


def portable_target(machine: str, extensions: dict[str, bool]) -> dict[str, str]:
    """Numba's settings for the target of a processor: a level that others share, or none for its own type.

    Parameters
    ----------
    machine : str
        Architecture, as `platform.machine()` names it.
    extensions : dict
        Instruction set extensions in LLVM's names, and whether the processor has them.
    """
    if machine.lower() in ("aarch64", "arm64"):
        return {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
    if machine.lower() in ("x86_64", "amd64") and all(extensions.get(name) for name in _X86_64_V3):
        return {"NUMBA_CPU_NAME": "x86-64-v3", "NUMBA_CPU_FEATURES": ""}
    return {}


if not any(name in os.environ for name in _TARGET_SETTINGS):  # those of the operator come first
    os.environ.update(portable_target(platform.machine(), dict(binding.get_host_cpu_features())))

import numba as nb  # noqa: E402 - it reads its settings when it is imported
from numba.core import event  # noqa: E402
from numba.extending import intrinsic  # noqa: E402

F = TypeVar("F", bound=Callable[..., object])

_njit: Any = nb.njit  # its types change from version to version


def kernel(function: F) -> F:
    """Compile a function that Python calls; floating-point sums may be reordered, so NaN and infinity are undefined."""
    compiled: F = _njit(cache=True, nogil=True, fastmath=True, error_model="numpy", no_cfunc_wrapper=True)(function)
    return compiled


def ieee_kernel(function: F) -> F:
    """Compile a function that Python calls, with IEEE 754 arithmetic in the order in which it is written."""
    compiled: F = _njit(cache=True, nogil=True, error_model="numpy", no_cfunc_wrapper=True)(function)
    return compiled


def routine(function: F) -> F:
    """Compile a function that kernels call from several places; floating-point sums may be reordered."""
    compiled: F = _njit(nogil=True, fastmath=True, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)(
        function
    )
    return compiled


def loop(function: F) -> F:
    """Compile a routine with a loop that is all of the work: as `routine`, but it counts no references to arrays.

    It must not allocate, nor call what allocates or is no `loop`. Counting the references to a `NamedTuple` of arrays
    at every call of a step takes as long as the step.
    """
    compiled: F = _njit(
        nogil=True, fastmath=True, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=False
    )(function)
    return compiled


def ieee_loop(function: F) -> F:
    """Compile a loop as `loop` does, with IEEE 754 arithmetic in the order written."""
    compiled: F = _njit(nogil=True, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=False)(
        function
    )
    return compiled


def ieee_loop_kernel(function: F) -> F:
    """Compile a loop that Python calls, which counts no references (`loop`), with IEEE 754 arithmetic as written."""
    compiled: F = _njit(cache=True, nogil=True, error_model="numpy", no_cfunc_wrapper=True, _nrt=False)(function)
    return compiled


def ieee_routine(function: F) -> F:
    """Compile a function that kernels call from several places, with IEEE 754 arithmetic in the order written."""
    compiled: F = _njit(nogil=True, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)(function)
    return compiled


def step(function: F) -> F:
    """Mark a function as a part of the one kernel that calls it; it takes over that kernel's arithmetic."""
    inlined: F = _njit(nogil=True, error_model="numpy", inline="always")(function)
    return inlined


def _trailing_zeros(_context: Any, word: Any) -> Any:
    """Number of zero bits below the lowest bit that is set, of an unsigned 64-bit word that is not 0."""

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return nb.types.int64(word), generate


trailing_zeros: Any = intrinsic(_trailing_zeros)


class _CompileNotice(event.Listener):
    """Logs the first kernel that this process compiles instead of loading it from the cache."""

    is_due = True

    def on_start(self, event: Any) -> None:
        compiled = event.data["dispatcher"].py_func
        if self.is_due and compiled.__module__.startswith("app."):
            self.is_due = False
            _LOG.warning(
                "kernels are compiled, which can take half a minute of processor time (first: %s.%s); "
                "run `waymark compile` once, as a user who may write the cache, to compile all of them in advance",
                compiled.__module__,
                compiled.__name__,
            )

    def on_end(self, event: Any) -> None:
        pass


_NOTICE = _CompileNotice()
event.register("numba:compile", _NOTICE)


def expect_compilation() -> None:
    """Log no notice of compiled kernels in this process."""
    _NOTICE.is_due = False
