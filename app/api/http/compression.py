"""Responses compressed with gzip for clients that accept it (RFC 9110 section 8.4): texts, JSON, CSV, SVG.

Tiles, archives, PDF and pictures are compressed already. The files of `static/` have their own way (ui.py).
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable
from functools import partial

import anyio
from anyio import to_thread
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.services.request_work import counted

MIN_BYTES = 1024
"""Shortest body that is compressed. [byte] It fits into one packet."""
_LEVEL = 1
"""Source: measured on 1.46 MB of markers: level 1 makes 253 kB of them in 10 ms, level 6 makes 228 kB in 25 ms."""
_THREAD_BYTES = 64 * 1024
"""Longest part that is compressed on the event loop: half a millisecond. [byte]"""
_THREADS = anyio.CapacityLimiter(2)
_TYPES = frozenset(
    {
        "application/json",
        "application/geo+json",
        "application/ld+json",
        "application/problem+json",
        "application/schema+json",
        "application/xml",
        "application/yaml",
        "image/svg+xml",
        "text/css",
        "text/csv",
        "text/html",
        "text/javascript",
        "text/markdown",
        "text/plain",
        "text/xml",
    }
)
_KEPT = "/openapi.json"
"""Path whose response stays the same: its compressed form is kept."""
_OTHERWISE = (204, 206, 304)
_SUFFIX = re.compile(rb'-gzip"')
_GZIP = 31
"""Window of zlib's streams with the header of gzip. Source: zlib.h, deflateInit2."""


def accepts_gzip(header: str) -> bool:
    """Whether an Accept-Encoding header allows gzip (RFC 9110 section 12.5.3)."""
    qualities = {}
    for part in header.lower().split(","):
        name, *parameters = (text.strip() for text in part.split(";"))
        zero = any(re.fullmatch(r"q=0(\.0*)?", text) for text in parameters)
        qualities[name] = not zero
    return qualities.get("gzip", qualities.get("*", False))


class Compressed:
    """Compresses responses. Its time is charged to the request: it stands inside of `Guarded`.

    The compressed form of what has the ETag `"3"` has `"3-gzip"`, as Apache's has; in If-Match and If-None-Match both
    mean the same to the app.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._kept = (b"", b"")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        accepted = scope["method"] != "HEAD" and accepts_gzip(Headers(scope=scope).get("accept-encoding", ""))
        has_suffix = any(name == b"if-none-match" and b'-gzip"' in value for name, value in scope["headers"])
        conditional = (b"if-none-match", b"if-match")
        scope["headers"] = [
            (name, _SUFFIX.sub(b'"', value) if name in conditional else value) for name, value in scope["headers"]
        ]
        start: Message | None = None
        stream = None

        async def send_compressed(message: Message) -> None:
            nonlocal start, stream
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                if message["status"] == 304:
                    headers.add_vary_header("Accept-Encoding")
                    if has_suffix:
                        _mark(headers)
                media_type = headers.get("content-type", "").partition(";")[0].strip().lower()
                if media_type in _TYPES and "content-encoding" not in headers:
                    headers.add_vary_header("Accept-Encoding")
                    short = int(headers.get("content-length", MIN_BYTES)) < MIN_BYTES
                    if accepted and not short and message["status"] not in _OTHERWISE:
                        start = message  # until its body shows how it is compressed
                        return
                await send(message)
                return
            body, more = message.get("body", b""), message.get("more_body", False)
            if start is not None:
                headers = MutableHeaders(scope=start)
                headers["Content-Encoding"] = "gzip"
                if scope["method"] == "GET":  # otherwise it is that of the resource, not of this response
                    _mark(headers)
                if more:
                    stream = zlib.compressobj(_LEVEL, zlib.DEFLATED, _GZIP)
                    del headers["content-length"]
                else:
                    body = await self._compressed(scope["path"], body)
                    headers["Content-Length"] = str(len(body))
                first, start = start, None
                await send(first)
            if stream is not None:
                body = await _in_turn(len(body), stream.compress, body)
                body += b"" if more else counted(stream.flush)
                if more and not body:
                    return
            await send({**message, "body": body})

        await self._app(scope, receive, send_compressed)

    async def _compressed(self, path: str, body: bytes) -> bytes:
        if path == _KEPT and self._kept[0] is body:
            return self._kept[1]
        made = await _in_turn(len(body), zlib.compress, body, _LEVEL, _GZIP)
        if path == _KEPT:
            self._kept = (body, made)
        return made


async def _in_turn(size_bytes: int, call: Callable[..., bytes], *arguments: object) -> bytes:
    """The result of a call, charged to the request; in a thread if there is much to do."""
    if size_bytes <= _THREAD_BYTES:
        return counted(call, *arguments)
    return await to_thread.run_sync(partial(counted, call, *arguments), limiter=_THREADS)


def _mark(headers: MutableHeaders) -> None:
    etag = headers.get("etag", "")
    if etag.startswith('"'):
        headers["ETag"] = etag[:-1] + '-gzip"'
