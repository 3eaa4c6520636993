"""``python -m benchmarks.corpus.record [GROUP ...]``: render the groups that have no recordings yet.

What is recorded stays as it is: later changes of the simulation must not change what was promised. So a group that has
recordings is left alone; delete its folder to record it anew, and its minima with it.
"""

from __future__ import annotations

import argparse
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from app.decoders.cerpm.verify import verify_packets
from app.errors import InvalidParameter
from app.markers.magnet import Polarity
from app.planning.cerpm_placement import place_markers
from app.sensors.camera import Camera
from app.simulation.camera import encode_jpeg, render_plate_scene
from app.simulation.conditions import Conditions, at_night, draw_daylight, draw_stress
from app.simulation.magnetic.clutter import Clutter, ferrous_clutter, slab_joints, town_clutter
from app.simulation.magnetic.drive import Course, Scene, SimulatedDrive, Vehicle, simulate_drive
from app.simulation.magnetic.road import PlacedTag, Road, RoadMagnet, line_magnets
from app.simulation.plate_face import plate_face
from app.simulation.plate_scene import PlateScene, face_truth
from app.simulation.radio.attacks import move_claim
from app.simulation.radio.drive import Driver, SatelliteReceiver, drive_past, write_packets, write_poses
from app.simulation.radio.lanes import install_markers, lose_share
from app.simulation.radio.link import Radio
from benchmarks.cerpm.scenes import LIMIT, ROUTE_NAMES, key_of, route, shortened, sign
from benchmarks.corpus.counts import RECORDINGS, write_truth
from benchmarks.corpus.drives import BAR, magnets_row, write_trace
from benchmarks.corpus.frames import camera_row, code_row
from benchmarks.hunt.bars import spoiled_trace, turned_bar, turned_trace
from benchmarks.magnets.drawn_scenes import FORMAT, draw_line_per_turn, draw_vehicle
from benchmarks.magnets.scenes import LEAD_M, random_magnets, random_tag
from benchmarks.plates.schemes import CANDIDATES, draw_places
from benchmarks.plates.sets import draw_light, draw_scenes
from benchmarks.plates.views import draw_background, draw_camera
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
)  # fmt: skip
from benchmarks.scenes.places import draw_occluder, draw_place, scene_under
from benchmarks.scenes.thermal import draw_thermal, render_thermal_scene, warm_face
from benchmarks.video.drive import DriveShape, write_drive

SEED = 20261130
FRAMES = 10
"""[frames] of a group; two of each scheme."""
_PART_PX = (640, 400)
"""[px] of a frame around the plate: whole frames would be eight times as large. Roads are whole photos."""
Photo = np.ndarray

# === Frames with a plate.


class _View(NamedTuple):
    """What a group changes of a fair day."""

    rows_px: tuple[float, float] = (18.0, 60.0)
    conditions: Callable[[np.random.Generator], Conditions] = draw_daylight
    camera: Callable[[np.random.Generator], Camera] = draw_camera
    # of a scene and the photo behind it
    change: Callable[[PlateScene, Photo, np.random.Generator], tuple[PlateScene, Photo]] = lambda s, p, _r: (s, p)


def _light(name: str) -> Callable[[np.random.Generator], Conditions]:
    return lambda rng: draw_light(name, rng)


def _blurred(scene: PlateScene, photo: Photo, rng: np.random.Generator) -> tuple[PlateScene, Photo]:
    sensor = replace(scene.sensor, blur_px=float(rng.uniform(0.9, 1.4)), readout_s=float(rng.uniform(0, 0.02)))
    moving = replace(scene, sensor=sensor, exposure_s=float(rng.uniform(1 / 400, 1 / 200)))
    return shaken(moving, float(rng.uniform(2, 10)), rng), photo


def _hidden(scene: PlateScene, photo: Photo, rng: np.random.Generator) -> tuple[PlateScene, Photo]:
    return replace(scene, occluder=replace(draw_occluder(rng), share=float(rng.uniform(0.05, 0.4)))), photo


def _snowed(scene: PlateScene, photo: Photo, rng: np.random.Generator) -> tuple[PlateScene, Photo]:
    layer = snow(
        float(rng.uniform(0.02, 0.4)), int(rng.integers(1 << 31)), bank=float(rng.uniform(0.1, 0.9)),
        from_deg=float(rng.uniform(0, 360)), patch_m=float(rng.uniform(0.06, 0.3)),
    )  # fmt: skip
    return lay(scene, photo, layer)


