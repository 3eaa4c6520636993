"""Commands that back up, verify, restore and upgrade: the drills of docs/operation.md."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.cli.database import owned_database, read_settings
from app.cli.progress import JsonOption, Progress
from app.errors import InvalidParameter, Unavailable
from app.settings import Settings

if TYPE_CHECKING:
    from app.registry.database import Database
    from app.services.backups.backup import BackupOptions
    from app.services.backups.manifest import Manifest
    from app.storage.blobs import Blobs

_PATIENCE_S = 3.0
"""How long connections of servers that have just stopped are waited for. [s] Source: by hand."""
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
    from app.services.backups.backup import BackupOptions
    from app.services.backups.manifest import verify_backup

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
    from app.services.backups.restore import Restores

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
    from app.services.backups.backup import BackupOptions

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
    from app.services.backups.backup import Backups
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
