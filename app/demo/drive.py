"""Frames of the demo's drives over plates on a real lane, rendered in front of real road photos."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from app.geodesy import enu_from_heading, enu_from_wgs84, wgs84_from_enu
from app.markers.plate import PlateCode, PlateScheme, recommended_geometry
from app.sensors.camera import Camera
from app.simulation.backgrounds import road_background, road_photos
from app.simulation.camera import render_plate_scene
from app.simulation.conditions import Drive, draw_daylight, drive_over_plate
from app.simulation.plate_face import plate_face
from app.simulation.plate_scene import PlateScene, face_truth
from app.values import JsonObject

# === A lane's boundaries -> places on its centre line.


_STEP_M = 0.5


@dataclass(frozen=True, slots=True)
class LanePlace:
    """A place on a lane's centre line."""

    # `lon_deg`, `lat_deg`: [deg]
    lon_deg: float
    lat_deg: float
    heading_deg: float  # [deg] direction of travel, clockwise from true north
    chainage_m: float  # [m] along the lane


def list_lane_places(lane: JsonObject, chainages_m: npt.ArrayLike, height_m: float) -> list[LanePlace]:
    """Places along a lane.

    Parameters
    ----------
    lane : dict
        GeoJSON with one line string for the left and one for the right boundary (`side` L, R), in direction of travel.
    chainages_m : array_like
        From the lane's beginning. [m]
    height_m : float
        Ellipsoidal height of the road. [m]
    """
    sides = {feature["properties"]["side"]: feature["geometry"]["coordinates"] for feature in lane["features"]}
    lon_deg, lat_deg = sides["L"][0]
    origin = (lon_deg, lat_deg, height_m)
    left_m, right_m = (
        np.array([enu_from_wgs84(lon, lat, height_m, origin)[:2] for lon, lat in sides[side]]) for side in "LR"
    )
    centre_m = _centre_line(left_m, right_m)
    along_m = _chainages(centre_m)
    places = []
    for chainage in np.atleast_1d(np.asarray(chainages_m, float)):
        at, before, after = (_at(centre_m, along_m, chainage + d) for d in (0.0, -_STEP_M, _STEP_M))
        east, north = after - before
        lon, lat, _height = wgs84_from_enu(np.array([*at, 0.0]), origin)
        places.append(LanePlace(lon, lat, math.degrees(math.atan2(east, north)) % 360.0, float(chainage)))
    return places


