"""What decoder processes are asked to do: functions, which `submit` names and the process imports.

They stand in the modules `tasks` and `*_tasks` of the services. The server imports these modules too, to name the
functions, so a function imports the decoders that it uses itself; `app.jobs.forkserver_preload` lists those that every
decoder process has from its start. Arguments and results are plain values that can be pickled.
"""

from __future__ import annotations

import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Generic, ParamSpec, TypeVar, TypeVarTuple

import cv2

from app.errors import ProcessStopped, is_exhausted

ArgumentsT = TypeVarTuple("ArgumentsT")
ParametersT = ParamSpec("ParametersT")
ResultT = TypeVar("ResultT")
_short_tasks: set[Callable[..., object]] = set()


def decoder_task(
    what: str, cure: str, *, is_long: bool = True
) -> Callable[[Callable[ParametersT, ResultT]], Callable[ParametersT, ResultT]]:
    """Decorate a task: what it reads, and what helps if the memory of a decoder process is not enough for that.

    The time limit of recordings applies to a long task, that of frames to others. A function that is not decorated is a
    long task.
    """

    def decorate(function: Callable[ParametersT, ResultT]) -> Callable[ParametersT, ResultT]:
        @wraps(function)
        def limited(*args: ParametersT.args, **kwargs: ParametersT.kwargs) -> ResultT:
            with memory_is_the_limit(what, cure):
                return function(*args, **kwargs)

        if not is_long:
            _short_tasks.add(limited)
        return limited

    return decorate


def is_long_task(task: Callable[..., object]) -> bool:
    """Whether the time limit of recordings applies to a task, instead of the limit of frames."""
    return task not in _short_tasks


# --- memory -----------------------------------------------------------------------------------------------------------


@contextmanager
def memory_is_the_limit(what: str, cure: str) -> Iterator[None]:
    """Report an allocation that the process's limit refused as the upload's fault, which it is."""
    try:
        yield
    except (MemoryError, OSError, cv2.error) as error:
        if not _is_exhausted(error):
            raise
        raise out_of_memory(f"decoding the {what}", cure) from error


def out_of_memory(work: str, cure: str) -> ProcessStopped:
    """The error of work that takes more memory than the process may have."""
    return ProcessStopped(
        f"{work} takes more memory than a decoder process has",
        field="file",
        limit=f"{resource.getrlimit(resource.RLIMIT_DATA)[0]} bytes",
        cure=cure,
    )


def ran_short(error: BaseException) -> bool:
    """Whether an error, or one that it was raised from, is that a process has no memory or no thread left.

    What fills a process need not be the upload at which it shows.
    """
    cause: BaseException | None = error
    while cause is not None:
        if _is_exhausted(cause):
            return True
        cause = cause.__cause__ or (None if cause.__suppress_context__ else cause.__context__)
    return False


def _is_exhausted(error: BaseException) -> bool:
    if isinstance(error, cv2.error):
        return getattr(error, "code", None) == cv2.Error.StsNoMem or "bad_alloc" in str(error)
    return is_exhausted(error) or (isinstance(error, RuntimeError) and "can't start new thread" in str(error))


# --- without a decoder process ----------------------------------------------------------------------------------------


class SameProcess:
    """Carries tasks out in this process: an operator's own files need no process with limits."""

    def run(self, task: Callable[[*ArgumentsT], ResultT], *arguments: *ArgumentsT, wait_s: float = 0.0) -> ResultT:
        """Carry a task out."""
        return task(*arguments)

    def submit(
        self, task: Callable[[*ArgumentsT], ResultT], *arguments: *ArgumentsT, wait_s: float = 0.0
    ) -> Finished[ResultT]:
        """Carry a task out."""
        return Finished(task(*arguments))


class Finished(Generic[ResultT]):
    """A task that is done."""

    def __init__(self, result: ResultT) -> None:
        self._result = result

    def result(self) -> ResultT:
        """The result."""
        return self._result

    def cancel(self) -> None:
        """Nothing is left to stop."""
