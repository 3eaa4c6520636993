"""Frames, loaded, decoded and annotated inside a decoder process."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from app.errors import ProcessStopped, WaymarkError
from app.families.frames import FrameReader, FrameReading
from app.families.plate.frames import PlateFrames
from app.families.plate.plates import PLATE
from app.formats.images import Frame, load_image
from app.jobs.memory_limit import memory_is_the_limit
from app.markers.reading import PlateReading
from app.plots.annotated_frame import draw_outlines, encode_picture
from app.services.decodes.frame_task import AnnotationTask, FramePicture, FrameResult, FrameRunTask, FrameSearch
from app.services.decodes.matching import FRAME_READERS

DecodePlates = Callable[..., list[PlateReading]]
_PICTURE = ("picture", "send frames at the camera's resolution, or crop them to the road")


class _Readers:
    by_family: ClassVar[Mapping[str, FrameReader[Any, Any]]] = {}


def use_decoder(decode: DecodePlates) -> None:
    """Set the function that decodes plates in this process."""
    _Readers.by_family = {**FRAME_READERS, PLATE.name: PlateFrames(decode)}


@dataclass(frozen=True, slots=True)
class LoadedFrame:
    """A frame between the two steps of its decoding."""

    frame: Frame
    thermal: bool
    load_ms: float


def load_frame(task: FramePicture, _before: None) -> LoadedFrame:
    """First step: the picture's codec."""
    with memory_is_the_limit(*_PICTURE):
        began = time.perf_counter()
        frame = load_image(task.file.read(), task.limits, thermal=task.thermal, thermal_range=task.thermal_range)
        return LoadedFrame(frame, task.thermal, 1e3 * (time.perf_counter() - began))


def find_markers(search: FrameSearch, loaded: LoadedFrame) -> FrameResult:
    """Second step: the markers in it, family by family."""
    if not _Readers.by_family:
        raise RuntimeError("the decoder process was not warmed")
    frame = loaded.frame
    readings: list[FrameReading] = []
    with memory_is_the_limit(*_PICTURE):
        began = time.perf_counter()
        for name, wanted in search.by_family.items():
            readings += _Readers.by_family[name].read(frame.pixels, wanted, thermal=loaded.thermal)
        decode_ms = 1e3 * (time.perf_counter() - began)
    return FrameResult(frame.header, tuple(readings), loaded.load_ms, decode_ms)


def decode_run(task: FrameRunTask, _before: None) -> tuple[FrameResult | WaymarkError, ...]:
    """Frame by frame."""
    results: list[FrameResult | WaymarkError] = []
    for picture, search in task.frames:
        try:
            results.append(find_markers(search, load_frame(picture, None)))
        except ProcessStopped:
            raise
        except WaymarkError as error:
            results.append(error)
    return tuple(results)


def annotate_frame(task: AnnotationTask, _before: None) -> bytes:
    """Draw outlines over a frame and encode it."""
    with memory_is_the_limit(*_PICTURE):
        frame = load_image(task.file.read(), task.limits, thermal=task.thermal, thermal_range=task.thermal_range)
        return encode_picture(draw_outlines(frame.pixels, task.outlines), task.suffix)