def _sanded(scene: PlateScene, photo: Photo, rng: np.random.Generator) -> tuple[PlateScene, Photo]:
    layer = sand(
        float(rng.uniform(0.2, 0.8)), int(rng.integers(1 << 31)), depth=float(rng.uniform(0.4, 0.95)),
        from_deg=float(rng.uniform(0, 360)), patch_m=float(rng.uniform(0.06, 0.3)),
    )  # fmt: skip
    return lay(scene, photo, layer)


def _wetted(scene: PlateScene, photo: Photo, rng: np.random.Generator) -> tuple[PlateScene, Photo]:
    colours = ((0.15, 1.0, 0.4), (0.05, 0.05, 1.0), (0.05, 0.55, 1.0), (0.9, 1.0, 1.0))
    blue, green, red = (float(rng.uniform(0.02, 0.35)) * share for share in colours[int(rng.integers(4))])
    right, along = rng.uniform(-0.5, 0.5, 2).tolist()
    return wet(scene, photo, Water(), (mirrored_lamp(scene, (blue, green, red), right_m=right, along_m=along),))


def _at_dusk(scene: PlateScene, photo: Photo, rng: np.random.Generator) -> tuple[PlateScene, Photo]:
    light = float(10 ** rng.uniform(-2.5, -1))
    return dusk(scene, light, longest_exposure_s=float(rng.uniform(1 / 400, 1 / 200))), photo


def _draw_wide(rng: np.random.Generator) -> Camera:
    return wide_camera(
        1920, 1080, float(rng.uniform(95, 130)), float(rng.uniform(0.3, 1)), height_m=float(rng.uniform(1.2, 2)),
        depression_deg=float(rng.uniform(15, 40)), azimuth_deg=float(rng.normal(0, 8)),
    )  # fmt: skip


_VIEWS: Mapping[str, _View] = {
    "plates-small": _View((11.0, 24.0)),
    "plates-shadow-edge": _View(conditions=_light("shadow-edge")),
    "plates-dapple": _View(conditions=_light("dapple")),
    "plates-glare": _View(conditions=_light("glare")),
    "plates-stained": _View((24.0, 80.0), _light("stained-shade")),
    "plates-worn": _View(conditions=_light("worn")),
    "plates-blurred": _View((22.0, 70.0), change=_blurred),
    "plates-hidden": _View((22.0, 70.0), change=_hidden),
    "plates-snow": _View((24.0, 80.0), change=_snowed),
    "plates-sand": _View((24.0, 80.0), change=_sanded),
    "plates-wet": _View((20.0, 70.0), change=_wetted),
    "plates-dusk": _View((24.0, 80.0), change=_at_dusk),
    "plates-night": _View((24.0, 80.0), lambda rng: at_night(draw_daylight(rng), rng)),
    "plates-wide-lens": _View(camera=_draw_wide),
    "plates-stress": _View((24.0, 80.0), draw_stress),
}


def _record_view(view: _View, folder: Path, rng: np.random.Generator) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    while len(rows) < FRAMES:
        candidate = CANDIDATES[len(rows) % len(CANDIDATES)]
        codes = [candidate.code(*place) for place in draw_places(rng)]
        conditions, camera = view.conditions(rng), view.camera(rng)
        conditions = replace(conditions, sensor=replace(conditions.sensor, jpeg_quality=None))
        face = plate_face(codes[0], candidate.geometry, conditions.look, conditions.wear, rng)
        try:
            placed = draw_place(camera, face, rng, view.rows_px)
        except InvalidParameter:
            continue
        scene = scene_under(conditions, camera, (placed,), float(rng.uniform(2, 33)), rng)
        scene, photo = view.change(scene, draw_background(camera, rng), rng)
        rows.append(_write_part(folder / f"{len(rows):02}.jpg", scene, photo, rng) | {"codes": _rows(codes)})
    return rows


def _rows(codes: Sequence[Any]) -> list[dict[str, Any]]:
    return [code_row(code) for code in codes]


def _write_part(path: Path, scene: PlateScene, photo: Photo, rng: np.random.Generator) -> dict[str, Any]:
    """Render a frame and write its part around the plate."""
    image, truth = render_plate_scene(scene, photo, rng).image, face_truth(scene, scene.faces[0])
    middle, camera = truth.corners_px.mean(axis=0), scene.camera
    size = np.array(_PART_PX)
    low = middle - size * rng.uniform(0.3, 0.7, 2)
    low = np.clip(low, 0, (camera.width_px - size[0], camera.height_px - size[1])).astype(int) // 16 * 16
    part = image[low[1] : low[1] + size[1], low[0] : low[0] + size[0]]
    path.write_bytes(encode_jpeg(np.ascontiguousarray(part), int(rng.integers(72, 90))).tobytes())
    seen = replace(
        camera, width_px=_PART_PX[0], height_px=_PART_PX[1], cx_px=camera.cx_px - float(low[0]),
        cy_px=camera.cy_px - float(low[1]), readout_s=scene.sensor.readout_s * float(size[1]) / camera.height_px,
    )  # fmt: skip
    return {"file": path.name, "corners_px": (truth.corners_px - low).round(2).tolist(), "camera": camera_row(seen)}


