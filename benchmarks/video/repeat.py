"""``python -m benchmarks.video.repeat [--videos N] [--frames F]``: one decoder process decodes a video many times.

Prints failures, memory and threads of the process after the first videos and after the last, and how often a process
was started: without a fault that is once.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import psutil

from app.decoders.plate.reader import decode_plates
from app.decoding.frames import PlateSearch
from app.families.plate.plates import PLATE
from app.formats.format import SpooledFile
from app.formats.video_file import VideoFile, VideoKind
from app.jobs.decoder_process import process_id
from app.jobs.pool import DecodePool
from app.markers.plate import EXPECTED_GEOMETRIES
from app.services.decodes.video_tasks import decode_segment, index_frames
from benchmarks.video.drive import CAMERA, DriveShape, write_drive

SPEED_M_S, SPACING_M, RATE_HZ = 25.0, 5.0, 30.0
WARM = 10
"""Videos after which the first memory is taken. Source: by hand; a process then has its buffers."""


@dataclass(frozen=True, slots=True)
class ProcessUse:
    """What a decoder process holds and used: resident and private memory [MB], threads, processor time [s]."""

    resident_mb: float
    private_mb: float
    threads: int
    processor_s: float

    @staticmethod
    def of(pid: int) -> ProcessUse:
        """Of a process now."""
        process = psutil.Process(pid)
        memory, times = process.memory_info(), process.cpu_times()
        return ProcessUse(memory.rss / 1e6, memory.data / 1e6, process.num_threads(), times.user + times.system)


def main() -> None:
    """Render a video, decode it many times, print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.video.repeat", description=__doc__)
    parser.add_argument("--videos", type=int, default=500)
    parser.add_argument("--frames", type=int, default=12, help="of the video")
    args = parser.parse_args()
    failures: dict[str, int] = {}
    uses: list[ProcessUse] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.mp4"
        shape = DriveShape(args.frames / RATE_HZ, RATE_HZ, SPEED_M_S, SPACING_M)
        write_drive(path, shape, preset="ultrafast")
        pool = DecodePool(decode_plates, workers=1)
        pool.open()
        try:
            for number in range(args.videos):
                try:
                    _decode(pool, path)
                except Exception as error:  # noqa: BLE001 - every failure is counted
                    why = f"{type(error).__name__}: {str(error)[:80]}"
                    failures[why] = failures.get(why, 0) + 1
                uses.append(ProcessUse.of(pool.run(process_id)))
                if number % 50 == WARM:
                    print(number, uses[-1], sum(failures.values()), "failures", file=sys.stderr, flush=True)
            starts = pool.describe().starts
        finally:
            pool.close()
    print("| videos | failures | resident MB | private MB | threads | process starts | processor s a video |")
    print("|---|---|---|---|---|---|---|")
    first, last = uses[min(WARM, len(uses)) - 1], uses[-1]
    print(
        f"| {args.videos} | {sum(failures.values())} | {first.resident_mb:.0f} to {last.resident_mb:.0f} "
        f"| {first.private_mb:.0f} to {last.private_mb:.0f} | {first.threads} to {last.threads} | {starts} "
        f"| {(last.processor_s - first.processor_s) / max(len(uses) - WARM, 1):.2f} |"
    )
    steps = range(0, len(uses), max(len(uses) // 10, 1))
    print(f"\nPrivate MB: {', '.join(f'{uses[k].private_mb:.0f}' for k in steps)}.")
    print(f"Most: {max(u.private_mb for u in uses):.0f} MB private, {max(u.threads for u in uses)} threads.")
    for why, count in failures.items():
        print(f"{count} times {why}")


def _decode(pool: DecodePool, path: Path) -> None:
    index = pool.run(index_frames, VideoFile(SpooledFile.at(path), VideoKind.MP4))
    wanted = {PLATE.name: PlateSearch(CAMERA, (), EXPECTED_GEOMETRIES)}
    for number in range(len(index.segments)):
        pool.run(decode_segment, index, number, wanted)


if __name__ == "__main__":
    main()
