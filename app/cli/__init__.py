"""`waymark`: the command line, a thin layer over the use cases, the encoders and the decoders.

Each module holds the commands of one use case; this one lists them.
"""

from __future__ import annotations

from typing import Annotated

import typer

from app import __version__
from app.cli import backups, plans, plates, proof, remote, server, snapshots, surveys
from app.errors import WaymarkError, is_disk_full

cli = typer.Typer(name="waymark", no_args_is_help=True, add_completion=False, pretty_exceptions_show_locals=False)
cli.command()(server.serve)
cli.command()(server.worker)
cli.command()(server.demo)
cli.command("compile")(server.compile_kernels)
cli.command()(server.migrate)
cli.command()(server.key)
cli.command()(backups.backup)
cli.command()(backups.restore)
cli.command()(backups.upgrade)
cli.command("import")(surveys.import_survey)
cli.command("export")(surveys.export_markers)
cli.add_typer(snapshots.cli, name="snapshot")
cli.add_typer(backups.audit_cli, name="audit")
cli.command()(plates.encode)
cli.command()(plates.board)
cli.command()(plates.decode)
cli.command()(plates.grade_print)
cli.command()(plates.decode_trace)
cli.add_typer(server.ingest_cli, name="ingest")
cli.command()(remote.upload)
cli.command()(remote.artwork)
cli.command()(remote.reprocess)
cli.command()(plans.plan)
cli.command()(proof.proof)
cli.add_typer(plans.rules_cli, name="rules")


def _show_version(asked: bool) -> None:
    if asked:
        typer.echo(f"waymark {__version__}")
        raise typer.Exit


@cli.callback()
def waymark(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_show_version, help="Print the version and exit.")
    ] = False,
) -> None:
    """The registry of machine-readable roads."""


def main() -> None:
    """Run the command line; an expected error is printed as one line, without a traceback."""
    try:
        cli()
    except WaymarkError as error:
        typer.echo(f"waymark: {error.message}", err=True)
        for name in ("limit", "cure"):
            if value := getattr(error, name):
                typer.echo(f"  {name}: {value}", err=True)
        raise SystemExit(1) from None
    except OSError as error:  # a file that cannot be read or written
        if error.filename is None and not is_disk_full(error):
            raise
        typer.echo(f"waymark: {error.filename or 'writing a file'}: {error.strerror}", err=True)
        raise SystemExit(1) from None
