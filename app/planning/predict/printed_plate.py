"""Whether a printed plate will be read at the design speed: its measured face in simulated passes, read by the decoder.

The passes shift the fitted model of plates (`PlateModel`): by how much higher must the image of a unit be than that of
a faultless plate? The model with this shift gives the probability that a pass reads the plate.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import cv2
import numpy as np
import numpy.typing as npt

from app.decoders.plate.reader import decode_plates
from app.markers.plate import PlateCode, PlateGeometry, PlateScheme
from app.markers.print_grade import PrintPrediction
from app.markers.reading import PlateOutcome, PlateReading
from app.planning.predict.rates import (
    DAY,
    FAR_M,
    MIN_READ_RATE,
    MIN_UNIT_PX,
    CameraView,
    PlateModel,
    ViewReading,
    camera_of,
    check_view_size,
    fitted_models,
    normal_quadrature,
    read_rate_of_model,
    readable_frames,
)
from app.planning.proof.plates import draw_drive, draw_plate
from app.planning.proof.report import Condition
from app.planning.rules import CameraRules
from app.simulation.backgrounds import road_background, road_photos
from app.simulation.camera import render_plate_scene
from app.simulation.conditions import Conditions, Drive, drive_over_plate
from app.simulation.plate_face import Face, plate_face
from app.simulation.plate_scene import PlacedFace, PlateScene, face_truth
from app.values import Floats

WHITE_REFLECTANCE = 0.75
"""[1] assumed for the plate's white, which a photo does not show. Source: `PlateLook.light`."""
TEXELS_PER_MM = 1.0
"""[1/mm] of the simulated face. Source: default of `plate_face`."""
PASSES, FRAMES_PER_PASS = 3, 6
"""Simulated passes, and frames rendered of each. For a second and a half of a processor."""
MAX_SHIFT = math.log(30.0)
"""[log height] greatest shift of the model. Units of 26 px, which no pass shows."""
_SHIFTS = np.linspace(0.0, MAX_SHIFT, 35)  # at which the likelihood is computed
_GRAIN = 0.03  # of the asphalt; source: middle of `_GRAIN` of app/planning/proof/plates.py
_NEIGHBOURS_DEG = (-0.00036, -0.00018, 0.00018, 0.00036)  # [deg] 20 and 40 m; a dense road
_NEAR_NUMBERS = (-2, -1, 1, 2)


@dataclass(frozen=True, slots=True)
class DesignSpeed:
    """Pass for which a print must be readable."""

    camera: CameraRules
    speed_m_s: float


_BASIS = (
    "{read} of {frames} frames of {passes} simulated passes by day, with the face as photographed and a white of "
    "{white:.0%}, were read with the registry, {alone} without; the fitted model of plans turns them into the rate. No "
    "rain, night or dirt."
)


def predict_print(
    reflectance: npt.NDArray[np.float32], code: PlateCode, geometry: PlateGeometry, design: DesignSpeed, seed: int = 0
) -> PrintPrediction:
    """Predict how often passes by day read a printed plate that is registered and new.

    Parameters
    ----------
    reflectance : ndarray of float32, shape (H, W, 3)
        Of the plate's face, relative to its white; blue, green, red.
    code : PlateCode
        What the registry has.
    seed : int
        Draws light, sensor and noise. The same seed gives the same prediction.
    """
    found = read_passes(_face(reflectance, geometry), code, geometry, design, seed=seed)
    model = fitted_models().plate_model(DAY)
    blur = design.speed_m_s * design.camera.exposure_s / (geometry.pitch_mm / 1000)
    weight = _posterior(model, found.passes, blur)
    rates = [read_rate_of_model(_shifted(model, shift), geometry, design.camera, design.speed_m_s) for shift in _SHIFTS]
    frames, read, rate = len(found.frames), sum(hit for _px, hit in found.frames), float((weight * rates).sum())
    basis = _BASIS.format(
        read=read, alone=found.alone, frames=frames, passes=len(found.passes), white=WHITE_REFLECTANCE
    )
    return PrintPrediction(
        speed_kmh=round(design.speed_m_s * 3.6, 3),
        camera=design.camera.name,
        condition=DAY,
        readable_frames_per_pass=round(readable_frames(geometry, design.camera, design.speed_m_s), 1),
        simulated_frames=frames,
        frames_read=read,
        frames_read_alone=found.alone,
        frames_wrong=found.wrong,
        unit_height_ratio=round(float(np.exp((weight * _SHIFTS).sum())), 2),
        read_rate=round(rate, 3),
        faultless_read_rate=round(rates[0], 3),
        will_be_read=rate >= MIN_READ_RATE,
        basis=basis,
    )


