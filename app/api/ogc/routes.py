"""The routes of /ogc. Plain ones: bodies and parameters are read by hand here, and every map view passes through."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from functools import wraps
from typing import Any

from fastapi import FastAPI
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Match, Route
from starlette.types import Scope

from app.api.ogc import documents, edits, items, tiles

_ITEMS = "/ogc/collections/{collection}/items"
_TILES = "/ogc/collections/{collection}/tiles"
_THREADS = max(2, min(os.cpu_count() or 1, 4))


def _few_at_once(answer: Callable[[Request], Response]) -> Callable[[Request], Awaitable[Response]]:
    """An endpoint that a few threads run: more would only wait for each other, and each for a connection."""

    @wraps(answer)
    async def endpoint(request: Request) -> Response:
        threads: ThreadPoolExecutor = request.app.state.ogc_threads
        return await asyncio.get_running_loop().run_in_executor(threads, copy_context().run, answer, request)

    return endpoint


class _NamedRoute(Route):
    """A route that metrics and logs can name."""

    def matches(self, scope: Scope) -> tuple[Match, Scope]:
        match, child = super().matches(scope)
        if match is not Match.NONE:
            child["route"] = self
        return match, child


def _route(path: str, endpoint: Any, *methods: str) -> Route:
    return _NamedRoute(path, endpoint, methods=list(methods or ("GET",)), include_in_schema=False)


ROUTES = (
    _route("/ogc", documents.landing_page),
    _route("/ogc/", documents.landing_page),
    _route("/ogc/conformance", documents.conformance),
    _route("/ogc/api", documents.api),
    _route("/ogc/collections", documents.collections),
    _route("/ogc/collections/{collection}", documents.collection),
    _route("/ogc/collections/{collection}/schema", documents.schema),
    _route("/ogc/collections/{collection}/queryables", documents.queryables),
    _route(_ITEMS, _few_at_once(items.list_items)),
    _route(f"{_ITEMS}/{{feature}}", items.get_item),
    _route(_ITEMS, edits.post_item, "POST"),
    _route(_ITEMS, edits.item_options, "OPTIONS"),
    _route(f"{_ITEMS}/{{feature}}", edits.put_item, "PUT"),
    _route(f"{_ITEMS}/{{feature}}", edits.patch_item, "PATCH"),
    _route(f"{_ITEMS}/{{feature}}", edits.delete_item, "DELETE"),
    _route(f"{_ITEMS}/{{feature}}", edits.item_options, "OPTIONS"),
    _route("/ogc/tileMatrixSets", tiles.list_matrix_sets),
    _route("/ogc/tileMatrixSets/{matrix_set}", tiles.get_matrix_set),
    _route(_TILES, tiles.list_tilesets),
    _route(f"{_TILES}/{{matrix_set}}", tiles.get_tileset),
    _route(f"{_TILES}/{{matrix_set}}/{{zoom}}/{{row}}/{{column}}", _few_at_once(tiles.get_tile)),
)


def mount_ogc(app: FastAPI) -> None:
    """Add /ogc to an app that has its use cases in `app.state.features` and `app.state.public_url`.

    It comes first: a map view asks dozens of times, and trying all other routes takes as long as reading a page.
    """
    app.state.ogc_threads = ThreadPoolExecutor(_THREADS, "ogc")
    app.router.routes[:0] = ROUTES
