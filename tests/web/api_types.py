"""``python -m tests.web.api_types``: write static/app/api/schema.d.ts from our OpenAPI document; ``--check`` compares.

Needs node and `npm ci`, see docs/web-pages.md.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from app.main import create_app
from app.settings import Settings

ROOT = Path(__file__).resolve().parents[2]
TYPES = ROOT / "static/app/api/schema.d.ts"


def made_types() -> str:
    """The TypeScript types of the API."""
    with tempfile.TemporaryDirectory() as folder:
        document = Path(folder) / "openapi.json"
        api = _without_texts(create_app(Settings(data_dir=Path(folder))).openapi())
        del api["components"]["responses"]  # the problems
        document.write_text(json.dumps(api))
        command = [
            ROOT / "node_modules/.bin/openapi-typescript",
            document,
            "--default-non-nullable=false",
            "--alphabetize",
        ]
        run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if run.returncode:
        raise SystemExit(run.stderr)
    return run.stdout


def _without_texts(part: Any, *, names: bool = False) -> Any:
    """The document without descriptions and examples, which /docs shows, and without the problems, which are all alike.

    `names`: the keys of this part are names of ours.
    """
    if isinstance(part, list):
        return [_without_texts(item) for item in part]
    if not isinstance(part, dict):
        return part
    return {
        name: _without_texts(value, names=not names and name in ("properties", "schemas", "paths"))
        for name, value in part.items()
        if not (len(name) == 3 and name[0] in "45" and name.isdigit())
        and (names or (name not in ("title", "examples", "example") and (name != "description" or "content" in part)))
    }


def main() -> None:
    """Write the types, or compare them."""
    parser = argparse.ArgumentParser(prog="python -m tests.web.api_types", description=__doc__)
    parser.add_argument("--check", action="store_true", help="change nothing; exit with 1 if they are not current")
    made = made_types()
    if parser.parse_args().check:
        if TYPES.read_text() != made:
            sys.exit(f"{TYPES.relative_to(ROOT)} is not that of the API: run python -m tests.web.api_types")
        return
    TYPES.write_text(made)


if __name__ == "__main__":
    main()
