"""Use cases and what they need from outside, wired once for the server and for `waymark worker`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import lru_cache, partial
from typing import Any

import numpy as np
import numpy.typing as npt

from app.encoders.plate import PlateReader
from app.families.rules import MarkerRules
from app.formats.archives import ArchiveLimits
from app.formats.images import ImageLimits
from app.geodesy import use_grids
from app.jobs.engine import JobEngine
from app.jobs.frame_tasks import DecodePlates
from app.jobs.local_queue import LocalQueue
from app.jobs.pool import DecodePool
from app.jobs.process_limits import ProcessLimits
from app.markers.plate import PlateGeometry
from app.markers.reading import PlateReading
from app.registry.database import Database
from app.registry.jobs import JobKind
from app.services.access.access import Access, Bearer
from app.services.access.agency_secrets import AgencySecrets
from app.services.access.audit import AuditLog
from app.services.access.audit_jobs import AuditVerifications
from app.services.access.keys import Keys
from app.services.access.oidc import Issuer, KeySet, Tokens
from app.services.decodes.archive_handler import ArchiveHandler
from app.services.decodes.decodes import Decodes
from app.services.decodes.frame_handler import FrameHandler
from app.services.decodes.outputs import DecodeOutputs
from app.services.decodes.packet_handler import PacketHandler
from app.services.decodes.rules import DecodeRules
from app.services.decodes.trace_handler import TraceHandler
from app.services.decodes.upload_path import UploadHandler
from app.services.decodes.video_handler import VideoHandler
from app.services.drives.drives import Drives
from app.services.fleet.calibrations import Calibrations
from app.services.fleet.snapshots import Snapshots
from app.services.fleet.vehicles import Vehicles
from app.services.health.maintenance import Maintenance
from app.services.jobs import Jobs
from app.services.markers.artwork import Artworks
from app.services.markers.artwork_jobs import ArtworkJobs
from app.services.markers.bulk import BulkMarkers
from app.services.markers.cerpm_programs import CerpmPrograms
from app.services.markers.codebooks import Codebooks
from app.services.markers.features import Features
from app.services.markers.layouts import Layouts
from app.services.markers.markers import Markers
from app.services.markers.observations import Observations
from app.services.markers.print_grades import PrintGrades
from app.services.markers.searches import Searches
from app.services.plans.alignments import Alignments
from app.services.plans.making import PlanMaking
from app.services.plans.packages import Packages
from app.services.plans.plan_jobs import PlanJobs
from app.services.plans.plans import Plans
from app.services.plans.proofs import Proofs
from app.services.progress.events import AgencyEvents
from app.services.progress.jobs import AllJobs
from app.services.progress.results import JobFiles
from app.services.reprocessing.reprocessings import Reprocessings
from app.services.request_work import check_deadline
from app.services.roads.roads import Roads
from app.services.surveys.export_jobs import ExportJobs
from app.services.surveys.exports import Exports
from app.services.surveys.import_jobs import ImportJobs
from app.services.surveys.imports import Imports
from app.services.unused_blobs import UnusedBlobs
from app.services.uploads.quotas import QuotaRules, Quotas, UploadRules
from app.services.uploads.uploads import Uploads
from app.services.webhooks.delivery import WebhookDelivery
from app.services.webhooks.webhooks import Webhooks
from app.settings import Settings
from app.storage.blobs import Blobs
from app.storage.jwks import read_jwks
from app.storage.master_key import load_master_key
from app.storage.s3_parts import S3Parts
from app.storage.signing_key import load_signing_keys
from app.storage.spool import Spool
from app.storage.webhook_sender import WebhookSender


@dataclass(frozen=True, slots=True)
class Outside:
    """What is opened when a process starts, and closed when it ends."""

    database: Database
    blobs: Blobs
    spool: Spool
    pool: DecodePool
    queue: JobEngine


def connect_outside(settings: Settings, decode: DecodePlates) -> Outside:
    """The stores, the decoder processes and the queue of the settings; nothing is opened yet.

    `decode` is imported by name in the decoder processes, so it must be a function of a module.
    """
    use_grids(settings.proj_grids_dir)
    return Outside(
        Database(settings.resolved_database_url),
        Blobs(settings.resolved_blobs_url, settings.resolved_spool_dir),
        Spool(settings.resolved_spool_dir),
        _decode_pool(settings, decode),
        _job_queue(settings),
    )


def _job_queue(settings: Settings) -> JobEngine:
    """The engine that runs jobs: threads of this process, or workers that a broker reaches."""
    if not settings.broker_url:
        return LocalQueue()
    from app.jobs.celery_app import make_celery  # Celery takes 0.2 s to import, and most servers need none
    from app.jobs.celery_queue import CeleryQueue

    return CeleryQueue(make_celery(settings.broker_url, settings.broker_prefix), settings.broker_prefix)


def make_use_cases(settings: Settings, outside: Outside, decode: DecodePlates) -> dict[str, Any]:
    """The use cases by the names under which routes ask for them."""
    database, blobs, pool, queue = outside.database, outside.blobs, outside.pool, outside.queue
    rules = _decode_rules(settings)
    ttl = rules.idempotency_ttl
    secrets = AgencySecrets(lru_cache(lambda: load_master_key(settings.resolved_master_key_file)))
    signing_keys = partial(load_signing_keys, settings.resolved_signing_key_file)
    handlers = _handlers(database, pool, secrets, rules)
    marker_cases = Markers(database, utc_now, marker_rules(settings))
    import_cases = Imports(database, utc_now, pool, marker_rules(settings))
    import_jobs = ImportJobs(database, utc_now, blobs, queue, imports=import_cases, idempotency_ttl=ttl)
    quotas = _quotas(settings, database)
    decode_cases = Decodes(database, utc_now, blobs=blobs, quotas=quotas, queue=queue, handlers=handlers, rules=rules)
    access = Access(database, utc_now, _token_check(settings))
    plans = _plan_use_cases(settings, outside, ttl)
    drives = Drives(database, utc_now, blobs, pool, queue, idempotency_ttl=ttl)
    sender = WebhookSender(loopback=settings.webhooks_to_loopback)
    files = _job_file_use_cases(settings, outside, ttl)
    reprocessings = Reprocessings(database, utc_now, blobs, queue, decode_cases)
    audit_verifications = AuditVerifications(database, utc_now, queue, idempotency_ttl=ttl)
    return {
        "access": access,
        "agency_events": AgencyEvents(database),
        "artworks": Artworks(database, public_url=settings.resolved_public_url, read=_face_reader(decode)),
        "audit": AuditLog(database),
        "audit_verifications": audit_verifications,
        "bulk_markers": BulkMarkers(database, utc_now, marker_cases, ttl),
        "calibrations": Calibrations(database, utc_now, pool, rules.images, ttl),
        "codebooks": Codebooks(database, utc_now, ttl),
        "decode_outputs": DecodeOutputs(database, blobs=blobs, processes=pool, rules=rules),
        "decodes": decode_cases,
        "drives": drives,
        "features": Features(database, utc_now),
        "import_jobs": import_jobs,
        "imports": import_cases,
        "jobs": Jobs(
            database,
            utc_now,
            {
                JobKind.AUDIT: audit_verifications,
                JobKind.DECODE: decode_cases,
                JobKind.IMPORT: import_jobs,
                JobKind.PLAN: plans["plan_making"],
                JobKind.PROOF: plans["proofs"],
                JobKind.PACKAGE: plans["packages"],
                JobKind.ARTWORK: files["artwork_jobs"],
                JobKind.EXPORT: files["export_jobs"],
                JobKind.REPROCESS: reprocessings,
                JobKind.DRIVE: drives,
            },
            queue,
        ),
        "keys": Keys(database, utc_now, access),
        "layouts": Layouts(database),
        "maintenance": Maintenance(database, utc_now, marker_cases),
        "markers": marker_cases,
        "observations": Observations(database),
        "print_grades": PrintGrades(database, utc_now, pool, rules.images),
        "programs": CerpmPrograms(database, utc_now, secrets),
        "reprocessings": reprocessings,
        "roads": Roads(database, utc_now, settings.crs_accuracy_m, ttl),
        "quotas": quotas,
        "searches": Searches(database),
        "snapshots": Snapshots(database, utc_now, signing_keys),
        "unused_blobs": UnusedBlobs(database, utc_now, blobs, alone=settings.is_embedded),
        "webhook_delivery": WebhookDelivery(database, utc_now, secrets, sender),
        "webhooks": Webhooks(database, utc_now, secrets, sender.check_url),
        "uploads": Uploads(
            database,
            utc_now,
            blobs=blobs,
            spool=outside.spool,
            s3=S3Parts(settings.resolved_blobs_url),
            decodes=decode_cases,
            quotas=quotas,
            rules=UploadRules(settings.max_resumable_bytes, timedelta(hours=settings.upload_expiry_h)),
        ),
        "vehicles": Vehicles(database, utc_now, ttl),
        **plans,
        **files,
    }


def _plan_use_cases(settings: Settings, outside: Outside, ttl: timedelta) -> dict[str, Any]:
    """Those about roads to plan and their plans."""
    stores = (outside.database, utc_now, outside.blobs, outside.pool)
    plan_cases = Plans(*stores, marker_rules(settings))
    workers = settings.decode_workers
    return {
        "alignments": Alignments(*stores, accuracy_m=settings.crs_accuracy_m, idempotency_ttl=ttl),
        "packages": Packages(*stores, outside.queue, in_flight=workers, idempotency_ttl=ttl),
        "plan_jobs": PlanJobs(outside.database, utc_now),
        "plan_making": PlanMaking(outside.database, utc_now, outside.queue, plans=plan_cases, idempotency_ttl=ttl),
        "plans": plan_cases,
        "proofs": Proofs(*stores, outside.queue, in_flight=workers, idempotency_ttl=ttl),
    }


def _job_file_use_cases(settings: Settings, outside: Outside, ttl: timedelta) -> dict[str, Any]:
    """Jobs of every kind, and those that write files."""
    database, queue = outside.database, outside.queue
    jobs, exports = AllJobs(database, utc_now), Exports(database)
    files = JobFiles(database, utc_now, outside.blobs, jobs)
    return {
        "all_jobs": jobs,
        "artwork_jobs": ArtworkJobs(
            database, utc_now, outside.pool, queue, files,
            public_url=settings.resolved_public_url, in_flight=settings.decode_workers, idempotency_ttl=ttl,
        ),
        "export_jobs": ExportJobs(database, utc_now, queue, exports, files, ttl),
        "exports": exports,
        "job_files": files,
    }  # fmt: skip


def utc_now() -> datetime:
    """The system's clock."""
    return datetime.now(UTC)


