"""``python -m benchmarks.bundle [--plates N]``: artwork of many plates as PDF and SVG in one ZIP, each read back.

One thread, from orders to the finished file; drawing, proof, writing and compression are inside the clock.
"""

from __future__ import annotations

import argparse
import tempfile
import time

import cv2
import numpy as np
import numpy.typing as npt

from app.decoders.plate.reader import decode_plates
from app.encoders.plate import BundleOptions, PlateOrder, write_bundle
from app.markers.plate import PlateCode, PlateGeometry
from app.markers.reading import PlateReading
from benchmarks.plates.tables import table

GOAL_S = 10.0
GOAL_PLATES = 1000
_STEP_DEG = 0.000271


def list_orders(count: int) -> list[PlateOrder]:
    """Plates 20 m apart."""
    orders = []
    for k in range(count):
        lon_deg, lat_deg = 8.4 + k * _STEP_DEG, 49.0
        code = PlateCode.from_position(lon_deg, lat_deg)
        url = f"https://waymark.example/v1/markers/{k:08d}"
        orders.append(PlateOrder(f"P{k:06d}", code, PlateGeometry(), record_url=url, lon_deg=lon_deg, lat_deg=lat_deg))
    return orders


def read_face(image: npt.NDArray[np.uint8], geometry: PlateGeometry) -> list[PlateReading]:
    """The decoder as the service hands it to the proof."""
    return decode_plates(image, geometries=(geometry,))


def main() -> int:
    """Print one table; the exit status says whether the goal was met."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bundle", description=__doc__)
    parser.add_argument("--plates", type=int, default=GOAL_PLATES)
    count = parser.parse_args().plates
    cv2.setNumThreads(1)
    with tempfile.TemporaryFile() as warm:
        write_bundle(list_orders(3), warm, read=read_face)
    rows, met = [], True
    for name, reader in (("with proof", read_face), ("without proof", None)):
        orders = list_orders(count)
        with tempfile.TemporaryFile() as target:
            wall, cpu = time.perf_counter(), time.process_time()
            write_bundle(orders, target, options=BundleOptions(), read=reader)
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            size_mb = target.tell() / 1e6
        goal = GOAL_S * count / GOAL_PLATES
        good = reader is None or wall <= goal
        met &= good
        rows.append(
            (f"{count} plates, {name}", f"{wall:.2f}", f"{cpu:.2f}", f"{1e3 * wall / count:.2f}", f"{size_mb:.1f}")
            + ((f"{goal:g}", "yes" if good else "**no**") if reader else ("-", "-"))
        )
    head = ("PDF + SVG in one ZIP", "wall s", "CPU s", "ms a plate", "MB", "goal s", "met")
    print(f"### bundle\n\n{table(head, rows)}")
    return 0 if met else 1


if __name__ == "__main__":
    raise SystemExit(main())
