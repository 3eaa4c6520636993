"""The web pages: one HTML file for every address, and the files of `static/`, under a strict policy."""

from __future__ import annotations

import base64
import hashlib
import os
import re
from collections.abc import Iterable, Mapping
from functools import cache
from gzip import compress
from pathlib import Path
from urllib.parse import urlsplit

from fastapi import FastAPI, Request
from fastapi import Response as FastapiResponse
from fastapi.responses import FileResponse as ResponsesFileResponse
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import FileResponse, Response
from starlette.staticfiles import NotModifiedResponse, StaticFiles
from starlette.types import Message, Receive, Scope, Send

from app import shipped_folder
from app.api.http.openapi import STORED
from app.api.http.permissions import PUBLIC
from app.api.http.routes import Router
from app.errors import NotFound

PAGES = (
    "/",
    "/markers",
    "/markers/{marker}",
    "/roads",
    "/roads/new",
    "/roads/{road}",
    "/roads/lanes/{alignment}",
    "/plans",
    "/plans/new",
    "/plans/compare",
    "/plans/{plan}",
    "/decode",
    "/decodes",
    "/decodes/{decode}",
    "/studio/plates",
    "/studio/magnets",
    "/studio/cerpms",
    "/imports",
    "/imports/{import_job}",
    "/operations/{section}",
    "/operations/{section}/{item}",
    "/sign-in",
)
"""Addresses of the web pages: each is answered by the same HTML file.

static/app/routes.js names the module that draws each; a test compares the two.
"""

# === What browsers may do on our pages: the Content-Security-Policy, which allows nothing that is not named here.


_IMPORT_MAP = re.compile(r'<script type="importmap">(.*?)</script>', re.DOTALL)


def content_security_policy(
    *, hosts: Iterable[str] = (), scripts: Iterable[str] = (), styles: Iterable[str] = (), pictures: str = "blob:"
) -> str:
    """The policy of a page: scripts, styles and requests of this host only, none of them inline.

    Parameters
    ----------
    hosts : iterable of str
        Origins to which the page may send requests, besides its own: those that the operator configured.
    scripts, styles : iterable of str
        Hashes of inline scripts and styles that are allowed.
    pictures : str
        Scheme of pictures that come from no host.
    """
    more = "".join(f" {host}" for host in hosts)
    return "; ".join((
        "default-src 'none'",
        " ".join(("script-src 'self'", *scripts)),
        " ".join(("style-src 'self'", *styles)),
        f"img-src 'self' {pictures}{more}",
        f"connect-src 'self'{more}",
        "worker-src 'self'",
        "form-action 'self'",
        "base-uri 'none'",
        "frame-ancestors 'none'",
    ))  # fmt: skip


def import_map_hashes(page: str) -> list[str]:
    """Hashes of a page's import maps: browsers take one from inside the page only, and run no script in it."""
    return [hash_of(text) for text in _IMPORT_MAP.findall(page)]


