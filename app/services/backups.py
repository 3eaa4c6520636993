"""Backups of the database and the blobs, also of a running server, and what brings them back."""

from __future__ import annotations

import hashlib
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import orjson
from pydantic import TypeAdapter, ValidationError
from typing_extensions import TypedDict

from app.errors import Conflict, InvalidParameter, NotFound, Unavailable
from app.registry.agencies import list_agencies
from app.registry.audit import ChainReport, check_history
from app.registry.database import Database, head_revision, is_known_revision
from app.registry.dumps import (
    DatabaseSummary,
    TableDump,
    copy_sqlite,
    dump_postgres,
    finished_sqlite,
    has_rows,
    load_postgres,
    summarize_sqlite,
)
from app.registry.engines import across_agencies
from app.registry.tables import blob_references
from app.services.access.audit import parse_head
from app.services.ports import Blobs, Clock
from app.storage.backup_files import BackupReader, BackupWriter, DamagedBackup, new_backup, open_backup

# === The manifest of a backup, and the checks that need nothing but its files.


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


# === Writing a backup: one snapshot of the database, and every blob that its rows refer to.


_TRIES = 3
"""How often a backup is begun. A plan's document is the only blob whose row lets go of it; if the daily cleaning then
deletes it between the snapshot and the copy, the next snapshot refers to the new one. Cleaning runs once a day, so the
second try succeeds."""
OWNERS = "owners/"
Progress = Callable[[str, int, int], None]
"""What is being done, how much of it is done, and all of it."""


@dataclass(frozen=True, slots=True)
class BackupOptions:
    """What a backup contains."""

    with_keys: bool = False  # the key files, too
    # the blobs themselves; otherwise only their names, for a store that is kept and backed up by itself
    copy_blobs: bool = True
    allow_missing: bool = False  # go on although blobs are lost, and name them


class _BlobGone(Exception):
    """A blob was deleted after the snapshot."""


class Backups:
    """Backups of a database and its store.

    Parameters
    ----------
    database : Database
        Not opened: an SQLite file may belong to a running server, and then it is only read.
    version : str
        Of the application.
    key_files : mapping of str to Path
        Files with the server's keys, by their names.
    """

    def __init__(
        self, database: Database, blobs: Blobs, clock: Clock, version: str, key_files: Mapping[str, Path]
    ) -> None:
        self._database, self._blobs, self._clock = database, blobs, clock
        self._version, self._key_files = version, key_files

    def write(self, target: Path, options: BackupOptions, progress: Progress = lambda *_: None) -> Manifest:
        """Write a backup and read it back. What was acknowledged before this began is in it.

        Parameters
        ----------
        target : Path
            A folder that does not exist, or a file that ends in .tar.

        Raises
        ------
        Unavailable
            The database is damaged, a blob is lost, or a store does not answer. Nothing is left at the target.
        """
        for left in reversed(range(_TRIES)):
            try:
                with new_backup(target) as writer:
                    self._write(writer, target, options, progress)
                break
            except _BlobGone as error:
                if not left:
                    raise Unavailable(
                        f"the blob {error} is lost",
                        cure="find out why; waymark backup --allow-missing saves everything else",
                    ) from error
        progress("verifying", 0, 0)
        return verify_backup(target)

    def _write(self, writer: BackupWriter, target: Path, options: BackupOptions, progress: Progress) -> None:
        created_at = self._clock()
        progress("database", 0, 0)
        with TemporaryDirectory(dir=target.absolute().parent, prefix=".waymark-") as name, across_agencies():
            folder = Path(name)
            summary, keys = self._copy_database(folder)
            for file in sorted(folder.iterdir()):
                writer.add_file(f"database/{file.name}", file)
        writer.add(BLOB_LIST, (f"{key}\n".encode() for key in keys))
        before_bytes = writer.size_bytes
        missing = self._copy_blobs(writer, keys, options, progress) if options.copy_blobs else []
        blobs_bytes = writer.size_bytes - before_bytes
        manifest = Manifest(
            format="waymark-backup",
            format_version=FORMAT_VERSION,
            app_version=self._version,
            created_at=created_at.isoformat(),
            database="sqlite" if self._database.path is not None else "postgresql",
            revision=summary.revision,
            tables=[TableEntry(name=t.name, columns=list(t.columns), rows=t.rows) for t in summary.tables],
            heads=summary.heads,
            blobs={"count": len(keys), "bytes": blobs_bytes, "copied": options.copy_blobs, "missing": missing},
            keys=list(self._copy_keys(writer, with_keys=options.with_keys)),
            members_sha256=writer.add_index(),
        )
        writer.add_manifest(dump_manifest(manifest))

    def _copy_database(self, folder: Path) -> tuple[DatabaseSummary, Sequence[str]]:
        """Write the database's files; returns what they contain, and the keys of the blobs that they refer to."""
        if self._database.path is None:
            with self._database.read(long=True) as connection:
                summary = dump_postgres(connection, folder)
                return summary, self._list_keys(summary.revision, lambda: blob_references(connection))
        file = folder / Path(SQLITE_FILE).name
        with _unless_a_server_runs(self._database):
            copy_sqlite(self._database.path, file)
        with finished_sqlite(file) as connection:
            summary = summarize_sqlite(connection)
            return summary, self._list_keys(summary.revision, lambda: blob_references(connection))

    def _list_keys(self, revision: str, references: Callable[[], Iterable[str]]) -> Sequence[str]:
        """The blobs that rows refer to; of an older schema, whose columns are not known here, all blobs."""
        if revision == head_revision():
            return sorted(set(references()))
        return sorted(key for key in self._blobs.list_keys() if not key.startswith(OWNERS))

    def _copy_blobs(
        self, writer: BackupWriter, keys: Sequence[str], options: BackupOptions, progress: Progress
    ) -> list[str]:
        missing = []
        for number, key in enumerate(keys):
            progress("blobs", number, len(keys))
            try:
                chunks = self._blobs.stream(key)
                first = next(chunks, b"")
            except NotFound as error:
                if not options.allow_missing:
                    raise _BlobGone(key) from error
                missing.append(key)
                continue
            writer.add(f"blobs/{key}", chain((first,), chunks))
        return missing

    def _copy_keys(self, writer: BackupWriter, *, with_keys: bool) -> Iterator[KeyEntry]:
        for name, path in self._key_files.items():
            if not path.exists():
                continue  # a server makes it when it needs it for the first time
            content = path.read_bytes()
            if with_keys:
                writer.add(f"keys/{name}", (content,))
            yield KeyEntry(name=name, sha256=hashlib.sha256(content).hexdigest(), included=with_keys)


