"""Frames in a decoder process: loaded, searched for markers, and annotated."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from app.decoders.plate.confirm import Expected
from app.decoding.frames import DecodePlates
from app.errors import ProcessStopped, WaymarkError
from app.families.family import FrameReader, FrameReading
from app.families.plate.frames import PlateFrames
from app.families.plate.plates import PLATE
from app.formats.format import SpooledFile
from app.formats.images import Frame, ImageHeader, ImageLimits, load_image
from app.markers.reading import PlateReading
from app.plots.annotated_frame import Outline, draw_outlines, encode_picture
from app.sensors.camera import Camera
from app.services.decoder_tasks import decoder_task
from app.services.decodes.matching import FRAME_READERS
from app.services.ports import Later

PlatesOfFrames = Sequence[tuple[int, Sequence[PlateReading]]]
"""Numbers of the frames of a drive, and the plates that each shows."""
FrameSearch = Mapping[str, object]
"""What to look for in a frame: what each family's `FrameReader.search` returns, by the family's name."""
_PICTURE = ("picture", "send frames at the camera's resolution, or crop them to the road")


class _Readers:
    by_family: ClassVar[Mapping[str, FrameReader[Any, Any]]] = {}


def use_decoder(decode: DecodePlates) -> None:
    """Set the function that decodes plates in this process."""
    _Readers.by_family = {**FRAME_READERS, PLATE.name: PlateFrames(decode)}


@dataclass(frozen=True, slots=True)
class FramePicture:
    """One frame to load."""

    file: SpooledFile  # JPEG or PNG
    thermal: bool = False
    thermal_range: tuple[float, float] | None = None  # [counts] that become 0 and 255 in a 16-bit thermal frame
    limits: ImageLimits = field(default_factory=ImageLimits)


@dataclass(frozen=True, slots=True)
class FrameResult:
    """What a decoder process found in a frame."""

    header: ImageHeader
    readings: tuple[FrameReading, ...]
    load_ms: float  # spent on the picture's codec
    decode_ms: float  # spent on the markers


@decoder_task(*_PICTURE, is_long=False)
def decode_frame(picture: FramePicture, search: Later[FrameSearch]) -> FrameResult:
    """Load a picture while the caller still finds out what to look for in it."""
    frame, load_ms = _load(picture)
    return _find_markers(frame, load_ms, picture, search.result())


def _load(picture: FramePicture) -> tuple[Frame, float]:
    """The frame, and the time that it took [ms]."""
    began_s = time.perf_counter()
    frame = load_image(
        picture.file.read(), picture.limits, thermal=picture.thermal, thermal_range=picture.thermal_range
    )
    return frame, 1e3 * (time.perf_counter() - began_s)


def _find_markers(frame: Frame, load_ms: float, picture: FramePicture, search: FrameSearch) -> FrameResult:
    """Search a frame family by family."""
    if not _Readers.by_family:
        raise RuntimeError("the decoder process was not warmed")
    began_s = time.perf_counter()
    readings: list[FrameReading] = []
    for name, wanted in search.items():
        readings += _Readers.by_family[name].read(frame.pixels, wanted, thermal=picture.thermal)
    return FrameResult(frame.header, tuple(readings), load_ms, 1e3 * (time.perf_counter() - began_s))


@decoder_task(*_PICTURE, is_long=False)
def decode_frames(frames: tuple[tuple[FramePicture, FrameSearch], ...]) -> tuple[FrameResult | WaymarkError, ...]:
    """Decode several frames one after the other, so that their processes are handed work less often.

    The result has the error of each frame that cannot be read. A frame that stops the process stops the whole run.
    """
    results: list[FrameResult | WaymarkError] = []
    for picture, search in frames:
        try:
            results.append(_find_markers(*_load(picture), picture, search))
        except ProcessStopped:
            raise
        except WaymarkError as error:
            results.append(error)
    return tuple(results)


@decoder_task(*_PICTURE)
def confirm_plates(frames: PlatesOfFrames) -> dict[int, list[PlateReading]]:
    """Plates that the frames of a drive show together, as `confirm_drive`."""
    from app.decoders.plate.accumulate import confirm_drive

    return confirm_drive(frames)


@decoder_task(*_PICTURE, is_long=False)
def find_expected_plates(
    picture: FramePicture, camera: Camera, expected: tuple[Expected, ...]
) -> tuple[PlateReading, ...]:
    """Plates that other frames of the drive show, where this frame should show them."""
    from app.decoders.plate.follow_plate import expect_plate, find_expected

    wanted = [expect_plate(one, camera) for one in expected]
    if not any(wanted):
        return ()
    frame, _load_ms = _load(picture)
    found = (find_expected(frame.pixels, one, camera) for one in wanted if one is not None)
    return tuple(reading for reading in found if reading is not None)


@decoder_task(*_PICTURE, is_long=False)
def annotate_frame(picture: FramePicture, outlines: tuple[Outline, ...], suffix: str) -> bytes:
    """Draw outlines over a frame, and encode it as ``png`` or ``jpg``."""
    frame, _load_ms = _load(picture)
    return encode_picture(draw_outlines(frame.pixels, outlines), suffix)
