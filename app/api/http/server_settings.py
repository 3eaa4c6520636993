"""GET /v1/server-settings: what the server runs with, for admins: no secret, no path, no address of a store."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Request, Response
from pydantic import Field
from typing_extensions import TypedDict

from app.api.http.dependencies import Caller
from app.api.http.responses import document_response, json_response
from app.api.http.strict_json import StrictRoute

router = APIRouter(prefix="/v1/server-settings", tags=["system"], route_class=StrictRoute)


class NumberSetting(TypedDict):
    """A setting that is a number or a switch."""

    name: Annotated[str, Field(description="Of the environment variable.")]
    value: float | bool
    default: float | bool
    description: str


class ServerSettings(TypedDict):
    """Settings in use."""

    version: Annotated[str, Field(description="Of the server.")]
    engine: Annotated[Literal["embedded", "celery"], Field(description="Who runs the jobs: the server, or workers.")]
    database: Literal["sqlite", "postgresql"]
    storage: Annotated[Literal["folder", "s3"], Field(description="Where uploads are stored.")]
    broker: Annotated[Literal["amqp"] | None, Field(description="null: the server needs none.")]
    public_url: Annotated[str | None, Field(description="Address of the server in QR codes and links.")]
    issuer: Annotated[str | None, Field(description="OpenID Connect issuer whose tokens are accepted.")]
    base_map: Annotated[Literal["pmtiles", "raster"] | None, Field(description="null: the pages draw a grid.")]
    grids: Annotated[bool, Field(description="PROJ grids for coordinate transformations are installed.")]
    tracing: Annotated[bool, Field(description="Traces are sent to a collector.")]
    log_format: Literal["console", "json"]
    log_level: Literal["DEBUG", "INFO", "WARNING", "ERROR"]
    numbers: Annotated[list[NumberSetting], Field(description="Limits and switches, see docs/settings.md.")]


@router.get("", responses=document_response(ServerSettings))
async def get_server_settings(request: Request, caller: Caller) -> Response:
    """The settings that the server runs with."""
    return json_response(request.app.state.server_settings)
