"""Writing a backup: one snapshot of the database, and every blob that its rows refer to."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory

from app.errors import NotFound, Unavailable
from app.registry.blob_references import blob_references
from app.registry.database import Database, head_revision
from app.registry.dumps import DatabaseSummary, copy_sqlite, dump_postgres, finished_sqlite, summarize_sqlite
from app.registry.tenancy import across_agencies
from app.services.backups.manifest import (
    BLOB_LIST,
    FORMAT_VERSION,
    SQLITE_FILE,
    KeyEntry,
    Manifest,
    TableEntry,
    dump_manifest,
    verify_backup,
)
from app.services.ports import Blobs, Clock
from app.storage.backup_files import BackupWriter, new_backup

_TRIES = 3
"""How often a backup is begun. A plan's document is the only blob whose row lets go of it; if the daily cleaning then
deletes it between the snapshot and the copy, the next snapshot refers to the new one. Source: by hand; cleaning runs
once a day, so the second try succeeds."""
OWNERS = "owners/"
Progress = Callable[[str, int, int], None]
"""What is being done, how much of it is done, and all of it."""


@dataclass(frozen=True, slots=True)
class BackupOptions:
    """What a backup contains.

    Attributes
    ----------
    with_keys : bool
        The key files, too.
    copy_blobs : bool
        The blobs themselves; otherwise only their names, for a store that is kept and backed up by itself.
    allow_missing : bool
        Go on although blobs are lost, and name them.
    """

    with_keys: bool = False
    copy_blobs: bool = True
    allow_missing: bool = False


class _BlobGone(Exception):
    """A blob was deleted after the snapshot."""


class Backups:
    """Backups of a database and its store.

    Parameters
    ----------
    database : Database
        Not opened: an SQLite file may belong to a running server, and then it is only read.
    blobs : Blobs
    clock : Clock
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
        options : BackupOptions
        progress : callable, optional

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
