"""Connections: how many there may be, and how long a client may take to send its request and to read the response.

uvicorn limits only the time between two requests. Its protocol class is extended here; the waiting for a body, which
the app does, has its limits in middleware.py.
"""

from __future__ import annotations

import asyncio
import socket
import struct
from collections import Counter
from dataclasses import dataclass
from http import HTTPStatus
from typing import ClassVar

import orjson
import structlog
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from app.api.http.event_stream import STOP
from app.api.http.rate_limits import address_of

MAX_HEADER_BYTES = 64 * 1024
"""Longest request line and headers. [byte] Source: twice what nginx takes by default (large_client_header_buffers)."""
RETRY_AFTER_S = 5
_CHECK_S = 1.0
_LINGER_S = 2.0
"""How long a client may still send after its response. [s] Source: by hand; nginx waits 5 s (lingering_timeout)."""
_DROP_UNSENT = struct.pack("ii", 1, 0)
"""Value of SO_LINGER: on, 0 s. Source: man 7 socket."""
_LOG = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class ConnectionLimits:
    """What clients may take.

    Attributes
    ----------
    header_s : float
        From the first byte of a request, or from connecting, to the end of the headers. [s]
    stall_s : float
        Time in which a client that does not keep up has to read `stall_s` x `min_bytes_per_s` of a response. [s]
    min_bytes_per_s : float
        Lowest rate at which a client has to read. [byte/s]
    total : int
        Connections at a time.
    per_address : int
        Connections from one address (`address_of`) at a time.
    proxies : frozenset of str
        Addresses that may have all connections, because many clients are behind them.
    check_s : float
        Time between two checks of a connection. [s]
    """

    header_s: float = 10.0
    stall_s: float = 30.0
    min_bytes_per_s: float = 8000.0
    total: int = 1000
    per_address: int = 200
    proxies: frozenset[str] = frozenset()
    check_s: float = _CHECK_S


