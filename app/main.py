"""The server: its routes, limits and lifetime. There is no app at import: call `create_app`."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from datetime import timedelta

import structlog
from fastapi import FastAPI
from prometheus_client import CollectorRegistry

from app import __version__
from app.api import access, drives, fleet, health, jobs, ogc, reprocessing, roads, surveys, uploads
from app.api.decodes import decodes
from app.api.http import system, ui
from app.api.http.compression import Compressed
from app.api.http.limits import Budget, RateLimit, Slots
from app.api.http.middleware import Guarded, Observed
from app.api.http.openapi import describe
from app.api.http.permissions import Permissions
from app.api.http.problems import install_problem_handlers
from app.api.http.routes import permissions_of
from app.api.jobs import Streams
from app.api.markers import artwork, codebooks, markers, plates, searches
from app.api.plans import alignments, plans
from app.api.public_pages import damage_reports, pages
from app.api.public_pages.forms import MAX_FIELD_BYTES, public_limits
from app.api.public_pages.pages import FormLimits
from app.control.metrics import ProcessMetrics
from app.control.operations import OperatorCases
from app.control.server import ControlServer
from app.decoding.frames import DecodePlates, decode_plates
from app.errors import Unavailable, is_disk_full
from app.jobs.queues import LocalQueue
from app.published_settings import other_hosts, page_settings_of, server_settings_of
from app.registry.database import Database
from app.services.access.access import Access
from app.services.ports import utc_now
from app.settings import Settings
from app.storage.spool import find_folder_fault
from app.use_cases import UseCases
from app.wiring import Outside, connect_outside, make_use_cases

_LOG = structlog.get_logger("waymark")
_FORM_BYTES = MAX_FIELD_BYTES * 16
"""Of a damage report besides the photo; a larger photo, up to here, is answered with the form. [byte]"""
ROUTERS = (
    *ogc.ROUTERS,  # first: a map view asks dozens of times, and trying all others takes as long as reading a page
    ui.router,
    system.router,
    pages.router,
    searches.router,
    markers.bulk_router,
    markers.observation_router,
    health.router,
    roads.router,
    markers.router,
    artwork.router,
    plates.draft_router,
    plates.print_grade_router,
    artwork.layout_router,
    artwork.program_router,
    plans.radio_router,
    alignments.router,
    plans.rule_router,
    plans.router,
    plans.proof_router,
    plans.package_router,
    jobs.router,
    jobs.file_router,
    jobs.webhook_router,
    jobs.event_router,
    reprocessing.router,
    reprocessing.decode_versions,
    codebooks.router,
    codebooks.draft_router,
    decodes.router,
    decodes.detail_router,
    uploads.router,
    drives.router,
    surveys.import_router,
    surveys.export_router,
    fleet.snapshot_router,
    access.audit_router,
    fleet.vehicle_router,
    fleet.calibration_router,
    access.key_router,
    access.agency_router,
    damage_reports.settings_router,
    damage_reports.router,
    access.me_router,
    system.page_settings_router,
    system.server_settings_router,
)


def create_app(settings: Settings, *, decode: DecodePlates = decode_plates) -> FastAPI:
    """An app with its own database, use cases, metrics and limits. Files are opened when it starts.

    `decode` is imported by name in the decoder processes, so it must be a function of a module.
    """
    outside = connect_outside(settings, decode)
    use_cases = make_use_cases(settings, outside, decode)
    app = FastAPI(
        title="Waymark",
        version=__version__,
        openapi_url=None,  # app/api/http/ui.py has the document and the pages about it
        lifespan=lambda _app: _running(settings, outside, use_cases),
    )
    app.state.use_cases = use_cases
    app.state.database = outside.database
    app.state.spool = outside.spool
    app.state.public_limits = public_limits(
        settings.public_pages_per_minute, settings.damage_reports_per_hour, settings.marker_reports_per_day
    )
    app.state.form_limits = FormLimits(settings.max_report_photo_bytes, settings.report_contact_days)
    app.state.public_url = settings.public_url.rstrip("/")
    app.state.readiness = system.Readiness(
        {
            "database": outside.database.find_fault,
            "decoders": lambda: None if outside.pool.is_ready() else "no decoder process runs",
            "storage": lambda: _find_storage_fault(outside),
        }
    )
    app.state.streams = Streams(use_cases.all_jobs.watched, use_cases.agency_events.newest_of)
    app.state.metrics = CollectorRegistry()
    app.state.metrics.register(ProcessMetrics(outside.database, outside.pool, utc_now))
    app.state.page_settings = page_settings_of(settings, __version__)
    app.state.server_settings = server_settings_of(settings, __version__)
    _add_routes(app)
    ui.mount_static(app, other_hosts(settings), settings.base_map_file, settings.guide_dir)
    app.state.permissions = permissions_of(app.routes)
    app.add_middleware(Compressed)
    budget = Budget(settings.key_processor_s_per_min, settings.agency_processor_s_per_min)
    if isinstance(outside.queue, LocalQueue):  # with a broker, jobs run in other processes
        outside.queue.charge = budget.charge_job
    _add_guard(app, settings, use_cases.access, budget)
    app.add_middleware(Observed, registry=app.state.metrics)
    return app


def _find_storage_fault(outside: Outside) -> str | None:
    """Why nothing can be stored: a folder of this machine cannot be written, or the blob store does not take a blob and
    return it."""
    if (fault := _find_folder_fault(outside)) is None:
        outside.blobs.probe()
    return fault


def _find_folder_fault(outside: Outside) -> str | None:
    database = outside.database.path
    folders = {folder for folder in (outside.blobs.folder, database.parent if database else None) if folder is not None}
    return next(filter(None, map(find_folder_fault, folders)), None)


@asynccontextmanager
async def _running(settings: Settings, outside: Outside, cases: UseCases) -> AsyncIterator[None]:
    """The time between the server's start and its end."""
    control = _control(outside.database, cases)
    outside.database.open()
    try:
        outside.database.migrate()
        for warning in outside.database.list_warnings():
            _LOG.warning(warning)
        left_out = [
            *_try_to_write("blobs", outside.blobs.open),
            *_try_to_write("spool", lambda: outside.spool.open(alone=settings.is_embedded)),
            *_try_to_write("admin key", lambda: _show_once(cases.access.ensure_first_key(_admin_key(settings)))),
        ]
        if settings.warm_decoders:
            outside.pool.warm()
        outside.queue.open(cases.jobs)
        if control is not None:
            left_out += _try_to_write("socket of commands", control.open)
        if settings.is_embedded:
            left_out += _try_to_write("locks of uploads", cases.uploads.release_all)
        fault = _find_folder_fault(outside)
        if left_out or fault:
            _LOG.error(
                "the disk is full or read-only: reads are served, writes are refused until that has changed",
                fault=fault,
                left_out=left_out,
            )
        async with (
            _each_minute(cases.access.write_uses),
            _each(timedelta(days=1), cases.unused_blobs.try_to_delete, stop=cases.unused_blobs.stop),
            _each(timedelta(days=1), cases.webhook_delivery.delete_old, stop=cases.webhook_delivery.stop),
            _each(timedelta(days=1), cases.job_files.try_to_delete_expired, stop=cases.job_files.stop),
            _each(timedelta(seconds=1), cases.webhook_delivery.try_to_work, stop=cases.webhook_delivery.stop),
            _each(timedelta(days=1), cases.damage_reports.try_to_delete_old_contacts, stop=_nothing),
            _each(timedelta(minutes=1), cases.uploads.try_to_tidy, stop=cases.uploads.stop),
        ):
            yield
    finally:
        if control is not None:
            control.close()
        outside.pool.close()
        outside.queue.close()
        outside.database.close()


