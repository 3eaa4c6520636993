"""Frames, loaded, decoded and annotated inside a decoder process, within its memory."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar

import cv2

from app.errors import ProcessStopped, WaymarkError, is_exhausted
from app.families.family import FrameReader, FrameReading
from app.families.plate.frames import PlateFrames
from app.families.plate.plates import PLATE
from app.formats.images import Frame, load_image
from app.markers.reading import PlateReading
from app.plots.annotated_frame import draw_outlines, encode_picture
from app.services.decodes.matching import FRAME_READERS
from app.services.decodes.tasks import AnnotationTask, FramePicture, FrameResult, FrameRunTask, FrameSearch

# === What happens when an upload takes more memory than its decoder process may have, or than is left in it.


@contextmanager
def memory_is_the_limit(what: str, cure: str) -> Iterator[None]:
    """Report an allocation that the process's limit refused as the upload's fault, which it is."""
    try:
        yield
    except (MemoryError, OSError, cv2.error) as error:
        if not _is_exhausted(error):
            raise
        raise out_of_memory(f"decoding the {what}", cure) from error


def out_of_memory(work: str, cure: str) -> ProcessStopped:
    """The error of work that takes more memory than the process may have."""
    return ProcessStopped(
        f"{work} takes more memory than a decoder process has",
        field="file",
        limit=f"{resource.getrlimit(resource.RLIMIT_DATA)[0]} bytes",
        cure=cure,
    )


def ran_short(error: BaseException) -> bool:
    """Whether an error, or one that it was raised from, is that a process has no memory or no thread left.

    What fills a process need not be the upload at which it shows.
    """
    cause: BaseException | None = error
    while cause is not None:
        if _is_exhausted(cause):
            return True
        cause = cause.__cause__ or (None if cause.__suppress_context__ else cause.__context__)
    return False


def _is_exhausted(error: BaseException) -> bool:
    if isinstance(error, cv2.error):
        return getattr(error, "code", None) == cv2.Error.StsNoMem or "bad_alloc" in str(error)
    return is_exhausted(error) or (isinstance(error, RuntimeError) and "can't start new thread" in str(error))


# === Frames, loaded, decoded and annotated inside a decoder process.


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
