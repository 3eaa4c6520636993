"""A picture of what a camera on a vehicle sees of a plate, and what the decoder reads in it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from app.decoders.plate.reader import decode_plates
from app.markers.plate import PlateCode, PlateGeometry
from app.markers.reading import PlateOutcome, PlateReading
from app.planning.plate_view import camera_of
from app.planning.predict.printed_plate import dense_codebook
from app.planning.predict.views import CameraView, ViewReading, check_view_size
from app.planning.proof.conditions import draw_drive, draw_plate
from app.planning.proof.terms import Condition
from app.planning.rules import CameraRules
from app.simulation.camera import render_plate_scene
from app.simulation.plate_face import plate_face
from app.simulation.plate_scene import PlacedFace, PlateScene
from app.simulation.road import road_background, road_photos

_GRAIN = 0.03  # of the asphalt; source: as in app/planning/predict/printed_plate.py
_SEED = 4  # draws light, sensor and noise, the same for every view; source: chosen by hand, a plain piece of road


def render_view(
    code: PlateCode,
    geometry: PlateGeometry,
    rules: CameraRules,
    *,
    speed_mps: float,
    ahead_m: float,
    left_m: float = 0.0,
    condition: Condition = Condition.DAY,
) -> CameraView:
    """Render one frame of a pass over a plate, with the blur of the exposure, and decode it.

    Parameters
    ----------
    code : PlateCode
        Of the geometry's size.
    geometry : PlateGeometry
    rules : CameraRules
    speed_mps : float
        [m/s]
    ahead_m, left_m : float
        The plate's centre from the camera, at mid-exposure. [m]
    condition : Condition
        Light, weather and state of the plate.

    Raises
    ------
    InvalidParameter
        The picture would be too large.
    """
    check_view_size(rules)
    cv2.setNumThreads(1)
    rng = np.random.default_rng(_SEED)
    parts = frozenset({condition})
    drawn = draw_plate(draw_drive(rules, parts, rng), parts, rng)
    sensor = replace(drawn.sensor, jpeg_quality=92)
    camera = camera_of(rules)
    face = plate_face(code, geometry, drawn.look, drawn.wear, rng)
    scene = PlateScene(
        camera=camera, faces=(PlacedFace(face, ahead_m, left_m),), speed_m_s=speed_mps, exposure_s=drawn.exposure_s,
        road_reflectance=drawn.road_reflectance, night_light=drawn.night_light, shadow=drawn.shadow, air=drawn.air,
        sensor=sensor,
    )  # fmt: skip
    background = road_background(road_photos()[0], camera, rng, grain=_GRAIN)
    frame = render_plate_scene(scene, background, rng)
    truth = frame.truths[0]
    corners = truth.corners_px if truth.partly_in_view else np.empty((0, 2))
    reading, confidence = _read(frame.image, code, geometry)
    return CameraView(
        frame.jpeg, tuple((round(x, 1), round(y, 1)) for x, y in corners.tolist()), reading, confidence,
        drawn.exposure_s,
    )  # fmt: skip


def _read(image: npt.NDArray[np.uint8], code: PlateCode, geometry: PlateGeometry) -> tuple[ViewReading, float]:
    tries: tuple[tuple[ViewReading, list[PlateCode]], ...] = (
        (ViewReading.ALONE, []),
        (ViewReading.WITH_REGISTRY, dense_codebook(code)),
    )
    for kind, codebook in tries:
        found = [one for one in decode_plates(image, codebook=codebook, geometries=(geometry,)) if _is_right(one, code)]
        if found:
            return kind, round(max(one.confidence for one in found), 4)
    return ViewReading.NOT_READ, 0.0


def _is_right(reading: PlateReading, code: PlateCode) -> bool:
    return reading.outcome is PlateOutcome.READ and reading.code is not None and reading.code.digits == code.digits
