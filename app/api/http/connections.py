"""Connections: how many there may be, and how long a client may take to send its request and to read the response.

uvicorn limits only the time between two requests. Its protocol class is extended here; the waiting for a body, which
the app does, has its limits in middleware.py.

What arrives is parsed in small slices, and what follows a request that is not answered yet waits unparsed: a client
that sends thousands of requests at once costs as much as one that waits for each answer.
"""

from __future__ import annotations

import asyncio
import re
import socket
import struct
from collections import Counter
from dataclasses import dataclass
from http import HTTPStatus
from typing import ClassVar

import httptools
import orjson
import structlog
from uvicorn._types import ASGI3Application
from uvicorn.protocols.http.flow_control import HIGH_WATER_LIMIT, FlowControl
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol, RequestResponseCycle

from app.api.http.event_stream import STOP
from app.api.http.limits import address_of

MAX_HEADER_BYTES = 64 * 1024
"""Longest request line and headers. [byte] Source: twice what nginx takes by default (large_client_header_buffers)."""
MAX_TARGET_BYTES = 65_535
"""Longest target of a request. [byte] Source: what httptools parses, whose fields have 16 bits."""
MAX_TRAILER_BYTES = 64 * 1024
"""Longest trailers, and longest line between two chunks, of a body. [byte] Trailers are dropped (RFC 9110 section
6.5.1)."""
RETRY_AFTER_S = 5
_SLICE_BYTES = 4096
"""What is parsed at a time outside a body of known length, so that at most a hundred requests are. [byte]"""
_MAX_AHEAD_BYTES = 64 * 1024
"""What is read behind a request that is not answered yet. [byte] Reading shows when a client leaves."""
_HOST = re.compile(rb"[A-Za-z0-9._~!$&'()*+,;=%:\[\]-]*")
"""Source: RFC 3986, host and port."""
_ESTABLISHED = 1
"""State of a connection whose client is there. Source: linux/tcp.h."""
_MALFORMED = "this is no request of HTTP/1.1"
_SEND_BUFFER_BYTES = 256 * 1024
"""What the kernel takes of an answer before its client has read it. [byte] Without a limit it is whole answers: a
client that reads nothing, with a small window, then costs 1 MB of the kernel's memory and 4 ms of it
(`python -m benchmarks.abuse --only "unread answers"`). Linux doubles it: 5 MB/s at a round trip of 100 ms."""
_CHECK_S = 1.0
_LINGER_S = 2.0
"""How long a client may still send after its response. [s] Nginx waits 5 s (lingering_timeout)."""
_DROP_UNSENT = struct.pack("ii", 1, 0)
"""Value of SO_LINGER: on, 0 s. Source: man 7 socket."""
_LOG = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class ConnectionLimits:
    """What clients may take."""

    header_s: float = 10.0  # [s] from the first byte of a request, or from connecting, to the end of the headers
    # [s] time in which a client that does not keep up has to read `stall_s` x `min_bytes_per_s` of a response
    stall_s: float = 30.0
    min_bytes_per_s: float = 8000.0  # [byte/s] lowest rate at which a client has to read
    total: int = 1000  # connections at a time
    per_address: int = 200  # connections from one address (`address_of`) at a time
    # addresses that may have all connections, because many clients are behind them
    proxies: frozenset[str] = frozenset()
    check_s: float = _CHECK_S  # [s] time between two checks of a connection


class _Refused(Exception):
    """A request that is not understood, raised by a callback of the parser."""

    def __init__(self, status: HTTPStatus, detail: str) -> None:
        super().__init__(detail)
        self.status, self.detail = status, detail


class _HeldFlow(FlowControl):
    """uvicorn's flow control, but reading stays paused while enough waits to be parsed."""

    held = False

    def resume_reading(self) -> None:
        if not self.held:
            super().resume_reading()


