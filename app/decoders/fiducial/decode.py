"""Grey values of modules -> the most likely code, with its posterior probability.

A square is a sign with one of the codewords that are looked for, or it is something else: an edge of a window, a road
marking, a plate. Each module votes with the likelihood of its grey value, so a damaged or blurred module costs little
and a clean one that contradicts the codeword costs much. What is not a sign is either noise (each module dark or light
at random) or a smooth pattern (neighbouring modules mostly alike), and the more squares a frame has, the likelier one
of them looks like a codeword by chance. So small dictionaries, such as AprilTag 16h5, are only read where the registry
expects the sign, and large ones also elsewhere; there is no other threshold.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from app.decoders.fiducial.pose import locate_fiducial
from app.decoders.fiducial.reading import FiducialOutcome, FiducialReading
from app.decoders.fiducial.sample import Floats, Image, SampledSquare, detect_squares, refine_corners, sample_square
from app.markers.fiducial import FiducialCode, KnownFiducial, codewords, get_dictionary
from app.sensors.camera import Camera

VERSION = "fiducial/1"
SURE = 0.99
"""Least posterior probability at which a code is returned. Source: as of plates with check digits, chosen by hand."""
DEFAULT_DICTIONARIES = ("apriltag-36h11", "aruco-mip-36h12", "aruco-6x6-250", "aruco-5x5-250", "apriltag-25h9")
"""Looked for besides the registered ones: dictionaries that are strong enough to be read without a registry."""
_EXPECTED = 0.9  # [-] prior share of the registered signs near by among the signs in view; chosen by hand
_MIN_SPREAD = 0.1  # [-] of a module's darkness: blur and uneven print; chosen by hand
_DAMAGED = 0.02  # [-] probability that a module shows nothing of its code: dirt, reflections; chosen by hand
_MIN_SQUARES = 20  # [-] squares for each sign that a frame has at least, a priori; chosen by hand
_CHANGE = 0.15  # [-] probability that neighbouring modules of a smooth pattern differ; chosen by hand
_WORTH_NAMING = 0.5  # [-] candidates whose best code is less likely are left out; source: more likely no sign than one


@dataclass(frozen=True, slots=True)
class _Best:
    """The most likely code of a square."""

    code: FiducialCode
    turns: int
    posterior: float
    bit_errors: int


def decode_fiducials(
    pixels: npt.NDArray[np.uint8],
    *,
    known: Sequence[KnownFiducial] = (),
    camera: Camera | None = None,
    dictionaries: Sequence[str] = DEFAULT_DICTIONARIES,
) -> list[FiducialReading]:
    """Fiducial signs in a frame.

    Parameters
    ----------
    pixels : ndarray of uint8, shape (H, W, 3) BGR or (H, W) grey
    known : sequence of KnownFiducial
        Signs that are registered near by; only these have poses.
    camera : Camera, optional
        Of the frame; without it there are no poses.
    dictionaries : sequence of str
        Looked for besides those of the known signs.

    Returns
    -------
    list of FiducialReading
        In the order of their codes; candidates that are probably no signs are left out.
    """
    grey = pixels if pixels.ndim == 2 else np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    squares = detect_squares(grey)
    names = tuple(dict.fromkeys((*(sign.code.dictionary for sign in known), *dictionaries)))
    readings = [
        reading
        for corners in squares
        if (reading := _read_square(grey, corners, names, known, camera, squares=len(squares))) is not None
    ]
    return sorted(_nearest_copies(readings), key=lambda reading: (reading.code is None, _text(reading)))


def _text(reading: FiducialReading) -> str:
    return reading.code.text if reading.code is not None else ""


def _nearest_copies(readings: Sequence[FiducialReading]) -> list[FiducialReading]:
    """The readings without those whose centre lies inside a surer one: a border has an inner edge too."""
    kept: list[FiducialReading] = []
    for reading in sorted(readings, key=lambda reading: -reading.confidence):
        centre = reading.corners_px.mean(axis=0)
        if not any(_holds(other.corners_px, centre) for other in kept):
            kept.append(reading)
    return kept


def _holds(corners_px: Floats, point_px: Floats) -> bool:
    return cv2.pointPolygonTest(corners_px.astype(np.float32), (float(point_px[0]), float(point_px[1])), False) >= 0


def _read_square(
    grey: Image,
    corners_px: Floats,
    names: Sequence[str],
    known: Sequence[KnownFiducial],
    camera: Camera | None,
    *,
    squares: int,
) -> FiducialReading | None:
    """The reading of a square; None of one that is probably no sign."""
    best: _Best | None = None
    sampled: SampledSquare | None = None
    for n in sorted({get_dictionary(name).modules for name in names}):
        square = sample_square(grey, corners_px, n)
        if square is None:
            continue
        found = _most_likely(square, [name for name in names if get_dictionary(name).modules == n], known, squares)
        if best is None or found.posterior > best.posterior:
            best, sampled = found, square
    if best is None or sampled is None or best.posterior < _WORTH_NAMING:
        return None
    refined = np.roll(refine_corners(grey, sampled), -best.turns, axis=0)
    is_sure = best.posterior >= SURE
    sign = next((sign for sign in known if sign.code.text == best.code.text), None)
    code = sign.code if sign is not None else best.code
    pose = locate_fiducial(refined, sign.geometry, camera) if is_sure and sign and camera else None
    return FiducialReading(
        outcome=FiducialOutcome.READ if is_sure else FiducialOutcome.UNSURE,
        corners_px=refined,
        code=code if is_sure else None,
        confidence=best.posterior,
        bit_errors=best.bit_errors,
        contrast=sampled.contrast,
        side_px=float(np.linalg.norm(refined - np.roll(refined, 1, axis=0), axis=1).mean()),
        pose=pose,
        reason="" if is_sure else f"{best.code.text} at {best.posterior:.3f}, {SURE:g} is needed",
    )


def _most_likely(square: SampledSquare, names: Sequence[str], known: Sequence[KnownFiducial], squares: int) -> _Best:
    """Posterior of the best code among the codewords, noise and smooth patterns."""
    dark, light = _log_likelihoods(square)
    words = np.concatenate([codewords(name) for name in names]).astype(np.float64)
    owners = [(name, number) for name in names for number in range(len(codewords(name)))]
    priors = _log_priors(owners, known)
    # a square's corners may begin at any corner: the darkness is turned back by each number of quarter turns
    scores = np.stack(
        [
            np.tensordot(words, np.rot90(dark, turns), 2) + np.tensordot(1.0 - words, np.rot90(light, turns), 2)
            for turns in range(4)
        ]
    )
    scores += priors - math.log(4.0)
    turns, index = np.unravel_index(int(np.argmax(scores)), scores.shape)
    rivals = np.array([*_log_other(dark, light, squares), _log_sum(_without_copies(scores, words, index))])
    best = float(scores[turns, index])
    read = np.rot90(square.darkness, int(turns)) > 0.5
    return _Best(
        FiducialCode(*owners[int(index)]),
        int(turns),
        float(1.0 / (1.0 + np.exp(rivals - best).sum())),
        int(np.count_nonzero(read != (words[index] > 0.5))),
    )


def _log_likelihoods(square: SampledSquare) -> tuple[Floats, Floats]:
    """Log-likelihood of each module's value if it is dark, and if it is light; shape (n, n) each."""
    spread = max(square.spread, _MIN_SPREAD)

    def of(level: float) -> Floats:
        fits = np.exp(-0.5 * ((square.darkness - level) / spread) ** 2)
        return np.log((1 - _DAMAGED) * fits + _DAMAGED * 0.5)

    return of(1.0), of(0.0)


