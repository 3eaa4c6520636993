"""Traces by OpenTelemetry (the extra `tracing`), sent to a collector by OTLP over HTTP."""

from __future__ import annotations

from typing import Any

from app import tracing
from app.errors import InvalidParameter
from app.settings import Settings

_PATH = "/v1/traces"  # https://opentelemetry.io/docs/specs/otlp/#otlphttp-request


def start_tracing(settings: Settings, service: str) -> object:
    """Send spans to the collector of the settings; without one nothing is imported. Returns the provider, or None.

    Raises
    ------
    InvalidParameter
        The extra is not installed.
    """
    if not settings.otlp_endpoint:
        return None
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ImportError as error:
        raise InvalidParameter(
            "OpenTelemetry is not installed", field="WAYMARK_OTLP_ENDPOINT", cure="pip install waymark-roads[tracing]"
        ) from error
    provider = TracerProvider(resource=Resource.create({"service.name": service}))
    exporter = OTLPSpanExporter(endpoint=settings.otlp_endpoint.rstrip("/") + _PATH)
    provider.add_span_processor(BatchSpanProcessor(exporter))
    tracing.install(OpenTelemetryTracer(provider))
    return provider


class OpenTelemetryTracer:
    """`app.tracing.Tracer` on OpenTelemetry's SDK."""

    def __init__(self, provider: Any) -> None:
        from opentelemetry import context, trace
        from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

        self._context, self._trace = context, trace
        self._tracer = provider.get_tracer("waymark")
        self._texts = TraceContextTextMapPropagator()

    def begin(self, name: str, parent: str | None, attributes: dict[str, str]) -> tuple[object, object]:
        """Begin a span, which is the thread's own until `end`."""
        started = self._tracer.start_span(name, context=self._from(parent), attributes=attributes)
        return started, self._context.attach(self._trace.set_span_in_context(started))

    def end(self, span: object, attributes: dict[str, str]) -> None:
        """End a span."""
        assert isinstance(span, tuple)
        started, token = span
        self._context.detach(token)
        for name, value in attributes.items():
            started.set_attribute(name, value)
        if "error.type" in attributes:
            started.set_status(self._trace.StatusCode.ERROR)
        started.end()

    def current(self) -> str | None:
        """The context of the thread's span."""
        carrier: dict[str, str] = {}
        self._texts.inject(carrier)
        return carrier.get("traceparent")

    def record(self, name: str, parent: str | None, times_ns: tuple[int, int], attributes: dict[str, str]) -> None:
        """Record a span that has ended."""
        began, ended = times_ns
        done = self._tracer.start_span(name, context=self._from(parent), attributes=attributes, start_time=began)
        done.end(end_time=ended)

    def _from(self, parent: str | None) -> object:
        return self._texts.extract({"traceparent": parent}) if parent is not None else None
