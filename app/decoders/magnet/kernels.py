"""How the kernels are compiled.

An entry is called from Python and cached on disk. A step is called by kernels only: without wrappers for Python and C,
the kernels of this package compile in a sixth less time. The exact ones keep NaN, which fast arithmetic may not.

numba's cache watches the file of an entry only: after a change to a step in another file, delete the cached entries.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, Protocol, TypeVar, cast

import numba as nb

_P = ParamSpec("_P")
_R = TypeVar("_R")


class _Compile(Protocol):
    """A decorator that keeps the type of its function."""

    def __call__(self, function: Callable[_P, _R], /) -> Callable[_P, _R]: ...


def _compile(**options: Any) -> _Compile:
    return cast(_Compile, nb.njit(nogil=True, error_model="numpy", **options))


entry = _compile(cache=True, fastmath=True)
exact_entry = _compile(cache=True)
step = _compile(fastmath=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
exact_step = _compile(no_cpython_wrapper=True, no_cfunc_wrapper=True)
