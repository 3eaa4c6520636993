"""The web pages: one HTML file for every address, and the files of `static/`, under a strict policy."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from fastapi import APIRouter, FastAPI, Request, Response
from fastapi.responses import FileResponse

from app import shipped_folder
from app.api.http.guide_files import GUIDE, GuideFiles
from app.api.http.openapi import STORED
from app.api.http.page_addresses import PAGES
from app.api.http.page_policy import content_security_policy, import_map_hashes
from app.api.http.static_files import CompressedFiles
from app.api.http.strict_json import StrictRoute

STATIC = shipped_folder("static")
BASE_MAP = "base-map.pmtiles"
"""Name under /static of the operator's base map."""
_REDOC_STYLES = (
    "'sha256-47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU='",
    "'sha256-QMIg+bpjm3JdElJ388KYke01izlUW0UoNOeKjpMxdgc='",
)
"""Hashes of the two style elements that Redoc makes: an empty one, which its script fills, and that of its menu."""

router = APIRouter(route_class=StrictRoute)


def page_headers(policy: str) -> dict[str, str]:
    """Headers of a page with a policy."""
    return {
        "Content-Security-Policy": policy,
        "Referrer-Policy": "no-referrer",
        "X-Content-Type-Options": "nosniff",
        "Cache-Control": "no-cache",
    }


PAGE_HEADERS = page_headers(content_security_policy())
"""Headers of pages that have nothing inline and ask this host only."""


def get_page(request: Request) -> Response:
    """The page, whatever its address: its script draws what the address names."""
    return FileResponse(STATIC / "index.html", headers=request.app.state.page_headers)


for _path in PAGES:
    router.add_api_route(_path, get_page, response_class=FileResponse, include_in_schema=False)


@router.get("/docs", response_class=FileResponse, include_in_schema=False)
def get_docs() -> FileResponse:
    """The API's documentation by Swagger UI, from static/vendor."""
    return FileResponse(STATIC / "docs.html", headers=page_headers(content_security_policy()))


@router.get("/redoc", response_class=FileResponse, include_in_schema=False)
def get_redoc() -> FileResponse:
    """The API's reference by Redoc, from static/vendor."""
    return FileResponse(STATIC / "redoc.html", headers=page_headers(content_security_policy(styles=_REDOC_STYLES)))


@router.api_route("/openapi.json", methods=["GET", "HEAD"], include_in_schema=False)
def get_openapi_document() -> Response:
    """The stored OpenAPI document."""
    return Response(_openapi_document(), media_type="application/json", headers={"Cache-Control": "no-cache"})


@cache
def _openapi_document() -> bytes:
    return STORED.read_bytes()


def mount_static(
    app: FastAPI, hosts: tuple[str, ...] = (), base_map: Path | None = None, guide: Path | None = None
) -> None:
    """Serve the files of the pages, that of the base map, and the guide.

    Parameters
    ----------
    app : FastAPI
    hosts : tuple of str
        Origins of other hosts that the pages may ask: a configured base map and identity provider.
    base_map : Path, optional
        A PMTiles file.
    guide : Path, optional
        Folder of the built guide; by default that of `make docs`.
    """
    page = (STATIC / "index.html").read_text("utf-8")
    app.state.page_headers = page_headers(content_security_policy(hosts=hosts, scripts=import_map_hashes(page)))
    policy = content_security_policy(hosts=hosts)
    others = {BASE_MAP: base_map} if base_map is not None else {}
    app.mount("/static", CompressedFiles(STATIC, page_headers(policy), others))
    app.mount("/guide", GuideFiles(guide or GUIDE, page_headers(content_security_policy(pictures="data:"))))