def marker_rules(settings: Settings) -> MarkerRules:
    """Rules of the registry, from the settings."""
    return MarkerRules(
        explicit_code_radius_m=settings.explicit_code_radius_m,
        position_code_radius_m=settings.position_code_radius_m,
        crs_accuracy_m=settings.crs_accuracy_m,
        idempotency_ttl=timedelta(hours=settings.idempotency_ttl_h),
    )


def _quotas(settings: Settings, database: Database) -> Quotas:
    rules = QuotaRules(
        settings.key_stored_bytes,
        settings.agency_stored_bytes,
        settings.key_open_uploads,
        settings.agency_open_uploads,
    )
    return Quotas(database, rules)


def _face_reader(decode: DecodePlates) -> PlateReader:
    """The decoder as the self-proof wants it: our own drawing is no stranger's upload, so it needs no child process."""

    def read(image: npt.NDArray[np.uint8], geometry: PlateGeometry) -> list[PlateReading]:
        check_deadline()  # once a plate: a bundle has thousands
        return decode(image, geometries=(geometry,))

    return read


def _decode_pool(settings: Settings, decode: DecodePlates) -> DecodePool:
    return DecodePool(
        decode,
        workers=settings.decode_workers,
        limits=ProcessLimits(settings.decode_memory_bytes, settings.decode_timeout_s, settings.trace_timeout_s),
        max_pixels=settings.max_image_pixels,
        max_waiting=max(32, 4 * settings.decode_workers),  # proofs and packages keep every process busy
    )


