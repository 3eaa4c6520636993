"""Runs of frames: how many frames one task has."""

from __future__ import annotations

from app.decoding.declarations import DecodeContext
from app.errors import UnreadableUpload
from app.formats.format import SpooledFile
from app.services.decodes.frame_tasks import FramePicture
from app.services.decodes.frames import RUN_BYTES, RUN_FRAMES, RUN_PIXELS, ArchiveFrame, FrameMoment, in_runs


def _frame(index: int, pixels: int = 1000, size: int = 1000) -> ArchiveFrame:
    moment = FrameMoment(DecodeContext())
    return ArchiveFrame(index, f"{index}.jpg", moment, FramePicture(SpooledFile.of(bytes(size))), pixels=pixels)


def _lengths(frames: list[ArchiveFrame]) -> list[int]:
    runs = list(in_runs(frames))
    assert [frame for run in runs for frame in run] == frames
    return [len(run) for run in runs]


def test_a_run_has_no_more_frames_pixels_or_bytes_than_it_may() -> None:
    assert _lengths([]) == []
    assert _lengths([_frame(k) for k in range(2 * RUN_FRAMES + 1)]) == [RUN_FRAMES, RUN_FRAMES, 1]
    assert _lengths([_frame(k, pixels=RUN_PIXELS // 2) for k in range(5)]) == [2, 2, 1]
    assert _lengths([_frame(k, size=RUN_BYTES // 3) for k in range(4)]) == [3, 1]


def test_a_frame_that_exceeds_a_run_is_alone() -> None:
    assert _lengths([_frame(0), _frame(1, pixels=2 * RUN_PIXELS), _frame(2)]) == [1, 1, 1]
    assert _lengths([_frame(0, size=2 * RUN_BYTES), _frame(1)]) == [1, 1]


def test_a_frame_with_an_error_costs_no_process_anything() -> None:
    broken = ArchiveFrame(1, "1.jpg", FrameMoment(DecodeContext()), error=UnreadableUpload("damaged", field="file"))
    assert _lengths([_frame(0), broken, _frame(2, size=RUN_BYTES - 1000)]) == [3]
