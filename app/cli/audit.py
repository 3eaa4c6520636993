"""The command that verifies the audit log."""

from __future__ import annotations

from typing import Annotated

import typer

from app.cli.database import read_settings, readable_database
from app.errors import InvalidParameter

_HELP = "The audit log: every change of the registry, chained by hashes."
cli = typer.Typer(no_args_is_help=True, help=_HELP)


@cli.callback(help=_HELP)
def audit() -> None:
    """Group the commands `waymark audit ...`."""


@cli.command("verify")
def verify_log(
    agency: Annotated[str | None, typer.Argument(help="Name of one agency. Default: all agencies.")] = None,
    expect_head: Annotated[
        str | None, typer.Option(help="NUMBER:HASH of an entry that an earlier run printed; needs an agency.")
    ] = None,
) -> None:
    """Compute every hash of the history again and print each fault. The exit status is 1 if there is any."""
    from app.services.access.audit import AuditLog, parse_head

    if expect_head is not None and agency is None:
        raise InvalidParameter("a head belongs to one agency's log", field="expect-head", cure="name the agency")
    expected = parse_head(expect_head) if expect_head is not None else None
    is_good = True
    with readable_database(read_settings()) as database:
        for name, report, faults in AuditLog(database).verify(agency, expected):
            for fault in faults:
                is_good = False
                typer.echo(f"{name}: {fault.where}: {fault.what}")
            head = f", head {report.head[0]}:{report.head[1]}" if report.head is not None else ""
            typer.echo(f"{name}: {report.entries} entries, {report.versions} versions{head}")
    if not is_good:
        raise typer.Exit(1)
