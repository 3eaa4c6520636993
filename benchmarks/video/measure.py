"""Decoding a video as a job does, in this process: counts of plates, wrong digits, and processor time."""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from app.decoders.plate.accumulate import MAX_ODD_UNITS
from app.decoders.plate.unit_likelihoods import LARGE_UNIT_PX, code_units
from app.decoders.plate.video_search import FoundPlate
from app.decoding.frames import PlateSearch
from app.families.plate.plates import PLATE
from app.formats.format import SpooledFile
from app.formats.video_file import VideoFile, VideoKind
from app.markers.plate import EXPECTED_GEOMETRIES, PlateCode
from app.sensors.camera import Camera
from app.services.decodes.video_tasks import decode_segment, index_frames
from benchmarks.video.drive import PassedPlate


@dataclass(slots=True)
class VideoScore:
    """What decoding one video gave."""

    frames: int = 0
    decoded: int = 0
    # `processor_s`, `codec_s`: [s] of the whole decode, and of the codec's part of the wall time
    processor_s: float = 0.0
    codec_s: float = 0.0
    # `plates`, `alone`, `together`: plates that were in view in at least one frame, read from a single frame (also
    # where all frames together take its digits back), and as the video's result has them
    plates: int = 0
    alone: int = 0
    together: int = 0
    # `hard`, `hard_alone`, `hard_together`: the same of plates under drawn degradations
    hard: int = 0
    hard_alone: int = 0
    hard_together: int = 0
    # `wrong_alone`, `wrong_together`: different digits than any plate in view has
    wrong_alone: int = 0
    wrong_together: int = 0
    # `missed`, `wrong`: plates that were not read, and digits that no plate in view has
    missed: list[str] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    # of the residuals of two frames of one plate, for each pair of frames with large units
    correlations: list[float] = field(default_factory=list)
    doubt: float = 0.0  # wrong plates that the stated confidences expect among those that were read together


def measure_video(
    path: Path, truth: Sequence[PassedPlate], camera: Camera, codebook: Sequence[PlateCode] = ()
) -> VideoScore:
    """Decode a video and compare what was read with the truth."""
    began_s = time.process_time()
    index = index_frames(VideoFile(SpooledFile.at(path), VideoKind.MP4))
    score = VideoScore(frames=len(index.stamps))
    found: list[FoundPlate] = []
    wanted = {PLATE.name: PlateSearch(camera, tuple(codebook), EXPECTED_GEOMETRIES)}
    for number in range(len(index.segments)):
        result = decode_segment(index, number, wanted)
        score.decoded += result.decoded
        score.codec_s += result.load_ms / 1e3
        found += result.plates
    score.processor_s = time.process_time() - began_s
    _compare(score, truth, found)
    return score


def _compare(score: VideoScore, truth: Sequence[PassedPlate], found: Sequence[FoundPlate]) -> None:
    in_view: dict[int, set[str]] = {}
    for plate in truth:
        for frame in range(min(plate.frames, default=0) - 2, max(plate.frames, default=-3) + 3):
            in_view.setdefault(frame, set()).add(plate.code.digits)
    alone: set[str] = set()
    together: set[str] = set()
    for one in found:
        digits = one.reading.digits
        expected = set().union(*(in_view.get(seen.frame, set()) for seen in one.seen))
        singles = {seen.reading.digits for seen in one.seen if seen.frame in one.alone} | set(one.taken_back)
        false = {single for single in singles if single is not None} - expected
        score.wrong_alone += len(false)
        if digits is not None and digits not in expected:
            false.add(digits)
        score.wrong += [f"{text} in frames {one.seen[0].frame} to {one.seen[-1].frame}" for text in sorted(false)]
        alone |= {single for single in singles if single in expected and single is not None}
        if digits is not None:
            score.wrong_together += digits not in expected
            score.doubt += 1 - one.reading.confidence
            together |= {digits} & expected
    for plate in truth:
        if not plate.frames:
            continue
        score.correlations += _correlations(plate, found)
        score.plates += 1
        score.alone += plate.code.digits in alone
        score.together += plate.code.digits in together
        score.hard += plate.is_hard
        score.hard_alone += plate.is_hard and plate.code.digits in alone
        score.hard_together += plate.is_hard and plate.code.digits in together
        if plate.code.digits not in together:
            score.missed.append(f"{plate.code.digits} at {plate.at_m:.0f} m, frames {plate.frames}")


def _correlations(plate: PassedPlate, found: Sequence[FoundPlate]) -> list[float]:
    """How much the residuals of the true units in two frames resemble each other, whitened by the model."""
    code = plate.code
    dark = code_units(code)
    residuals = []
    for seen in (seen for one in found for seen in one.seen if seen.frame in plate.frames):
        evidence = seen.evidence
        if evidence is None or evidence.geometry.n != code.n or evidence.unit_px < LARGE_UNIT_PX:
            continue
        units = evidence.units
        odd = dark.astype(float) - units.dark
        if np.abs(odd).mean() <= MAX_ODD_UNITS:
            whitened = np.linalg.cholesky(units.weight).T @ (units.residual + units.contrast * odd)
            residuals.append((whitened - whitened.mean()) / whitened.std())
    return [float((a * b).mean()) for a, b in itertools.combinations(residuals, 2)]