def _handlers(
    database: Database, pool: DecodePool, secrets: AgencySecrets, rules: DecodeRules
) -> tuple[UploadHandler[Any], ...]:
    """Kinds of uploads; the first one that accepts an upload decodes it."""
    return (
        TraceHandler(database, pool, rules),
        PacketHandler(database, pool, secrets, rules),
        VideoHandler(database, utc_now, pool, rules),
        ArchiveHandler(database, utc_now, pool, rules),
        FrameHandler(database, pool, rules),
    )


def _decode_rules(settings: Settings) -> DecodeRules:
    return DecodeRules(
        images=ImageLimits(pixels=settings.max_image_pixels, file_bytes=settings.max_upload_bytes),
        archives=ArchiveLimits(members=settings.max_archive_frames, member_bytes=settings.max_upload_bytes),
        frames_in_flight=settings.decode_workers,
        idempotency_ttl=timedelta(hours=settings.idempotency_ttl_h),
    )


def _token_check(settings: Settings) -> Callable[[str], Bearer] | None:
    if not settings.oidc_issuer:
        return None
    issuer = Issuer(settings.oidc_issuer, settings.oidc_audience, settings.oidc_agency_claim, settings.oidc_scope_claim)
    return Tokens(issuer, KeySet(partial(read_jwks, settings.oidc_jwks))).verify
