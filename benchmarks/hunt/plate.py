"""Scenes of plates: a plate under light, shade, weather, dirt and wear, a camera, and what is read from the frame."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from app.decoders.plate.reader import decode_plates
from app.markers.plate import PlateCode
from app.sensors.camera import Camera
from app.simulation.camera import render_plate_scene
from app.simulation.conditions import Conditions
from app.simulation.plate_face import Face, PlateLook, PlateWear, draw_look, plate_face
from app.simulation.plate_scene import Air, FaceTruth, PlacedFace, PlateScene, Sensor, Shadow, face_truth
from benchmarks.hunt.scenes import Bound, Kind, Outcome, Parameters, switch
from benchmarks.plates.evaluate import find_right
from benchmarks.plates.peers import FAMILIES, reads_tag, tag_face
from benchmarks.plates.schemes import CANDIDATES, draw_places
from benchmarks.plates.views import draw_background
from benchmarks.scenes.hunted_weather import (
    Water,
    dusk,
    lay,
    mirrored_lamp,
    sand,
    shaken,
    snow,
    wet,
    wide_camera,
)

_BY_HAND = "by hand"
_LAMPS = ((0.15, 1.0, 0.4), (0.05, 0.05, 1.0), (0.05, 0.55, 1.0), (0.9, 1.0, 1.0))
"""Colours of lamps in blue, green, red: green, red, amber, white."""
PLATE = {
    "scheme": Bound(0, len(CANDIDATES) - 1, 2, "schemes of `benchmarks.plates.schemes`", whole=True),
    "contrast_loss": Bound(0, 0.5, 0, "paint fades to half of its contrast", plain=0.6),
    "patchy_loss": Bound(0, 0.8, 0, "worn to the plate in places", plain=0.6),
    "patch_mm": Bound(20, 150, 60, _BY_HAND, logarithmic=True),
    "paint_spots": Bound(0, 5, 0, "drops of line paint, bitumen, chewing gum", whole=True, plain=0.6),
    "paint_mm": Bound(4, 40, 20, "largest half axis; a drop to a splash", logarithmic=True),
    "dirt_blobs": Bound(0, 5, 0, "mud and leaves", whole=True, plain=0.75),
    "dirt_mm": Bound(5, 30, 20, _BY_HAND, logarithmic=True),
}
LIGHT = {
    "edge_light": Bound(0.1, 1, 1, "light in the shade of a car, pole or bridge", plain=0.7),
    "edge_angle_deg": Bound(0, 360, 0, "any"),
    "edge_offset_m": Bound(-0.25, 0.25, 0, "across the plate"),
    "penumbra_m": Bound(0.005, 0.15, 0.02, "the sun's 0.53 degrees from a kerb to a tree", logarithmic=True),
    "dapple_light": Bound(0.15, 1, 1, "light below leaves", plain=0.75),
    "dapple_m": Bound(0.03, 0.5, 0.15, "leaves to branches", logarithmic=True),
    "dapple_softness": Bound(0.03, 0.5, 0.15, _BY_HAND),
    "haze": Bound(0, 0.6, 0, "spray and a dirty windscreen", plain=0.8),
    "glare": Bound(0, 0.4, 0, "the low sun on a wet plate", plain=0.8),
    "glare_size_m": Bound(0.05, 0.4, 0.2, _BY_HAND),
    "night": switch("headlights", plain=0.85),
}
CAMERA = {
    "rows": Bound(11, 140, 60, "from the reader's least plate to two metres ahead", logarithmic=True),
    "fov_deg": Bound(50, 95, 70, "dash cameras"),
    "height_m": Bound(1.1, 2.6, 1.4, "cars to trucks"),
    "depression_deg": Bound(10, 50, 25, "the paper's 15 to 45 degrees and more"),
    "azimuth_deg": Bound(-20, 20, 0, "mounted beside the mirror", plain=0.3),
    "roll_deg": Bound(-5, 5, 0, "banked roads and mounting", plain=0.3),
    "left_m": Bound(-0.8, 0.8, 0, "beside the middle of the lane"),
    "rotation_deg": Bound(-180, 180, 0, "laid in any direction", plain=0.6),
    "speed_m_s": Bound(0, 36, 14, "standing to a motorway"),
    "exposure_s": Bound(0.0003, 0.004, 0.001, "sun to dusk", logarithmic=True, plain=0.4),
    "readout_s": Bound(0, 0.03, 0, "rolling shutters", plain=0.4),
    "blur_px": Bound(0.35, 1.2, 0.6, "a good lens to a cheap one out of focus", plain=0.4),
    "decentred": Bound(-0.004, 0.004, 0, "p1, p2 of cheap lenses", plain=0.5),
    "full_well_e": Bound(500, 12000, 5000, "phones to industrial cameras", logarithmic=True, plain=0.4),
    "gain": Bound(0.5, 1.7, 1, "exposure control that is off by a stop", plain=0.4),
    "shoulder": Bound(0.5, 1, 0.8, "tone curves"),
    "gamma": Bound(1.8, 2.6, 2.2, "tone curves"),
    "sharpen": Bound(0, 1.2, 0.3, "image processors"),
    "colour_shift_px": Bound(-0.8, 0.8, 0, "lateral chromatic aberration", plain=0.4),
    "red_gain": Bound(0.7, 1.35, 1, "white balance", plain=0.4),
    "blue_gain": Bound(0.7, 1.35, 1, "white balance", plain=0.4),
    "jpeg_quality": Bound(30, 96, 90, "4:2:0 of dash cameras and of uplinks", whole=True),
}
WEATHER = {
    "snow": Bound(0, 0.8, 0, "share of the plate under it; with more, no method could", plain=0.85),
    "sand": Bound(0, 0.95, 0, "share of the plate under it", plain=0.85),
    "sand_depth": Bound(0.3, 1, 0.85, "opacity of its middle: dust to a drift"),
    "layer_from_deg": Bound(0, 360, 90, "side that it comes from"),
    "layer_bank": Bound(0, 1, 0.5, "patches anywhere to one straight edge"),
    "layer_patch_m": Bound(0.05, 0.4, 0.15, _BY_HAND, logarithmic=True),
    "wet": switch("a film of water that mirrors the sky", plain=0.8),
    "lamp": Bound(0, 1.5, 0, "radiance of a lamp that the film mirrors, as a share of saturation", plain=0.6),
    "lamp_colour": Bound(0, len(_LAMPS) - 1, 0, "traffic lights, brake lights, headlights", whole=True),
    "lamp_right_m": Bound(-0.3, 0.3, 0, "its image beside the plate's middle"),
    "lamp_along_m": Bound(-0.3, 0.3, 0, "its image ahead of the plate's middle"),
    "light": Bound(0.001, 1, 1, "share of the day's, to the end of civil twilight", logarithmic=True, plain=0.85),
    "shake": Bound(0, 12, 0, "times an ordinary road's, to a pothole", plain=0.7),
    "bend": Bound(0.1, 1, 0, "of the lens: 1 is an equidistant fisheye", plain=0.85),
    "wide_fov_deg": Bound(90, 130, 110, "of such a lens"),
    "undeclared": switch("uploads need not declare their camera", plain=0.8),
}
_MIN_ROWS = 16.0  # [px] below it a miss is the physical limit's; source: 1.25 px a unit of 10 x 10, by hand
_ROAD_REFLECTANCE = 0.22  # source: `PlateScene`


class _Shot(NamedTuple):
    image: np.ndarray
    scene: PlateScene  # without its weather, as is the photo
    truth: FaceTruth
    codes: list[PlateCode]
    conditions: Conditions
    background: np.ndarray
    camera: Camera | None  # as declared


class PlateScenes:
    """Frames with one plate.

    The oracle knows which plates are registered nearby, or reads an ArUco tag in the plate's place: what neither
    reads is beyond the limit. The badness of a wrong reading is its confidence, of a missed one its height in rows.
    """

    bounds: Mapping[str, Bound] = {**PLATE, **LIGHT, **CAMERA, **WEATHER}

    def evaluate(self, parameters: Parameters, seed: int) -> Outcome:
        """Read a frame alone and with the registry, and compare the readings with the true plate."""
        cv2.setNumThreads(1)
        shot = _simulate(parameters, seed)
        if shot is None:
            return Outcome(Kind.BEYOND, detail="the plate is not in view in this size")
        readings = decode_plates(shot.image, camera=shot.camera)
        hit, wrong = find_right(readings, shot.codes[0], shot.truth)
        sure = [(hit.confidence, True)] if hit is not None else []
        for reading in readings:
            if reading.likely_code is not None:
                sure.append((reading.confidence, reading.likely_code.digits == shot.codes[0].digits))
        sure += [(reading.confidence, False) for reading in readings if reading.code and reading.code.digits in wrong]
        known, known_wrong = find_right(
            decode_plates(shot.image, camera=shot.camera, codebook=tuple(shot.codes)), shot.codes[0], shot.truth
        )
        if wrong or known_wrong:
            said = f"read as {(*wrong, *known_wrong)[0]} in place of {shot.codes[0].digits}"
            return Outcome(Kind.WRONG, 1.0, said + ("" if wrong else " with the registry"), sure)
        if hit is not None:
            return Outcome(Kind.RIGHT, detail=f"{shot.truth.height_px:.0f} rows", sure=sure, read=1.0)
        oracle = (
            "with the registry"
            if known is not None
            else "as an ArUco tag"
            if _reads_aruco(shot, parameters, seed)
            else ""
        )
        if not oracle or shot.truth.height_px < _MIN_ROWS:
            return Outcome(Kind.BEYOND, detail="not read by the oracle", sure=sure)
        why = next((reading.reason for reading in readings if reading.reason), "no plate found")
        said = f"{shot.truth.height_px:.0f} rows, read {oracle}: {why}"
        return Outcome(Kind.MISSED, shot.truth.height_px, said, sure, read=0.0)

    def draw(self, parameters: Parameters, seed: int, path: Path) -> None:
        """Write the part of the frame around the plate as PNG."""
        shot = _simulate(parameters, seed)
        if shot is None:
            return
        reach = int(0.8 * max(shot.truth.height_px, shot.truth.width_px)) + 8
        x, y = (int(v) for v in shot.truth.corners_px.mean(axis=0))
        part = shot.image[max(y - reach, 0) : y + reach, max(x - reach, 0) : x + reach]
        cv2.imwrite(str(path.with_suffix(".png")), cv2.resize(part, None, fx=4, fy=4, interpolation=cv2.INTER_NEAREST))


def _simulate(p: Parameters, seed: int) -> _Shot | None:
    rng = np.random.default_rng([seed, 2])
    candidate = CANDIDATES[int(p["scheme"])]
    codes = [candidate.code(*place) for place in draw_places(rng)]
    conditions = _conditions(p, draw_look(rng), seed)
    camera = _camera(p)
    face = plate_face(codes[0], candidate.geometry, conditions.look, conditions.wear, np.random.default_rng([seed, 3]))
    scene = _placed(p, camera, face, conditions)
    if scene is None:
        return None
    background = draw_background(camera, rng)
    weather, photo = _under_weather(p, scene, background, seed)
    image = render_plate_scene(weather, photo, np.random.default_rng([seed, 4])).image
    truth = face_truth(weather, weather.faces[0])
    return _Shot(image, scene, truth, codes, conditions, background, None if p["undeclared"] else camera)


def _camera(p: Parameters) -> Camera:
    mount = {name: p[name] for name in ("height_m", "depression_deg", "azimuth_deg", "roll_deg")}
    if p["bend"]:
        camera = wide_camera(1920, 1080, p["wide_fov_deg"], p["bend"], **mount)
    else:
        camera = Camera.from_field_of_view(1920, 1080, p["fov_deg"], **mount)
        camera = replace(camera, distortion=(0.0, 0.0, p["decentred"], -p["decentred"] / 2))
    return replace(camera, readout_s=p["readout_s"])


def _under_weather(
    p: Parameters, scene: PlateScene, background: np.ndarray, seed: int
) -> tuple[PlateScene, np.ndarray]:
    """The scene and the photo behind it in its weather: what lies on the plate, then water, then light and shaking."""
    side = {"from_deg": p["layer_from_deg"], "patch_m": p["layer_patch_m"]}
    scene, background = lay(scene, background, sand(p["sand"], seed, depth=p["sand_depth"], **side))
    scene, background = lay(scene, background, snow(p["snow"], seed + 1, bank=p["layer_bank"], **side))
    if p["wet"]:
        blue, green, red = (p["lamp"] * share for share in _LAMPS[int(p["lamp_colour"])])
        lamp = mirrored_lamp(scene, (blue, green, red), right_m=p["lamp_right_m"], along_m=p["lamp_along_m"])
        scene, background = wet(scene, background, Water(), (lamp,) if p["lamp"] else ())
    if p["light"] < 1 and scene.night_light is None:
        scene = dusk(scene, p["light"])
    if p["shake"]:
        scene = shaken(scene, p["shake"], np.random.default_rng([seed, 5]))
    return scene, background


def _conditions(p: Parameters, look: PlateLook, seed: int) -> Conditions:
    wear = PlateWear(
        p["contrast_loss"], p["patchy_loss"], p["patch_mm"], int(p["dirt_blobs"]), p["dirt_mm"],
        int(p["paint_spots"]), (min(4.0, p["paint_mm"]), p["paint_mm"]),
    )  # fmt: skip
    shadow = Shadow(
        p["edge_light"], p["edge_angle_deg"], p["edge_offset_m"], p["penumbra_m"], p["dapple_light"], p["dapple_m"],
        p["dapple_softness"], seed,
    )  # fmt: skip
    air = Air(haze=p["haze"], glare=p["glare"], glare_size_m=(p["glare_size_m"], 2 * p["glare_size_m"]))
    sensor = Sensor(
        blur_px=p["blur_px"], full_well_e=p["full_well_e"], gain=p["gain"],
        white_balance=(p["blue_gain"], 1.0, p["red_gain"]), gamma=p["gamma"], shoulder=p["shoulder"],
        sharpen=p["sharpen"], colour_shift_px=p["colour_shift_px"], readout_s=p["readout_s"],
        jpeg_quality=int(p["jpeg_quality"]),
    )  # fmt: skip
    night = 0.06 if p["night"] else None
    return Conditions(look, wear, shadow, air, sensor, p["exposure_s"], _ROAD_REFLECTANCE, night)


def _placed(p: Parameters, camera: Camera, face: Face, conditions: Conditions) -> PlateScene | None:
    """The scene with the plate so far ahead that it has the wanted height; None where no place gives it."""

    def at(ahead_m: float) -> PlateScene:
        return PlateScene(
            camera, (PlacedFace(face, ahead_m, p["left_m"], p["rotation_deg"]),), p["speed_m_s"],
            conditions.exposure_s, road_reflectance=conditions.road_reflectance, night_light=conditions.night_light,
            shadow=conditions.shadow, air=conditions.air, sensor=conditions.sensor,
        )  # fmt: skip

    best = None
    for ahead in np.geomspace(0.5, 40, 200):
        truth = face_truth(at(float(ahead)), PlacedFace(face, float(ahead), p["left_m"], p["rotation_deg"]))
        if truth.in_view and (best is None or abs(math.log(truth.height_px / p["rows"])) < best[0]):
            best = (abs(math.log(truth.height_px / p["rows"])), float(ahead))
    return at(best[1]) if best is not None and best[0] < 0.1 else None


def _reads_aruco(shot: _Shot, p: Parameters, seed: int) -> bool:
    family = FAMILIES[0]
    face = tag_face(family, 7, shot.conditions, np.random.default_rng([seed, 3]))
    scene = replace(shot.scene, faces=(replace(shot.scene.faces[0], face=face),))
    image = render_plate_scene(*_under_weather(p, scene, shot.background, seed), np.random.default_rng([seed, 4])).image
    return reads_tag(family, 7, image, shot.truth)
