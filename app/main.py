"""The only place where things are wired. There is no app at import: call `create_app`."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from datetime import UTC, datetime, timedelta
from functools import lru_cache, partial

import numpy as np
import numpy.typing as npt
import structlog
from fastapi import Depends, FastAPI
from prometheus_client import CollectorRegistry

from app import __version__
from app.api import (
    artwork,
    audit,
    bulk,
    calibrations,
    cerpms,
    codebooks,
    decodes,
    exports,
    imports,
    keys,
    layouts,
    markers,
    observations,
    radio_checks,
    roads,
    searches,
    snapshots,
    system,
    ui,
    vehicles,
)
from app.api.dependencies import refuse_unknown_parameters
from app.api.middleware import Guarded, Observed
from app.api.ogc import mount_ogc
from app.api.openapi import describe
from app.api.permissions import Permissions
from app.api.problems import install_problem_handlers
from app.api.rate_limits import RateLimit
from app.api.schemas_imports import parse_declaration
from app.decoders.archives import ArchiveLimits
from app.decoders.images import ImageLimits
from app.decoders.plate import decode_plates
from app.encoders.plate import PlateReader
from app.geodesy import use_grids
from app.jobs.child import ChildLimits, DecodePlates
from app.jobs.local import LocalQueue
from app.jobs.pool import DecodePool
from app.markers.plate import PlateGeometry
from app.markers.reading import PlateReading
from app.registry.database import Database
from app.services.access import Access, Bearer
from app.services.agency_secrets import AgencySecrets
from app.services.artwork import Artworks
from app.services.audit import AuditLog
from app.services.bulk_markers import BulkMarkers
from app.services.calibrations import Calibrations
from app.services.cerpm_programs import CerpmPrograms
from app.services.codebooks import Codebooks
from app.services.decode_jobs import DecodeJobs
from app.services.decode_rules import DecodeRules
from app.services.decodes import Decodes
from app.services.exports import Exports
from app.services.features import Features
from app.services.import_jobs import ImportJobs
from app.services.imports import Imports
from app.services.keys import Keys
from app.services.layouts import Layouts
from app.services.marker_rules import MarkerRules
from app.services.markers import Markers
from app.services.observations import Observations
from app.services.oidc import Issuer, KeySet, Tokens
from app.services.roads import Roads
from app.services.searches import Searches
from app.services.snapshots import Snapshots
from app.services.vehicles import Vehicles
from app.settings import Settings
from app.storage.blobs import Blobs
from app.storage.jwks import read_jwks
from app.storage.master_key import load_master_key
from app.storage.signing_key import load_signing_key

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


def create_app(settings: Settings, *, decode: DecodePlates = decode_plates) -> FastAPI:
    """An app with its own database, use cases, metrics and limits. Files are opened when it starts.

    `decode` is imported by name in the decoder processes, so it must be a function of a module.
    """
    use_grids(settings.proj_grids_dir)
    database = Database(settings.resolved_database_url)
    blobs = Blobs(settings.resolved_blobs_url)
    pool = _decode_pool(settings, decode)
    queue = LocalQueue()
    rules = _decode_rules(settings)
    secrets = AgencySecrets(lru_cache(lambda: load_master_key(settings.resolved_master_key_file)))
    imports_service = Imports(database, utc_now, pool, marker_rules(settings))
    import_jobs = ImportJobs(
        database, utc_now, blobs, queue, marker_rules(settings), imports=imports_service, parse=parse_declaration
    )
    jobs = DecodeJobs(
        database, utc_now, blobs=blobs, decoder=pool, secrets=secrets, rules=rules, run_import=import_jobs.run
    )
    access = Access(database, utc_now, _token_check(settings))
    metrics = CollectorRegistry()
    readiness: dict[str, Callable[[], bool]] = {"database": database.is_ready, "decoders": pool.is_ready}

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        database.open()
        try:
            database.migrate()
            for warning in database.list_warnings():
                _LOG.warning(warning)
            blobs.open()
            _show_once(access.ensure_first_key(_admin_key(settings)))
            if settings.warm_decoders:
                pool.warm()
            queue.open(jobs.run_job, jobs.list_unfinished())
            async with _each_minute(access.write_uses):
                yield
        finally:
            pool.close()
            queue.close()
            database.close()

    app = FastAPI(title="Waymark", version=__version__, lifespan=lifespan)
    app.state.database = database
    app.state.markers = Markers(database, utc_now, marker_rules(settings))
    app.state.imports, app.state.import_jobs = imports_service, import_jobs
    app.state.exports = Exports(database)
    app.state.snapshots = Snapshots(
        database, utc_now, lru_cache(lambda: load_signing_key(settings.resolved_signing_key_file))
    )
    app.state.audit = AuditLog(database)
    app.state.searches = Searches(database)
    app.state.roads = Roads(database, utc_now, settings.crs_accuracy_m, rules.idempotency_ttl)
    app.state.observations = Observations(database)
    app.state.bulk_markers = BulkMarkers(database, utc_now, app.state.markers, rules.idempotency_ttl)
    app.state.programs = CerpmPrograms(database, utc_now, secrets)
    app.state.layouts = Layouts(database)
    app.state.codebooks = Codebooks(database, utc_now, rules.idempotency_ttl)
    app.state.calibrations = Calibrations(database, utc_now, pool, rules.images, rules.idempotency_ttl)
    app.state.vehicles = Vehicles(database, utc_now, rules.idempotency_ttl)
    app.state.decodes = Decodes(database, utc_now, blobs=blobs, decoder=pool, queue=queue, secrets=secrets, rules=rules)
    app.state.jobs = jobs
    app.state.artworks = Artworks(database, public_url=settings.resolved_public_url, read=_face_reader(decode))
    app.state.features = Features(database, utc_now)
    app.state.public_url = settings.public_url.rstrip("/")
    app.state.access = access
    app.state.keys = Keys(database, utc_now, access)
    app.state.readiness = readiness
    app.state.metrics = metrics
    _add_routes(app)
    _add_guard(app, settings, access)
    app.add_middleware(Observed, registry=metrics)
    return app


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
            "/v1/calibrations": settings.max_upload_bytes,
        },
        permissions=Permissions(),
        body_timeout_s=settings.body_timeout_s,
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
        said="too many requests came with this key",
        cure="wait as long as Retry-After says, or ask for more at a time: larger pages, bulk requests, ZIP uploads",
    )


def _failure_limit(settings: Settings) -> RateLimit | None:
    if not settings.wrong_keys_per_minute:
        return None
    return RateLimit(
        settings.wrong_keys_per_minute / 60,
        max(1, round(settings.wrong_keys_per_minute)),
        name="wrong-keys",
        said="too many wrong keys came from this address",
        cure="wait as long as Retry-After says, and check the key",
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
        return decode(image, geometries=(geometry,))

    return read


def _decode_pool(settings: Settings, decode: DecodePlates) -> DecodePool:
    return DecodePool(
        decode,
        workers=settings.decode_workers,
        limits=ChildLimits(settings.decode_memory_bytes, settings.decode_timeout_s, settings.trace_timeout_s),
        max_pixels=settings.max_image_pixels,
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
