"""Groups of frames: plates in colour and thermal frames, drives of them, a video, signs, and roads with neither."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from app.decoders.fiducial import FiducialOutcome, decode_fiducials
from app.decoders.plate.confirm import confirm_frames
from app.decoders.plate.reader import decode_plates
from app.markers.fiducial import FiducialCode
from app.markers.plate import PlateCode, PlateScheme
from app.markers.reading import PlateOutcome, PlateReading
from app.sensors.camera import Camera
from app.values import Floats
from benchmarks.corpus.counts import Counts, Tally
from benchmarks.video.drive import CAMERA, PassedPlate
from benchmarks.video.measure import measure_video

Image = np.ndarray

# === Frames and cameras of a truth.


def code_row(code: PlateCode) -> dict[str, Any]:
    """A plate's code for a truth."""
    return {"digits": code.digits, "scheme": str(code.scheme), "n": code.n, "check_digits": code.check_digits}


def _code(row: Mapping[str, Any]) -> PlateCode:
    return PlateCode(row["digits"], PlateScheme(row["scheme"]), row["n"], row["check_digits"])


def camera_row(camera: Camera) -> dict[str, Any]:
    """A camera for a truth."""
    return {name: value for name, value in asdict(camera).items() if name not in ("forward_m", "left_m")}


def _camera(row: Mapping[str, Any]) -> Camera:
    return Camera(**{**row, "distortion": tuple(row["distortion"])})


def _read_image(path: Path) -> Image:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None, path
    return np.asarray(image, np.uint8)


def _turned(image: Image, corners_px: Floats, camera: Camera) -> tuple[Image, Floats, Camera]:
    """The frame of a camera that is mounted upside down."""
    far = np.array([image.shape[1] - 1, image.shape[0] - 1])
    k = camera.distortion
    mirrored = (*k[:2], -k[2], -k[3], *k[4:]) if k else ()
    around = replace(
        camera, cx_px=far[0] - camera.cx_px, cy_px=far[1] - camera.cy_px, roll_deg=camera.roll_deg + 180,
        distortion=mirrored, readout_s=0.0,
    )  # fmt: skip
    return np.ascontiguousarray(np.rot90(image, 2)), far - corners_px, around


def _halved(image: Image, corners_px: Floats, camera: Camera) -> tuple[Image, Floats, Camera]:
    """The frame at half its size."""
    size = (image.shape[1] // 2, image.shape[0] // 2)
    small = replace(
        camera, width_px=size[0], height_px=size[1], fx_px=camera.fx_px / 2, fy_px=camera.fy_px / 2,
        cx_px=(camera.cx_px - 0.5) / 2, cy_px=(camera.cy_px - 0.5) / 2,
    )  # fmt: skip
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA)), (corners_px - 0.5) / 2, small


# === Plates.


def _judge(readings: Sequence[PlateReading], digits: str, corners_px: Floats, name: str) -> tuple[int, list[str]]:
    """Whether the plate is read, and the sure readings that are not it."""
    hit, wrong = 0, []
    reach = float(np.ptp(corners_px, axis=0).max()) / 2
    for reading in readings:
        if reading.outcome is not PlateOutcome.READ or reading.code is None:
            continue
        near = reading.corners_px is not None and (
            float(np.linalg.norm(np.mean(reading.corners_px, axis=0) - corners_px.mean(axis=0))) < reach
        )
        if reading.code.digits == digits and near:
            hit = 1
        else:
            wrong.append(f"{name}: {reading.code.digits}")
    return hit, wrong


