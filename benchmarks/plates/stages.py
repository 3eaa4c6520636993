"""Processor time of the decoder's stages."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import ModuleType
from typing import Any
from unittest import mock

import numpy as np
import numpy.typing as npt

from app.decoders.plate import detect_quads, find_candidates, reader

Image = npt.NDArray[np.uint8]
STAGES: tuple[tuple[str, ModuleType, str], ...] = (
    ("half resolution", reader, "half_planes"),
    ("blobs", detect_quads, "find_blobs"),
    ("quadruples of blobs", find_candidates, "detect_marker_quads"),
    ("filter of candidates", find_candidates, "candidate_log_odds"),
    ("fits", reader, "fit_coarsely"),
    ("fits", reader, "finish_fit"),
    ("colours of markers", reader, "measure_marker_colours"),
    ("unit likelihoods", reader, "unit_log_likelihoods"),
    ("symbols", reader, "read_evidence"),
    ("verification by pixels", reader, "verify_units"),
)
"""Stages and the functions that they are; `SIGNALS` are a stage beside them. A stage's time is without those that it
calls."""
SIGNALS, REST = "signals of red and green", "the rest"


def measure_stages(images: list[Image]) -> dict[str, float]:
    """Mean milliseconds of the processor that each stage takes of a frame, the longest first; clocks take a part."""
    for image in images:
        reader.decode_plates(image)
    with _clocks() as (seconds, clock):
        decode = clock(REST, reader.decode_plates)
        for image in images:
            decode(image)
    return {stage: 1000 * total / len(images) for stage, total in sorted(seconds.items(), key=lambda item: -item[1])}


@contextmanager
def _clocks() -> Iterator[tuple[dict[str, float], Callable[[str, Callable[..., Any]], Callable[..., Any]]]]:
    """All stages under clocks: their seconds so far, and the function that puts another one under a clock."""
    seconds: dict[str, float] = defaultdict(float)
    within: list[float] = []  # seconds in the stages that each of those that run has called

    def clock(stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def run(*args: Any, **options: Any) -> Any:
            within.append(0.0)
            start = time.process_time()
            try:
                return function(*args, **options)
            finally:
                took = time.process_time() - start
                seconds[stage] += took - within.pop()
                if within:
                    within[-1] += took

        return run

    with ExitStack() as stack:
        for stage, module, name in STAGES:
            stack.enter_context(mock.patch.object(module, name, clock(stage, getattr(module, name))))
        signals = tuple(clock(SIGNALS, signal_of) for signal_of in find_candidates.SIGNALS)
        stack.enter_context(mock.patch.object(find_candidates, "SIGNALS", signals))
        yield seconds, clock
