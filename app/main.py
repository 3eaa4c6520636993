"""The only place where things are wired. There is no app at import: call `create_app`."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import structlog
from fastapi import Depends, FastAPI, Response
from prometheus_client import CollectorRegistry

from app import __version__
from app.api.access import audit, keys
from app.api.decodes import decodes
from app.api.fleet import calibrations, snapshots, vehicles
from app.api.http import system, ui
from app.api.http.costs import Budget, Slots
from app.api.http.dependencies import refuse_unknown_parameters
from app.api.http.middleware import Guarded, Observed
from app.api.http.openapi import describe, operation_id
from app.api.http.permissions import Permissions
from app.api.http.problems import install_problem_handlers
from app.api.http.rate_limits import RateLimit
from app.api.markers import artwork, bulk, cerpms, codebooks, layouts, markers, observations, searches
from app.api.ogc import mount_ogc
from app.api.plans import alignments, packages, plan_jobs, plans, proofs, radio_checks
from app.api.roads import roads
from app.api.surveys import exports, imports
from app.decoders.plate import decode_plates
from app.encoders.plate import PlateReader
from app.families.rules import MarkerRules
from app.formats.archives import ArchiveLimits
from app.formats.images import ImageLimits
from app.geodesy import use_grids
from app.jobs.decoder_process import ProcessLimits
from app.jobs.frame_tasks import DecodePlates
from app.jobs.local_queue import LocalQueue
from app.jobs.pool import DecodePool
from app.markers.plate import PlateGeometry
from app.markers.reading import PlateReading
from app.registry.database import Database
from app.registry.jobs import JobKind
from app.services.access.access import Access, Bearer
from app.services.access.agency_secrets import AgencySecrets
from app.services.access.audit import AuditLog
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
from app.services.fleet.calibrations import Calibrations
from app.services.fleet.snapshots import Snapshots
from app.services.fleet.vehicles import Vehicles
from app.services.jobs import Jobs
from app.services.markers.artwork import Artworks
from app.services.markers.bulk import BulkMarkers
from app.services.markers.cerpm_programs import CerpmPrograms
from app.services.markers.codebooks import Codebooks
from app.services.markers.features import Features
from app.services.markers.layouts import Layouts
from app.services.markers.markers import Markers
from app.services.markers.observations import Observations
from app.services.markers.searches import Searches
from app.services.plans.alignments import Alignments
from app.services.plans.making import PlanMaking
from app.services.plans.packages import Packages
from app.services.plans.plan_jobs import PlanJobs
from app.services.plans.plans import Plans
from app.services.plans.proofs import Proofs
from app.services.request_work import check_deadline
from app.services.roads.roads import Roads
from app.services.surveys.exports import Exports
from app.services.surveys.import_jobs import ImportJobs
from app.services.surveys.imports import Imports
from app.services.unused_blobs import UnusedBlobs
from app.settings import Settings
from app.storage.blobs import Blobs
from app.storage.jwks import read_jwks
from app.storage.master_key import load_master_key
from app.storage.probe import FolderProbe
from app.storage.signing_key import load_signing_keys

_LOG = structlog.get_logger("waymark")
ROUTERS = (
    searches.router,
    bulk.router,
    observations.router,
    roads.router,
    markers.router,
    artwork.router,
    layouts.router,
    cerpms.router,
    radio_checks.router,
    alignments.router,
    plans.router,
    proofs.router,
    packages.router,
    plan_jobs.router,
    codebooks.router,
    decodes.router,
    imports.router,
    exports.router,
    snapshots.router,
    audit.router,
    vehicles.router,
    calibrations.router,
    keys.router,
)


@dataclass(frozen=True, slots=True)
class _Outside:
    """What is opened when the server starts, and closed when it ends."""

    database: Database
    blobs: Blobs
    pool: DecodePool
    queue: LocalQueue
    plan_queue: LocalQueue
    proof_queue: LocalQueue

    @property
    def queues(self) -> tuple[tuple[LocalQueue, tuple[JobKind, ...]], ...]:
        """The queues with the kinds of their jobs: a proof of hours holds up no upload, nor another plan."""
        return (
            (self.queue, (JobKind.DECODE, JobKind.IMPORT)),
            (self.plan_queue, (JobKind.PLAN, JobKind.PACKAGE)),
            (self.proof_queue, (JobKind.PROOF,)),
        )


def create_app(settings: Settings, *, decode: DecodePlates = decode_plates) -> FastAPI:
    """An app with its own database, use cases, metrics and limits. Files are opened when it starts.

    `decode` is imported by name in the decoder processes, so it must be a function of a module.
    """
    use_grids(settings.proj_grids_dir)
    outside = _Outside(
        Database(settings.resolved_database_url),
        Blobs(settings.resolved_blobs_url),
        _decode_pool(settings, decode),
        LocalQueue(),
        LocalQueue(),
        LocalQueue(),
    )
    use_cases = _use_cases(settings, outside, decode)
    app = FastAPI(
        title="Waymark",
        version=__version__,
        openapi_url=None,  # app/api/http/ui.py has the document and the pages about it
        lifespan=lambda _app: _running(settings, outside, use_cases),
        default_response_class=Response,
        generate_unique_id_function=operation_id,
    )
    for name, use_case in use_cases.items():
        setattr(app.state, name, use_case)
    app.state.database = outside.database
    app.state.public_url = settings.public_url.rstrip("/")
    app.state.readiness = {
        "database": outside.database.is_ready,
        "decoders": outside.pool.is_ready,
        "storage": FolderProbe(_folders(outside)).is_writable,
    }
    app.state.metrics = CollectorRegistry()
    _add_routes(app)
    _add_guard(app, settings, app.state.access)
    app.add_middleware(Observed, registry=app.state.metrics)
    return app


def _folders(outside: _Outside) -> set[Path]:
    """Folders of this machine in which data are stored."""
    database = outside.database.path
    return {folder for folder in (outside.blobs.folder, database.parent if database else None) if folder is not None}


def _use_cases(settings: Settings, outside: _Outside, decode: DecodePlates) -> dict[str, Any]:
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
    decode_cases = Decodes(database, utc_now, blobs=blobs, queue=queue, handlers=handlers, rules=rules)
    access = Access(database, utc_now, _token_check(settings))
    plan_cases = Plans(database, utc_now, blobs, pool, marker_rules(settings))
    plan_making = PlanMaking(database, utc_now, outside.plan_queue, plans=plan_cases, idempotency_ttl=ttl)
    package_cases = Packages(
        database, utc_now, blobs, pool, outside.plan_queue, in_flight=settings.decode_workers, idempotency_ttl=ttl
    )
    proof_cases = Proofs(
        database, utc_now, blobs, pool, outside.proof_queue, in_flight=settings.decode_workers, idempotency_ttl=ttl
    )
    return {
        "access": access,
        "artworks": Artworks(database, public_url=settings.resolved_public_url, read=_face_reader(decode)),
        "alignments": Alignments(
            database, utc_now, blobs, pool, accuracy_m=settings.crs_accuracy_m, idempotency_ttl=ttl
        ),
        "audit": AuditLog(database),
        "bulk_markers": BulkMarkers(database, utc_now, marker_cases, ttl),
        "calibrations": Calibrations(database, utc_now, pool, rules.images, ttl),
        "codebooks": Codebooks(database, utc_now, ttl),
        "decode_outputs": DecodeOutputs(database, blobs=blobs, processes=pool, rules=rules),
        "decodes": decode_cases,
        "exports": Exports(database),
        "features": Features(database, utc_now),
        "import_jobs": import_jobs,
        "imports": import_cases,
        "jobs": Jobs(
            database,
            utc_now,
            {
                JobKind.DECODE: decode_cases,
                JobKind.IMPORT: import_jobs,
                JobKind.PLAN: plan_making,
                JobKind.PROOF: proof_cases,
                JobKind.PACKAGE: package_cases,
            },
        ),
        "keys": Keys(database, utc_now, access),
        "layouts": Layouts(database),
        "markers": marker_cases,
        "observations": Observations(database),
        "packages": package_cases,
        "plan_jobs": PlanJobs(database, utc_now),
        "plan_making": plan_making,
        "plans": plan_cases,
        "proofs": proof_cases,
        "programs": CerpmPrograms(database, utc_now, secrets),
        "roads": Roads(database, utc_now, settings.crs_accuracy_m, ttl),
        "searches": Searches(database),
        "snapshots": Snapshots(database, utc_now, signing_keys),
        "unused_blobs": UnusedBlobs(database, utc_now, blobs, alone=settings.is_embedded),
        "vehicles": Vehicles(database, utc_now, ttl),
    }


@asynccontextmanager
async def _running(settings: Settings, outside: _Outside, use_cases: Mapping[str, Any]) -> AsyncIterator[None]:
    """The time between the server's start and its end."""
    jobs, access, unused_blobs = use_cases["jobs"], use_cases["access"], use_cases["unused_blobs"]
    outside.database.open()
    try:
        outside.database.migrate()
        for warning in outside.database.list_warnings():
            _LOG.warning(warning)
        outside.blobs.open()
        _show_once(access.ensure_first_key(_admin_key(settings)))
        if settings.warm_decoders:
            outside.pool.warm()
        for queue, kinds in outside.queues:
            queue.open(jobs.run_job, jobs.list_unfinished(kinds))
        async with _each_minute(access.write_uses), _each_day(unused_blobs.try_to_delete, stop=unused_blobs.stop):
            yield
    finally:
        outside.pool.close()
        for queue, _kinds in outside.queues:
            queue.close()
        outside.database.close()