def _control(database: Database, cases: UseCases) -> ControlServer | None:
    """What carries out commands; those for PostgreSQL open the database themselves."""
    if database.path is None:
        return None
    operator = OperatorCases(database, utc_now, cases.access, lambda: cases.imports, lambda: cases.exports)
    return ControlServer(database.path, operator)


def _add_routes(app: FastAPI) -> None:
    for router in ROUTERS:
        app.router.routes += router.routes  # `include_router` would build all of them
    install_problem_handlers(app)
    describe(app)


def _add_guard(app: FastAPI, settings: Settings, access: Access, budget: Budget) -> None:
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
            "/v1/print-grades": settings.max_upload_bytes,
            "/v1/uploads": settings.max_resumable_bytes,
            "/m/": settings.max_report_photo_bytes + _FORM_BYTES,
        },
        permissions=Permissions(app.state.permissions),
        body_timeout_s=settings.body_timeout_s,
        min_bytes_per_s=settings.min_bytes_per_s,
        budget=budget,
        slots=Slots(settings.expensive_at_once, settings.expensive_per_agency),
        request_timeout_s=settings.request_timeout_s,
    )


@asynccontextmanager
async def _each_minute(work: Callable[[], None]) -> AsyncIterator[None]:
    """Call `work` in a thread once a minute, and a last time at the end."""

    async def repeat() -> None:
        while True:
            await asyncio.sleep(60)
            await asyncio.to_thread(_attempt, work)

    task = asyncio.create_task(repeat())
    try:
        yield
    finally:
        task.cancel()
        await asyncio.to_thread(_attempt, work)


@asynccontextmanager
async def _each(wait: timedelta, work: Callable[[], None], *, stop: Callable[[], None]) -> AsyncIterator[None]:
    """Call `work` in a thread now and again, with a wait in between; `stop` ends a call."""

    async def repeat() -> None:
        while True:
            await asyncio.to_thread(_attempt, work)
            await asyncio.sleep(wait.total_seconds())

    task = asyncio.create_task(repeat())
    try:
        yield
    finally:
        stop()
        task.cancel()


def _try_to_write(name: str, step: Callable[[], None]) -> list[str]:
    """Do a step of the start; what a full or read-only disk prevents is returned with the cause."""
    try:
        step()
    except Unavailable as error:
        return [f"{name}: {error.message}"]
    except OSError as error:
        if not is_disk_full(error):
            raise
        return [f"{name}: {error.strerror}"]
    return []


def _attempt(work: Callable[[], None]) -> None:
    """Call `work`; a failure is logged, and does not end the calls after it."""
    try:
        work()
    except Unavailable as error:
        _LOG.warning("periodic work is tried again later", work=getattr(work, "__qualname__", ""), why=error.message)
    except Exception:  # noqa: BLE001 - whatever it is, it must not end what comes after it
        _LOG.exception("periodic work failed; it is tried again", work=getattr(work, "__qualname__", repr(work)))


def _nothing() -> None:
    """Work of one statement needs no way to stop it."""


def _admin_key(settings: Settings) -> str | None:
    return settings.admin_key.get_secret_value() if settings.admin_key is not None else None


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


def _show_once(key: str | None) -> None:
    if key is not None:
        print(f"Admin key (shown once, keep it): {key}", flush=True)
