"""``python -m benchmarks.video [--short] [--seed N] [--minutes M]``: render a drive as a video and decode it.

The long mode drives ten minutes at 1080p30, the short one ten seconds. Times are processor time of one core, all in:
index, codec, search, decoder. The same video is decoded without a registry, and with one that holds nine of ten plates.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from app.markers.plate import PlateCode
from benchmarks.video.drive import CAMERA, DriveShape, PassedPlate, kept_drive
from benchmarks.video.measure import VideoScore, measure_video

REGISTERED_SHARE = 0.9
"""[1] of the plates that the registry of the second run holds. Source: chosen by hand."""
SHORT_S, SHORT_SPACING_M = 10.0, 25.0
REAL_TIME_MS = 1000 / 30


def main() -> None:
    """Render, decode, print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.video", description=__doc__)
    parser.add_argument("--short", action="store_true", help="ten seconds with a plate every 25 m")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seeds", type=int, default=1, help="drives, with successive seeds")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--spacing", type=float, default=60.0, help="distance of the plates [m]")
    parser.add_argument("--preset", default="veryfast", help="of x264")
    parser.add_argument("--crf", type=int, default=23, help="quality of x264: smaller is better")
    parser.add_argument("--keep", type=Path, help="folder for rendered drives, which the next run takes from there")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    rows: dict[str, list[VideoScore]] = {"none": [], "nine of ten plates": []}
    size_bytes = 0
    seconds = SHORT_S if args.short else 60 * args.minutes
    for seed in range(args.seed, args.seed + args.seeds):
        shape = DriveShape(seconds, spacing_m=SHORT_SPACING_M if args.short else args.spacing, seed=seed)
        with tempfile.TemporaryDirectory() as folder:
            path = (args.keep or Path(folder)) / f"{seconds:g}s_{shape.spacing_m:g}m_crf{args.crf}_{seed}.mp4"
            truth = kept_drive(path, shape, preset="ultrafast" if args.short else args.preset, crf=args.crf)
            size_bytes += path.stat().st_size
            rows["none"].append(measure_video(path, truth, CAMERA))
            rows["nine of ten plates"].append(measure_video(path, truth, CAMERA, _registry(truth, seed)))
    print("### video\n")
    print(
        f"Seeds {args.seed} to {args.seed + args.seeds - 1}: {seconds * args.seeds:.0f} s at 1080p30 and 25 m/s, "
        f"{8e-6 * size_bytes / (seconds * args.seeds):.1f} Mbit/s.\n"
    )
    print(_table(rows))
    alone = rows["none"]
    pairs = [value for score in alone for value in score.correlations]
    if pairs:
        print(f"Correlation of two frames' residuals: median {np.median(pairs):.2f} over {len(pairs)} pairs.")
    expected = sum(score.doubt for score in alone)
    print(f"Expected number of wrong plates without a registry, by the reported confidences: {expected:.3f}.")
    for name, scores in rows.items():
        for score in scores:
            for missed in score.wrong:
                print(f"Wrong, registry {name}: {missed}")


def _registry(truth: Sequence[PassedPlate], seed: int) -> list[PlateCode]:
    rng = np.random.default_rng([seed, 3])
    return [plate.code for plate in truth if rng.random() < REGISTERED_SHARE]


def _table(rows: dict[str, list[VideoScore]]) -> str:
    lines = [
        "| registry | frames a second, one core | ms a frame | plates | read from single frames | read from all frames "
        "| under degradations | single | all | wrong, single | wrong, all |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, scores in rows.items():
        frames = sum(score.frames for score in scores)
        ms = 1e3 * sum(score.processor_s for score in scores) / frames
        counts = [
            sum(getattr(score, field) for score in scores)
            for field in ("plates", "alone", "together", "hard", "hard_alone", "hard_together", "wrong_alone",
                          "wrong_together")
        ]  # fmt: skip
        lines.append(f"| {name} | {1e3 / ms:.0f} | {ms:.1f} | " + " | ".join(map(str, counts)) + " |")
    return "\n".join(lines) + f"\n\nReal time at 30 Hz is {REAL_TIME_MS:.1f} ms a frame."


if __name__ == "__main__":
    main()