def _record_drives(folder: Path, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Five drives of four frames, far to near, in stained shade."""
    rows = []
    for drive, candidate in enumerate(CANDIDATES):
        codes, conditions = [candidate.code(*place) for place in draw_places(rng)], draw_light("stained-shade", rng)
        conditions = replace(conditions, sensor=replace(conditions.sensor, jpeg_quality=None))
        face = plate_face(codes[0], candidate.geometry, conditions.look, conditions.wear, rng)
        scenes = draw_scenes(face, conditions, rng)[-4:]
        photo = draw_background(scenes[0].camera, rng)
        for number, scene in enumerate(scenes):
            row = _write_part(folder / f"{drive}-{number}.jpg", scene, photo, rng)
            rows.append(row | {"codes": _rows(codes), "drive": str(drive)})
    return rows


def _record_thermal(folder: Path, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Heated plates before a bolometer at walking to town speed."""
    rows: list[dict[str, Any]] = []
    camera = Camera.from_field_of_view(640, 512, 50.0)
    while len(rows) < FRAMES:
        candidate = CANDIDATES[len(rows) % len(CANDIDATES)]
        codes, (warmth, sensor) = [candidate.code(*place) for place in draw_places(rng)], draw_thermal(rng)
        face = warm_face(codes[0], candidate.geometry, warmth, rng)
        placed = draw_place(camera, face, rng, (24.0, 90.0))
        scene = PlateScene(camera, (placed,), float(rng.uniform(1, 8)), 0.01)
        name = f"{len(rows):02}.jpg"
        frame = render_thermal_scene(scene, replace(sensor, jpeg_quality=88), draw_background(camera, rng), rng)
        (folder / name).write_bytes(frame.jpeg)
        corners = frame.truths[0].corners_px.round(2).tolist()
        rows.append({"file": name, "corners_px": corners, "camera": camera_row(camera), "codes": _rows(codes)})
    return rows


def _record_video(folder: Path, _rng: np.random.Generator) -> list[dict[str, Any]]:
    """Three seconds past plates, H.264 at 10 Hz."""
    shape = DriveShape(duration_s=3.2, rate_hz=10.0, speed_m_s=14.0, spacing_m=15.0, seed=SEED, readout_s=0.01)
    passed = write_drive(folder / "0.mp4", shape, preset="slow", crf=30)
    plates = [
        {"code": code_row(p.code), "at_m": round(p.at_m, 2), "frames": list(p.frames), "is_hard": p.is_hard}
        for p in passed
    ]
    return [{"file": "0.mp4", "plates": plates}]


# === Traces over magnets.


class _Course(NamedTuple):
    """A drive over magnets, tags and iron."""

    clearance_m: float
    magnets: int = 20
    tags: int = 0
    line: bool = False
    wheels_am2: float | None = None  # drawn
    clutter: str = ""  # ferrous, town, slabs, rails
    yaw_deg: float = 0.0
    fault: str = ""
    bend: bool = False


_COURSES: Mapping[str, Sequence[_Course]] = {
    "magnets-16-to-25-cm": (_Course(0.16), _Course(0.20, bend=True), _Course(0.25)),
    "magnets-30-cm": (_Course(0.30), _Course(0.30, bend=True)),
    "magnets-35-cm": (_Course(0.35), _Course(0.35, bend=True)),
    "magnets-40-cm": (_Course(0.40), _Course(0.40, bend=True)),
    "magnets-45-to-50-cm": (_Course(0.45, wheels_am2=0.4), _Course(0.50, wheels_am2=0.3)),
    "magnets-tags": (_Course(0.18, 0, 5, line=True), _Course(0.28, 0, 5), _Course(0.34, 4, 5, line=True)),
    "magnets-wheels": (
        _Course(0.18, 14, wheels_am2=1.0),
        _Course(0.35, 14, wheels_am2=0.6),
        _Course(0.40, 14, wheels_am2=0.9),
    ),
    "magnets-iron": (_Course(0.18, 10, clutter="ferrous"), _Course(0.30, 10, clutter="town")),
    "magnets-joints": (_Course(0.20, 14, clutter="slabs"), _Course(0.30, 14, clutter="slabs")),
    "magnets-rails": (_Course(0.20, 10, clutter="rails"),),
    "magnets-turned-bar": (_Course(0.18, 14, yaw_deg=4, bend=True), _Course(0.22, 14, yaw_deg=10)),
    "magnets-faulty-bar": tuple(
        _Course(0.20, 14, fault=fault, bend=True)
        for fault in ("two sensors swapped", "one sensor upside down", "array from left to right", "halves mirrored")
    ),
}


def _record_course(courses: Sequence[_Course], folder: Path, rng: np.random.Generator) -> list[dict[str, Any]]:
    rows = []
    for number, course in enumerate(courses):
        drive = _drive(course, rng)
        trace = drive.trace
        if course.yaw_deg:
            trace = turned_trace(trace, BAR, course.yaw_deg)
        if course.fault:
            trace = spoiled_trace(trace, BAR, course.fault, float(rng.random()))
        path = folder / f"{number}.npz"
        write_trace(path, trace)
        rows.append({"file": path.name, "what": course._asdict()} | magnets_row(drive))
    return rows


def _drive(course: _Course, rng: np.random.Generator) -> SimulatedDrive:
    spacing_m = float(rng.uniform(2.2, 4))
    magnets: list[RoadMagnet] = random_magnets(rng, course.magnets, spacing_m)
    first_m = LEAD_M + course.magnets * spacing_m + 5
    tags = [
        PlacedTag(random_tag(rng, FORMAT), first_m + 9 * k, float(rng.uniform(-0.2, 0.2))) for k in range(course.tags)
    ]
    end_m = first_m + 9 * course.tags + 10
    if course.line:
        magnets += line_magnets(first_m, end_m - 8, 3.0, float(rng.choice((-0.65, 0.65))), Polarity.N)
    clutter: list[Clutter] = []
    if course.clutter in ("ferrous", "town"):
        draw = town_clutter(end_m, end_m + 150, rng) if course.clutter == "town" else None
        clutter, end_m = draw or ferrous_clutter(end_m, end_m + 120, 10, rng), end_m + 150
    elif course.clutter == "slabs":
        clutter, end_m = slab_joints(LEAD_M + 1.2, end_m + 40, 5.0), end_m + 40
    elif course.clutter == "rails":
        clutter, end_m = [Clutter("tram rails", end_m + 40, float(rng.uniform(-0.4, 0.4)))], end_m + 80
    vehicle = draw_vehicle(rng, course.clearance_m)
    if course.wheels_am2 is not None:
        vehicle = Vehicle.compact(clearance_m=course.clearance_m, wheel_moment_am2=course.wheels_am2)
    if course.yaw_deg:
        vehicle = replace(vehicle, bar=turned_bar(BAR, course.yaw_deg))
    bends = [(5.0, 0.6 * end_m, float(rng.choice((-1, 1)) * rng.uniform(40, 90)))] if course.bend else []
    driven = Course(float(rng.uniform(11, 22 if not bends else 14)), weave_m=0.06)
    return simulate_drive(Scene(Road(end_m, bends), vehicle, driven, tags=tags, lines=magnets, clutter=clutter), rng)


def _record_turns(folder: Path, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Lines whose magnets are a turn of the wheels apart, or half a turn."""
    rows = []
    for number, (spacing, clearance_m) in enumerate(((1.0, 0.2), (0.5, 0.25), (2.0, 0.33))):
        drive = draw_line_per_turn(rng, spacing=spacing, clearance_m=clearance_m)
        path = folder / f"{number}.npz"
        write_trace(path, drive.trace)
        what = {"spacing_turns": spacing, "clearance_m": clearance_m}
        rows.append({"file": path.name, "what": what} | magnets_row(drive))
    return rows


# === Logs of packets.


_RADIO: Mapping[str, Mapping[str, Any]] = {
    "cerpm-fair": {},
    "cerpm-lost": {"lost": 0.4},
    "cerpm-poor-receiver": {"receiver": SatelliteReceiver(0.3, 1.5, 40.0, 1.0, 1.5)},
    "cerpm-misplaced": {"moved_m": 12.0},
}


def _record_logs(
    folder: Path, rng: np.random.Generator, *, lost: float = 0.0, moved_m: float = 0.0,
    receiver: SatelliteReceiver | None = None,
) -> list[dict[str, Any]]:  # fmt: skip
    """Drives past the markers of two real lanes: packets and track as a ZIP."""
    rows = []
    for number, name in enumerate(ROUTE_NAMES[::2]):
        lane = shortened(route(name), 450.0)
        installed = install_markers(lane, place_markers(lane.left_m, lane.right_m), rng, speed_limit=LIMIT)
        installed = lose_share(installed, lost, rng) if lost else installed
        sent = move_claim(lane, installed, len(installed) // 2, rng, distance_m=moved_m) if moved_m else installed
        radio, driver = Radio(), Driver(speed_m_s=float(rng.uniform(8, 16)))
        passed = drive_past(lane, sent, rng, sign=sign, radio=radio, driver=driver, receiver=receiver)
        path = folder / f"{number}.zip"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("packets.jsonl", write_packets(passed.packets))
            archive.writestr("poses.csv", write_poses(passed.track))
        keys = {int(n): key_of(int(n)) for n in installed.number}
        heard = {p.number for p in verify_packets(list(passed.packets), keys).packets if p.accepted}
        chainages = installed.chainage_m[[int(n) in heard for n in installed.number]]
        step = slice(None, None, 4)
        rows.append({
            "file": path.name, "route": name, "heard": len(heard),
            "span_m": [round(float(chainages.min()), 2), round(float(chainages.max()), 2)],
            "markers": {
                str(int(n)): [round(float(lon), 9), round(float(lat), 9)]
                for n, lon, lat in zip(installed.number, installed.lon_deg, installed.lat_deg, strict=True)
            },
            "left_deg": np.round(np.stack(lane.wgs84_from_enu(lane.left_m), 1)[step], 9).tolist(),
            "right_deg": np.round(np.stack(lane.wgs84_from_enu(lane.right_m), 1)[step], 9).tolist(),
        })  # fmt: skip
    return rows


# === Pictures of others, which stay where they are.


def _list_signs(folder: Path, _rng: np.random.Generator) -> list[dict[str, Any]]:
    """The photos of real AprilTags, and how many tags the library's own test lists."""
    photos = sorted((RECORDINGS.parents[2] / "tests/families/fiducial/apriltags/photos").glob("*.jpg"))
    return [
        {
            "file": str(Path("../../../..") / path.relative_to(RECORDINGS.parents[2])), "dictionary": "apriltag-36h11",
            "number": 0, "signs": sum(bool(line.strip()) for line in path.with_suffix(".txt").open()),
        }
        for path in photos
    ]  # fmt: skip


def _list_roads(_folder: Path, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Real road photos, and plates that a registry would expect on them."""
    photos = sorted((RECORDINGS.parents[1] / "backgrounds").glob("*.jpg"))
    return [
        {
            "file": str(Path("../../..") / path.relative_to(RECORDINGS.parents[1])),
            "codes": _rows([CANDIDATES[k % len(CANDIDATES)].code(*place) for place in draw_places(rng)]),
        }
        for k, path in enumerate(photos)
    ]


def list_recorders() -> dict[str, Callable[[Path, np.random.Generator], list[dict[str, Any]]]]:
    """How each group is recorded, by its name."""
    recorders: dict[str, Callable[[Path, np.random.Generator], list[dict[str, Any]]]] = {}
    for name, view in _VIEWS.items():
        recorders[name] = partial(_record_view, view)
    recorders |= {"plates-drives": _record_drives, "plates-thermal": _record_thermal, "plates-video": _record_video}
    for name, courses in _COURSES.items():
        recorders[name] = partial(_record_course, courses)
    recorders["magnets-wheel-turns"] = _record_turns
    for name, options in _RADIO.items():
        recorders[name] = partial(_record_logs, **options)
    return recorders | {"signs-photos": _list_signs, "roads": _list_roads}


def main() -> None:
    """Record the groups without recordings."""
    recorders = list_recorders()
    parser = argparse.ArgumentParser(prog="python -m benchmarks.corpus.record", description=__doc__)
    parser.add_argument("groups", nargs="*", help="all, if none is named")
    chosen = parser.parse_args().groups or list(recorders)
    cv2.setNumThreads(1)
    for name in recorders:
        folder = RECORDINGS / name
        if name not in chosen or folder.exists():
            continue
        folder.mkdir(parents=True)
        write_truth(folder, recorders[name](folder, np.random.default_rng([SEED, zlib.crc32(name.encode())])))
        size = sum(path.stat().st_size for path in folder.iterdir())
        print(f"{name}: {len(list(folder.iterdir())) - 1} files, {size / 1e6:.2f} MB", flush=True)


if __name__ == "__main__":
    main()
