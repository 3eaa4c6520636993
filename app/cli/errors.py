"""Bad input of commands: the message, the place, the limit and the cure on standard error, and exit status 2."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import typer

from app.errors import WaymarkError

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
