"""What commands share on the terminal: progress, messages about bad input, and loading many modules at once."""

from __future__ import annotations

import gc
import os
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from app.errors import WaymarkError

if TYPE_CHECKING:
    from rich.progress import Progress as Bars
    from rich.progress import TaskID


# === Progress on the terminal: bars where there is one, a line every few seconds where the output goes to a file.


JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON, and no progress.")]
_LINE_EVERY_S = 5.0
BYTES = "B"
"""Unit of steps that are counted in bytes; they are shown in kB or MB."""
_MEGABYTE = 1e6


class _Line(NamedTuple):
    """What was shown of a step last, and how far it was at first."""

    at_s: float
    share: float
    began_s: float
    began: float


class Progress:
    """Shows how far several steps of a command are, with their rates, on standard error.

    Parameters
    ----------
    quiet : bool, optional
        Show nothing.
    """

    def __init__(self, *, quiet: bool = False) -> None:
        self._quiet = quiet
        is_terminal = sys.stderr.isatty() and os.environ.get("TERM") != "dumb"
        self._bars: Bars | None = _make_bars() if is_terminal and not quiet else None
        self._tasks: dict[str, TaskID] = {}
        self._lines: dict[str, _Line] = {}

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bars is not None:
            self._bars.stop()

    def show(self, step: str, done: float, total: float, unit: str = "") -> None:
        """Show how far a step is.

        Parameters
        ----------
        step : str
            Its name; a new one gets a bar of its own.
        done, total : float
            Total 0 is not known; of 1 only the share is shown.
        unit : str, optional
            Of what is counted; `BYTES` for bytes.
        """
        if self._bars is not None:
            self._bars.start()
            if step not in self._tasks:
                self._tasks[step] = self._bars.add_task(step, total=total or None, unit=unit)
            self._bars.update(self._tasks[step], completed=done, total=total or None)
        elif not self._quiet:
            self._show_line(step, done, total, unit)

    def counted(self, step: str, parts: Iterable[bytes], size_bytes: int, *, done: int = 0) -> Iterator[bytes]:
        """Parts of a file on their way, shown by their bytes, from those that are there already."""
        for part in parts:
            yield part
            done += len(part)
            self.show(step, done, size_bytes, BYTES)

    def _show_line(self, step: str, done: float, total: float, unit: str) -> None:
        share = done / total if total else 0.0
        now_s = time.monotonic()
        before = self._lines.get(step) or _Line(now_s - _LINE_EVERY_S, -1.0, now_s, done)
        if share == before.share or (now_s - before.at_s < _LINE_EVERY_S and share < 1.0):
            self._lines.setdefault(step, before)
            return
        self._lines[step] = before._replace(at_s=now_s, share=share)
        elapsed_s = now_s - before.began_s
        rate = (done - before.began) / elapsed_s if elapsed_s > 0 else None
        shown = [f"{share:.0%}" if total else "", amount(done, total, unit), speed(rate, total, unit)]
        text = ", ".join(text for text in shown if text)
        print(f"{step}: {text}" if text else step, file=sys.stderr, flush=True)


def amount(done: float, total: float | None, unit: str) -> str:
    """How much of a step is done, e.g. ``3 of 12``; empty where nothing is counted."""
    if total == 1 or not (done or total):
        return ""
    if unit == BYTES:
        scale, unit = (_MEGABYTE, "MB") if max(done, total or 0) >= _MEGABYTE else (1e3, "kB")
        of_all = f" of {total / scale:.1f}" if total else ""
        return f"{done / scale:.1f}{of_all} {unit}"
    return (f"{done:.0f} of {total:.0f} {unit}" if total else f"{done:.0f} {unit}").rstrip()


def speed(rate: float | None, total: float | None, unit: str) -> str:
    """Steps a second, e.g. ``4.1/s``; empty where it is not known."""
    if not rate or rate <= 0 or total == 1:
        return ""
    return f"{rate / _MEGABYTE:.1f} MB/s" if unit == BYTES else f"{rate:.3g}/s" if rate < 1000 else f"{rate:.0f}/s"


def _make_bars() -> Bars:
    from rich.console import Console
    from rich.progress import BarColumn, ProgressColumn, Task, TaskProgressColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars
    from rich.text import Text

    class Counts(ProgressColumn):
        """Done, total and rate."""

        def render(self, task: Task) -> Text:
            unit = task.fields["unit"]
            rate = task.finished_speed or task.speed
            return Text(
                "  ".join(filter(None, (amount(task.completed, task.total, unit), speed(rate, task.total, unit))))
            )

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), Counts(), TimeRemainingColumn())
    return Bars(*columns, console=Console(stderr=True))


# === Loading many modules at once.


@contextmanager
def collector_paused() -> Iterator[None]:
    """No garbage collection in a block that imports modules: it would free nothing, and take a fifth of the time."""
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


# === Bad input of commands: the message, the place, the limit and the cure on standard error, and exit status 2.


BAD_INPUT = 2


@contextmanager
def bad_input() -> Iterator[None]:
    """End the command with status 2 where its input is refused."""
    try:
        yield
    except WaymarkError as error:
        for part in error.parts or (error,):
            typer.echo(f"waymark: {part.message}", err=True)
            for name in ("field", "limit", "cure"):
                if value := getattr(part, name):
                    typer.echo(f"  {name}: {value}", err=True)
        raise typer.Exit(BAD_INPUT) from None
