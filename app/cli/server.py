"""Commands that run the server, prepare its database and create keys."""

from __future__ import annotations

import signal
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

from app.cli.database import owned_database, perform, read_settings

HostOption = Annotated[str | None, typer.Option(help="Address to listen on. Default: WAYMARK_HOST, or 127.0.0.1.")]
PortOption = Annotated[int | None, typer.Option(help="Port to listen on. Default: WAYMARK_PORT, or 8000.")]


def serve(host: HostOption = None, port: PortOption = None) -> None:
    """Start the server. On an empty database it prints the first admin key."""
    from app.cli.serving import serve_until_stopped
    from app.control.exporting import start_tracing
    from app.logs import configure_logs

    settings = read_settings(host=host, port=port)
    configure_logs(settings.log_format, settings.log_level)
    start_tracing(settings, "waymark-server")
    with owned_database(settings):
        pass  # a database that another process owns is reported in one line here, not in a traceback of the server
    serve_until_stopped(settings)


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the results; created if it does not exist.")] = Path("demo-out"),
    serve: Annotated[bool, typer.Option("--serve", help="Leave the server running afterwards.")] = False,
) -> None:
    """Register plates, magnets and CERPMs, decode simulated drives past them, and print a table for each family."""
    from app.demo import run_demo

    signal.signal(signal.SIGTERM, _end)
    if not run_demo(out, say=lambda line: typer.echo(line), keep_serving=serve):
        raise typer.Exit(1)


def _end(number: int, _frame: FrameType | None) -> None:
    """End as after Ctrl-C: the demo's server is stopped on the way."""
    raise SystemExit(128 + number)


def migrate(
    revision: Annotated[str, typer.Argument(help="Revision to migrate to, newer or older.")] = "head",
) -> None:
    """Migrate the database's schema to a revision. `waymark serve` migrates to the newest one by itself."""
    with owned_database(read_settings()) as database:
        database.migrate(revision)
    typer.echo(f"{database.name} is at revision {revision}")


def key(
    agency: Annotated[str, typer.Argument(help="Name of the agency; it is created if it does not exist.")],
    scope: Annotated[str, typer.Option(help="admin, planner, surveyor, viewer or vehicle.")] = "planner",
    label: Annotated[str, typer.Option(help="Who or what the key is for; shown in histories.")] = "key",
    days: Annotated[
        int | None, typer.Option(min=1, max=3653, help="Days until the key expires. Default: never.")
    ] = None,
) -> None:
    """Create a key for an agency and print it once, also while the server runs."""
    values = {"agency": agency, "scope": scope, "label": label, "days": days}
    typer.echo(perform(read_settings(), "key", values)["key"])