class LimitedConnection(HttpToolsProtocol):
    """One connection of a client; `limited_connections` makes a subclass with limits.

    A check each second ends it when its headers are late or when it does not read. A connection between two requests is
    ended by uvicorn. One whose request is answered before the whole body has come is ended unless the rest comes soon;
    it is not read and does not count as headers. Where all places are taken, a new client takes that of an idle
    connection.
    """

    limits = ConnectionLimits()
    open_by_address: ClassVar[Counter[str]] = Counter()

    # --- uvicorn's interface ------------------------------------------------------------------------------------------

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Admit a connection, or refuse it."""
        super().connection_made(transport)
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
        self.flow: _HeldFlow = _HeldFlow(transport)
        self._address = address_of(self.client[0]) if self.client else "unknown"
        self._headers_since_s: float | None = self.loop.time()
        self._idle_since_s = self.loop.time()
        self._outside_bytes = 0  # of headers, trailers and chunks' lines, since there was something else
        self._body_left = 0  # of a body of known length
        self._sends_body = False
        self._unparsed = b""
        self._running: RequestResponseCycle | None = None
        self._fault: _Refused | None = None
        self._unread_since: tuple[float, int] | None = None
        self.open_by_address[self._address] += 1
        self._check_handle = self.loop.call_later(self.limits.check_s, self._check)
        if (full := self._full()) is not None:
            self._refuse(HTTPStatus.SERVICE_UNAVAILABLE, f"there are {full}", f"Retry-After: {RETRY_AFTER_S}\r\n")

    def connection_lost(self, exc: Exception | None) -> None:
        """Give its place to another one, and let every request of it know that its client has left."""
        self._check_handle.cancel()
        self.open_by_address[self._address] -= 1
        if not self.open_by_address[self._address]:
            del self.open_by_address[self._address]
        self._unparsed = b""
        self.pipeline.clear()
        if self._running is not None and not self._running.response_complete:
            self._running.disconnected = True
            self._running.message_event.set()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Parse what came, unless it has to wait or the connection is closing."""
        if self.transport.is_closing() or self._fault is not None:
            return
        self._unset_keepalive_if_required()
        self._unparsed = self._unparsed + data if self._unparsed else data
        self._parse()

    def on_message_begin(self) -> None:
        """The parser has seen the first byte of a request."""
        if self._headers_since_s is None:
            self._begin_headers()
        super().on_message_begin()

    def on_url(self, url: bytes) -> None:
        """The parser has seen a part of the target."""
        super().on_url(url)
        if len(self.url) > MAX_TARGET_BYTES:
            raise _Refused(
                HTTPStatus.REQUEST_URI_TOO_LONG, f"the target of the request is longer than {MAX_TARGET_BYTES} bytes"
            )

    def on_header(self, name: bytes, value: bytes) -> None:
        """The parser has seen a header, or a trailer, which is dropped: what checks headers has already done so."""
        if not self._sends_body:
            super().on_header(name, value)

    def on_headers_complete(self) -> None:
        """The parser has seen all headers."""
        hosts = [value for name, value in self.headers if name == b"host"]
        if len(hosts) > 1 or (not hosts and self.parser.get_http_version() == "1.1"):
            raise _Refused(HTTPStatus.BAD_REQUEST, f"the request has {len(hosts)} Host headers; send exactly one")
        if hosts and not _HOST.fullmatch(hosts[0]):
            raise _Refused(HTTPStatus.BAD_REQUEST, "the Host header is no name or address with an optional port")
        super().on_headers_complete()
        self._headers_since_s, self._outside_bytes = None, 0
        self._sends_body = True
        self._body_left = next((int(value) for name, value in self.headers if name == b"content-length"), 0)

    def on_body(self, body: bytes) -> None:
        """The parser has seen a part of the body."""
        self._outside_bytes = 0
        self._body_left -= len(body)
        super().on_body(body)

    def on_message_complete(self) -> None:
        """The parser has seen the whole body."""
        self._sends_body = False
        super().on_message_complete()

    def on_response_complete(self) -> None:
        """Parse what waited. Let a client that still sends a body that nobody reads see the response, and then end the
        connection.

        Closing at once would reset the connection, and the client could lose the response (RFC 9112 section 9.6).
        """
        self._idle_since_s = self.loop.time()
        super().on_response_complete()
        if self.transport.is_closing():
            return
        if self._is_idle and self._fault is not None:
            self._refuse(self._fault.status, self._fault.detail)
            return
        if self._headers_since_s is not None:  # of the next request: they had to wait
            self._headers_since_s = self.loop.time()
        if self._unparsed:
            self._unset_keepalive_if_required()
            self._parse()
        if not self.pipeline and self.cycle.response_complete and self._sends_body:
            self.loop.call_later(_LINGER_S, self._end_unread, self.cycle)

    def _start_asgi_task(self, cycle: RequestResponseCycle, app: ASGI3Application) -> None:
        self._running = cycle
        super()._start_asgi_task(cycle, app)

    def _end_unread(self, cycle: object) -> None:
        if self.cycle is cycle and self._sends_body:
            self.transport.close()

    def shutdown(self) -> None:
        """The server stops: end an event stream, which would go on for minutes."""
        scope = getattr(self, "scope", None) or {}  # uvicorn sets it at the first request
        if (end := scope.get("state", {}).get(STOP)) is not None:
            end()
        super().shutdown()

    def pause_writing(self) -> None:
        """The client does not keep up."""
        super().pause_writing()
        self._unread_since = self.loop.time(), self.transport.get_write_buffer_size()

    def resume_writing(self) -> None:
        """The client has read most of what was waiting."""
        self._unread_since = None
        super().resume_writing()

    # --- limits -------------------------------------------------------------------------------------------------------

    @property
    def _is_idle(self) -> bool:
        return self.cycle is None or (self.cycle.response_complete and not self.pipeline)

    @property
    def _waits_for_answer(self) -> bool:
        """Whether a whole request was parsed that is not answered yet."""
        return bool(self.pipeline) or not (self._is_idle or self._sends_body)

    def _begin_headers(self) -> None:
        self._headers_since_s, self._outside_bytes = self.loop.time(), 0

    def _parse(self) -> None:
        """Parse what came, up to the end of a request that has to be answered first."""
        data, at = memoryview(self._unparsed), 0
        while at < len(data) and not self._waits_for_answer and not self.transport.is_closing():
            if self._headers_since_s is None and self._is_idle and not self._sends_body:
                self._begin_headers()
            part = data[at : at + max(_SLICE_BYTES, self._body_left if self._sends_body else 0)]
            at += len(part)
            self._outside_bytes += len(part)
            try:
                self.parser.feed_data(part)
                self._check_outside()
            except _Refused as error:
                self._fail(error)
                return
            except httptools.HttpParserUpgrade:
                # the parser takes what follows for another protocol: none is spoken here
                self.cycle.keep_alive = False
                self._unparsed, self._fault = b"", _Refused(HTTPStatus.BAD_REQUEST, "no other protocol is spoken here")
                return
            except httptools.HttpParserError as error:
                cause = error.__context__
                self._fail(cause if isinstance(cause, _Refused) else _Refused(HTTPStatus.BAD_REQUEST, _MALFORMED))
                return
        self._unparsed = bytes(data[at:])
        self.flow.held = len(self._unparsed) >= _MAX_AHEAD_BYTES
        if self.flow.held:
            self.flow.pause_reading()
        elif self.cycle is not None and len(self.cycle.body) <= HIGH_WATER_LIMIT:
            self.flow.resume_reading()  # uvicorn pauses it behind a request: then nobody would see the client leave

    def _check_outside(self) -> None:
        """Refuse headers and trailers that are too long.

        Raises
        ------
        _Refused
            They are.
        """
        if self._headers_since_s is not None and self._outside_bytes > MAX_HEADER_BYTES:
            limit = f"longer than {MAX_HEADER_BYTES} bytes"
            if not self.headers and len(self.url) > MAX_HEADER_BYTES // 2:
                raise _Refused(HTTPStatus.REQUEST_URI_TOO_LONG, f"the target of the request is {limit}")
            raise _Refused(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, f"the request line and the headers are {limit}")
        if self._sends_body and self._outside_bytes > MAX_TRAILER_BYTES:
            raise _Refused(
                HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE,
                f"the trailers or the line before a chunk are longer than {MAX_TRAILER_BYTES} bytes",
            )

    def _fail(self, fault: _Refused) -> None:
        """Refuse what is not understood, once the requests before it are answered."""
        self._unparsed = b""
        if self._waits_for_answer:
            self._fault = fault
            if self._sends_body:  # in the body of a request that has not begun
                self.pipeline.popleft()
                self.cycle = self.pipeline[0][0] if self.pipeline else self._running  # type: ignore[assignment]
        elif self._sends_body and self.cycle.response_started:
            self.transport.close()
        else:
            self._refuse(fault.status, fault.detail)

    def _full(self) -> str | None:
        own = self.open_by_address[self._address]
        if own > self.limits.per_address and self._address not in self.limits.proxies:
            return f"{self.limits.per_address} connections from {self._address} already"
        if len(self.connections) > self.limits.total and not self._make_room(own):
            return f"{self.limits.total} connections already"
        return None

    def _make_room(self, own: int) -> bool:
        """End the idle connection of the address that has most of them, the oldest first, but none of an address with
        fewer connections than this one's."""
        now_s = self.loop.time()
        idle = [
            (self.open_by_address[other._address], since_s, other)
            for other in self.connections
            if isinstance(other, LimitedConnection) and (since_s := other._idle_s(now_s)) is not None
        ]
        most, _, longest = max(idle, key=lambda each: each[:2], default=(0, 0.0, self))
        if longest is self or most < own:
            return False
        longest._log_end("it is idle, and all places are taken")
        longest._abort()
        return True

    def _idle_s(self, now_s: float) -> float | None:
        """How long it has sent no whole request, or has not read its answer; None if it is neither. [s]"""
        if self.transport.is_closing():
            return None
        if self._is_idle and not self._sends_body and not self.transport.get_write_buffer_size():
            return now_s - self._idle_since_s
        return None if self._unread_since is None else now_s - self._unread_since[0]

    def _check(self) -> None:
        """End the connection if it is overdue, else look again later."""
        now_s = self.loop.time()
        if self._is_unread(now_s):
            self._log_end("the client does not read")
            self._abort()
            return
        if self.flow.held and self._has_left():
            self._abort()
            return
        self._check_handle = self.loop.call_later(self.limits.check_s, self._check)
        late = self._headers_since_s is not None and now_s - self._headers_since_s > self.limits.header_s
        if late and self._is_idle and not self.transport.is_closing():
            self._log_end("the headers are late")
            self._refuse(HTTPStatus.REQUEST_TIMEOUT, f"the headers did not arrive within {self.limits.header_s:g} s")

    def _has_left(self) -> bool:
        """Whether the client has closed a connection that is not read at the moment."""
        if not hasattr(socket, "TCP_INFO"):  # Linux has it
            return False
        info = self.transport.get_extra_info("socket").getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)
        return bool(info[0] != _ESTABLISHED)

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
        """Answer with a problem document and close; the app is not asked, or asked no more."""
        if self._running is not None:
            self._running.disconnected = True
            self._running.message_event.set()
        if self._is_idle or not self.cycle.response_started:
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
