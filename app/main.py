"""The only place where things are wired. There is no app at import: call `create_app`."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from datetime import UTC, datetime, timedelta

from fastapi import FastAPI
from prometheus_client import CollectorRegistry

from app import __version__
from app.api import markers, system
from app.api.middleware import Guarded, Observed
from app.api.openapi import describe
from app.api.problems import install_problem_handlers
from app.registry.database import Database
from app.services.access import Access, Scope
from app.services.markers import MarkerRules, Markers
from app.settings import Settings

ROUTERS = (system.router, markers.router)


def create_app(settings: Settings) -> FastAPI:
    """An app with its own database, use cases, metrics and limits. Files are opened when it starts."""
    database = Database(settings.resolved_database_url)
    access = Access(database, utc_now)
    metrics = CollectorRegistry()
    readiness: dict[str, Callable[[], bool]] = {"database": database.is_ready}

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        database.open()
        try:
            database.migrate()
            _show_once(access.ensure_first_key(_admin_key(settings)))
            yield
        finally:
            database.close()

    app = FastAPI(title="Waymark", version=__version__, lifespan=lifespan)
    app.state.markers = Markers(database, utc_now, _marker_rules(settings))
    app.state.access = access
    app.state.readiness = readiness
    app.state.metrics = metrics
    for router in ROUTERS:
        app.include_router(router)
    install_problem_handlers(app)
    describe(app)
    app.add_middleware(
        Guarded,
        authenticate=access.authenticate,
        body_limits={"": settings.max_json_bytes, "/v1/decodes": settings.max_upload_bytes},
        needed_scopes={"": Scope.WRITE, "/v1/decodes": Scope.DECODE},
        body_timeout_s=settings.body_timeout_s,
    )
    app.add_middleware(Observed, registry=metrics)
    return app


def utc_now() -> datetime:
    """The system's clock."""
    return datetime.now(UTC)


def _admin_key(settings: Settings) -> str | None:
    return settings.admin_key.get_secret_value() if settings.admin_key is not None else None


def _marker_rules(settings: Settings) -> MarkerRules:
    return MarkerRules(
        explicit_code_radius_m=settings.explicit_code_radius_m,
        position_code_radius_m=settings.position_code_radius_m,
        crs_accuracy_m=settings.crs_accuracy_m,
        idempotency_ttl=timedelta(hours=settings.idempotency_ttl_h),
    )


def _show_once(key: str | None) -> None:
    if key is not None:
        print(f"Admin key (shown once, keep it): {key}", flush=True)
