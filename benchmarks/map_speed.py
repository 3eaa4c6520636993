"""``python -m benchmarks.map_speed [--markers N] [--folder FOLDER]``: the map of the markers' page in Chromium.

A server on SQLite with markers along roads, a million by default. Measured are the first view (from the request of the
page until the map shows as many markers as are registered), the same in a new profile of the browser and after a
reload, the view after a closer look, and how many frames a second the map draws while it moves. Chromium draws without
a graphics card, so a computer with one is faster. A folder is filled once and used again.
"""

from __future__ import annotations

import argparse
import re
import tempfile
import time
from pathlib import Path

from playwright.sync_api import Page

from app.registry.database import Database
from benchmarks.planning.tables import table
from benchmarks.registry.fill import AREA_DEG, fill, lay_roads
from benchmarks.registry.servers import waymark
from tests.web.browsing import Watched, chromium, watched_page

GOAL_FIRST_S = 2.0
GOAL_FRAMES_PER_S = 20.0
_MOVES_MS = 4000
_WITHIN_S = 120.0
_PAN = """(milliseconds) => new Promise((resolve) => {
  const box = document.querySelector(".map canvas").getBoundingClientRect();
  const canvas = document.querySelector(".map canvas");
  const [x, y] = [box.left + box.width / 2, box.top + box.height / 2];
  const send = (kind, dx, dy) => canvas.dispatchEvent(new MouseEvent(kind, {
    bubbles: true, clientX: x + dx, clientY: y + dy, button: 0, buttons: kind === "mouseup" ? 0 : 1, view: window }));
  send("mousedown", 0, 0);
  const start = performance.now();
  let frames = 0, worst = 0, last = start;
  const step = (now) => {
    frames += 1;
    worst = Math.max(worst, now - last);
    last = now;
    const angle = (now - start) / 600;
    send("mousemove", 150 * Math.sin(angle), 100 * Math.cos(angle));
    if (now - start < milliseconds) requestAnimationFrame(step);
    else { send("mouseup", 0, 0); resolve({ per_s: 1000 * frames / (now - start), worst_ms: worst }); }
  };
  requestAnimationFrame(step);
})"""


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.map_speed", description=__doc__)
    parser.add_argument("--markers", type=int, default=1_000_000)
    parser.add_argument("--folder", type=Path, help="where the registry is kept; without it, it is made and removed")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        folder = arguments.folder or Path(made)
        url, key = _filled(folder, arguments.markers)
        with waymark(url, folder) as port, chromium() as browser:
            address = f"http://127.0.0.1:{port}"
            with watched_page(browser, address, key) as watched:
                first_s = _open(watched, arguments.markers)
            with watched_page(browser, address, key) as watched:
                rows = _measure(watched, arguments.markers, first_s)
    print(f"\n### map-speed\n\n{arguments.markers} markers on SQLite, a window of 1440 x 900, no graphics card.\n")
    print(table(("figure", "ours", "goal", "met"), rows))


def _measure(watched: Watched, markers: int, first_s: float) -> list[tuple[str, str, str, str]]:
    other_s = _open(watched, markers)
    again_s = _open(watched, markers)
    whole = watched.page.evaluate(_PAN, _MOVES_MS)
    west, south, width, height = AREA_DEG
    rows = [
        (
            "view, server and browser just started [s]",
            f"{first_s:.2f}",
            f"{GOAL_FIRST_S:g}",
            _met(first_s <= GOAL_FIRST_S),
        ),
        ("first view of another person [s]", f"{other_s:.2f}", f"{GOAL_FIRST_S:g}", _met(other_s <= GOAL_FIRST_S)),
        ("view again [s]", f"{again_s:.2f}", f"{GOAL_FIRST_S:g}", _met(again_s <= GOAL_FIRST_S)),
        _moved("all markers", whole),
    ]
    for zoom in (9, 12):
        start = time.monotonic()
        watched.open(f"/markers?view=map&map={west + width / 2},{south + height / 2},{zoom}")
        _wait_for_markers(watched.page, 1)
        rows.append((f"view at zoom {zoom} [s]", f"{time.monotonic() - start:.2f}", f"{GOAL_FIRST_S:g}",
                     _met(time.monotonic() - start <= GOAL_FIRST_S)))  # fmt: skip
        rows.append(_moved(f"zoom {zoom}", watched.page.evaluate(_PAN, _MOVES_MS)))
    return rows


def _open(watched: Watched, markers: int) -> float:
    start = time.monotonic()
    watched.open("/markers?view=map")
    _wait_for_markers(watched.page, markers)
    return time.monotonic() - start


def _wait_for_markers(page: Page, at_least: int) -> None:
    """Wait until the caption counts so many on the map."""
    until = time.monotonic() + _WITHIN_S
    while True:
        found = page.evaluate("() => document.querySelector('.map-caption')?.textContent ?? ''")
        if int(re.sub(r"\D", "", found) or 0) >= at_least:
            return
        if time.monotonic() > until:
            raise TimeoutError(f"the map never showed {at_least} markers: {found!r}")
        page.wait_for_timeout(20)


def _moved(what: str, frames: dict[str, float]) -> tuple[str, str, str, str]:
    rate = f"{frames['per_s']:.0f} (longest {frames['worst_ms']:.0f} ms)"
    return (
        f"frames a second while it moves, {what}", rate, f"{GOAL_FRAMES_PER_S:g}",
        _met(frames["per_s"] >= GOAL_FRAMES_PER_S),
    )  # fmt: skip


def _met(is_met: bool) -> str:
    return "yes" if is_met else "**no**"


def _filled(folder: Path, markers: int) -> tuple[str, str]:
    """URL of the registry in a folder, and a key; filled if it is not there."""
    path, key_path = folder / "waymark.sqlite3", folder / f"key-of-{markers}"
    url = f"sqlite:///{path}"
    if not key_path.exists():
        database = Database(url)
        database.open()
        database.migrate()
        key = fill(database, lay_roads(markers))
        database.close()
        key_path.write_text(key)
    return url, key_path.read_text()


if __name__ == "__main__":
    main()