@dataclass(slots=True)
class PassesRead:
    """Frames of simulated passes."""

    # of each frame of each pass: height of a unit's image [px], and whether it was read with the registry
    passes: list[list[tuple[float, bool]]] = field(default_factory=list)
    # `alone`, `wrong`: frames that were read without the registry, and those in which other digits were read
    alone: int = 0
    wrong: int = 0

    @property
    def frames(self) -> list[tuple[float, bool]]:
        """Of all passes."""
        return [frame for frames in self.passes for frame in frames]


def read_passes(
    face: Face, code: PlateCode, geometry: PlateGeometry, design: DesignSpeed, *, seed: int, passes: int = PASSES
) -> PassesRead:
    """Render frames of passes by day over a face, and decode them as a vehicle does that knows the registry.

    Parameters
    ----------
    face : Face
        Of a plate; a margin around it may be part of the face.
    code : PlateCode
        What the registry has.
    seed, passes : int
        Each pass draws light, sensor and noise of its own.
    """
    cv2.setNumThreads(1)
    codebook, out = dense_codebook(code), PassesRead()
    for k in range(passes):
        frames: list[tuple[float, bool]] = []
        for unit_px, image in _frames(face, geometry, design, np.random.default_rng((seed, k))):
            digits = _read(image, geometry, ())
            if code.digits in digits:  # what is read alone is read with the registry too
                out.alone += 1
            else:
                digits = _read(image, geometry, codebook)
            frames.append((unit_px, code.digits in digits))
            out.wrong += any(found != code.digits for found in digits)
        out.passes.append(frames)
    return out


def _read(image: npt.NDArray[np.uint8], geometry: PlateGeometry, codebook: Sequence[PlateCode]) -> list[str]:
    readings = decode_plates(image, codebook=codebook, geometries=(geometry,))
    return [one.code.digits for one in readings if one.code is not None]


def _shifted(model: PlateModel, shift: float) -> PlateModel:
    return replace(model, unit_px=model.unit_px * math.exp(shift))


def _posterior(model: PlateModel, passes: list[list[tuple[float, bool]]], blur_units: float) -> Floats:
    """Probability of each shift; all are equally likely before the frames.

    A pass's own circumstances shift the log-odds of all its frames alike, as in `app.planning.predict.rates`.
    """
    nodes, weights = normal_quadrature()
    log = np.zeros(len(_SHIFTS))
    for k, shift in enumerate(_SHIFTS):
        shifted = _shifted(model, shift)
        for frames in passes:
            if not frames:
                continue
            heights, hits = np.array([px for px, _hit in frames]), np.array([hit for _px, hit in frames])
            odds = shifted.pass_log_odds(heights, blur_units)[:, None] + model.spread * nodes
            each = -np.logaddexp(0, np.where(hits[:, None], -odds, odds)).sum(axis=0)
            log[k] += np.log(np.maximum((weights * np.exp(each)).sum(), 1e-300))
    likelihood = np.exp(log - log.max())
    return np.asarray(likelihood / likelihood.sum())


def _face(reflectance: npt.NDArray[np.float32], geometry: PlateGeometry) -> Face:
    size = round(geometry.side_mm * TEXELS_PER_MM)
    texels = cv2.resize(reflectance, (size, size), interpolation=cv2.INTER_AREA)
    return Face(geometry.side_mm / 1000, np.ascontiguousarray(np.clip(texels * WHITE_REFLECTANCE, 0, 1), np.float32))


