"""Frames to records: readings of the decoder and of its peers in each frame, compared with the truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from app.decoders.plate.confirm import confirm_frames
from app.decoders.plate.fit import FINE_CORNER_SCATTER
from app.decoders.plate.paper import decode_plates_paper
from app.decoders.plate.pose import camera_position_m, locate_moving_plate
from app.decoders.plate.reader import decode_plates
from app.markers.plate import PlateCode
from app.markers.reading import PlateOutcome, PlateReading
from app.simulation.plate_scene import FaceTruth
from benchmarks.plates.peers import FAMILIES, reads_tag, tag_face
from benchmarks.plates.sets import LIGHT, Job, Shot, Unseen, replace_face, shoot


@dataclass(frozen=True, slots=True)
class PositionAccuracy:
    """Errors of a camera's position at the time of the frame, with the speed known where the shutter rolls."""

    error_m: float  # [m] distance to the truth
    # across, along and up in the plate frame: the error is below two reported standard deviations
    within_2_sigma: tuple[bool, ...]
    # [m] distance to the truth of the position from true corners with errors as if those of the pixels were independent
    noise_error_m: float


@dataclass(frozen=True, slots=True)
class Record:
    """One frame."""

    # `set_name`, `label`, `seed`, `share`: where it comes from; ``share`` of that set's frames was taken
    set_name: str
    label: str
    seed: int
    share: float
    # `index`, `number`: job and place in it: what ``python -m benchmarks.plates.show`` takes
    index: int
    number: int
    height_px: float  # of the plate's image; NaN where there is none
    # `decoded`, `decoded_known`: its digits were read from the frame alone, or with the codebook
    decoded: bool = False
    decoded_known: bool = False
    # `wrong`, `wrong_known`: digits returned as valid that are on no plate in the frame
    wrong: tuple[str, ...] = ()
    wrong_known: tuple[str, ...] = ()
    # `decoded_paper`, `wrong_paper`: the same of the paper's own algorithm, in the trials
    decoded_paper: bool = False
    wrong_paper: tuple[str, ...] = ()
    tentative: bool = False  # its digits were returned as likely, from the frame alone
    wrong_tentative: tuple[str, ...] = ()  # likely digits that are on no plate in the frame
    # of each reading with digits or likely ones, from the frame alone: its confidence, whether it is sure, and whether
    # it is right
    claims: tuple[tuple[float, bool, bool], ...] = ()
    # `together`, `wrong_together`: as `decoded` and `wrong`, with what the frames of its drive confirm together
    together: bool = False
    wrong_together: tuple[str, ...] = ()
    corner_errors_px: tuple[float, ...] = ()  # distance of each corner to the truth, where decoded
    position_error_m: float = math.nan  # distance of the camera's position to the truth, where decoded; else NaN
    rolling: bool = False  # the camera has a rolling shutter
    accuracy: PositionAccuracy | None = None  # of the camera's position, where decoded in a trial
    tags: tuple[bool, ...] | None = None  # whether each peer's tag was read in the same scene


def evaluate_job(job: Job) -> list[Record]:
    """Render and evaluate the frames of a job."""
    cv2.setNumThreads(1)
    records, frames = [], []
    for number, shot in enumerate(shoot(job)):
        record, readings = _evaluate(job, number, shot)
        records.append(record)
        if job.set_name in LIGHT and isinstance(shot, Shot):
            frames.append((shot.code, shot.frame.truths[0], readings))
    if frames:
        for label in dict.fromkeys(record.label for record in records):
            _add_together([place for place, record in enumerate(records) if record.label == label], frames, records)
    return records


def _add_together(
    drive: list[int], frames: list[tuple[PlateCode | None, FaceTruth, list[PlateReading]]], records: list[Record]
) -> None:
    """Complete the records of one drive by what its frames confirm together."""
    confirmed = confirm_frames([(place, frames[place][2]) for place in drive])
    for place in drive:
        code, truth, readings = frames[place]
        hit, wrong = find_right(confirmed.get(place, readings), code, truth)
        records[place] = replace(records[place], together=hit is not None, wrong_together=wrong)


