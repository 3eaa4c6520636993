"""The manifest of a backup, and the checks that need nothing but its files."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import orjson
from pydantic import TypeAdapter, ValidationError
from typing_extensions import TypedDict

from app.registry.agencies import list_agencies
from app.registry.audit_check import ChainReport, check_history
from app.registry.database import head_revision
from app.registry.dumps import TableDump, finished_sqlite, summarize_sqlite
from app.storage.backup_files import BackupReader, DamagedBackup, open_backup

FORMAT = "waymark-backup"
FORMAT_VERSION: Literal[1] = 1
BLOB_LIST = "blobs.txt"
SQLITE_FILE = "database/waymark.sqlite3"
_BLOB_KEY = re.compile(r"[a-z]+/[0-9a-f]{2}/[0-9a-f]{32}")


class TableEntry(TypedDict):
    """A table, the columns of its file (none in an SQLite file), and its rows."""

    name: str
    columns: list[str]
    rows: int


class BlobEntry(TypedDict):
    """The blobs: how many, their size, and whether they are in the backup or only named. [byte]"""

    count: int
    bytes: int
    copied: bool
    missing: list[str]


class KeyEntry(TypedDict):
    """A key file: the SHA-256 of its 32 or 64 random bytes, and whether it is in the backup."""

    name: str
    sha256: str
    included: bool


class Manifest(TypedDict):
    """What is in a backup."""

    format: Literal["waymark-backup"]
    format_version: Literal[1]
    app_version: str
    created_at: str
    database: Literal["sqlite", "postgresql"]
    revision: str
    tables: list[TableEntry]
    heads: dict[str, str]
    blobs: BlobEntry
    keys: list[KeyEntry]
    members_sha256: str


_MANIFEST = TypeAdapter(Manifest)


def dump_manifest(manifest: Manifest) -> bytes:
    """The manifest as a file."""
    return orjson.dumps(manifest, option=orjson.OPT_INDENT_2 | orjson.OPT_APPEND_NEWLINE)


def tables_of(manifest: Manifest) -> tuple[TableDump, ...]:
    """The tables as `app.registry.dumps` takes them."""
    return tuple(TableDump(entry["name"], tuple(entry["columns"]), entry["rows"]) for entry in manifest["tables"])


def verify_backup(path: Path) -> Manifest:
    """Check a backup by its files alone: every hash, that nothing is missing, the counts, and each blob that is named.

    In a backup of SQLite the audit log is verified, too; that of PostgreSQL is when it is restored.

    Raises
    ------
    DamagedBackup
        With the first fault.
    """
    with open_backup(path) as backup:
        return verify_opened(backup)


def verify_opened(backup: BackupReader) -> Manifest:
    """As `verify_backup`, of a backup that is open."""
    try:
        manifest = _MANIFEST.validate_json(backup.read_manifest())
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise DamagedBackup(
            f"the manifest has no valid {place or 'content'}: {first['msg']}",
            limit=f"{FORMAT}, version {FORMAT_VERSION}",
            cure="use the version of Waymark that wrote it",
        ) from error
    hashes = backup.verify(manifest["members_sha256"])
    named = list_blobs(backup)
    copied = {name.removeprefix("blobs/") for name in hashes if name.startswith("blobs/")}
    if manifest["blobs"]["copied"] and (lost := set(named) - copied - set(manifest["blobs"]["missing"])):
        raise DamagedBackup(f"the blob {min(lost)} is missing, and {len(lost) - 1} others")
    if manifest["database"] == "sqlite":
        with TemporaryDirectory() as folder:
            file = Path(folder, "waymark.sqlite3")
            backup.extract(SQLITE_FILE, file)
            check_sqlite(file, manifest)
    else:
        for table in manifest["tables"]:
            lines = sum(chunk.count(b"\n") for chunk in backup.stream(f"database/{table['name']}.copy"))
            if lines != table["rows"]:
                raise DamagedBackup(f"the table {table['name']} has {lines} rows, the manifest states {table['rows']}")
    return manifest


def check_sqlite(file: Path, manifest: Manifest) -> None:
    """Compare a copied SQLite file with its manifest, and verify its audit log if it has this version's schema."""
    with finished_sqlite(file) as connection:
        summary = summarize_sqlite(connection)
        found = {table.name: table.rows for table in summary.tables}
        expected = {table["name"]: table["rows"] for table in manifest["tables"]}
        if differing := [name for name in found.keys() | expected.keys() if found.get(name) != expected.get(name)]:
            name = min(differing)
            raise DamagedBackup(
                f"the table {name} has {found.get(name)} rows, the manifest states {expected.get(name)}"
            )
        if (summary.revision, summary.heads) != (manifest["revision"], manifest["heads"]):
            raise DamagedBackup("the schema's revision or the end of the audit log is not that of the manifest")
        if summary.revision == head_revision():
            for agency in list_agencies(connection):
                for fault in check_history(connection, agency.id, ChainReport()):
                    raise DamagedBackup(f"{agency.name}: {fault.where}: {fault.what}", cure="waymark audit verify")


def list_blobs(backup: BackupReader) -> list[str]:
    """Keys of the blobs that the rows refer to.

    Raises
    ------
    DamagedBackup
        One is no key, or stands there twice.
    """
    keys = backup.read(BLOB_LIST).decode("ascii", "replace").split()
    if wrong := [key for key in keys if not _BLOB_KEY.fullmatch(key)]:
        raise DamagedBackup(f"{wrong[0][:80]!r} is no key of a blob")
    if keys and (twice := Counter(keys).most_common(1)[0])[1] > 1:
        raise DamagedBackup(f"the blob {twice[0]} is named twice")
    return keys