def _add_routes(app: FastAPI) -> None:
    for router in (ui.router, system.router):
        app.include_router(router)
    for router in ROUTERS:
        app.include_router(router, dependencies=[Depends(refuse_unknown_parameters)])
    mount_ogc(app)
    ui.mount_static(app)
    install_problem_handlers(app)
    describe(app)


def _add_guard(app: FastAPI, settings: Settings, access: Access) -> None:
    app.add_middleware(
        Guarded,
        authenticate=access.authenticate,
        recall=access.recall,
        was_valid=access.was_valid,
        requests=_request_limit(settings),
        failures=_failure_limit(settings),
        body_limits={
            "": settings.max_json_bytes,
            "/v1/decodes": settings.max_upload_bytes,
            "/v1/imports": settings.max_import_bytes,
            "/v1/alignments": settings.max_import_bytes,
            "/v1/calibrations": settings.max_upload_bytes,
        },
        permissions=Permissions(),
        body_timeout_s=settings.body_timeout_s,
        min_bytes_per_s=settings.min_bytes_per_s,
        budget=Budget(settings.key_processor_s_per_min, settings.agency_processor_s_per_min),
        slots=Slots(settings.expensive_at_once, settings.expensive_per_agency),
        request_timeout_s=settings.request_timeout_s,
    )


