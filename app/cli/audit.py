"""The command that verifies the audit log."""

from __future__ import annotations

import json
import os
from pathlib import Path
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
    heads: Annotated[
        Path | None,
        typer.Option(help="File with the last entry of each agency that was verified: check only what follows it."),
    ] = None,
) -> None:
    """Compute every hash of the history again and print each fault. The exit status is 1 if there is any.

    With --heads only what was written since the last check is checked. The file is written anew where no fault was
    found; without it, or for an agency that it does not name, the whole history is checked.
    """
    from app.services.access.audit import AuditLog, parse_head

    if expect_head is not None and agency is None:
        raise InvalidParameter("a head belongs to one agency's log", field="expect-head", cure="name the agency")
    expected = parse_head(expect_head) if expect_head is not None else None
    verified = _read_heads(heads) if heads is not None else {}
    known = {name: parse_head(head) for name, head in verified.items()}
    is_good = True
    with readable_database(read_settings()) as database:
        for name, report, faults in AuditLog(database).verify(agency, expected, known):
            count = 0
            for fault in faults:
                count += 1
                typer.echo(f"{name}: {fault.where}: {fault.what}")
            head = f"{report.head[0]}:{report.head[1]}" if report.head is not None else None
            since = f" after entry {report.since}" if report.since else ""
            shown = f", head {head}" if head is not None else ""
            typer.echo(f"{name}: {report.entries} entries, {report.versions} versions{since}{shown}")
            is_good &= count == 0
            if not count and head is not None:
                verified[name] = head
    if heads is not None:
        written = heads.with_name(f"{heads.name}.new")
        written.write_text(json.dumps(verified, indent=2) + "\n", encoding="utf-8")
        os.replace(written, heads)
    if not is_good:
        raise typer.Exit(1)


def _read_heads(path: Path) -> dict[str, str]:
    """Heads by the names of agencies; none where there is no such file yet."""
    if not path.exists():
        return {}
    try:
        found = json.loads(path.read_bytes())
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict) or not all(isinstance(head, str) for head in found.values()):
        raise InvalidParameter(
            f"{path.name} has no heads", field="heads", limit="a file that verify wrote", cure="name another file"
        )
    return found