def _read_plates(folder: Path, truth: Sequence[Any], *, thermal: bool) -> Counts:
    """Each frame alone, with the registry, turned, and at half size; frames of one drive also together."""
    tally = Tally()
    drives: dict[str, list[tuple[list[PlateReading], str, Floats, str]]] = {}
    for row in truth:
        name, codes = row["file"], tuple(_code(one) for one in row["codes"])
        digits, frame = codes[0].digits, (_read_image(folder / name), np.array(row["corners_px"]))
        image, corners, camera = (*frame, _camera(row["camera"]))
        alone = decode_plates(image, camera=camera, thermal=thermal)
        tally.add("alone", 1, *_judge(alone, digits, corners, name))
        known = decode_plates(image, camera=camera, codebook=codes, thermal=thermal)
        tally.add("with the registry", 1, *_judge(known, digits, corners, name))
        for way, change in (("turned by 180 degrees", _turned), ("at half size", _halved)):
            changed, moved, other = change(image, corners, camera)
            found = decode_plates(changed, camera=other, thermal=thermal)
            tally.add(way, 1, *_judge(found, digits, moved, name))
        tally.add("camera not declared", 1, *_judge(decode_plates(image, thermal=thermal), digits, corners, name))
        if "drive" in row:
            drives.setdefault(row["drive"], []).append((alone, digits, corners, name))
    for shown in drives.values():
        confirmed = confirm_frames([(k, one[0]) for k, one in enumerate(shown)])
        for k, (alone, digits, corners, name) in enumerate(shown):
            tally.add("with the drive's frames", 1, *_judge(confirmed.get(k, alone), digits, corners, name))
    return tally.counts


def read_plate_frames(folder: Path, truth: Sequence[Any]) -> Counts:
    """Plates in colour frames."""
    return _read_plates(folder, truth, thermal=False)


def read_thermal_frames(folder: Path, truth: Sequence[Any]) -> Counts:
    """Heated plates in thermal frames."""
    return _read_plates(folder, truth, thermal=True)


def read_video(folder: Path, truth: Sequence[Any]) -> Counts:
    """Plates that a video passes, as a job decodes it."""
    tally = Tally()
    for row in truth:
        passed = [PassedPlate(_code(p["code"]), p["at_m"], tuple(p["frames"]), p["is_hard"]) for p in row["plates"]]
        for way, codebook in (("alone", ()), ("with the registry", tuple(p.code for p in passed))):
            score = measure_video(folder / row["file"], passed, CAMERA, codebook)
            tally.add(way, score.plates, score.together, [f"{row['file']}: {one}" for one in score.wrong])
    return tally.counts


# === Signs, and roads with neither plates nor signs.


def read_signs(folder: Path, truth: Sequence[Any]) -> Counts:
    """Fiducial signs in photos: as they are, turned, at half size, and in grey."""
    tally = Tally()
    for row in truth:
        image, expected = _read_image((folder / row["file"]).resolve()), FiducialCode(row["dictionary"], row["number"])
        camera, nowhere = Camera.from_field_of_view(image.shape[1], image.shape[0], 60.0), np.zeros((4, 2))
        views = {
            "as it is": image,
            "turned by 180 degrees": _turned(image, nowhere, camera)[0],
            "at half size": _halved(image, nowhere, camera)[0],
            "in grey": np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)),
        }
        for way, view in views.items():
            codes = [one.code for one in decode_fiducials(view) if one.outcome is FiducialOutcome.READ]
            wrong = [f"{row['file']}: {code.text}" for code in codes if code is not None and code != expected]
            tally.add(way, row["signs"], min(codes.count(expected), row["signs"]), wrong)
    return tally.counts


def read_roads(folder: Path, truth: Sequence[Any]) -> Counts:
    """Real road photos without a marker, read in every way: all that is read is wrong."""
    tally = Tally()
    for row in truth:
        path = (folder / row["file"]).resolve()
        image, codes = _read_image(path), tuple(_code(one) for one in row["codes"])
        camera, nowhere = Camera.from_field_of_view(image.shape[1], image.shape[0], 65.0), np.zeros((4, 2))
        views = {
            "as it is": image,
            "turned by 180 degrees": _turned(image, nowhere, camera)[0],
            "mirrored": np.ascontiguousarray(image[:, ::-1]),
            "at half size": _halved(image, nowhere, camera)[0],
        }
        for way, view in views.items():
            grey = np.asarray(cv2.cvtColor(view, cv2.COLOR_BGR2GRAY), np.uint8)
            read: list[Any] = [*decode_plates(view), *decode_plates(view, codebook=codes)]
            read += [*decode_plates(grey, thermal=True), *decode_fiducials(view)]
            wrong = [f"{path.name}: {one.code}" for one in read if one.code is not None]
            tally.add(way, 0, 0, wrong)
    return tally.counts