def dense_codebook(code: PlateCode) -> list[PlateCode]:
    """The plate and its neighbours on a dense road, as a vehicle's registry has them."""
    if code.scheme is PlateScheme.ID:
        numbers = [code.registry_number + step for step in _NEAR_NUMBERS]
        return [code, *(PlateCode.from_registry_number(max(number, 0), n=code.n) for number in numbers)]
    lon, lat = code.decimals
    places = [(float(f"0.{lon}") + step, float(f"0.{lat}") + step) for step in _NEIGHBOURS_DEG]
    of_position = partial(PlateCode.from_position, n=code.n, scheme=code.scheme, check_digits=code.check_digits)
    return [code, *(of_position(x, y) for x, y in places)]


def _frames(
    face: Face, geometry: PlateGeometry, design: DesignSpeed, rng: np.random.Generator
) -> Iterator[tuple[float, npt.NDArray[np.uint8]]]:
    """Height of a unit's image, and the frame, in an even choice of a pass's readable frames. [px]"""
    conditions = draw_drive(design.camera, frozenset({Condition.DAY}), rng)
    scenes = [(unit, scene) for unit, scene in _scenes(face, geometry, design, conditions, rng) if unit >= MIN_UNIT_PX]
    photos = road_photos()
    photo = photos[int(rng.integers(len(photos)))]
    background = road_background(photo, camera_of(design.camera), rng, grain=_GRAIN)
    chosen = np.unique(np.linspace(0, len(scenes) - 1, min(FRAMES_PER_PASS, len(scenes))).round().astype(int))
    for k in chosen:
        unit, scene = scenes[k]
        yield unit, render_plate_scene(scene, background, rng).image


def _scenes(
    face: Face, geometry: PlateGeometry, design: DesignSpeed, conditions: Conditions, rng: np.random.Generator
) -> Iterator[tuple[float, PlateScene]]:
    drive = Drive(
        camera=camera_of(design.camera), face=face, speed_m_s=design.speed_m_s, fps=design.camera.frames_per_s,
        exposure_s=conditions.exposure_s, far_m=FAR_M, road_reflectance=conditions.road_reflectance,
        air=conditions.air, sensor=conditions.sensor,
    )  # fmt: skip
    for scene in drive_over_plate(drive, rng):
        plate_share = geometry.side_mm / 1000 / face.side_m
        yield plate_share * face_truth(scene, scene.faces[0]).height_px / geometry.n, scene


# === A picture of what a camera on a vehicle sees of a plate, and what the decoder reads in it.


_SEED = 4  # draws light, sensor and noise, the same for every view; a plain piece of road


def render_view(
    code: PlateCode,
    geometry: PlateGeometry,
    rules: CameraRules,
    *,
    speed_m_s: float,
    ahead_m: float,
    left_m: float = 0.0,
    condition: Condition = Condition.DAY,
) -> CameraView:
    """Render one frame of a pass over a plate, with the blur of the exposure, and decode it.

    Parameters
    ----------
    code : PlateCode
        Of the geometry's size.
    speed_m_s : float
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
        camera=camera, faces=(PlacedFace(face, ahead_m, left_m),), speed_m_s=speed_m_s, exposure_s=drawn.exposure_s,
        road_reflectance=drawn.road_reflectance, night_light=drawn.night_light, shadow=drawn.shadow, air=drawn.air,
        sensor=sensor,
    )  # fmt: skip
    background = road_background(road_photos()[0], camera, rng, grain=_GRAIN)
    frame = render_plate_scene(scene, background, rng)
    truth = frame.truths[0]
    corners = truth.corners_px if truth.partly_in_view else np.empty((0, 2))
    reading, confidence = _read_view(frame.image, code, geometry)
    return CameraView(
        frame.jpeg,
        tuple((round(x, 1), round(y, 1)) for x, y in corners.tolist()),
        reading,
        confidence,
        drawn.exposure_s,
    )


def _read_view(image: npt.NDArray[np.uint8], code: PlateCode, geometry: PlateGeometry) -> tuple[ViewReading, float]:
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
