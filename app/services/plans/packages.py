"""Packages: all files of a plan in one ZIP, with sheets, artwork and a manifest, written by a job."""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict, dataclass
from datetime import timedelta
from pathlib import Path
from tempfile import TemporaryDirectory

from pydantic import TypeAdapter

from app.encoders.packer import Packer
from app.errors import NotFound
from app.planning.outputs.package import MANIFEST, PackageOptions
from app.registry import jobs as store
from app.registry.column_types import new_id
from app.registry.database import Database
from app.registry.jobs import JobKind, new_job
from app.registry.plans import PLANS
from app.services.access.access import Caller
from app.services.blobs import delete_unused, staged
from app.services.idempotency import IdempotencyKey, find_earlier, write_once
from app.services.jobs import RunningJob
from app.services.plans.alignments import BUSY_WAIT_S
from app.services.plans.proofs import WAIT_S, check_only_one, results_in_order
from app.services.plans.tasks import check_package, list_package_parts, write_package_manifest, write_package_part
from app.services.ports import Blobs, Clock, DecoderProcesses, JobQueue
from app.services.progress import JobDocument, job_document

_FOLDER = "packages"
_OPTIONS = TypeAdapter(PackageOptions)


@dataclass(frozen=True, slots=True)
class StoredPackage:
    """A package to send: its job's id, size, hash, and content part by part."""

    job_id: str
    size_bytes: int
    sha256: str
    chunks: Iterator[bytes]


class Packages:
    """Use cases on packages of plans.

    Parameters
    ----------
    in_flight : int
        Parts of one package that are written at the same time; as many are in memory.
    """

    def __init__(
        self, database: Database, clock: Clock, blobs: Blobs, processes: DecoderProcesses, queue: JobQueue,
        *, in_flight: int = 2, idempotency_ttl: timedelta = timedelta(hours=24),
    ) -> None:  # fmt: skip
        self._database, self._clock, self._blobs = database, clock, blobs
        self._processes, self._queue = processes, queue
        self._in_flight, self._ttl = in_flight, idempotency_ttl

    def request(
        self, caller: Caller, plan_id: str, options: PackageOptions, key: IdempotencyKey | None = None
    ) -> tuple[JobDocument, bool]:
        """Queue the package of a plan as it is; returns the job and whether the request had been made before.

        Raises
        ------
        NotFound
        InvalidParameter, ReferenceSystemError
            The options do not fit the plan.
        Conflict
            Another package of the plan is unfinished.
        """
        now, agency_id = self._clock(), caller.agency_id
        if earlier := find_earlier(self._database, agency_id, key, now):
            return earlier, True
        with self._database.read() as connection:
            row = PLANS.get(connection, agency_id, plan_id)
        document = self._blobs.get(row.document_key)
        self._processes.run(check_package, document, options, wait_s=BUSY_WAIT_S)
        job_input = {
            "document_key": row.document_key,
            "plan_version": row.version,
            "options": asdict(options),
            "label": caller.label,
        }
        job = new_job(
            JobKind.PACKAGE, new_id(now), agency_id, caller.key_id, now, job_input=job_input, subject_id=plan_id
        )
        with write_once(self._database, agency_id, key, now, self._ttl) as (connection, answer):
            if answer.replayed:
                return answer.response, True
            check_only_one(connection, agency_id, JobKind.PACKAGE, plan_id)
            store.add_job(connection, job)
            response = answer.store(job_document(job, now))
        self._queue.submit(job.id, job.agency_id, JobKind.PACKAGE)
        return response, False

    def open(self, caller: Caller, plan_id: str) -> StoredPackage:
        """The newest package of a plan.

        Raises
        ------
        NotFound
            There is no such plan, or no package of its markers as they are.
        """
        with self._database.read() as connection:
            row = PLANS.get(connection, caller.agency_id, plan_id)
            job = store.find_job_about(connection, caller.agency_id, JobKind.PACKAGE, plan_id, ("done",))
        if job is None or job.result is None or job.input["document_key"] != row.document_key:
            raise NotFound(
                f"plan {plan_id} has no package",
                field="plan_id",
                limit="plans that were packed since their markers were placed",
                cure=f"POST /v1/plans/{plan_id}/package, and wait for the job",
            )
        result = job.result
        return StoredPackage(job.id, result["size_bytes"], result["sha256"], self._blobs.stream(result["blob_key"]))

    def run(self, job: RunningJob) -> None:
        """Write a package; the handler of jobs of the kind `JobKind.PACKAGE`."""
        with TemporaryDirectory(prefix="waymark-package-") as folder:
            path = Path(folder) / "package.zip"
            files = self._write(job, path)
            self._store(job, path, files)

    def _write(self, job: RunningJob, path: Path) -> int:
        """Write the ZIP part by part; returns the number of its files."""
        document = self._blobs.get(job.row.input["document_key"])
        options = _OPTIONS.validate_python(job.row.input["options"])
        parts = self._processes.run(list_package_parts, document, options, wait_s=WAIT_S)
        arguments = ((document, options, part) for part in parts)
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            packer = Packer(archive)
            with closing(results_in_order(self._processes, write_package_part, arguments, self._in_flight)) as written:
                for done, files in enumerate(written, 1):
                    for name, content in files:
                        packer.add(name, content)
                    job.report_progress(done / (len(parts) + 1), steps=(done, len(parts)))
            entries = list(packer.entries)
            packer.add(MANIFEST, self._processes.run(write_package_manifest, document, options, entries, wait_s=WAIT_S))
        return len(packer.entries)

    def _store(self, job: RunningJob, path: Path, files: int) -> None:
        """Store the ZIP, finish the job, and remove the plan's package of before."""
        agency_id, plan_id = job.row.agency_id, job.row.subject_id
        assert plan_id is not None
        with path.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        with staged(self._blobs) as stage:
            result = {
                "plan_version": job.row.input["plan_version"],
                "size_bytes": path.stat().st_size,
                "sha256": sha256,
                "files": files,
                "blob_key": stage.put_file(_FOLDER, path),
            }
            with self._database.write() as connection:
                before = store.find_job_about(connection, agency_id, JobKind.PACKAGE, plan_id, ("done",))
                if not job.finish(connection, result):
                    return
            stage.keep()
        if before is not None and before.result is not None:
            delete_unused(self._blobs, [before.result["blob_key"]])
