"""What pages and admins see of the settings."""

from __future__ import annotations

from typing import Literal

from app.api.http.system import BaseMap, NumberSetting, PageSettings, ServerSettings, SignInOptions
from app.api.http.ui import BASE_MAP, GUIDE, origin_of
from app.settings import Settings

_PLACES = ("port", "worker_metrics_port")


def page_settings_of(settings: Settings, version: str) -> PageSettings:
    """The server's settings that concern the pages."""
    sign_in = base_map = None
    if settings.oidc_client_id:
        sign_in = SignInOptions(
            issuer=settings.oidc_issuer,
            client_id=settings.oidc_client_id,
            authorize_url=settings.oidc_authorize_url,
            token_url=settings.oidc_token_url,
            scopes=settings.oidc_request_scopes,
        )
    if settings.base_map:
        is_file = settings.base_map_file is not None
        base_map = BaseMap(
            kind="pmtiles" if is_file else "raster",
            url=f"/static/{BASE_MAP}" if is_file else settings.base_map,
            attribution=settings.base_map_attribution,
        )
    guide = ((settings.guide_dir or GUIDE) / "index.html").is_file()
    return PageSettings(version=version, sign_in=sign_in, base_map=base_map, guide=guide)


def server_settings_of(settings: Settings, version: str) -> ServerSettings:
    """The settings in use, as admins may see them: of texts only what is named here, of numbers all."""
    numbers = [
        NumberSetting(
            name=f"WAYMARK_{name.upper()}",
            value=getattr(settings, name),
            default=field.default,
            description=field.description or "",
        )
        for name, field in type(settings).model_fields.items()
        if field.annotation in (int, float, bool) and name not in _PLACES
    ]
    base_map: Literal["pmtiles", "raster"] | None = None
    if settings.base_map:
        base_map = "pmtiles" if settings.base_map_file is not None else "raster"
    return ServerSettings(
        version=version,
        engine="celery" if settings.broker_url else "embedded",
        database="sqlite" if settings.resolved_database_url.startswith("sqlite") else "postgresql",
        storage="s3" if settings.resolved_blobs_url.startswith("s3:") else "folder",
        broker="amqp" if settings.broker_url else None,
        public_url=settings.public_url or None,
        issuer=settings.oidc_issuer or None,
        base_map=base_map,
        grids=settings.proj_grids_dir is not None,
        tracing=bool(settings.otlp_endpoint),
        log_format=settings.log_format,
        log_level=settings.log_level,
        numbers=numbers,
    )


def other_hosts(settings: Settings) -> tuple[str, ...]:
    """Origins that the pages ask besides their own server: only those that were configured."""
    urls = [settings.oidc_token_url] if settings.oidc_client_id else []
    if settings.base_map and settings.base_map_file is None:
        urls.append(settings.base_map)
    return tuple(sorted({origin for url in urls if (origin := origin_of(url)) is not None}))
