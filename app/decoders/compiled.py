"""How the decoders' numerical kernels are compiled.

Three kinds of compiled function, so that as little as possible is compiled on first use:

- a kernel is called from Python: compiled once per combination of argument types, and cached on disk;
- a routine is called from several places in kernels: compiled once, with each kernel's cache holding its own copy;
- a step is a part of one kernel that deserves a name: its code is copied into the kernel, at no cost.

Arguments that belong together are passed as one `NamedTuple` of arrays. All kernels release the interpreter's lock.
Numba's cache is keyed by the file of the kernel: after editing a routine or a step in another file, delete the cache.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba as nb
from llvmlite import ir
from numba.extending import intrinsic

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