@contextmanager
def _unless_a_server_runs(database: Database) -> Iterator[None]:
    """Keep servers from starting, and take what a killed one left in the log into the file; if one runs, do nothing."""
    try:
        database.open()
    except Unavailable:
        yield
        return
    with closing(database):
        if database.path is None or not database.path.exists():
            raise Unavailable(
                f"there is no database {database.name}", cure="set WAYMARK_DATA_DIR or WAYMARK_DATABASE_URL"
            )
        with database.read() as connection:
            connection.exec_driver_sql("SELECT count(*) FROM sqlite_schema")
        yield


# === Bringing a backup back: into an empty database and an empty store, and verified.


_SIDE_FILES = ("-wal", "-shm", "-journal")
_SHOWN_FAULTS = 20


@dataclass(frozen=True, slots=True)
class RestoreReport:
    """What was restored."""

    manifest: Manifest  # of the backup
    faults: tuple[str, ...]  # what is not as it should be, although the backup is as it was written
    absent_keys: tuple[str, ...]  # key files that are neither in the backup nor here


class Restores:
    """Restores into a database and a store.

    Parameters
    ----------
    database : Database
        Empty, and open: no server may start meanwhile.
    blobs : Blobs
        Empty, or the store that the backup refers to.
    key_files : mapping of str to Path
        Where the server's keys belong, by their names.
    """

    def __init__(self, database: Database, blobs: Blobs, key_files: Mapping[str, Path]) -> None:
        self._database, self._blobs, self._key_files = database, blobs, key_files

    def restore(self, source: Path, progress: Progress = lambda *_: None) -> RestoreReport:
        """Verify a backup, restore it, migrate it to this version's schema, and verify the result.

        A restore that was cut off can be repeated: no row is there before the last blob, and all rows come at once.

        Raises
        ------
        DamagedBackup
            The backup is not as it was written. Nothing was changed.
        Conflict
            The database, the store or a key file here is not empty, or another one. Nothing was changed.
        """
        with open_backup(source) as backup, across_agencies():
            progress("verifying", 0, 0)
            manifest = verify_opened(backup)
            self._check_target(manifest)
            keys = list_blobs(backup)
            self._check_store(manifest, keys)
            self._check_keys(manifest)
            if manifest["blobs"]["copied"]:
                self._restore_blobs(backup, manifest, keys, progress)
            progress("database", 0, 0)
            self._restore_database(backup, manifest)
            self._restore_keys(backup, manifest)
            self._database.migrate()
            progress("verifying", 0, 0)
            absent = [entry["name"] for entry in manifest["keys"] if not self._key_files[entry["name"]].exists()]
            return RestoreReport(manifest, tuple(islice(self._faults(manifest), _SHOWN_FAULTS)), tuple(absent))

    # --- before anything is changed ---------------------------------------------------------------------------------

    def _check_target(self, manifest: Manifest) -> None:
        kind = "sqlite" if self._database.path is not None else "postgresql"
        if manifest["database"] != kind:
            raise InvalidParameter(
                f"the backup is of {manifest['database']}, and {self._database.name} is {kind}",
                field="WAYMARK_DATABASE_URL",
                cure="restore into the same kind of database",
            )
        if not is_known_revision(manifest["revision"]):
            raise InvalidParameter(
                f"the backup's schema {manifest['revision']} is newer than this version of Waymark",
                cure=f"restore it with version {manifest['app_version']} or a later one",
            )
        path = self._database.path
        if path is not None and not path.exists():
            if left := [suffix for suffix in _SIDE_FILES if path.with_name(path.name + suffix).exists()]:
                raise Conflict(f"{path}{left[0]} belongs to another database", cure="move it away")
        elif has_rows(self._database):
            raise Conflict(
                f"{self._database.name} is not empty",
                field="WAYMARK_DATABASE_URL",
                cure="restore into a new database; a restore never overwrites rows",
            )

    def _check_store(self, manifest: Manifest, keys: Sequence[str]) -> None:
        wanted = set(keys)
        present = {key for key in self._blobs.list_keys() if not key.startswith(OWNERS)}
        if not manifest["blobs"]["copied"]:
            if lost := wanted - present:
                raise Conflict(
                    f"the store lacks {len(lost)} of the {len(wanted)} blobs that the backup refers to: {min(lost)}",
                    field="WAYMARK_BLOBS_URL",
                    cure="set WAYMARK_BLOBS_URL to the store of the server that was backed up",
                )
        elif others := present - wanted:
            raise Conflict(
                f"the store has {len(others)} blobs that are not of the backup, as {min(others)}",
                field="WAYMARK_BLOBS_URL",
                cure="restore into an empty store: two databases must not share one",
            )

    def _check_keys(self, manifest: Manifest) -> None:
        for entry in manifest["keys"]:
            path = self._key_files.get(entry["name"])
            if path is None:
                raise DamagedBackup(f"there is no key file {entry['name'][:80]!r}")
            if path.exists() and hashlib.sha256(path.read_bytes()).hexdigest() != entry["sha256"]:
                raise Conflict(
                    f"{path} is not the key of the backup",
                    cure="put the key file of the server that was backed up in its place",
                )

    # --- changes, in an order that may be cut off anywhere ----------------------------------------------------------

    def _restore_blobs(self, backup: BackupReader, manifest: Manifest, keys: Sequence[str], progress: Progress) -> None:
        lost = set(manifest["blobs"]["missing"])
        present = {key for key in self._blobs.list_keys() if not key.startswith(OWNERS)}
        with TemporaryDirectory(prefix="waymark-restore-") as folder:
            file = Path(folder, "blob")
            for number, key in enumerate(keys):
                progress("blobs", number, len(keys))
                if key in lost:
                    continue
                if key in present:  # of a restore that was cut off, perhaps in the middle of this one
                    self._blobs.delete(key)
                with file.open("wb") as written:
                    written.writelines(backup.stream(f"blobs/{key}"))
                self._blobs.put_file(key, file)

    def _restore_database(self, backup: BackupReader, manifest: Manifest) -> None:
        if self._database.path is not None:
            self._place_sqlite(backup, manifest, self._database.path)
            return
        with TemporaryDirectory(prefix="waymark-restore-") as name:
            folder = Path(name)
            for table in manifest["tables"]:
                backup.extract(f"database/{table['name']}.copy", folder / f"{table['name']}.copy")
            self._database.migrate(manifest["revision"])
            with self._database.write(long=True) as connection:
                load_postgres(connection, folder, tables_of(manifest))

    def _place_sqlite(self, backup: BackupReader, manifest: Manifest, path: Path) -> None:
        self._database.disconnect()  # from a file with a schema and no rows, which is replaced
        new = path.with_name(f"{path.name}.restored")
        new.unlink(missing_ok=True)
        backup.extract(SQLITE_FILE, new)
        check_sqlite(new, manifest)
        for suffix in _SIDE_FILES:
            path.with_name(path.name + suffix).unlink(missing_ok=True)
        os.replace(new, path)
        _sync(path.parent)

    def _restore_keys(self, backup: BackupReader, manifest: Manifest) -> None:
        for entry in manifest["keys"]:
            path = self._key_files[entry["name"]]
            if not entry["included"] or path.exists():
                continue
            path.parent.mkdir(parents=True, exist_ok=True)
            with suppress(FileExistsError):
                descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
                with os.fdopen(descriptor, "wb") as file:
                    file.write(backup.read(f"keys/{entry['name']}"))
                    file.flush()
                    os.fsync(file.fileno())
            _sync(path.parent)

    # --- afterwards -------------------------------------------------------------------------------------------------

    def _faults(self, manifest: Manifest) -> Iterator[str]:
        """What is wrong with the restored database and store."""
        present = set(self._blobs.list_keys()) | set(manifest["blobs"]["missing"])
        with self._database.read(long=True) as connection:
            for key in sorted(set(blob_references(connection)) - present):
                yield f"the blob {key} is missing"
            for agency in list_agencies(connection):
                head = manifest["heads"].get(agency.name)
                expected = parse_head(head) if head is not None else None
                for fault in check_history(connection, agency.id, ChainReport(), expected):
                    yield f"{agency.name}: {fault.where}: {fault.what}"


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