@asynccontextmanager
async def _each_minute(work: Callable[[], None]) -> AsyncIterator[None]:
    """Call `work` in a thread once a minute, and a last time at the end."""

    async def repeat() -> None:
        while True:
            await asyncio.sleep(60)
            await asyncio.to_thread(work)

    task = asyncio.create_task(repeat())
    try:
        yield
    finally:
        task.cancel()
        await asyncio.to_thread(work)


@asynccontextmanager
async def _each_day(work: Callable[[], None], *, stop: Callable[[], None]) -> AsyncIterator[None]:
    """Call `work` in a thread now and once a day; `stop` ends a call."""

    async def repeat() -> None:
        while True:
            await asyncio.to_thread(work)
            await asyncio.sleep(24 * 3600)

    task = asyncio.create_task(repeat())
    try:
        yield
    finally:
        stop()
        task.cancel()


def utc_now() -> datetime:
    """The system's clock."""
    return datetime.now(UTC)


def _admin_key(settings: Settings) -> str | None:
    return settings.admin_key.get_secret_value() if settings.admin_key is not None else None


def _token_check(settings: Settings) -> Callable[[str], Bearer] | None:
    if not settings.oidc_issuer:
        return None
    issuer = Issuer(settings.oidc_issuer, settings.oidc_audience, settings.oidc_agency_claim, settings.oidc_scope_claim)
    return Tokens(issuer, KeySet(partial(read_jwks, settings.oidc_jwks))).verify


def _request_limit(settings: Settings) -> RateLimit | None:
    if not settings.requests_per_s:
        return None
    return RateLimit(
        settings.requests_per_s,
        settings.requests_at_once,
        name="key",
        message="too many requests were sent with this key",
        cure="wait for the time in Retry-After, and combine requests: larger pages, bulk requests, ZIP uploads",
    )


def _failure_limit(settings: Settings) -> RateLimit | None:
    if not settings.wrong_keys_per_minute:
        return None
    return RateLimit(
        settings.wrong_keys_per_minute / 60,
        max(1, round(settings.wrong_keys_per_minute)),
        name="wrong-keys",
        message="too many wrong keys were sent from this address",
        cure="wait for the time in Retry-After, and check the key",
    )


def marker_rules(settings: Settings) -> MarkerRules:
    return MarkerRules(
        explicit_code_radius_m=settings.explicit_code_radius_m,
        position_code_radius_m=settings.position_code_radius_m,
        crs_accuracy_m=settings.crs_accuracy_m,
        idempotency_ttl=timedelta(hours=settings.idempotency_ttl_h),
    )


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
        ArchiveHandler(database, utc_now, pool, rules),
        FrameHandler(database, pool, rules),
    )


def _decode_rules(settings: Settings) -> DecodeRules:
    return DecodeRules(
        images=ImageLimits(pixels=settings.max_image_pixels),
        archives=ArchiveLimits(members=settings.max_archive_frames, member_bytes=settings.max_upload_bytes),
        frames_in_flight=settings.decode_workers,
        idempotency_ttl=timedelta(hours=settings.idempotency_ttl_h),
    )


def _show_once(key: str | None) -> None:
    if key is not None:
        print(f"Admin key (shown once, keep it): {key}", flush=True)
