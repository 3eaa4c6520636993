"""Photos that show no board do not occupy a decoder process that others wait for."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from app.calibration.board_view import BoardView, find_board
from app.errors import CalibrationRefused, UploadTooLarge
from app.formats.format import SpooledFile
from app.sensors.camera import CalibrationBoard
from app.services.fleet import tasks
from app.services.fleet.tasks import MAX_PHOTOS, WITHOUT_BOARD, calibrate_photos


def _calibrate_from_noise() -> None:
    pixels = np.random.default_rng(7).integers(0, 256, (240, 320, 3), dtype=np.uint8)
    photo = cv2.imencode(".png", pixels)[1].tobytes()
    photos = tuple((f"{k}.png", SpooledFile.of(photo)) for k in range(MAX_PHOTOS))
    calibrate_photos(photos, CalibrationBoard(7, 10, 25.0, 18.0))


@pytest.mark.slow
def test_sixty_photos_of_noise_are_refused_after_eight(monkeypatch: pytest.MonkeyPatch) -> None:
    searched: list[int] = []

    def count(grey: np.ndarray[tuple[int, int], np.dtype[np.uint8]], board: CalibrationBoard) -> BoardView:
        searched.append(len(searched))
        return find_board(grey, board)

    monkeypatch.setattr(tasks, "find_board", count)
    with pytest.raises(CalibrationRefused) as caught:
        _calibrate_from_noise()
    assert len(searched) == len(caught.value.parts) == WITHOUT_BOARD


def test_photos_that_take_all_of_the_time_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tasks, "PROCESSOR_S", -1.0)
    with pytest.raises(UploadTooLarge, match="first 0 photos") as caught:
        _calibrate_from_noise()
    assert caught.value.limit == "-1 s of a processor"