def _evaluate(job: Job, number: int, shot: Shot | Unseen) -> tuple[Record, list[PlateReading]]:
    if isinstance(shot, Unseen):
        tags = (False,) * len(FAMILIES) if job.peers else None
        return Record(job.set_name, shot.label, job.seed, job.share, job.index, number, shot.height_px, tags=tags), []
    truth = shot.frame.truths[0] if shot.code is not None else None
    alone = decode_plates(shot.frame.image, camera=shot.camera, thermal=shot.thermal)
    known = decode_plates(shot.frame.image, camera=shot.camera, codebook=shot.codebook, thermal=shot.thermal)
    hit, wrong = find_right(alone, shot.code, truth)
    hit_known, wrong_known = find_right(known, shot.code, truth)
    by_paper = decode_plates_paper(shot.frame.image) if job.set_name == "trial" else []
    hit_paper, wrong_paper = find_right(by_paper, shot.code, truth)
    likely = [r.likely_code.digits for r in alone if r.likely_code is not None]
    record = Record(
        set_name=job.set_name,
        label=shot.label,
        seed=job.seed,
        share=job.share,
        index=job.index,
        number=number,
        height_px=truth.height_px if truth else math.nan,
        decoded=hit is not None,
        decoded_known=hit_known is not None,
        wrong=wrong,
        wrong_known=wrong_known,
        decoded_paper=hit_paper is not None,
        wrong_paper=wrong_paper,
        claims=tuple(
            (one.confidence, one.code is not None, shot.code is not None and shown.digits == shot.code.digits)
            for one in alone
            if (shown := one.code or one.likely_code) is not None
        ),
        tentative=shot.code is not None and hit is None and shot.code.digits in likely,
        wrong_tentative=tuple(digits for digits in likely if shot.code is None or digits != shot.code.digits),
        corner_errors_px=_corner_errors(hit, truth),
        position_error_m=_position_error(hit, truth),
        rolling=shot.scene is not None and shot.scene.sensor.readout_s > 0,
        accuracy=_position_accuracy(hit, shot, np.random.default_rng([job.seed, job.index, number])),
        tags=_evaluate_tags(job, shot, truth),
    )
    return record, alone


def find_right(
    readings: Sequence[PlateReading], code: PlateCode | None, truth: FaceTruth | None
) -> tuple[PlateReading | None, tuple[str, ...]]:
    """The reading that is right in digits and place, and the digits of all that are not."""
    hit, wrong = None, []
    for reading in readings:
        if reading.outcome is not PlateOutcome.READ or reading.code is None:
            continue
        right = code is not None and reading.code.digits == code.digits and _is_there(reading, truth)
        if right and hit is None:
            hit = reading
        elif not right:
            wrong.append(reading.code.digits)
    return hit, tuple(wrong)


def _is_there(reading: PlateReading, truth: FaceTruth | None) -> bool:
    if truth is None or reading.corners_px is None:
        return False
    apart = np.linalg.norm(reading.corners_px.mean(axis=0) - truth.corners_px.mean(axis=0))
    return bool(apart < max(truth.width_px, truth.height_px) / 2)


def _corner_errors(hit: PlateReading | None, truth: FaceTruth | None) -> tuple[float, ...]:
    if hit is None or hit.corners_px is None or truth is None:
        return ()
    return tuple(float(v) for v in np.linalg.norm(hit.corners_px - truth.corners_px, axis=1))


def _position_error(hit: PlateReading | None, truth: FaceTruth | None) -> float:
    if hit is None or hit.pose is None or truth is None:
        return math.nan
    return float(np.linalg.norm(camera_position_m(hit.pose) - truth.camera_position_m))


def _position_accuracy(
    hit: PlateReading | None, shot: Shot | Unseen, rng: np.random.Generator
) -> PositionAccuracy | None:
    if isinstance(shot, Unseen) or hit is None or hit.pose is None or shot.scene is None:
        return None
    assert hit.corners_px is not None
    assert hit.corners_covariance_px2 is not None
    assert hit.geometry is not None
    scene, placed = shot.scene, shot.scene.faces[0]
    camera, geometry = replace(shot.camera, readout_s=scene.sensor.readout_s), hit.geometry
    from_face_m = np.array([-placed.ahead_m, -placed.left_m, camera.height_m])
    truth_m = placed.ground_from_face.T @ from_face_m  # at the middle row's time
    drawn = rng.multivariate_normal(np.zeros(8), hit.corners_covariance_px2 / FINE_CORNER_SCATTER).reshape(4, 2)
    pose, at_limit = (
        locate_moving_plate(corners_px, hit.corners_covariance_px2, geometry, camera, scene.speed_m_s)
        for corners_px in (hit.corners_px, shot.frame.truths[0].corners_px + drawn)
    )
    if pose is None or at_limit is None:
        return None
    error_m = camera_position_m(pose) - truth_m
    x, y, z = pose.translation_m
    by_pose = np.hstack([np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.eye(3)])  # of the negative position
    covariance = pose.rotation.T @ by_pose @ pose.covariance @ by_pose.T @ pose.rotation
    return PositionAccuracy(
        float(np.linalg.norm(error_m)),
        tuple(bool(v) for v in np.abs(error_m) < 2 * np.sqrt(np.diag(covariance))),
        float(np.linalg.norm(camera_position_m(at_limit) - truth_m)),
    )


def _evaluate_tags(job: Job, shot: Shot, truth: FaceTruth | None) -> tuple[bool, ...] | None:
    if not job.peers or truth is None or shot.conditions is None:
        return None
    read = []
    for family in FAMILIES:
        rng = np.random.default_rng([shot.noise_seed, family.modules])
        number = int(rng.integers(50))
        frame = replace_face(shot, tag_face(family, number, shot.conditions, rng))
        read.append(reads_tag(family, number, frame.image, truth))
    return tuple(read)
