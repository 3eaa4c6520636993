"""``python -m benchmarks.screens``: pictures of every web page in bench-out/screens: light and dark, wide and phone."""

from __future__ import annotations

import argparse
import re
import tempfile
from pathlib import Path

from app.demo.server import LocalServer
from tests.web.browsing import DESKTOP, PHONE, Watched, chromium, watched_page
from tests.web.demo_data import fill
from tests.web.test_pages import PAGES, wait_until_quiet

OUT = Path("bench-out/screens")
_SIZES = {"wide": DESKTOP, "phone": PHONE}
_MAP_SETTLES_MS = 3000


def main() -> None:
    """Make them, or those whose address contains a text."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.screens", description=__doc__)
    parser.add_argument("part", nargs="?", default="", help="only pages whose address contains this")
    parser.add_argument("--language", choices=("en", "de"), default="en")
    arguments = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, LocalServer(Path(folder)) as server, chromium() as browser:
        with server.client() as client:
            ids = fill(client)
        for name, size in _SIZES.items():
            for scheme in ("light", "dark"):
                options = {"color_scheme": scheme, "reduced_motion": "reduce", "locale": arguments.language}
                with watched_page(browser, server.url, None, size, **options) as signed_out:
                    signed_out.open("/markers")
                    signed_out.page.wait_for_selector(".sign-in")
                    _save(signed_out, f"sign-in-{name}-{scheme}")
                with watched_page(browser, server.url, server.key, size, **options) as watched:
                    for path in (page for page in PAGES if arguments.part in page):
                        watched.open(path.format(**ids))
                        wait_until_quiet(watched)
                        if watched.page.locator(".map").count() or "/markers/" in path:
                            watched.page.wait_for_timeout(_MAP_SETTLES_MS)
                        _save(watched, f"{_file_name(path)}-{name}-{scheme}")
    print(f"{len(list(OUT.glob('*.png')))} pictures are in {OUT}")


def _file_name(path: str) -> str:
    return re.sub(r"[^a-z]+", "-", path).strip("-") or "home"


def _save(watched: Watched, name: str) -> None:
    watched.page.screenshot(path=OUT / f"{name}.png")


if __name__ == "__main__":
    main()
