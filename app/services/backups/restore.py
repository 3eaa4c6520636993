"""Bringing a backup back: into an empty database and an empty store, and verified."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory

from app.errors import Conflict, InvalidParameter
from app.registry.agencies import list_agencies
from app.registry.audit_check import ChainReport, check_history
from app.registry.blob_references import blob_references
from app.registry.database import Database, is_known_revision
from app.registry.dumps import has_rows, load_postgres
from app.registry.tenancy import across_agencies
from app.services.access.audit import parse_head
from app.services.backups.backup import OWNERS, Progress
from app.services.backups.manifest import (
    SQLITE_FILE,
    Manifest,
    check_sqlite,
    list_blobs,
    tables_of,
    verify_opened,
)
from app.services.ports import Blobs
from app.storage.backup_files import BackupReader, DamagedBackup, open_backup

_SIDE_FILES = ("-wal", "-shm", "-journal")
_SHOWN_FAULTS = 20


@dataclass(frozen=True, slots=True)
class RestoreReport:
    """What was restored.

    Attributes
    ----------
    manifest : Manifest
        Of the backup.
    faults : tuple of str
        What is not as it should be, although the backup is as it was written.
    absent_keys : tuple of str
        Key files that are neither in the backup nor here.
    """

    manifest: Manifest
    faults: tuple[str, ...]
    absent_keys: tuple[str, ...]


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
