"""/ogc: OGC API Features and Tiles, for QGIS, GDAL and their kin."""

from __future__ import annotations

from fastapi import APIRouter, FastAPI
from fastapi.routing import APIRoute

from app.api.http.strict_json import StrictRoute
from app.api.ogc import documents, edits, features, tiles


def mount_ogc(app: FastAPI) -> None:
    """Add /ogc to an app that has its use cases in `app.state.features` and `app.state.public_url`.

    It comes first: a map view asks dozens of times, and trying all other routes takes as long as reading a page.
    """
    reads = [
        route
        for router in (features.router, tiles.router, documents.router)
        for route in router.routes
        if isinstance(route, APIRoute)
    ]
    heads = APIRouter(route_class=StrictRoute)  # HEAD is answered as GET is, and described nowhere
    for route in reads:
        heads.add_api_route(route.path, route.endpoint, methods=["HEAD"], include_in_schema=False)
    app.router.routes[:0] = [*reads, *edits.router.routes, *heads.routes]
