"""Times and outcomes of decodes, for /metrics: of this process, whichever app or worker in it decodes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

from prometheus_client import CollectorRegistry, Histogram, generate_latest

from app.errors import Unavailable, WaymarkError

Outcome = Literal["read", "none", "refused", "failed"]
DECODE_METRICS = CollectorRegistry()
_SECONDS = Histogram(
    "waymark_decode_seconds",
    "Time from the start of a decode to its stored result, waiting for a decoder process included",
    ("kind", "outcome"),
    buckets=(0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30, 60, 120, 300, 600),
    registry=DECODE_METRICS,
)


class MeasuredDecode:
    """A decode that goes on.

    Attributes
    ----------
    has_read : bool
        Whether a marker was read in it.
    """

    has_read = False


@contextmanager
def measured(kind: str) -> Iterator[MeasuredDecode]:
    """Measure a decode: what was refused is the upload's fault, what failed is ours or a matter of load."""
    decode, started_s = MeasuredDecode(), time.perf_counter()
    outcome: Outcome = "failed"
    try:
        yield decode
        outcome = "read" if decode.has_read else "none"
    except Unavailable:
        raise
    except WaymarkError:
        outcome = "refused"
        raise
    finally:
        _SECONDS.labels(kind, outcome).observe(time.perf_counter() - started_s)


def written_metrics(registry: CollectorRegistry) -> bytes:
    """The metrics of an app or worker, and of the decodes of this process, as text."""
    return generate_latest(registry) + generate_latest(DECODE_METRICS)
