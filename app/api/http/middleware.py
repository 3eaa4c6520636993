"""Pure ASGI middleware: request ids and logs, metrics, authentication and limits, all before the body is read."""

from __future__ import annotations

import re
import time
import uuid
from collections.abc import Callable, Mapping
from http import HTTPStatus

import anyio
import structlog
from anyio import to_thread
from prometheus_client import CollectorRegistry, Counter, Histogram
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app import tracing
from app.api.http.limits import Budget, RateLimit, Slots, Transport, address_of, admitted
from app.api.http.permissions import Permissions, key_in
from app.api.http.problems import BodyRefused, problem_from, unexpected
from app.api.public_pages.texts import accepts_html
from app.errors import ClientLeft, MalformedRequest, NotAuthenticated, UploadTooLarge, WaymarkError
from app.registry.engines import acting_for
from app.services.access.access import Caller

PROTECTED = ("/v1", "/ogc")
_OPEN = ("/v1/page-settings",)
_METHODS = ("GET", "HEAD", "OPTIONS", "POST", "PUT", "PATCH", "DELETE")
_AUTH_THREADS = 4
_UNKNOWN_PER_S = 20.0
"""Unknown keys from an address that sent too many wrong ones that are checked per second. A key that an operator chose
has 24 characters or more, and 20/s are 600 million guesses a year."""
_ID = re.compile(r"[0-9a-f]{8}(-?[0-9a-f]{4}){3}-?[0-9a-f]{12}")
_RECORD = re.compile(r"/v1/markers/([0-9a-f]{8}(?:-[0-9a-f]{4}){3}-[0-9a-f]{12})")
_UNLOGGED = ("/healthz", "/readyz")
"""Routes that are asked every few seconds: their answers of 200 are in the metrics, not in the log."""
_CLIENT_LEFT = 499
"""Status in logs and metrics of a request whose client left before its body had come. Source: nginx."""
_REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")
_ACTIVE_TYPES = frozenset({"image/svg+xml", "text/html", "application/xhtml+xml", "application/xml", "text/xml"})
_FILE_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox"
"""Policy of files in which browsers run scripts, where a route sets none: artwork and plots as SVG."""
_LOG = structlog.get_logger("waymark.access")


def is_protected(path: str) -> bool:
    """Whether a path needs a key."""
    return path not in _OPEN and any(path == prefix or path.startswith(prefix + "/") for prefix in PROTECTED)


