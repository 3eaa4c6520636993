"""Commands that back up, verify, restore and upgrade, the drills of docs/operation.md, and verify the audit log."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.cli.database import owned_database, read_settings, readable_database
from app.cli.terminal import JsonOption, Progress
from app.errors import InvalidParameter, Unavailable
from app.settings import Settings

if TYPE_CHECKING:
    from app.registry.database import Database
    from app.services.backups import BackupOptions, Manifest
    from app.storage.blobs import Blobs


_PATIENCE_S = 3.0
"""How long connections of servers that have just stopped are waited for. [s]"""
TargetArgument = Annotated[Path, typer.Argument(help="A new folder, or a new file that ends in .tar.")]
KeysOption = Annotated[
    bool, typer.Option("--with-keys", help="Include the key files. Whoever has the backup then has the server's keys.")
]
ReferenceOption = Annotated[
    bool,
    typer.Option(
        "--reference-blobs", help="Name the blobs and leave them in their store, which is backed up by itself."
    ),
]
MissingOption = Annotated[bool, typer.Option("--allow-missing", help="Go on although blobs are lost, and name them.")]


def backup(
    target: TargetArgument,
    verify: Annotated[
        bool, typer.Option("--verify", help="Write nothing: verify the backup that is there already.")
    ] = False,
    with_keys: KeysOption = False,
    reference_blobs: ReferenceOption = False,
    allow_missing: MissingOption = False,
    as_json: JsonOption = False,
) -> None:
    """Back up the database and the blobs, also while the server runs, and verify the backup."""
    from app.services.backups import BackupOptions, verify_backup

    if verify:
        if not target.exists():
            raise InvalidParameter(f"there is no backup {target}", cure="name a folder or a .tar file")
        _describe(target, verify_backup(target), as_json=as_json)
        return
    options = BackupOptions(with_keys=with_keys, copy_blobs=not reference_blobs, allow_missing=allow_missing)
    manifest = _write_backup(read_settings(), target, options, quiet=as_json)
    _describe(target, manifest, as_json=as_json)


def restore(
    source: Annotated[Path, typer.Argument(exists=True, help="The backup: a folder, or a .tar file.")],
    as_json: JsonOption = False,
) -> None:
    """Restore a backup into an empty database and store, and verify them. The exit status is 1 if a check fails."""
    from app.services.backups import Restores

    settings = read_settings()
    with owned_database(settings) as database, Progress(quiet=as_json) as shown:
        report = Restores(database, _blobs(settings), _key_files(settings)).restore(source, shown.show)
    if as_json:
        _print_json({"backup": str(source), "database": database.name, **asdict(report)})
        if report.faults:
            raise typer.Exit(1)
        return
    for fault in report.faults:
        typer.echo(f"waymark: {fault}", err=True)
    for name in report.absent_keys:
        typer.echo(f"still missing: {_key_files(settings)[name]}; put it there before the server starts", err=True)
    if missing := report.manifest["blobs"]["missing"]:
        typer.echo(f"{len(missing)} blobs were lost before the backup, as {missing[0]}", err=True)
    typer.echo(f"restored {source} of {report.manifest['created_at']} into {database.name}")
    if report.faults:
        raise typer.Exit(1)


def upgrade(
    backup_to: Annotated[Path, typer.Option("--backup", help="Where the backup goes; it must not exist.")],
    with_keys: KeysOption = False,
    reference_blobs: ReferenceOption = False,
) -> None:
    """Back up, migrate to this version's schema, and verify. Stop all servers and workers of the database first."""
    from app.registry.database import head_revision
    from app.services.access.audit import AuditLog
    from app.services.backups import BackupOptions

    settings = read_settings()
    with owned_database(settings) as database:
        _wait_for_the_last_client(database)
        before = database.current_revision()
    options = BackupOptions(with_keys=with_keys, copy_blobs=not reference_blobs)
    _describe(backup_to, _write_backup(settings, backup_to, options))
    way_back = f"the way back: install the version before, and run waymark restore {backup_to} on an empty database"
    with owned_database(settings) as database:
        try:
            database.migrate()
            faults = [f"{name}: {f.where}: {f.what}" for name, _, found in AuditLog(database).verify() for f in found]
        except BaseException:
            typer.echo(way_back, err=True)
            raise
    for fault in faults:
        typer.echo(f"waymark: {fault}", err=True)
    typer.echo(f"{database.name}: revision {before} -> {head_revision()}")
    typer.echo(way_back)
    if faults:
        raise typer.Exit(1)


def _wait_for_the_last_client(database: Database) -> None:
    """PostgreSQL ends connections a moment after their clients."""
    last_s = time.monotonic() + _PATIENCE_S
    while others := database.count_other_clients():
        if time.monotonic() > last_s:
            raise Unavailable(
                f"{others} connections of Waymark use {database.name}", cure="stop all servers and workers first"
            )
        time.sleep(0.1)


def _write_backup(settings: Settings, target: Path, options: BackupOptions, *, quiet: bool = False) -> Manifest:
    from app import __version__
    from app.registry.database import Database
    from app.services.backups import Backups
    from app.services.ports import utc_now

    with closing(Database(settings.resolved_database_url)) as database, Progress(quiet=quiet) as shown:
        backups = Backups(database, _blobs(settings), utc_now, __version__, _key_files(settings))
        return backups.write(target, options, shown.show)


def _blobs(settings: Settings) -> Blobs:
    from app.storage.blobs import Blobs

    blobs = Blobs(settings.resolved_blobs_url)
    blobs.open()
    return blobs


def _key_files(settings: Settings) -> dict[str, Path]:
    return {"master.key": settings.resolved_master_key_file, "signing.key": settings.resolved_signing_key_file}


def _print_json(document: Mapping[str, object]) -> None:
    import orjson

    typer.echo(orjson.dumps(document, option=orjson.OPT_INDENT_2))


def _describe(path: Path, manifest: Manifest, *, as_json: bool = False) -> None:
    """What is in a backup, and what has to be kept apart from it."""
    if as_json:
        _print_json({"backup": str(path), "manifest": manifest})
        return
    rows, blobs = sum(table["rows"] for table in manifest["tables"]), manifest["blobs"]
    where = f"{blobs['bytes']} bytes" if blobs["copied"] else "left in their store"
    typer.echo(
        f"{path}: verified; {manifest['database']} at revision {manifest['revision']}, {rows} rows, "
        f"{blobs['count']} blobs ({where}), {manifest['created_at']}"
    )
    for agency, head in manifest["heads"].items():
        typer.echo(f"{agency}: audit log ends with {head}")
    included = [entry["name"] for entry in manifest["keys"] if entry["included"]]
    apart = [entry["name"] for entry in manifest["keys"] if not entry["included"]]
    if included:
        typer.echo(f"contains the keys {', '.join(included)}: protect it as you protect the server")
    if apart:
        typer.echo(f"does not contain {', '.join(apart)}: keep copies apart; without them secrets cannot be read")
    if blobs["missing"]:
        typer.echo(f"{len(blobs['missing'])} blobs are lost, as {blobs['missing'][0]}", err=True)


# === The command that verifies the audit log.


_HELP = "The audit log: every change of the registry, chained by hashes."
audit_cli = typer.Typer(no_args_is_help=True, help=_HELP)


@audit_cli.callback(help=_HELP)
def audit() -> None:
    """Group the commands `waymark audit ...`."""


@audit_cli.command("verify")
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

    With --heads only what was written since the last check is checked. The file is written again where no fault was
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
