"""Commands that run the server, prepare its database and create keys."""

from __future__ import annotations

import signal
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import typer

from app.cli.database import owned_database, perform, read_settings
from app.errors import InvalidParameter

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
    with owned_database(settings) as database:
        database.migrate()  # what is wrong is one line here, and would be a traceback of the server later
    serve_until_stopped(settings)


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the results; created if it does not exist.")] = Path("demo-out"),
    serve: Annotated[
        bool, typer.Option("--serve", help="Leave the server running afterwards, on WAYMARK_HOST and WAYMARK_PORT.")
    ] = False,
) -> None:
    """Register plates, magnets and CERPMs, decode simulated drives past them, and print a table for each family."""
    from app.demo import run_demo

    signal.signal(signal.SIGTERM, _end)
    where = _address_to_serve_on() if serve else {}
    if not run_demo(out, say=lambda line: typer.echo(line), keep_serving=serve, **where):
        raise typer.Exit(1)


def _address_to_serve_on() -> dict[str, Any]:
    """Host, and port if the environment has one: by default the demo takes any free port."""
    from app.cli.serving import check_port

    settings = read_settings()
    if "port" not in settings.model_fields_set:
        return {"host": settings.host}
    check_port(settings.host, settings.port)
    return {"host": settings.host, "port": settings.port}


def _end(number: int, _frame: FrameType | None) -> None:
    """End as after Ctrl-C: the demo's server is stopped on the way."""
    raise SystemExit(128 + number)


def compile_kernels() -> None:
    """Compile the decoders' numerical kernels into the cache, so that no drive waits for it."""
    from app.jobs.compile_kernels import compile_kernels

    compile_kernels()


def migrate(
    revision: Annotated[str, typer.Argument(help="Revision to migrate to, newer or older.")] = "head",
) -> None:
    """Migrate the database's schema to a revision. `waymark serve` migrates to the newest one by itself."""
    with owned_database(read_settings()) as database:
        try:
            database.migrate(revision)
        except InvalidParameter as error:
            typer.echo(f"waymark: {error.message}; allowed: {error.limit}", err=True)
            raise typer.Exit(2) from None
    typer.echo(f"{database.name} is at revision {revision}")


def key(
    agency: Annotated[
        str | None, typer.Argument(help="Name of the agency; it is created if it does not exist.")
    ] = None,
    scope: Annotated[str | None, typer.Option(help="admin, planner (default), surveyor, viewer or vehicle.")] = None,
    label: Annotated[str, typer.Option(help="Who or what the key is for; shown in histories.")] = "key",
    days: Annotated[
        int | None, typer.Option(min=1, max=3653, help="Days until the key expires. Default: never.")
    ] = None,
    operator: Annotated[
        bool, typer.Option("--operator", help="Instead of an agency's: a key that creates agencies over HTTP.")
    ] = False,
) -> None:
    """Create a key for an agency, or for an operator, and print it once, also while the server runs."""
    if operator == (agency is not None) or (operator and scope is not None):
        raise InvalidParameter(
            "a key is either an agency's or an operator's",
            field="agency",
            limit="AGENCY with or without --scope, or --operator without both",
            cure="waymark key AGENCY --scope planner, or waymark key --operator",
        )
    values = {"agency": agency, "scope": scope or "planner", "label": label, "days": days}
    typer.echo(perform(read_settings(), "key", values)["key"])
