"""Surveys, logs and receivers that are wrong as a whole: wrong paths are called unfit, and right ones are not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from app.lanes.estimate import Lane, fit_lane
from app.simulation.radio.drive import SatelliteReceiver
from benchmarks.cerpm import shape_errors
from benchmarks.cerpm.shape_errors import Scene, Upload, is_fit, worst_m

SEED = 7301


def decoded(scene: Scene, receiver: Callable[[], SatelliteReceiver], run: int) -> tuple[Upload, Lane]:
    upload = scene(receiver(), np.random.default_rng([SEED, run]))
    return upload, fit_lane(upload.markers, upload.track, strengths=upload.strengths)


@pytest.mark.parametrize("run", range(3))
def test_a_path_between_two_datums_is_unfit_and_says_where(run: int) -> None:
    upload, path = decoded(shape_errors.two_datums, SatelliteReceiver.rtk, run)
    assert worst_m(upload.lane, path) > 0.5
    assert not is_fit(path)
    assert any("turns aside where the vehicle does not" in text for text in path.localization_warnings)


def test_a_path_a_metre_from_where_vehicles_drive_is_unfit() -> None:
    upload, path = decoded(shape_errors.common_shift, SatelliteReceiver.rtk, 0)
    assert worst_m(upload.lane, path) > 0.5
    assert not is_fit(path)
    assert path.track_agreement is not None
    assert path.track_agreement.disagrees


def test_without_a_track_the_path_runs_in_the_order_in_which_markers_were_received() -> None:
    upload, path = decoded(shape_errors.swapped_sides, SatelliteReceiver.rtk, 0)
    assert upload.track is None
    assert worst_m(upload.lane, path) < 0.25
    assert any("order in which the markers were received" in text for text in path.localization_warnings)
    silent = fit_lane(upload.markers)  # without the packets nothing contradicts the sides
    assert worst_m(upload.lane, silent) == np.inf


@pytest.mark.parametrize("receiver", [SatelliteReceiver.rtk, SatelliteReceiver.plain])
def test_a_track_in_the_opposite_order_makes_the_path_unfit(receiver: Callable[[], SatelliteReceiver]) -> None:
    _, path = decoded(shape_errors.reversed_track, receiver, 0)
    assert not is_fit(path)
    assert any("opposite order" in text for text in path.localization_warnings)


@pytest.mark.parametrize(
    "scene",
    [
        shape_errors.nothing,
        shape_errors.receiver_step,
        shape_errors.wild_fixes,
        shape_errors.tunnel,
        shape_errors.overtaking,
    ],
    ids=["nothing", "step", "wild", "tunnel", "overtaking"],
)
def test_a_right_path_stays_fit_whatever_the_receiver_and_the_driver_do(scene: Scene) -> None:
    upload, path = decoded(scene, SatelliteReceiver.rtk, 0)
    assert worst_m(upload.lane, path) < 0.15
    assert is_fit(path), path.localization_warnings