def hash_of(text: str) -> str:
    """The hash of an inline script or style as a policy names it."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def origin_of(url: str) -> str | None:
    """Scheme and host of an address; None if it is on this host."""
    parts = urlsplit(url)
    return f"{parts.scheme}://{parts.netloc}" if parts.scheme in ("http", "https") and parts.netloc else None


# === The files of `static/`: compressed, and those of other people's programs kept by browsers for ever.
#
# They are sent from memory, read when they are first requested and again when they have changed: a client that does not
# read its response holds no file open.


_VERSIONED = re.compile(r"/vendor/[a-z-]+-\d[^/]*/")
"""Folders of static/vendor, whose names contain the version: what they contain never changes."""
_FOR_EVER = "public, max-age=31536000, immutable"
_MEDIA_TYPES = {".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml", ".html": "text/html"}
_MAX_KEPT_BYTES = 1_000_000
_ENCODINGS = (("br", ".br"), ("gzip", ".gz"))


class CompressedFiles(StaticFiles):
    """Static files, compressed where the client accepts it.

    Files of static/vendor lie beside their compressed forms, which static/vendor/refresh.sh makes. Our own are
    compressed when they are first requested, and again when they have changed.

    Parameters
    ----------
    headers : mapping
        Headers of every response.
    others : mapping
        Files from elsewhere, by name.
    """

    def __init__(self, directory: Path, headers: Mapping[str, str], others: Mapping[str, Path]) -> None:
        super().__init__(directory=directory)
        self._others = dict(others)
        self._headers = dict(headers)
        self._kept: dict[tuple[str, bool], tuple[int, bytes]] = {}

    def lookup_path(self, path: str) -> tuple[str, os.stat_result | None]:
        """The file behind a path, if there is one."""
        other = self._others.get(path)
        return (str(other), other.stat()) if other is not None else super().lookup_path(path)

    def file_response(
        self, full_path: str | os.PathLike[str], stat_result: os.stat_result, scope: Scope, status_code: int = 200
    ) -> Response:
        """A file, in a form that the client accepts."""
        path = os.fspath(full_path)
        request = Headers(scope=scope)
        media_type = _MEDIA_TYPES.get(Path(path).suffix)
        headers = self._headers | {"Vary": "Accept-Encoding"}
        if _VERSIONED.search(path):
            headers["Cache-Control"] = _FOR_EVER
        kept = "range" not in request and stat_result.st_size < _MAX_KEPT_BYTES
        response: Response
        accepted = {part.partition(";")[0].strip() for part in request.get("accept-encoding", "").split(",")}
        made = next((e for e in _ENCODINGS if e[0] in accepted and Path(path + e[1]).is_file()), None)
        if made is not None and "range" not in request:
            headers["Content-Encoding"], path = made[0], path + made[1]
            stat_result = Path(path).stat()
            kept = stat_result.st_size < _MAX_KEPT_BYTES
        if made is None and kept and media_type is not None and "gzip" in accepted:
            etag = f'"{stat_result.st_mtime_ns:x}-{stat_result.st_size:x}-gzip"'
            headers |= {"Content-Encoding": "gzip", "ETag": etag}
            response = Response(self._content(path, stat_result, gzip=True), status_code, headers, media_type)
        else:
            response = FileResponse(path, status_code, headers, media_type=media_type, stat_result=stat_result)
        if self.is_not_modified(response.headers, request):
            return NotModifiedResponse(response.headers)
        if kept and isinstance(response, FileResponse):
            return Response(self._content(path, stat_result), status_code, response.headers)
        return response

    def _content(self, path: str, stat: os.stat_result, *, gzip: bool = False) -> bytes:
        kept = self._kept.get((path, gzip))
        if kept is None or kept[0] != stat.st_mtime_ns:
            content = Path(path).read_bytes()
            kept = (stat.st_mtime_ns, compress(content, 6, mtime=0) if gzip else content)
            self._kept[path, gzip] = kept
        return kept[1]


# === The guide at /guide: the documents as a web site, which `make docs` builds.


GUIDE = shipped_folder("build/guide")
"""Where `make docs` writes it."""


class GuideFiles(StaticFiles):
    """The guide; it may be built, or built again, while the server runs.

    Parameters
    ----------
    headers : mapping
        Headers of every response. The style sheets of its theme contain icons as data, which the policy must allow.
    """

    def __init__(self, folder: Path, headers: Mapping[str, str]) -> None:
        super().__init__(directory=folder, html=True, check_dir=False)
        self._first_page = folder / "index.html"
        self._headers = dict(headers)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or with a problem while there is no guide."""
        if not self._first_page.is_file():
            raise NotFound(
                "the guide is not built on this server",
                cure="run `make docs` in a source checkout and reload this page; the container image has the guide",
            )

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(self._headers)
            await send(message)

        await super().__call__(scope, receive, send_with_headers)


# === The web pages.


STATIC = shipped_folder("static")
BASE_MAP = "base-map.pmtiles"
"""Name under /static of the operator's base map."""
_REDOC_STYLES = (
    "'sha256-47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU='",
    "'sha256-QMIg+bpjm3JdElJ388KYke01izlUW0UoNOeKjpMxdgc='",
)
"""Hashes of the two style elements that Redoc makes: an empty one, which its script fills, and that of its menu."""

router = Router("")


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


def get_page(request: Request) -> FastapiResponse:
    """The page, whatever its address: its script draws what the address names."""
    return ResponsesFileResponse(STATIC / "index.html", headers=request.app.state.page_headers)


for _path in PAGES:
    router.get(_path, PUBLIC, response_class=ResponsesFileResponse, include_in_schema=False)(get_page)


@router.get("/docs", PUBLIC, response_class=ResponsesFileResponse, include_in_schema=False)
def get_docs() -> ResponsesFileResponse:
    """The API's documentation by Swagger UI, from static/vendor."""
    return ResponsesFileResponse(STATIC / "docs.html", headers=page_headers(content_security_policy()))


@router.get("/redoc", PUBLIC, response_class=ResponsesFileResponse, include_in_schema=False)
def get_redoc() -> ResponsesFileResponse:
    """The API's reference by Redoc, from static/vendor."""
    return ResponsesFileResponse(
        STATIC / "redoc.html", headers=page_headers(content_security_policy(styles=_REDOC_STYLES))
    )


@router.get("/openapi.json", PUBLIC, include_in_schema=False)
@router.head("/openapi.json", PUBLIC, include_in_schema=False)
def get_openapi_document() -> FastapiResponse:
    """The stored OpenAPI document."""
    return FastapiResponse(_openapi_document(), media_type="application/json", headers={"Cache-Control": "no-cache"})


@cache
def _openapi_document() -> bytes:
    return STORED.read_bytes()


def mount_static(
    app: FastAPI, hosts: tuple[str, ...] = (), base_map: Path | None = None, guide: Path | None = None
) -> None:
    """Serve the files of the pages, that of the base map, and the guide.

    Parameters
    ----------
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
