"""Decoder processes as the services see them: a task goes in, its result comes out, and nothing else passes between."""

from __future__ import annotations

from typing import ClassVar, Generic, Protocol, TypeVar

ResultT = TypeVar("ResultT")
ResultT_co = TypeVar("ResultT_co", covariant=True)


class Task(Generic[ResultT]):
    """Base of everything that a decoder process is asked to do: plain values that can be pickled, and no database.

    `app.jobs.tasks` names the function that carries each task out.

    Attributes
    ----------
    is_long : bool
        Whether the time limit of recordings applies to it, instead of the limit of frames.
    """

    __slots__ = ()
    is_long: ClassVar[bool] = True

    def steps(self) -> tuple[object, ...]:
        """Arguments of the task's steps, in their order; one that is a Future is sent when the caller has set it."""
        return (self,)


class Pending(Protocol[ResultT_co]):
    """A task on its way through a decoder process."""

    def result(self) -> ResultT_co:
        """Wait for the result.

        Raises
        ------
        UnreadableUpload
            The upload is refused, it killed the decoder process, or it took longer than it may.
        Unavailable
            No decoder process is free.
        """

    def cancel(self) -> None:
        """Stop the task, also when it runs already. Every task that was submitted ends in `result` or here."""


class DecoderProcesses(Protocol):
    """Processes with limits on memory and time."""

    def submit(self, task: Task[ResultT], *, wait_s: float = 0.0) -> Pending[ResultT]:
        """Hand a task over and return.

        Parameters
        ----------
        task : Task
        wait_s : float, optional
            How long to wait for a place. [s]

        Raises
        ------
        Unavailable
            Too many tasks are waiting already.
        """
