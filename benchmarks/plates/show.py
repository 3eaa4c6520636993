"""``python -m benchmarks.plates.show SET INDEX NUMBER [--seed N] [--short] [--out FILE]``: a frame as a picture.

The frame is written twice: whole, and the surroundings of its plate enlarged (``FILE`` with ``-plate``).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from app.decoders.plate.reader import decode_plates
from benchmarks.plates.__main__ import BATCH, COUNTS, SHORT_SHARE
from benchmarks.plates.sets import SETS, Job, Shot, find_shot


def main() -> None:
    """Write the frame asked for and print the truth and the readings."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.plates.show", description=__doc__)
    parser.add_argument("set_name", choices=SETS)
    parser.add_argument("index", type=int)
    parser.add_argument("number", type=int)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--short", action="store_true", help="as the short mode draws it")
    parser.add_argument("--out", type=Path, default=Path("bench-out/frame.png"))
    args = parser.parse_args()
    share = SHORT_SHARE if args.short and args.set_name == "trial" else 1.0
    frames = BATCH if args.set_name not in COUNTS else min(BATCH, COUNTS[args.set_name][args.short])
    shot = find_shot(Job(args.set_name, args.index, args.seed, frames, share), args.number)
    if not isinstance(shot, Shot):
        print(f"the plate is {shot.height_px:.1f} rows high and was not rendered")
        return
    args.out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(args.out), shot.frame.image)
    if shot.code is not None:
        truth = shot.frame.truths[0]
        print(f"truth {shot.code.digits}, {truth.height_px:.1f} rows, corners {truth.corners_px.round(2).tolist()}")
        cv2.imwrite(str(args.out.with_stem(args.out.stem + "-plate")), _enlarged(shot.frame.image, truth.corners_px))
    print(f"scene {shot.scene}\nconditions {shot.conditions}")
    for reading in decode_plates(shot.frame.image, camera=shot.camera, thermal=shot.thermal):
        corners = None if reading.corners_px is None else reading.corners_px.round(2).tolist()
        print(f"{reading.outcome}: {reading.digits}, confidence {reading.confidence:.4f}, {corners}, {reading.reason}")


def _enlarged(image: np.ndarray, corners_px: np.ndarray) -> np.ndarray:
    margin = 0.3 * (corners_px.max(axis=0) - corners_px.min(axis=0)) + 8
    low = np.clip(corners_px.min(axis=0) - margin, 0, None).astype(int)
    high = (corners_px.max(axis=0) + margin).astype(int)
    part = image[low[1] : high[1], low[0] : high[0]]
    scale = max(800 // max(part.shape[:2]), 1)
    return cv2.resize(part, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)


if __name__ == "__main__":
    main()
