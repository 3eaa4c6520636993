"""Processor time a frame: the decoder and cv2.aruco on the same frames, in turns, in one thread."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
import numpy.typing as npt

from app.decoders.plate.reader import decode_plates
from app.formats.images import load_image
from benchmarks.plates.peers import FAMILIES, TagFamily, detector, tag_face
from benchmarks.plates.sets import Job, Shot, Unseen, replace_face, shoot
from benchmarks.plates.stages import measure_stages

Image = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Timing:
    """Milliseconds of the processor a frame."""

    what: str
    frames: str
    median_ms: float
    mean_ms: float
    worst_ms: float


@dataclass(frozen=True, slots=True)
class StageTiming:
    """Mean milliseconds of the processor that a stage of the decoder takes of a frame, in one group of frames."""

    stage: str
    frames: str
    mean_ms: float


def measure_speed(seed: int, frames: int) -> tuple[list[Timing], list[StageTiming]]:
    """Median and mean processor time a frame of the decoder and the peers, by what is in view.

    Frames with a plate in clear light come from the trials at all distances, those in shade from drives under leaves;
    the peers see their tag in the plate's place. Frames without one are a fourth each of the plate-free set: roads and
    photos as they are, and those with many coloured things. Every call is timed by itself, the decoders take turns.
    The times of the decoder's stages are of a second run of the same frames.
    """
    cv2.setNumThreads(1)
    groups: dict[str, list[Shot | Unseen]] = {
        "plate in clear light": list(_trial_shots(seed, frames)),
        "plate in shade": list(shoot(Job("dapple", 0, seed, frames))),
        "no plate": list(shoot(Job("free", 0, seed, 4 * frames)))[0::4],
        "no plate, clutter": list(shoot(Job("free", 1, seed, 4 * frames)))[3::4],
    }
    timings: list[Timing] = []
    stages: list[StageTiming] = []
    for name, shots in groups.items():
        seen = [shot for shot in shots if isinstance(shot, Shot)]
        timings += _measure(name, seen, seed)
        found = measure_stages([shot.frame.image for shot in seen])
        stages += [StageTiming(stage, name, mean_ms) for stage, mean_ms in found.items()]
    return timings, stages


def _trial_shots(seed: int, frames: int) -> list[Shot]:
    shots: list[Shot] = []
    trials = (0, 3, 6, 9)
    for index in trials:
        seen = [s for s in shoot(Job("trial", index, seed, 0)) if isinstance(s, Shot)]
        step = max(len(seen) * len(trials) // frames, 1)
        shots += seen[::step]
    return shots[:frames]


def _measure(name: str, shots: list[Shot], seed: int) -> list[Timing]:
    contenders: list[tuple[str, list[Callable[[], object]]]] = [
        ("decode_plates", [partial(decode_plates, s.frame.image) for s in shots]),
        ("JPEG bytes to digits", [partial(_decode_bytes, s.frame.jpeg) for s in shots]),
    ]
    for family in FAMILIES:
        images, find = [_tagged(s, family, seed) for s in shots], detector(family)
        contenders.append((f"cv2.aruco {family.name}", [partial(find.detectMarkers, image) for image in images]))
    for _, calls in contenders:
        calls[0]()
    times = np.empty((len(contenders), len(shots)))
    for k in range(len(shots)):
        for row, (_, calls) in enumerate(contenders):
            start = time.process_time()
            calls[k]()
            times[row, k] = 1000 * (time.process_time() - start)
    return [
        Timing(what, name, float(np.median(t)), float(t.mean()), float(t.max()))
        for (what, _), t in zip(contenders, times, strict=True)
    ]


def _decode_bytes(jpeg: bytes) -> object:
    return decode_plates(load_image(jpeg).pixels)


def _tagged(shot: Shot, family: TagFamily, seed: int) -> Image:
    if shot.code is None or shot.conditions is None:
        return shot.frame.image
    return replace_face(shot, tag_face(family, 7, shot.conditions, np.random.default_rng(seed))).image
