"""The files of `static/`: compressed, and those of other people's programs kept by browsers for ever.

They are sent from memory, read when they are first requested and again when they have changed: a client that does not
read its response holds no file open.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from gzip import compress
from pathlib import Path

from starlette.datastructures import Headers
from starlette.responses import FileResponse, Response
from starlette.staticfiles import NotModifiedResponse, StaticFiles
from starlette.types import Scope

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
    directory : Path
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
