"""/ogc: OGC API Features and Tiles, for QGIS, GDAL and their kin."""

from __future__ import annotations

from app.api.http.routes import Router
from app.api.ogc import documents, edits, features, tiles

_HEADS = Router("")
for _read in (*features.router.routes, *tiles.router.routes, *documents.router.routes):
    _HEADS.head(_read.path, _read.scopes, include_in_schema=False)(_read.endpoint)  # answered as GET is

ROUTERS = (features.router, tiles.router, documents.router, edits.router, _HEADS)
