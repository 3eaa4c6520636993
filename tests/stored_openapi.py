"""``python -m tests.stored_openapi``: write the OpenAPI document that the server sends, after a change of the API."""

from __future__ import annotations

import tempfile
from pathlib import Path

from app.api.http.openapi import STORED, stored_text
from app.main import create_app
from app.settings import Settings


def main() -> None:
    """Write it."""
    with tempfile.TemporaryDirectory() as folder:
        document = create_app(Settings(data_dir=Path(folder))).openapi()
    STORED.parent.mkdir(exist_ok=True)
    STORED.write_text(stored_text(document), encoding="utf-8")


if __name__ == "__main__":
    main()
