"""`waymark compile`: compile all kernels in advance, those of decoders, lanes, tracks and simulations.

Numba keeps the result beside the code, or in NUMBA_CACHE_DIR, or else in the user's cache folder.
"""

from __future__ import annotations

import multiprocessing
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from app.compiled import expect_compilation
from app.decoders.magnet.metro import cancel_wheel_noise
from app.decoders.plate.detect_blobs import half_planes, ratio_signal
from app.decoders.plate.reader import decode_plates
from app.jobs.decoder_process import warm_frame
from app.lanes.control import Controller
from app.lanes.driven_lane import choose_driven_lane
from app.lanes.initial_line import DrivenLine
from app.lanes.lane_fit import assign_sides
from app.lanes.least_squares import factor, inverse_band
from app.lanes.smooth_line import SmoothLine
from app.sensors.camera import Camera
from app.services.decodes.trace_tasks import compile_traces
from app.simulation.camera import render_plate_scene
from app.simulation.magnetic.drive import Course, Scene, Vehicle, simulate_drive
from app.simulation.magnetic.road import Road
from app.simulation.plate_face import Face
from app.simulation.plate_scene import PlacedFace, PlateScene, Shadow
from app.simulation.steering import PoseNoise, check_steering
from app.tracks import Clock, LanePath, PositionFix, Samples, TrackInput
from app.tracks.estimate import estimate_track

_STEP_DEG = 1e-4
_STATIONS_M = np.arange(0.0, 40.0, 10.0)


def compile_kernels() -> None:
    """Run everything once, so that every kernel takes part: cameras in one process, the rest in another."""
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn"), initializer=expect_compilation) as pool:
        for done in [pool.submit(_render_and_read_plate), pool.submit(_read_trace_and_track)]:
            done.result()


def _render_and_read_plate() -> None:
    decode_plates(warm_frame())
    grey = Face(0.3, np.full((300, 300, 3), 0.5, np.float32))
    camera = Camera.from_field_of_view(320, 240, 60.0)
    scene = PlateScene(camera, (PlacedFace(grey, 4.0),), shadow=Shadow(edge_light=0.5))
    render_plate_scene(scene, None, np.random.default_rng(1))
    ratio_signal(half_planes(warm_frame()))  # which only frames with weak colours need


def _read_trace_and_track() -> None:
    """Decode a trace, simulate one, cancel wheel noise, find a lane and its sides, steer, estimate a track."""
    compile_traces()
    simulate_drive(Scene(Road(40.0), Vehicle.compact(), Course()), np.random.default_rng(1))
    inverse_band(factor(np.array([[2.0] * 4, [1.0] * 4])))
    assign_sides(_STATIONS_M, np.resize((1.7, -1.7), 4), np.zeros(4, np.int64), wander=0.1, near_track=False)
    drive = DrivenLine(SmoothLine(np.column_stack((_STATIONS_M, np.zeros(4)))), np.zeros((0, 2)), 0.02, 0.02, 14.0, 0.0)
    choose_driven_lane(_STATIONS_M, np.resize((1.7, -1.7), 4), np.zeros(4, np.int64), drive)
    path_m = np.column_stack((np.zeros(100), np.arange(100.0)))
    for controller in Controller:
        check_steering(path_m, 50.0, controller=controller, noise=PoseNoise(), rng=np.random.default_rng(1))
    cancel_wheel_noise(np.ones(1000), np.ones(1000))
    estimate_track(short_track())


def short_track() -> TrackInput:
    """A drive of ten seconds with two sensors and one lane."""
    time_s = np.arange(0.0, 10.0, 0.1)
    fixes = tuple(
        PositionFix(name, second, 0.0, _STEP_DEG * second, (0.01, 0.0, 0.01), 0.0, 1.0, marker_id=f"{name} {second}")
        for second, name in enumerate(["bar", "camera"] * 5)
    )
    lane = LanePath("lane", np.zeros(12), _STEP_DEG * np.arange(-1.0, 11.0), 0.1)
    speeds = Samples("bar", time_s, np.full(time_s.size, 11.1), 0.1)
    headings = Samples("bar", time_s, np.zeros(time_s.size), 0.5)
    return TrackInput((Clock("bar"), Clock("camera")), fixes, (speeds,), (headings,), (lane,))
