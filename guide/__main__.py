"""``python -m guide``: build the guide into build/guide. `make docs` calls it."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from guide.build import ROOT, GuideError, build_guide


def main() -> int:
    """Build it; a fault of a document, such as a link that leads nowhere, is an error."""
    parser = argparse.ArgumentParser(prog="python -m guide", description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "guide", help="folder to write (build/guide)")
    out = parser.parse_args().out
    try:
        build_guide(out)
    except GuideError as error:
        print(f"The guide was not built:\n{error}", file=sys.stderr)
        return 1
    print(f"{out}: {len(list(out.rglob('*.html')))} pages; `waymark serve` shows them at /guide")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
