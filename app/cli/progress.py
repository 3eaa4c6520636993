"""Progress on the terminal: bars where there is one, a line every few seconds where the output goes to a file."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator
from types import TracebackType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import TaskID

_LINE_EVERY_S = 5.0


class Progress:
    """Shows how far several steps of a command are, on standard error.

    Parameters
    ----------
    quiet : bool, optional
        Show nothing.
    """

    def __init__(self, *, quiet: bool = False) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
        from rich.progress import Progress as Bars

        self._quiet = quiet
        console = Console(stderr=True)
        self._bars: Bars | None = None
        if console.is_terminal and not quiet:
            columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
            self._bars = Bars(*columns, console=console)
        self._tasks: dict[str, TaskID] = {}
        self._shown: dict[str, tuple[float, float]] = {}

    def __enter__(self) -> Progress:
        if self._bars is not None:
            self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bars is not None:
            self._bars.stop()

    def show(self, step: str, done: float, total: float) -> None:
        """Say how far a step is."""
        if self._bars is not None:
            if step not in self._tasks:
                self._tasks[step] = self._bars.add_task(step, total=total)
            self._bars.update(self._tasks[step], completed=done, total=total)
        elif not self._quiet:
            self._show_line(step, done, total)

    def counted(self, step: str, parts: Iterable[bytes], size_bytes: int) -> Iterator[bytes]:
        """Parts of a file on their way, shown by their bytes."""
        done = 0
        for part in parts:
            yield part
            done += len(part)
            self.show(step, done, size_bytes)

    def _show_line(self, step: str, done: float, total: float) -> None:
        share = done / total if total else 1.0
        before_s, before = self._shown.get(step, (-_LINE_EVERY_S, -1.0))
        now_s = time.monotonic()
        if share != before and (now_s - before_s >= _LINE_EVERY_S or share >= 1.0):
            self._shown[step] = now_s, share
            print(f"{step}: {share:.0%}", file=sys.stderr, flush=True)
