"""Use cases and what they need from outside, wired once for the server and for `waymark worker`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import timedelta
from functools import lru_cache, partial
from typing import Any

import numpy as np
import numpy.typing as npt

from app.decoding.frames import DecodePlates
from app.encoders.plate import PlateReader
from app.families.surveys import MarkerRules
from app.formats.format import ArchiveLimits
from app.formats.images import ImageLimits
from app.geodesy import use_grids
from app.jobs.decoder_process import ProcessLimits
from app.jobs.export_process import ExportProcesses
from app.jobs.pool import DecodePool
from app.jobs.queues import JobEngine, LocalQueue
from app.markers.plate import PlateGeometry
from app.markers.reading import PlateReading
from app.registry.database import Database
from app.registry.jobs import JobKind
from app.services.access.access import Access, Bearer
from app.services.access.agency_secrets import AgencySecrets
from app.services.access.audit import AuditLog
from app.services.access.audit_jobs import AuditVerifications
from app.services.access.keys import Agencies, Keys
from app.services.blobs import UnusedBlobs
from app.services.decodes.context import DecodeRules
from app.services.decodes.decodes import DecodeDetails, Decodes
from app.services.decodes.frames import ArchiveHandler, FrameHandler
from app.services.decodes.outputs import DecodeOutputs
from app.services.decodes.recordings import PacketHandler, TraceHandler
from app.services.decodes.upload_path import UploadHandler
from app.services.decodes.video_handler import VideoHandler
from app.services.drives.drives import Drives
from app.services.fleet.calibrations import Calibrations
from app.services.fleet.snapshots import Snapshots
from app.services.fleet.vehicles import Vehicles
from app.services.health.maintenance import Maintenance
from app.services.jobs import JobHandler, Jobs
from app.services.markers.artwork import ArtworkJobs, Artworks
from app.services.markers.bulk import BulkMarkers
from app.services.markers.codebooks import Codebooks
from app.services.markers.features import Features
from app.services.markers.markers import Markers, Observations
from app.services.markers.plate_drafts import PlateDrafts
from app.services.markers.print_grades import PrintGrades
from app.services.markers.programs import CerpmPrograms, Layouts
from app.services.markers.searches import Searches
from app.services.plans.alignments import Alignments
from app.services.plans.making import PlanMaking, PlanPreviews
from app.services.plans.packages import Packages
from app.services.plans.plans import Plans
from app.services.plans.proofs import Proofs
from app.services.ports import utc_now
from app.services.progress import AgencyEvents, AllJobs, JobFiles
from app.services.public_pages.pages import FormTokens, PublicPages
from app.services.public_pages.reports import DamageReports
from app.services.reprocessing import Reprocessings
from app.services.request_work import check_deadline
from app.services.roads.roads import Roads
from app.services.surveys.exports import ExportJobs, Exports
from app.services.surveys.import_jobs import ImportJobs
from app.services.surveys.imports import Imports
from app.services.uploads.quotas import QuotaRules, Quotas, UploadRules
from app.services.uploads.uploads import Uploads
from app.services.webhooks import WebhookDelivery, Webhooks
from app.settings import Settings
from app.storage.blobs import Blobs, S3Parts
from app.storage.keys import load_master_key, load_signing_keys
from app.storage.spool import Spool
from app.storage.webhook_sender import WebhookSender
from app.use_cases import UseCases


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
    from app.jobs.celery_queue import (
        CeleryQueue,
        make_celery,  # Celery takes 0.2 s to import, and most servers need none
    )

    return CeleryQueue(make_celery(settings.broker_url, settings.broker_prefix), settings.broker_prefix)


def make_use_cases(settings: Settings, outside: Outside, decode: DecodePlates) -> UseCases:
    """The use cases of the server and of `waymark worker`."""
    database, blobs, pool, queue = outside.database, outside.blobs, outside.pool, outside.queue
    clock, ttl, workers = utc_now, timedelta(hours=settings.idempotency_ttl_h), settings.decode_workers
    master_key = lru_cache(lambda: load_master_key(settings.resolved_master_key_file))
    secrets = AgencySecrets(master_key)
    quotas = _quotas(settings, database)
    sender = WebhookSender(loopback=settings.webhooks_to_loopback)
    read_face, decode_rules = _face_reader(decode), _decode_rules(settings)
    access = Access(database, clock, _token_check(settings))
    audits = AuditVerifications(database, clock, queue, idempotency_ttl=ttl)

    markers = Markers(database, clock, marker_rules(settings))
    imports = Imports(database, clock, pool, marker_rules(settings))
    import_jobs = ImportJobs(database, clock, blobs, queue, imports=imports, idempotency_ttl=ttl)

    handlers = _upload_handlers(database, pool, secrets, decode_rules)
    decodes = Decodes(database, clock, blobs=blobs, quotas=quotas, queue=queue, handlers=handlers, rules=decode_rules)
    drives = Drives(database, clock, blobs, pool, queue, idempotency_ttl=ttl)
    reprocessings = Reprocessings(database, clock, blobs, queue, decodes)
    resumable = UploadRules(settings.max_resumable_bytes, timedelta(hours=settings.upload_expiry_h))

    plans = Plans(database, clock, blobs, pool, marker_rules(settings))
    plan_making = PlanMaking(database, clock, queue, plans=plans, idempotency_ttl=ttl)
    proofs = Proofs(database, clock, blobs, pool, queue, in_flight=workers, idempotency_ttl=ttl)
    packages = Packages(database, clock, blobs, pool, queue, in_flight=workers, idempotency_ttl=ttl)

    all_jobs = AllJobs(database, clock)
    job_files = JobFiles(database, clock, blobs, all_jobs)
    exports = Exports(database, ExportProcesses(settings.decode_memory_bytes).write)
    export_jobs = ExportJobs(database, clock, queue, exports, job_files, ttl)
    artwork_jobs = ArtworkJobs(
        database, clock, pool, queue, job_files, public_url=settings.qr_code_url, in_flight=workers, idempotency_ttl=ttl
    )
    job_handlers: dict[JobKind, JobHandler] = {
        JobKind.AUDIT: audits,
        JobKind.DECODE: decodes,
        JobKind.IMPORT: import_jobs,
        JobKind.PLAN: plan_making,
        JobKind.PROOF: proofs,
        JobKind.PACKAGE: packages,
        JobKind.ARTWORK: artwork_jobs,
        JobKind.EXPORT: export_jobs,
        JobKind.REPROCESS: reprocessings,
        JobKind.DRIVE: drives,
    }
    return UseCases(
        access=access,
        agencies=Agencies(database, clock, secrets, ttl),
        audit=AuditLog(database),
        audit_verifications=audits,
        keys=Keys(database, clock, access),
        vehicles=Vehicles(database, clock, ttl),
        bulk_markers=BulkMarkers(database, clock, markers, ttl),
        codebooks=Codebooks(database, clock, ttl),
        features=Features(database, clock),
        layouts=Layouts(database),
        maintenance=Maintenance(database, clock, markers),
        markers=markers,
        observations=Observations(database),
        programs=CerpmPrograms(database, clock, secrets),
        roads=Roads(database, clock, settings.crs_accuracy_m, ttl),
        searches=Searches(database),
        snapshots=Snapshots(database, clock, partial(load_signing_keys, settings.resolved_signing_key_file)),
        imports=imports,
        import_jobs=import_jobs,
        artworks=Artworks(database, public_url=settings.qr_code_url, read=read_face),
        calibrations=Calibrations(database, clock, pool, decode_rules.images, ttl),
        plate_drafts=PlateDrafts(pool, read=read_face, crs_accuracy_m=settings.crs_accuracy_m),
        print_grades=PrintGrades(database, clock, pool, decode_rules.images),
        decode_details=DecodeDetails(database, blobs=blobs, processes=pool, rules=decode_rules),
        decode_outputs=DecodeOutputs(database, blobs=blobs, processes=pool, rules=decode_rules),
        decodes=decodes,
        drives=drives,
        reprocessings=reprocessings,
        unused_blobs=UnusedBlobs(database, clock, blobs, alone=settings.is_embedded),
        uploads=Uploads(
            database, clock, blobs=blobs, spool=outside.spool, s3=S3Parts(settings.resolved_blobs_url),
            decodes=decodes, quotas=quotas, rules=resumable,
        ),
        alignments=Alignments(
            database, clock, blobs, pool, accuracy_m=settings.crs_accuracy_m, idempotency_ttl=ttl
        ),
        packages=packages,
        plan_making=plan_making,
        plan_previews=PlanPreviews(plans, plan_making),
        plans=plans,
        proofs=proofs,
        all_jobs=all_jobs,
        artwork_jobs=artwork_jobs,
        export_jobs=export_jobs,
        exports=exports,
        job_files=job_files,
        agency_events=AgencyEvents(database),
        webhook_delivery=WebhookDelivery(database, clock, secrets, sender),
        webhooks=Webhooks(database, clock, secrets, sender.check_url),
        damage_reports=DamageReports(
            database, clock, blobs, pool, quotas,
            images=ImageLimits(pixels=settings.max_image_pixels, file_bytes=settings.max_report_photo_bytes),
            contact_days=settings.report_contact_days,
        ),
        form_tokens=FormTokens(master_key, clock),
        public_pages=PublicPages(database, clock),
        jobs=Jobs(database, clock, job_handlers, queue),
        quotas=quotas,
    )  # fmt: skip


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


def _upload_handlers(
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
    from app.services.access.oidc import Issuer, KeySet, Tokens  # here: they load JWT and HTTP libraries
    from app.storage.jwks import read_jwks

    issuer = Issuer(settings.oidc_issuer, settings.oidc_audience, settings.oidc_agency_claim, settings.oidc_scope_claim)
    return Tokens(issuer, KeySet(partial(read_jwks, settings.oidc_jwks))).verify