def _centre_line(left_m: npt.NDArray[np.float64], right_m: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Midpoints of boundary points at the same share of the boundaries' lengths, shape (N, 2). [m]"""
    along_left, along_right = _chainages(left_m), _chainages(right_m)
    shares = np.linspace(0, 1, max(int(along_left[-1] / _STEP_M), 2))
    mean: npt.NDArray[np.float64] = (
        _at(left_m, along_left, shares * along_left[-1]) + _at(right_m, along_right, shares * along_right[-1])
    ) / 2
    return mean


def _chainages(line_m: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    lengths = np.linalg.norm(np.diff(line_m, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(lengths)])


def _at(
    line_m: npt.NDArray[np.float64], along_m: npt.NDArray[np.float64], chainage_m: float | npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    return np.stack([np.interp(chainage_m, along_m, line_m[:, k]) for k in range(2)], axis=-1)


# === Frames of the demo's drives over plates on a real lane, rendered in front of real road photos.


DATA = Path(__file__).parent / "data"
PAPER_DIGITS = "023792168411"
CAMERA = Camera.from_field_of_view(1920, 1080, 70.0, height_m=1.57, depression_deg=23.0, forward_m=1.2)
SPEED_KMH = 30.0
FPS = 30.0
MIN_ROWS = 8.0  # a unit is one pixel high: from here on frames are counted
SURVEY_RMSE_M = 0.01
SURVEY_HEADING_RMSE_DEG = 0.1
COARSE_ERROR_M = (2.0, 5.0)
_ROAD_HEIGHT_M = 165.0
_FIRST_M, _SPACING_M = 40.0, 28.0
_CODES: tuple[dict[str, object], ...] = (
    {"scheme": "position-robust"},
    {"scheme": "position-check", "check_digits": 2},
    {"scheme": "position", "digits": PAPER_DIGITS, "allow_mismatched_digits": True},
    {"scheme": "position-robust"},
    {"scheme": "id", "registry_number": 0xC0FFEE42},
    {"scheme": "id", "registry_number": 0x5EEDBEAD},
)


@dataclass(frozen=True, slots=True)
class DemoPlate:
    """A plate on the lane: where it truly lies, and how it is registered."""

    place: LanePlace
    body: dict[str, object]


@dataclass(frozen=True, slots=True)
class DemoFrame:
    """A frame and the truth about it."""

    jpeg: bytes
    rows: float  # [px] height of the plate's image
    # `lon_deg`, `lat_deg`, `heading_deg`: [deg] of the vehicle
    lon_deg: float
    lat_deg: float
    heading_deg: float
    context: dict[str, object]  # what is uploaded with the frame: a coarse position some metres off, heading, camera


def list_plates(rng: np.random.Generator) -> list[DemoPlate]:
    """Plates along the lane, surveyed within a centimetre."""
    lane = json.loads((DATA / "lane.geojson").read_text())
    places = list_lane_places(lane, _FIRST_M + _SPACING_M * np.arange(len(_CODES)), _ROAD_HEIGHT_M)
    return [DemoPlate(place, _survey(place, code, rng)) for place, code in zip(places, _CODES, strict=True)]


def _survey(place: LanePlace, code: dict[str, object], rng: np.random.Generator) -> dict[str, object]:
    """The plate as a survey crew registers it: position and heading with the errors of a survey."""
    error_m = rng.standard_normal(3) * SURVEY_RMSE_M / np.sqrt(2)
    lon, lat, height = wgs84_from_enu(error_m, (place.lon_deg, place.lat_deg, _ROAD_HEIGHT_M))
    heading_deg = (place.heading_deg + SURVEY_HEADING_RMSE_DEG * rng.standard_normal()) % 360
    return {
        "position": {
            "lon_deg": lon,
            "lat_deg": lat,
            "height_m": height,
            "realization": "ITRF2014",
            "epoch": 2026.4,
            "horizontal_rmse_m": SURVEY_RMSE_M,
            "vertical_rmse_m": SURVEY_RMSE_M,
            "survey_method": "simulated GNSS RTK",
        },
        "heading_deg": heading_deg,
        "heading_rmse_deg": SURVEY_HEADING_RMSE_DEG,
        "status": "surveyed",
        "road": "Karlsruhe, demo lane",
        "measure_m": place.chainage_m,
        "code": code,
    }


def drive_over(place: LanePlace, code: PlateCode, rng: np.random.Generator) -> Iterator[DemoFrame]:
    """Frames of a pass over a plate at 30 km/h and 30 frames a second, far to near, in fair weather.

    The camera has a global shutter; light, lens, sensor and the plate's paint are drawn.
    """
    conditions = draw_daylight(rng)
    sensor = replace(conditions.sensor, readout_s=0.0)
    photos = road_photos()
    background = road_background(photos[int(rng.integers(len(photos)))], CAMERA, rng)
    drive = Drive(
        camera=CAMERA,
        face=plate_face(code, recommended_geometry(code.scheme, n=code.n), conditions.look, conditions.wear, rng),
        speed_m_s=SPEED_KMH / 3.6,
        fps=FPS,
        exposure_s=conditions.exposure_s,
        left_m=float(rng.normal(0, 0.15)),
        rotation_deg=float(rng.normal(0, 2)),
        road_reflectance=conditions.road_reflectance,
        air=conditions.air,
        sensor=sensor,
    )
    for scene in drive_over_plate(drive, rng):
        rows = face_truth(scene, scene.faces[0]).height_px
        if rows >= MIN_ROWS:
            frame = render_plate_scene(scene, background, rng)
            yield _with_truth(frame.jpeg, rows, scene, place, rng)


def _with_truth(jpeg: bytes, rows: float, scene: PlateScene, place: LanePlace, rng: np.random.Generator) -> DemoFrame:
    placed = scene.faces[0]
    heading_deg = (place.heading_deg - placed.rotation_deg) % 360.0
    ground_from_vehicle = scene.camera_from_ground.T @ scene.camera.camera_from_vehicle
    vehicle_ground_m = (0.0, 0.0, scene.camera.height_m) - ground_from_vehicle @ scene.camera.position_vehicle_m
    x, y, z = vehicle_ground_m - (placed.ahead_m, placed.left_m, 0.0)
    vehicle_enu_m = enu_from_heading(heading_deg) @ np.array([-y, x, z])
    origin = (place.lon_deg, place.lat_deg, _ROAD_HEIGHT_M)
    lon, lat, _height = wgs84_from_enu(vehicle_enu_m, origin)
    off_m, towards = rng.uniform(*COARSE_ERROR_M), rng.uniform(0, 2 * np.pi)
    off_enu_m = off_m * np.array([np.cos(towards), np.sin(towards), 0.0])
    coarse_lon, coarse_lat, _height = wgs84_from_enu(vehicle_enu_m + off_enu_m, origin)
    context = {
        "coarse_position": {"lon_deg": coarse_lon, "lat_deg": coarse_lat, "accuracy_m": 10.0},
        "heading_deg": (heading_deg + 3.0 * rng.standard_normal()) % 360.0,
        "captured_at": "2026-06-01T08:00:00Z",
        "camera": {
            "width_px": CAMERA.width_px,
            "height_px": CAMERA.height_px,
            "horizontal_fov_deg": 70.0,
            "height_m": CAMERA.height_m,
            "depression_deg": CAMERA.depression_deg,
            "forward_m": CAMERA.forward_m,
        },
    }
    return DemoFrame(jpeg, rows, lon, lat, heading_deg, context)


def registered_code(marker: JsonObject) -> PlateCode:
    """The code of a marker as the API describes it."""
    code = marker["code"]
    scheme = PlateScheme(code["scheme"])
    return PlateCode(code["digits"], scheme, marker["geometry"]["n"], code["check_digits"] or 1)