def _log_priors(owners: Sequence[tuple[str, int]], known: Sequence[KnownFiducial]) -> Floats:
    """Prior of each codeword: the registered signs near by share 0.9, all codewords the rest."""
    expected = {sign.code.text for sign in known}
    texts = [f"{get_dictionary(name).series}-{number}" for name, number in owners]
    is_expected = np.array([text in expected for text in texts])
    rest = (1.0 - _EXPECTED if is_expected.any() else 1.0) / len(owners)
    share = _EXPECTED / len(expected) if expected else 0.0
    return np.log(np.where(is_expected, share + rest, rest))


def _log_other(dark: Floats, light: Floats, squares: int) -> tuple[float, float]:
    """Log-evidence that a square is noise, and that it is a smooth pattern, by how many squares the frame has."""
    odds = math.log(max(squares, _MIN_SQUARES))
    noise = float(np.logaddexp(dark, light).sum()) + dark.size * math.log(0.5)
    smooth = math.log(0.5)
    ahead = np.array([dark[0, 0], light[0, 0]])  # forward pass over the modules, row by row, of a two-state chain
    step = np.log(np.array([[1 - _CHANGE, _CHANGE], [_CHANGE, 1 - _CHANGE]]))
    for row in range(len(dark)):
        columns = range(len(dark)) if row % 2 == 0 else range(len(dark) - 1, -1, -1)  # there and back: neighbours touch
        for column in columns:
            if row == column == 0:
                continue
            values = np.array([dark[row, column], light[row, column]])
            ahead = np.logaddexp(ahead[0] + step[0], ahead[1] + step[1]) + values
    smooth += float(np.logaddexp(*ahead))
    return noise + odds + math.log(0.5), smooth + odds + math.log(0.5)


def _without_copies(scores: Floats, words: Floats, index: Any) -> Floats:
    """Scores of the codewords that look different from the best one."""
    others = np.any(words != words[index], axis=(1, 2))
    return np.asarray(scores[:, others].ravel(), dtype=np.float64)


def _log_sum(values: Floats) -> float:
    return float(np.logaddexp.reduce(values)) if len(values) else -math.inf