class LimitedConnection(HttpToolsProtocol):
    """One connection of a client; `limited_connections` makes a subclass with limits.

    A check each second ends it when its headers are late or when it does not read. A connection between two requests is
    ended by uvicorn. One whose request is answered before the whole body has come is ended unless the rest comes soon;
    it is not read and does not count as headers.
    """

    limits = ConnectionLimits()
    open_by_address: ClassVar[Counter[str]] = Counter()

    # --- uvicorn's interface ------------------------------------------------------------------------------------------

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Admit a connection, or refuse it."""
        super().connection_made(transport)
        self._address = address_of(self.client[0]) if self.client else "unknown"
        self._headers_since_s: float | None = self.loop.time()
        self._header_bytes = 0
        self._sends_body = False
        self._unread_since: tuple[float, int] | None = None
        self.open_by_address[self._address] += 1
        self._check_handle = self.loop.call_later(self.limits.check_s, self._check)
        if (full := self._full()) is not None:
            self._refuse(HTTPStatus.SERVICE_UNAVAILABLE, f"there are {full}", f"Retry-After: {RETRY_AFTER_S}\r\n")

    def connection_lost(self, exc: Exception | None) -> None:
        """Give its place to another one."""
        self._check_handle.cancel()
        self.open_by_address[self._address] -= 1
        if not self.open_by_address[self._address]:
            del self.open_by_address[self._address]
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Parse what came, unless the connection is closing."""
        if self.transport.is_closing():
            return
        if self._headers_since_s is None and self._is_idle and not self._sends_body:
            self._begin_headers()
        self._header_bytes += len(data)
        super().data_received(data)
        if self._headers_since_s is not None and self._header_bytes > MAX_HEADER_BYTES:
            detail = f"the request line and the headers are longer than {MAX_HEADER_BYTES} bytes"
            self._refuse(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, detail)

    def on_message_begin(self) -> None:
        """The parser has seen the first byte of a request."""
        if self._headers_since_s is None:
            self._begin_headers()
        super().on_message_begin()

    def on_headers_complete(self) -> None:
        """The parser has seen all headers."""
        self._headers_since_s = None
        self._sends_body = True
        super().on_headers_complete()

    def on_response_complete(self) -> None:
        """Let a client that still sends a body that nobody reads see the response, and then end the connection.

        Closing at once would reset the connection, and the client could lose the response (RFC 9112 section 9.6).
        """
        super().on_response_complete()
        if not self.pipeline and self.cycle.response_complete and self._sends_body:
            self.loop.call_later(_LINGER_S, self._end_unread, self.cycle)

    def on_message_complete(self) -> None:
        """The parser has seen the whole body."""
        self._sends_body = False
        super().on_message_complete()

    def _end_unread(self, cycle: object) -> None:
        if self.cycle is cycle and self._sends_body:
            self.transport.close()

    def shutdown(self) -> None:
        """The server stops: end an event stream, which would go on for minutes."""
        scope = getattr(self, "scope", None) or {}  # uvicorn sets it at the first request
        if (end := scope.get("state", {}).get(STOP)) is not None:
            end()
        super().shutdown()

    def resume_writing(self) -> None:
        """The client has read most of what was waiting."""
        self._unread_since = None
        super().resume_writing()

    # --- limits -------------------------------------------------------------------------------------------------------

    @property
    def _is_idle(self) -> bool:
        return self.cycle is None or (self.cycle.response_complete and not self.pipeline)

    def _begin_headers(self) -> None:
        self._headers_since_s, self._header_bytes = self.loop.time(), 0

    def _full(self) -> str | None:
        if len(self.connections) > self.limits.total:
            return f"{self.limits.total} connections already"
        own = self.open_by_address[self._address]
        if own > self.limits.per_address and self._address not in self.limits.proxies:
            return f"{self.limits.per_address} connections from {self._address} already"
        return None

    def _check(self) -> None:
        """End the connection if it is overdue, else look again later."""
        now_s = self.loop.time()
        if self._is_unread(now_s):
            self._log_end("the client does not read")
            self._abort()
            return
        self._check_handle = self.loop.call_later(self.limits.check_s, self._check)
        late = self._headers_since_s is not None and now_s - self._headers_since_s > self.limits.header_s
        if late and not self.transport.is_closing():
            self._log_end("the headers are late")
            self._refuse(HTTPStatus.REQUEST_TIMEOUT, f"the headers did not arrive within {self.limits.header_s:g} s")

    def _is_unread(self, now_s: float) -> bool:
        """Whether the client has read too little of what waits for it."""
        waiting = self.transport.get_write_buffer_size()
        if not waiting:
            self._unread_since = None
        elif self._unread_since is None:
            self._unread_since = now_s, waiting
        elif now_s - self._unread_since[0] >= self.limits.stall_s:
            expected = self._unread_since[1] - self.limits.stall_s * self.limits.min_bytes_per_s
            self._unread_since = now_s, waiting
            return waiting > max(0.0, expected)
        return False

    def _abort(self) -> None:
        """End the connection without waiting for the client, and let the kernel drop what the client did not read."""
        self.transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _DROP_UNSENT)
        self.transport.abort()

    def _refuse(self, status: HTTPStatus, detail: str, headers: str = "") -> None:
        """Answer with a problem document and close; no request has been understood, so no app is asked.

        While an earlier request of the connection is still being answered, it is only closed.
        """
        if self._is_idle:
            slug = status.phrase.lower().replace(" ", "-")
            document = {"type": f"urn:waymark:problem:{slug}", "title": status.phrase, "status": status.value}
            body = orjson.dumps(document | {"detail": detail})
            self.transport.write(
                f"HTTP/1.1 {status.value} {status.phrase}\r\nContent-Type: application/problem+json\r\n"
                f"Content-Length: {len(body)}\r\nConnection: close\r\n{headers}\r\n".encode()
                + body
            )
        self.transport.close()

    def _log_end(self, reason: str) -> None:
        _LOG.info("a connection is ended", reason=reason, address=self._address)


def limited_connections(limits: ConnectionLimits) -> type[LimitedConnection]:
    """The protocol class of a server, for uvicorn's `http`."""
    return type("Connection", (LimitedConnection,), {"limits": limits, "open_by_address": Counter()})
