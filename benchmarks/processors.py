"""What a portable target costs: the same kernels for this processor's own type and for the level that others share.

`python -m benchmarks.processors` runs each target in a process of its own with a cache of its own, in turn, and prints
the processor time of each kind of upload (medians over the repetitions), and of the compilation.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path


def targets() -> dict[str, dict[str, str]]:
    """Numba's settings by the name of a target: this processor's own, and the one that the product chooses."""
    from llvmlite import binding

    from app.compiled import portable_target

    extensions = dict(binding.get_host_cpu_features())
    own = {"NUMBA_CPU_NAME": binding.get_host_cpu_name(), "NUMBA_CPU_FEATURES": extensions_text(extensions)}
    return {"own": own, "portable": portable_target(platform.machine(), extensions) or own}


def extensions_text(extensions: dict[str, bool]) -> str:
    """Extensions in LLVM's form."""
    return ",".join(f"{'+' if has else '-'}{name}" for name, has in sorted(extensions.items()))


def uploads() -> dict[str, Callable[[], object]]:
    """What is measured: a frame with a plate, one without, a trace and a track."""
    import cv2
    import numpy as np

    from app.decoders.magnet.decoder import decode_trace
    from app.decoders.plate.reader import decode_plates
    from app.formats.traces.declaration import TraceDeclaration
    from app.formats.traces.read import read_trace
    from app.jobs.compile_kernels import short_track
    from app.sensors.magnetometer_bar import MagnetometerBar
    from app.tracks.estimate import estimate_track

    cv2.setNumThreads(1)
    pictures = Path(__file__).resolve().parents[1] / "docs/images"
    frame = np.asarray(cv2.imread(str(pictures / "frame.jpg")), np.uint8)
    empty = np.ascontiguousarray(frame[:, ::-1])
    empty[empty.shape[0] // 3 :] = cv2.GaussianBlur(empty[empty.shape[0] // 3 :], (0, 0), 9)
    archive = (pictures / "drive.zip").read_bytes()
    trace = read_trace({"drive.zip": archive}, TraceDeclaration()).trace
    bar, track = MagnetometerBar.metro(), short_track()
    return {
        "frame": lambda: decode_plates(frame),
        "empty frame": lambda: decode_plates(empty),
        "trace": lambda: decode_trace(trace, bar),
        "track": lambda: estimate_track(track),
    }


def measure(repetitions: int) -> dict[str, float]:
    """Processor seconds of the first run of all, which compiles, and milliseconds of each upload."""
    began = time.process_time()
    found = uploads()
    for run in found.values():
        run()
    result = {"compile [s]": time.process_time() - began}
    for name, run in found.items():
        spent = []
        for _ in range(repetitions):
            began = time.process_time()
            run()
            spent.append(1e3 * (time.process_time() - began))
        result[f"{name} [ms]"] = statistics.median(spent)
    return result


def main() -> None:
    """Print a table of the targets."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repetitions", type=int, default=15, help="runs of each upload (15)")
    parser.add_argument("--rounds", type=int, default=2, help="processes of each target, in turn (2)")
    parser.add_argument("--measure", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        print(json.dumps(measure(arguments.repetitions)))
        return
    rows: dict[str, list[dict[str, float]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(arguments.rounds):
            for name, target in targets().items():
                own = target | {"NUMBA_CACHE_DIR": f"{folder}/{name}"}
                command = [sys.executable, "-m", "benchmarks.processors", "--measure"]
                command += ["--repetitions", str(arguments.repetitions)]
                done = subprocess.run(command, env=os.environ | own, stdout=subprocess.PIPE, text=True, check=True)
                rows.setdefault(f"{name}: {target['NUMBA_CPU_NAME']}", []).append(json.loads(done.stdout))
    first = next(iter(rows.values()))[0]
    print("| target | " + " | ".join(first) + " |\n|" + "---|" * (len(first) + 1))
    for name, measured in rows.items():
        cells = [max(one[column] for one in measured) if "[s]" in column else min(one[column] for one in measured)
                 for column in first]  # fmt: skip
        print(f"| {name} | " + " | ".join(f"{cell:.1f}" for cell in cells) + " |")


if __name__ == "__main__":
    main()