class Observed:
    """Gives each request an id, a log line and metrics, and turns a bug into a problem document."""

    def __init__(self, app: ASGIApp, registry: CollectorRegistry) -> None:
        self._app = app
        labels = ("method", "route", "status")
        self._count = Counter("waymark_http_requests", "Requests answered", labels, registry=registry)
        self._seconds = Histogram("waymark_http_request_seconds", "Time to answer", labels[:2], registry=registry)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        asked = Headers(scope=scope).get("x-request-id", "")
        request_id = asked if _REQUEST_ID.fullmatch(asked) else uuid.uuid4().hex
        scope.setdefault("state", {})["request_id"] = request_id
        structlog.contextvars.clear_contextvars()
        structlog.contextvars.bind_contextvars(request_id=request_id)
        started = time.perf_counter()
        status = 0
        sent = tracing.accepted(Headers(scope=scope).get("traceparent", "")) if tracing.is_on() else None

        async def send_with_id(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                headers["X-Request-ID"] = request_id
                _protect(headers)
                headers.raw.extend(scope["state"].get("rate_limit", ()))
            await send(message)

        with tracing.span("request", parent=sent, method=scope["method"], request_id=request_id) as attributes:
            try:
                await self._app(scope, receive, send_with_id)
            except ClientDisconnect:
                status = status or _CLIENT_LEFT
            except Exception as error:
                if not status:
                    await unexpected(error, scope)(scope, receive, send_with_id)
                elif not isinstance(error.__cause__, ClientLeft):  # in the middle of a response that nobody reads
                    raise
            finally:
                self._record(scope, status, time.perf_counter() - started)
                attributes |= {"http.route": _route_of(scope), "http.response.status_code": str(status)}

    def _record(self, scope: Scope, status: int, seconds: float) -> None:
        route = _route_of(scope)
        method = scope["method"] if scope["method"] in _METHODS else "other"
        self._count.labels(method, route, str(status)).inc()
        self._seconds.labels(method, route).observe(seconds)
        if route in _UNLOGGED and status == HTTPStatus.OK:
            return
        _LOG.info(
            "request",
            method=scope["method"],
            path=_shown_path(scope, route),
            route=route,
            status=status,
            ms=round(seconds * 1000, 2),
            agency=scope["state"].get("agency_id"),
        )


def _route_of(scope: Scope) -> str:
    return getattr(scope.get("route"), "path", None) or "unmatched"


def _shown_path(scope: Scope, route: str) -> str:
    """The route with its ids filled in: other parts may be a position, as a tile is, or a key that was misplaced."""
    for name, value in scope.get("path_params", {}).items():
        if _ID.fullmatch(str(value)):
            route = re.sub(rf"\{{{re.escape(name)}(:\w+)?\}}", str(value), route)
    return route


def _protect(headers: MutableHeaders) -> None:
    """No cache may give a response to another key, and no browser may guess its type (docs/access.md, "Caches")."""
    headers.setdefault("Cache-Control", "private, no-cache" if "ETag" in headers else "private, no-store")
    headers.setdefault("X-Content-Type-Options", "nosniff")
    if headers.get("content-type", "").partition(";")[0].strip().lower() in _ACTIVE_TYPES:
        headers.setdefault("Content-Security-Policy", _FILE_POLICY)
    headers.add_vary_header("Authorization, X-API-Key")


class Guarded:
    """Checks the key and the declared length before the body is read, and the length while it is.

    Parameters
    ----------
    authenticate : callable
        The caller behind a key; runs in a thread.
    recall : callable
        The caller behind a key if that is known without asking anybody.
    was_valid : callable
        Whether a key was valid when it was last asked about.
    requests, failures : RateLimit or None
        Of requests by key, and of wrong keys by address; None: as many as they like.
    body_limits : mapping
        Most bytes of a body by path prefix; the empty prefix is the default. [byte]
    permissions : Permissions
        Who may make which request.
    body_timeout_s : float
        Longest wait for the next part of a body. [s]
    min_bytes_per_s : float
        Lowest rate at which a body may arrive after `body_timeout_s` of waiting for it. [byte/s]
    budget : Budget
        Processor time of keys and agencies.
    slots : Slots
        Places for expensive requests.
    request_timeout_s : float
        Longest time of a request once its body was read, where its work checks that. [s]
    """

    def __init__(
        self,
        app: ASGIApp,
        *,
        authenticate: Callable[[str], Caller],
        recall: Callable[[str], Caller | None],
        was_valid: Callable[[str], bool],
        requests: RateLimit | None,
        failures: RateLimit | None,
        body_limits: Mapping[str, int],
        permissions: Permissions,
        body_timeout_s: float,
        min_bytes_per_s: float,
        budget: Budget,
        slots: Slots,
        request_timeout_s: float,
    ) -> None:
        self._app = app
        self._authenticate = authenticate
        self._recall = recall
        self._was_valid = was_valid
        self._requests = requests
        self._failures = failures
        self._body_limits = body_limits
        self._permissions = permissions
        self._body_timeout_s = body_timeout_s
        self._min_bytes_per_s = min_bytes_per_s
        self._unknown = RateLimit(_UNKNOWN_PER_S, 1, name="unknown-keys", message="", cure="")
        self._budget = budget
        self._slots = slots
        self._request_timeout_s = request_timeout_s
        self._threads = anyio.CapacityLimiter(_AUTH_THREADS)  # its own, or slow requests would keep new ones waiting

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        if (page := _page_of_old_qr_code(scope, headers)) is not None:
            await page(scope, receive, send)
            return
        try:
            if is_protected(scope["path"]):
                await self._admit(scope, headers)
            limit = _by_prefix(self._body_limits, scope["path"])
            _check_declared_length(headers, limit)
        except WaymarkError as error:
            response = problem_from(error, scope)
            response.headers["Connection"] = "close"
            await response(scope, receive, send)
            return
        transport = getattr(getattr(receive, "__self__", None), "transport", None)  # uvicorn's, of the connection
        await self._answer(scope, self._limited(receive, limit), send, transport)

    def _limited(self, receive: Receive, limit: int) -> Receive:
        """A `receive` that stops a body that is too large or too slow. Only the time spent waiting for it counts."""
        seen, waited_s, complete = 0, 0.0, False

        async def receive_within_limit() -> Message:
            nonlocal seen, waited_s, complete
            if complete:
                return await receive()
            started = time.perf_counter()
            allowed_s = self._body_timeout_s + seen / self._min_bytes_per_s - waited_s
            try:
                with anyio.fail_after(min(self._body_timeout_s, allowed_s)):
                    message = await receive()
            except TimeoutError as error:
                raise self._too_slow(seen) from error
            waited_s += time.perf_counter() - started
            if message["type"] == "http.request":
                seen += len(message.get("body", b""))
                complete = not message.get("more_body", False)
                if seen > limit:
                    raise BodyRefused(_too_large(limit))
            return message

        return receive_within_limit

    def _too_slow(self, seen: int) -> HTTPException:
        limit = (
            f"no part for {self._body_timeout_s:g} s, or fewer than {self._min_bytes_per_s:g} bytes/s in the long run"
        )
        return HTTPException(408, f"the body arrived too slowly: {limit} ({seen} bytes came)", {"Connection": "close"})

    async def _answer(self, scope: Scope, receive: Receive, send: Send, transport: Transport) -> None:
        """Let the app answer a request, and charge what that costs."""
        state = scope.get("state", {})
        agency_id: str = state.get("agency_id", "")
        caller: Caller | None = state.get("caller")
        accounted = admitted(self._slots, agency_id, self._request_timeout_s, receive, transport)
        with acting_for(agency_id), accounted as work:
            try:
                await self._app(scope, receive, send)
            finally:
                if caller is not None:
                    self._budget.charge(caller, work.used_s)

    async def _admit(self, scope: Scope, headers: Headers) -> None:
        key = key_in(headers)
        caller = self._recall(key)
        if caller is None:
            caller = await self._authenticated(scope, key)
        state = scope.setdefault("state", {})
        state["agency_id"] = caller.agency_id
        if self._requests is not None:
            left = self._requests.take(caller.key_id)
            state["rate_limit"] = ((b"ratelimit-policy", self._requests.policy), (b"ratelimit", left))
        self._budget.check(caller)
        allowed = self._permissions.find(scope["method"], scope["path"])
        if allowed is None:
            return  # nothing there: 404 or 405. Should there be a route after all, it finds no caller and refuses
        caller.require(allowed)
        state["caller"] = caller

    async def _authenticated(self, scope: Scope, key: str) -> Caller:
        if self._failures is None:
            return await to_thread.run_sync(self._authenticate, key, limiter=self._threads)
        client = scope.get("client")
        address = address_of(client[0]) if client else "unknown"
        if not self._was_valid(key) and self._failures.is_spent(address):
            # a valid key that comes from the address of a guesser is delayed, but never refused
            await anyio.sleep(self._unknown.reserve_s(address))
        try:
            return await to_thread.run_sync(self._authenticate, key, limiter=self._threads)
        except NotAuthenticated:
            self._failures.take(address)
            raise


def _page_of_old_qr_code(scope: Scope, headers: Headers) -> Response | None:
    """A redirect to the public page, for a browser that asks for a marker without a key.

    QR codes had the address of the marker's record before there were public pages. The address is relative: a proxy may
    serve this server below a path.
    """
    found = _RECORD.fullmatch(scope["path"]) if scope["method"] in ("GET", "HEAD") else None
    if found is None or "authorization" in headers or "x-api-key" in headers or not accepts_html(headers):
        return None
    return Response(status_code=303, headers={"Location": f"../../m/{found[1]}", "Vary": "Accept"})


def _by_prefix(table: Mapping[str, int], path: str) -> int:
    return table[max((prefix for prefix in table if path.startswith(prefix)), key=len)]


def _check_declared_length(headers: Headers, limit: int) -> None:
    declared = headers.get("content-length")
    if declared is None:
        return
    if not (declared.isascii() and declared.isdigit()):
        raise MalformedRequest("Content-Length is not a number", field="Content-Length", limit="digits")
    if len(declared) > 19 or int(declared) > limit:
        raise _too_large(limit)


def _too_large(limit: int) -> UploadTooLarge:
    return UploadTooLarge(
        f"the body is larger than {limit} bytes", field="body", limit=f"{limit} bytes", cure="split the request"
    )
